"""Checks against a model, ordered so that one fault is not reported as another.

An IMU's mounting follows from kinematics alone and is checked first. Signs, frames and gains of
forces are estimated together. Delays and excitation are checked last, if no fault was found.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.effort_findings import NO_CONVERSIONS, SignConversions
from symbid_ros.diagnosis.encoder_offsets import estimate_offsets, offset_findings
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.forces import (
    MAX_ROTATION_COST,
    MIN_EVIDENCE,
    ForceVerdict,
    check_forces,
    reversed_imu_finding,
    rotated_imu_finding,
)
from symbid_ros.diagnosis.gain_problem import GainEstimate, GainProblem, loads
from symbid_ros.diagnosis.gains import (
    estimate_delays,
    estimate_gains,
    find_late_streams,
    fit_imu_rotation,
)
from symbid_ros.diagnosis.joint_efforts import (
    FARTHEST,
    LARGEST_DELAY,
    effort_delay_error,
    late_efforts,
)
from symbid_ros.diagnosis.like_limbs import joints_of_limbs, limbs_without_sensor
from symbid_ros.diagnosis.missing_body import with_missing_body
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stance_gyro_check import (
    DEVIATIONS,
    LARGEST_ANGLE,
    fit_gyro,
    is_usable,
    mounting_findings,
)
from symbid_ros.estimation.directions import DETERMINED
from symbid_ros.options import robot_file_line
from symbid_ros.signals.weak_form import INFLATION

# Sensor resolution as a share of the load; smaller changes do not count as motion.
RESOLUTION = 5e-3
# Fewest determined directions beyond those of a single pose. On a fixed base most of what motion
# shows is friction, which does not count here.
FEWEST_DIRECTIONS, FEWEST_FIXED = 3, 1


@dataclass(frozen=True)
class Excitation:
    """Information of a log about the parameters.

    Attributes
    ----------
    determined : int
        Directions of the parameters whose prior variance is reduced by more than half.
    at_rest : int
        Directions determined by the mean pose alone.
    gain : float
        Information gain over the prior, bit.
    """

    determined: int
    at_rest: int
    gain: float


def excitation(statistics: ModelStatistics, left: FloatArray) -> Excitation:
    """Return the excitation, given the residual variances (n,) of the rows with known gains."""
    rows_, prior = statistics.rows, statistics.prior
    p = len(prior.names)
    scale = loads(rows_, statistics.problem.expected)
    deviation = np.sqrt(INFLATION * (left + (RESOLUTION * scale) ** 2))
    L = prior.covariance_factor()
    rows = rows_.whitened(deviation)[:, :p] @ L
    at_rest = np.sqrt(rows_.samples) * (statistics.mean_row / deviation[:, None]) @ L
    singular = np.linalg.svd(rows, compute_uv=False)
    # A singular value s and a prior deviation of one leave a deviation of 1/√(1 + s²).
    least = np.sqrt(1 / DETERMINED**2 - 1)
    return Excitation(
        determined=int(np.sum(singular > least)),
        at_rest=int(np.sum(np.linalg.svd(at_rest, compute_uv=False) > least)),
        gain=float(np.sum(np.log2(1 + singular**2)) / 2),
    )


# Share of the time in which a joint moves from which its delay is looked for. The motion of those
# that stick explains static friction by any delay: joints of a real quadruped that stuck moved for
# up to .13 of a log, the others for .31 and more.
LEAST_MOVING = 0.2
# Delays that differ by less than this share of their mean count as equal.
ALIKE = 0.5
# What a contact without a sensor looks like.
OF_MISSING_WRENCH = Kind.WEIGHT, Kind.CONTRADICTION, Kind.ENCODER_OFFSET
OF_FORCES = "wrench_sign, wrench_frame, torque_sign, torque_gain, delay, excitation"
TOO_SHORT = "every part of the log without a gap is too short"
DEPEND_ON_IMU = "they depend on the IMU, whose mounting or unit is wrong"


@dataclass
class ModelChecks:
    """Findings, figures, and skipped checks with their reasons."""

    findings: list[Finding] = field(default_factory=list)
    figures: dict[str, float] = field(default_factory=dict)
    left_out: list[str] = field(default_factory=list)


def check_model(
    statistics: ModelStatistics,
    joints: str,
    imus: Sequence[str],
    wrenches: Mapping[str, str],
    *,
    conversions: SignConversions = NO_CONVERSIONS,
) -> ModelChecks:
    """Check the accumulated statistics of a log.

    Parameters
    ----------
    statistics : ModelStatistics
        Statistics of the complete log.
    joints : str
        Topic of the joint states.
    imus : sequence of str
        Topics of the IMUs.
    wrenches : mapping of str to str
        Topic of each wrench frame, wrist sensors included.
    conversions : SignConversions
        What the user's options have changed already.
    """
    checks = _check_in_order(statistics, joints, imus, wrenches, conversions)
    limbs = limbs_without_sensor(statistics.model, statistics.gains.wrench_frames)
    own = {f"{name}/gain" for name in joints_of_limbs(statistics.model, limbs)}
    disturbed = [
        one.severity
        for one in checks.findings
        if one.kind in OF_MISSING_WRENCH or (one.kind is Kind.TORQUE_SIGN and own >= {*one.figures})
    ]
    if disturbed and limbs:
        checks.findings.insert(0, _missing_wrench(limbs, max(disturbed)))
    return checks


def _missing_wrench(limbs: Sequence[str], severity: Severity) -> Finding:
    """Return the finding of limbs without a sensor that others of the same joints have."""
    text = (
        f"the log has no wrench at {', '.join(limbs)}, although it has one at each other limb with "
        "the same joints: if it touches the ground, this explains the other findings; record its "
        "wrench, or name it in `contact`"
    )
    return Finding(Kind.MISSING_WRENCH, "", severity, text)


def _check_in_order(
    statistics: ModelStatistics,
    joints: str,
    imus: Sequence[str],
    wrenches: Mapping[str, str],
    conversions: SignConversions,
) -> ModelChecks:
    """Check the statistics of a log; a fault that disturbs later checks ends them."""
    checks = ModelChecks()
    _check_wrist_sensors(checks, statistics, wrenches)
    _check_imus(checks, statistics, imus)
    if reason := _reason_to_stop(checks, statistics):
        checks.left_out.append(f"{OF_FORCES}: {reason}")
        return checks
    problem = statistics.problem
    gains = estimate_gains(problem)
    verdict = check_forces(statistics, gains, joints, imus, wrenches, conversions=conversions)
    if not statistics.model.floating:
        verdict = _with_missing_body(verdict, problem, gains, statistics)
    if payloads := {one.stream for one in checks.findings if one.kind is Kind.WRIST_SENSOR}:
        verdict = verdict.without(payloads)
    if verdict.findings and any(one.kind is Kind.DELAY for one in checks.findings):
        checks.left_out.append(
            "wrench_sign, wrench_frame, torque_sign, torque_gain, excitation: they depend on the "
            "IMU, which is late or early"
        )
        return checks
    if verdict.findings:
        if verdict.blamed == Kind.IMU_MOUNTING.value:
            checks.findings += verdict.findings
        else:
            _check_imu_rotations(checks, problem, gains, imus)
        if any(one.kind is Kind.IMU_MOUNTING for one in checks.findings):
            checks.left_out.append(f"{OF_FORCES}: {DEPEND_ON_IMU}")
            return checks
    checks.findings += verdict.findings
    checks.findings += _offset_findings(statistics, wrenches)
    checks.figures |= verdict.figures
    checks.left_out += verdict.left_out
    if verdict.blamed:
        checks.left_out.append(f"delay, excitation: they would only repeat {verdict.blamed}")
        return checks
    _check_encoders(checks, problem, gains, statistics.model.joint_names, joints)
    if any(one.kind is Kind.ENCODER_OFFSET for one in checks.findings):
        checks.left_out.append(f"delay: it would only repeat {Kind.ENCODER_OFFSET.value}")
    else:
        _check_delays(checks, statistics, joints, imus, wrenches)
    _check_excitation(checks, statistics, gains)
    return checks


def _with_missing_body(
    verdict: ForceVerdict, problem: GainProblem, gains: GainEstimate, statistics: ModelStatistics
) -> ForceVerdict:
    """Return the verdict with a body that the model lacks, if it explains all wrong factors."""
    if {one.kind for one in verdict.findings} != {Kind.TORQUE_GAIN}:
        return verdict
    driven = gains.sensors.joint_names
    joints = [name for name in driven for one in verdict.findings if f"{name}/reads" in one.figures]
    found = with_missing_body(verdict.findings, joints, problem, gains, statistics.parameters)
    return replace(verdict, findings=found, blamed=found[-1].kind.value)


def _offset_findings(statistics: ModelStatistics, wrenches: Mapping[str, str]) -> list[Finding]:
    """Return the findings of sensors that read something while their foot is in the air."""
    readings = statistics.unloaded.readings().items()
    found = (reading.finding(wrenches[frame]) for frame, reading in readings)
    return [one for one in found if one is not None]


def _reason_to_stop(checks: ModelChecks, statistics: ModelStatistics) -> str:
    """Return why forces cannot be checked after the checks so far; empty if they can."""
    kinds = {one.kind for one in checks.findings}
    if Kind.WRENCH_SIGN in kinds:
        return "they depend on the wrist sensor, whose sign is wrong"
    for evidence in statistics.payloads:
        # Taken for a contact, such a wrench loads the joints with the opposite of the payload.
        if not evidence.is_named and evidence.is_payload and evidence.sensor.startswith("-"):
            return (
                f"they depend on the wrench at {evidence.frame}, which is that of a payload with "
                "the opposite sign"
            )
    # A few degrees turn gravity by as much as a wrong wrench would.
    if Kind.IMU_MOUNTING in kinds or any(
        one.severity is Severity.UNUSABLE for one in checks.findings
    ):
        return DEPEND_ON_IMU
    if statistics.rows.samples < 1:
        return TOO_SHORT
    return ""


def _check_wrist_sensors(
    checks: ModelChecks, statistics: ModelStatistics, wrenches: Mapping[str, str]
) -> None:
    """Check the signs of wrist sensors, and whether other wrenches are those of payloads."""
    for evidence in statistics.payloads:
        topic = wrenches[evidence.frame]
        if evidence.is_named and evidence.is_reversed:
            mass, std = evidence.mass()
            found = Finding(
                Kind.WRENCH_SIGN,
                topic,
                Severity.UNUSABLE,
                f"{topic}: the mass beyond {evidence.frame} would be {mass:.3g} ± {std:.1g} kg, so "
                f"the sign of its wrench is wrong; give `wrist_sensor` {evidence.other_sign}, or "
                f"write {robot_file_line('wrist_sensor', evidence.other_sign)}",
                {"mass_kg": mass, "mass_std_kg": std},
            )
            checks.findings.append(found)
        elif not evidence.is_named and evidence.is_payload:
            mass, share = abs(evidence.mass()[0]), evidence.share
            found = Finding(
                Kind.WRIST_SENSOR,
                topic,
                Severity.WARNING,
                f"{topic}: the force is that of a body of {mass:.3g} kg fixed to {evidence.frame} "
                f"({100 * share:.0f} % of its variance), not that of a contact; give "
                f"`wrist_sensor` {evidence.sensor}, or write "
                f"{robot_file_line('wrist_sensor', evidence.sensor)}",
                {"mass_kg": mass, "share": share},
            )
            checks.findings.append(found)


def _check_imus(checks: ModelChecks, statistics: ModelStatistics, imus: Sequence[str]) -> None:
    for topic, rates in zip(imus, statistics.standing, strict=False):
        found = fit_gyro(rates)
        if found is None or not is_usable(found):
            checks.left_out.append(
                f"imu_mounting of {topic} from its angular velocity: no foot stands while the "
                "robot turns"
            )
            continue
        checks.figures |= {
            f"{topic}/angle_deg": float(np.degrees(found.angle)),
            f"{topic}/angle_std_deg": float(np.degrees(found.angle_std)),
            f"{topic}/delay_ms": 1e3 * found.delay,
            f"{topic}/delay_std_ms": 1e3 * found.delay_std,
            f"{topic}/rate_left": found.left,
            f"{topic}/gyroscope_gain": found.gain,
        }
        frame = statistics.gains.imu_frames[imus.index(topic)]
        wrong = [with_rotation_line(one, frame) for one in mounting_findings(topic, found)]
        checks.findings += wrong
        if not any(one.severity is Severity.UNUSABLE for one in wrong):
            checks.findings += delay_finding(
                topic, found.delay, found.delay_std, "the joint states"
            )


def with_rotation_line(finding: Finding, frame: str) -> Finding:
    """Return a finding of a rotated IMU with the line of a robot file that corrects it."""
    angles = [finding.figures.get(f"{angle}_deg") for angle in ("roll", "pitch", "yaw")]
    if finding.kind is not Kind.IMU_MOUNTING or None in angles:
        return finding
    value = f"{frame}:={','.join(f'{angle:.1f}' for angle in angles)}"
    line = robot_file_line("rotate_imu", value)
    return replace(finding, message=f"{finding.message}, or write {line}")


def _check_imu_rotations(
    checks: ModelChecks, problem: GainProblem, gains: GainEstimate, imus: Sequence[str]
) -> None:
    """Check whether rotated accelerometers explain the force findings."""
    for index in range(len(problem.gains.imu_frames)):
        fit = fit_imu_rotation(problem, gains, index)
        topic, evidence = imus[index], fit.plain - fit.cost
        checks.figures[f"{topic}/force_angle_deg"] = float(np.degrees(fit.angle))
        if evidence <= MIN_EVIDENCE or fit.cost > MAX_ROTATION_COST:
            continue
        if fit.sign < 0 and fit.angle < LARGEST_ANGLE:
            checks.findings.append(reversed_imu_finding([topic]))
        elif fit.sign > 0 and fit.angle > LARGEST_ANGLE:
            checks.findings.append(rotated_imu_finding(topic, fit, evidence))


def _check_encoders(
    checks: ModelChecks,
    problem: GainProblem,
    gains: GainEstimate,
    names: tuple[str, ...],
    joints: str,
) -> None:
    """Check the zeros of the joints' encoders.

    Without efforts a wrong zero is not told apart from an offset of a wrench sensor.
    """
    if not problem.rows.target_squares[-len(names) :].any():
        return
    estimate = estimate_offsets(problem, gains.left)
    layout = estimate.sensors
    for index, joint in enumerate(layout.measured):
        offset, std = estimate.delay(layout.encoders.start + index)
        checks.figures |= {
            f"{names[joint]}/offset_deg": float(np.degrees(offset)),
            f"{names[joint]}/offset_std_deg": float(np.degrees(std)),
        }
    checks.findings += offset_findings(joints, names, estimate)


def _check_delays(
    checks: ModelChecks,
    statistics: ModelStatistics,
    joints: str,
    imus: Sequence[str],
    wrenches: Mapping[str, str],
) -> None:
    """Check the delays of efforts, IMUs, wrist sensors and loaded wrench sensors."""
    delays, gains = estimate_delays(statistics.problem), statistics.gains
    late = find_late_streams(delays)
    streams = {joints: ("the efforts", gains.effort_delay)} if gains.driven else {}
    for index in range(len(gains.imu_frames)):
        # Above a standing foot the angular velocity gives a better delay.
        if f"{imus[index]}/delay_ms" not in checks.figures:
            streams[imus[index]] = ("", gains.imu(index).stop)
    found, _ = late.get(gains.effort_delay, (0.0, 0.0))
    problem = statistics.problem.with_later_efforts(found)
    error = effort_delay_error(problem) if gains.driven else 0.0
    for topic, (what, place) in streams.items():
        delay, std = delays.delay(place)
        name = f"{topic}/effort_delay" if what else f"{topic}/delay"
        checks.figures |= {f"{name}_ms": 1e3 * delay, f"{name}_std_ms": 1e3 * std}
        if place in late:
            delay, std = late[place]
            std = float(np.hypot(std, error)) if what else std
            checks.findings += delay_finding(topic, delay, std, "motion and forces", what)
    places = dict(
        zip(gains.wrist_sensors, range(gains.wrist_delays.start, gains.encoders.start), strict=True)
    )
    for index, frame in enumerate(gains.wrench_frames):
        if not statistics.is_loaded[index]:
            checks.left_out.append(
                f"wrench_sign, wrench_frame, delay of {wrenches[frame]}: it carries "
                f"{statistics.loads[index]:.2g} N of {statistics.weight:.0f} N"
            )
            continue
        places[frame] = gains.wrench(index).stop
    for frame, place in places.items():
        delay, std = delays.delay(place)
        checks.figures |= {f"{frame}/delay_ms": 1e3 * delay, f"{frame}/delay_std_ms": 1e3 * std}
        if place in late:
            checks.findings += delay_finding(wrenches[frame], *late[place], "efforts and motion")
    late_topics = {one.stream for one in checks.findings if one.kind is Kind.DELAY}
    _attribute_to_joints(checks, joints, {*imus, *wrenches.values()})
    if late_topics <= {joints}:  # late wrenches or IMUs would make efforts look early
        common = found if late_topics else 0.0
        moves = statistics.moving_shares > LEAST_MOVING
        checks.findings += _late_joints(joints, late_efforts(statistics.problem, common, moves))


def _attribute_to_joints(checks: ModelChecks, joints: str, others: set[str]) -> None:
    """Replace delay findings that are all due to late or early joint states.

    These are equal delays of all other streams, or of the IMU against positions and of efforts
    against forces.
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
    mean, std = 1e-3 * float(delays.mean()), 1e-3 * float(delays.std())
    # Delays that scatter too much for one finding keep their own.
    if replacing := list(delay_finding(joints, mean, std, "the other streams")):
        kept = [one for one in checks.findings if one.kind is not Kind.DELAY]
        checks.findings = kept + replacing


