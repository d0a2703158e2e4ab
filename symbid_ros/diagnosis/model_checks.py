"""The checks against a model in an order in which one fault is not taken for another.

An IMU's mounting is seen by kinematics alone, so it comes first. Signs, frames and gains of
forces are found together. Delays and excitation are asked of what is right so far.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.forces import (
    FURTHEST,
    PLAINER,
    check_forces,
    reversed_finding,
    turned_finding,
)
from symbid_ros.diagnosis.gains import (
    GainEstimate,
    GainProblem,
    estimate_delays,
    estimate_gains,
    find_late_streams,
    fit_imu_rotation,
    loads,
)
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stance_gyro_check import (
    DEVIATIONS,
    LARGEST_ANGLE,
    fit_gyro,
    is_told,
    mounting_findings,
)
from symbid_ros.estimation.verdict import DETERMINED
from symbid_ros.signals.weak_form import INFLATION

# Identification's windows see no shift below this, s.
LARGEST_DELAY = 3e-3

# Share of a load that a good sensor cannot tell: what moves less is no motion, noise or none.
RESOLUTION = 5e-3
# So few directions beyond those of a single pose are next to nothing.
FEWEST_DIRECTIONS = 3


@dataclass(frozen=True)
class Excitation:
    """What a log determines.

    Attributes
    ----------
    determined : int
        Directions of the parameters of which more than half the prior's variance goes.
    at_rest : int
        As many of them as the mean pose tells without any motion.
    gain : float
        Information over the prior, bit.
    """

    determined: int
    at_rest: int
    gain: float


def excitation(watch: ModelStatistics, left: FloatArray) -> Excitation:
    """Judge rows of which (n,) variances are left when their gains are known."""
    rows_, prior = watch.rows, watch.prior
    p = len(prior.names)
    scale = loads(rows_, watch.problem.expected)
    deviation = np.sqrt(INFLATION * (left + (RESOLUTION * scale) ** 2))
    L = prior.covariance_factor()
    rows = rows_.whitened(deviation)[:, :p] @ L
    at_rest = np.sqrt(rows_.samples) * (watch.mean_row / deviation[:, None]) @ L
    singular = np.linalg.svd(rows, compute_uv=False)
    # Rows s and a prior of one leave a deviation of 1/√(1 + s²).
    least = np.sqrt(1 / DETERMINED**2 - 1)
    return Excitation(
        determined=int(np.sum(singular > least)),
        at_rest=int(np.sum(np.linalg.svd(at_rest, compute_uv=False) > least)),
        gain=float(np.sum(np.log2(1 + singular**2)) / 2),
    )


# Delays that differ by no more than this share of themselves are one delay.
ALIKE = 0.5
REST_ON_IMU = (
    "wrench_sign, wrench_frame, torque_sign, torque_gain, delay, excitation: they rest on the "
    "IMU, whose mounting or unit is wrong"
)


@dataclass
class ModelChecks:
    """Findings, figures and what was left out and why."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def check_model(
    watch: ModelStatistics, joints: str, imus: Sequence[str], wrenches: Mapping[str, str]
) -> ModelChecks:
    """Judge what was gathered.

    Parameters
    ----------
    watch : ModelStatistics
        Of a whole log.
    joints : str
        Topic of the joint states.
    imus : sequence of str
        Topics of the IMUs.
    wrenches : mapping of str to str
        Topic of each wrench frame.
    """
    checks = ModelChecks()
    _check_imus(checks, watch, imus)
    if any(one.kind in (Kind.IMU_MOUNTING, Kind.UNIT) for one in checks.findings):
        checks.left_out.append(REST_ON_IMU)
        return checks
    if watch.rows.samples < 1:
        checks.left_out.append(
            "wrench_sign, wrench_frame, torque_sign, torque_gain, delay, excitation: no stretch "
            "without a gap is long enough"
        )
        return checks
    problem = watch.problem
    gains = estimate_gains(problem)
    judged = check_forces(watch, gains, joints, imus, wrenches)
    if judged.findings and checks.findings:
        checks.left_out.append(
            "wrench_sign, wrench_frame, torque_sign, torque_gain, excitation: they rest on the "
            "IMU, which is late or early"
        )
        return checks
    if judged.findings:
        _check_turns(checks, problem, gains, imus)
        if any(one.kind is Kind.IMU_MOUNTING for one in checks.findings):
            checks.left_out.append(REST_ON_IMU)
            return checks
    checks.findings += judged.findings
    checks.figures |= judged.figures
    checks.left_out += judged.left_out
    if judged.blamed:
        checks.left_out.append(f"delay, excitation: they would repeat {judged.blamed}")
        return checks
    _check_delays(checks, watch, joints, imus, wrenches)
    _check_excitation(checks, watch, gains)
    return checks


def _check_imus(checks: ModelChecks, watch: ModelStatistics, imus: Sequence[str]) -> None:
    for topic, rates in zip(imus, watch.standing, strict=False):
        found = fit_gyro(rates)
        if found is None or not is_told(found):
            checks.left_out.append(
                f"imu_mounting of {topic} by its rate of turn: no foot stands that turns"
            )
            continue
        checks.figures |= {
            f"{topic}/angle_deg": float(np.degrees(found.angle)),
            f"{topic}/angle_std_deg": float(np.degrees(found.angle_std)),
            f"{topic}/delay_ms": 1e3 * found.delay,
            f"{topic}/delay_std_ms": 1e3 * found.delay_std,
            f"{topic}/rate_left": found.left,
        }
        wrong = list(mounting_findings(topic, found))
        checks.findings += wrong
        if not wrong:
            checks.findings += delay_finding(
                topic, found.delay, found.delay_std, "the joint states"
            )


