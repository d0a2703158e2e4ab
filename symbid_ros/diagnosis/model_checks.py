"""Checks against a model, ordered so that one fault is not reported as another.

An IMU's mounting follows from kinematics alone and is checked first. Signs, frames and gains of
forces are estimated together. Delays and excitation are checked last, if no fault was found.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.delay_checks import check_delays, delay_finding
from symbid_ros.diagnosis.effort_findings import NO_CONVERSIONS, SignConversions
from symbid_ros.diagnosis.encoder_offsets import estimate_offsets, offset_findings
from symbid_ros.diagnosis.findings import Finding, Kind, ModelChecks, Severity
from symbid_ros.diagnosis.forces import (
    MAX_ROTATION_COST,
    MIN_EVIDENCE,
    ForceVerdict,
    check_forces,
    reversed_imu_finding,
    rotated_imu_finding,
)
from symbid_ros.diagnosis.gain_problem import GainEstimate, GainProblem, loads
from symbid_ros.diagnosis.gains import estimate_gains, fit_imu_rotation
from symbid_ros.diagnosis.like_limbs import joints_of_limbs, limbs_without_sensor
from symbid_ros.diagnosis.missing_body import with_missing_body
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stance_gyro_check import (
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
# What a contact without a sensor looks like.
OF_MISSING_WRENCH = Kind.WEIGHT, Kind.CONTRADICTION, Kind.ENCODER_OFFSET
OF_FORCES = "wrench_sign, wrench_frame, torque_sign, torque_gain, delay, excitation"
TOO_SHORT = "every part of the log without a gap is too short"
DEPEND_ON_IMU = "they depend on the IMU, whose mounting or unit is wrong"


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
        check_delays(checks, statistics, joints, imus, wrenches)
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