def _late_joints(topic: str, late: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Yield the finding of joints whose efforts alone are late or early."""
    if not late:
        return
    each = ", ".join(f"{name} {_delay_text(*found)}" for name, found in late.items())
    figures: dict[str, float] = {}
    for name, (delay, std) in late.items():
        figures |= {f"{name}/delay_ms": 1e3 * delay, f"{name}/delay_std_ms": 1e3 * std}
    yield Finding(
        Kind.EFFORT_DELAY,
        topic,
        Severity.WARNING,
        f"{topic}: single efforts are not of the instant of the positions: {each}; remove the "
        "delay or filter of these drives' readings, or give `sensor_errors` compliance if the "
        "joints are elastic, which looks alike",
        figures,
    )


def _delay_text(delay: float, std: float) -> str:
    side = "late" if delay > 0 else "early"
    if abs(delay) == FARTHEST:
        return f"at least {1e3 * FARTHEST:.0f} ms {side}"
    return f"{1e3 * abs(delay):.1f} ± {1e3 * std:.1g} ms {side}"


def _check_excitation(
    checks: ModelChecks, statistics: ModelStatistics, gains: GainEstimate
) -> None:
    found = excitation(statistics, gains.left)
    checks.figures |= {
        "directions_determined": found.determined,
        "directions_at_rest": found.at_rest,
        "information_bit": found.gain,
    }
    moved = found.determined - found.at_rest
    floating = statistics.model.floating
    if moved < (FEWEST_DIRECTIONS if floating else FEWEST_FIXED):
        checks.findings.append(
            Finding(
                Kind.EXCITATION,
                "",
                Severity.WARNING,
                f"the log determines {found.determined} combinations of the links' inertias to "
                f"better than ±25 %, and a log at rest would determine {found.at_rest}; move all "
                f"joints further and faster{', and turn the base' if floating else ''}",
                {"determined": found.determined, "at_rest": found.at_rest},
            )
        )


def delay_finding(
    topic: str, delay: float, std: float, others: str, what: str = ""
) -> Iterator[Finding]:
    """Yield a finding if a stream or a part of it is late or early."""
    if abs(delay) <= LARGEST_DELAY or abs(delay) <= DEVIATIONS * std:
        return
    which = "late" if delay > 0 else "early"
    is_commanded = bool(what) and delay < 0
    hint = "; efforts that are computed from commands look early" if is_commanded else ""
    yield Finding(
        Kind.DELAY,
        topic,
        Severity.WARNING,
        f"{topic}: {f'{what} are' if what else 'is'} {1e3 * abs(delay):.1f} ± {1e3 * std:.1g} ms "
        f"{which} relative to {others}{hint}; set stamps to the time of the measurement, or add "
        "sensor_delay to `sensor_errors`, which estimates it",
        {"delay_ms": 1e3 * delay, "delay_std_ms": 1e3 * std},
    )