def _check_turns(
    checks: ModelChecks, problem: GainProblem, gains: GainEstimate, imus: Sequence[str]
) -> None:
    """Judge the accelerometers' axes by the forces that seem wrong."""
    for index in range(len(problem.gains.imu_frames)):
        turn = fit_imu_rotation(problem, gains, index)
        topic, told = imus[index], turn.plain - turn.cost
        checks.figures[f"{topic}/force_angle_deg"] = float(np.degrees(turn.angle))
        if told <= PLAINER or turn.cost > FURTHEST:
            continue
        if turn.sign < 0 and turn.angle < LARGEST_ANGLE:
            checks.findings.append(reversed_finding([topic]))
        elif turn.sign > 0 and turn.angle > LARGEST_ANGLE:
            checks.findings.append(turned_finding(topic, turn, told))


def _check_delays(
    checks: ModelChecks,
    watch: ModelStatistics,
    joints: str,
    imus: Sequence[str],
    wrenches: Mapping[str, str],
) -> None:
    """Judge the delays of efforts, IMUs and of wrench sensors that carry something."""
    delays, gains = estimate_delays(watch.problem), watch.gains
    late = find_late_streams(delays)
    streams = {joints: ("the efforts", gains.effort_delay)} if gains.driven else {}
    for index in range(len(gains.imu_frames)):
        # Above a foot that stands the rates of turn tell it better.
        if f"{imus[index]}/delay_ms" not in checks.figures:
            streams[imus[index]] = ("", gains.imu(index).stop)
    for topic, (what, place) in streams.items():
        delay, std = delays.delay(place)
        name = f"{topic}/effort_delay" if what else f"{topic}/delay"
        checks.figures |= {f"{name}_ms": 1e3 * delay, f"{name}_std_ms": 1e3 * std}
        if place in late:
            checks.findings += delay_finding(topic, *late[place], "motion and forces", what)
    for index, frame in enumerate(watch.gains.wrench_frames):
        if not watch.is_loaded[index]:
            checks.left_out.append(
                f"wrench_sign, wrench_frame, delay of {wrenches[frame]}: it carries "
                f"{watch.loads[index]:.2g} N of {watch.weight:.0f} N"
            )
            continue
        place = gains.wrench(index).stop
        delay, std = delays.delay(place)
        checks.figures |= {f"{frame}/delay_ms": 1e3 * delay, f"{frame}/delay_std_ms": 1e3 * std}
        if place in late:
            checks.findings += delay_finding(wrenches[frame], *late[place], "efforts and motion")
    _blame_the_joints(checks, joints, {*imus, *wrenches.values()})


def _blame_the_joints(checks: ModelChecks, joints: str, others: set[str]) -> None:
    """Replace findings that all say it is the joint states that are late.

    Those of all other streams, early alike, or of an IMU's rates against positions and of
    forces against efforts.
    """
    found = {
        one.stream: one.figures["delay_ms"] * (1 if one.stream == joints else -1)
        for one in checks.findings
        if one.kind is Kind.DELAY
    }
    if len(found) < 2 or not (joints in found or set(found) == others):
        return
    delays = np.array(list(found.values()))
    if np.ptp(delays) > ALIKE * abs(delays.mean()):
        return
    checks.findings = [one for one in checks.findings if one.kind is not Kind.DELAY]
    checks.findings += delay_finding(
        joints, 1e-3 * float(delays.mean()), 1e-3 * float(delays.std()), "the other streams"
    )


def _check_excitation(checks: ModelChecks, watch: ModelStatistics, gains: GainEstimate) -> None:
    found = excitation(watch, gains.left)
    checks.figures |= {
        "directions_determined": found.determined,
        "directions_at_rest": found.at_rest,
        "information_bit": found.gain,
    }
    moved = found.determined - found.at_rest
    if moved < FEWEST_DIRECTIONS:
        checks.findings.append(
            Finding(
                Kind.EXCITATION,
                "",
                Severity.WARNING,
                f"{found.determined} directions of the parameters would be determined beyond "
                f"±25 %, {found.at_rest} of them by the mean pose alone; move all joints and turn "
                "the base",
                {"determined": found.determined, "at_rest": found.at_rest},
            )
        )


def delay_finding(
    topic: str, delay: float, std: float, others: str, what: str = ""
) -> Iterator[Finding]:
    """Yield whether a stream, or what of it is named, is late or early, s."""
    if abs(delay) <= LARGEST_DELAY or abs(delay) <= DEVIATIONS * std:
        return
    which = "late" if delay > 0 else "early"
    yield Finding(
        Kind.DELAY,
        topic,
        Severity.WARNING,
        f"{topic}: {f'{what} are' if what else 'is'} {1e3 * abs(delay):.1f} ± {1e3 * std:.1g} ms "
        f"{which} against {others}; let drivers stamp the time of the measurement",
        {"delay_ms": 1e3 * delay, "delay_std_ms": 1e3 * std},
    )
