"""Checks signs, frames and gains of wrenches and efforts by the equation of motion."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.diagnosis.common_scale import (
    KGF,
    MASS_ERROR,
    MILLI,
    Cause,
    ScaleEvidence,
    is_plausible_mass,
    load_cause,
    masses_fault,
    unit_name,
    unit_of,
)
from symbid_ros.diagnosis.effort_findings import (
    DEVIATIONS,
    GAINS,
    NO_CONVERSIONS,
    SignConversions,
    effort_findings,
    sign_finding,
)
from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.gain_problem import GainEstimate
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.rotation_fit import RotationFit, fit_rotation
from symbid_ros.options import robot_file_line

# Largest unexplained share of the weight with all gains at one if sensors, IMU and model agree.
MAX_UNEXPLAINED = 0.35
# Median gains outside this range do not explain the log.
EXPLAINED = 0.4, 2.5
# A gain matrix further from every rotation, in squared deviations, is not a rotated sensor's.
MAX_ROTATION_COST = 40.0
SMALLEST_ANGLE = np.radians(5.0)
# Squared deviations by which a rotation must explain more than the identity.
MIN_EVIDENCE = 25.0
# The same for the sign of all efforts, as the inertias of links err together.
REVERSED = 2 * MIN_EVIDENCE
# Noise of torques above this share of the usual effort is named.
NOISY = 0.1
# Several faults of one kind may have one cause. More faults than this of several kinds are
# reported as one contradiction.
MOST_FAULTS = 2


@dataclass(frozen=True)
class ForceVerdict:
    """Result of the force checks.

    Attributes
    ----------
    findings : tuple of Finding
    figures : dict of str to float
    blamed : str
        Kind of the first fault, for which later checks are skipped; empty if there is none.
    left_out : tuple of str
        Skipped checks and their reasons.
    """

    findings: tuple[Finding, ...]
    figures: dict[str, float]
    blamed: str = ""
    left_out: tuple[str, ...] = ()

    def without(self, payloads: Collection[str]) -> "ForceVerdict":
        """Return the verdict without faults that wrenches of payloads on some topics explain.

        Taken for those of contacts, they load every joint before the payload too.
        """
        explained = Kind.CONTRADICTION, Kind.TORQUE_SIGN, Kind.TORQUE_GAIN
        kept = tuple(
            one for one in self.findings if one.stream not in payloads and one.kind not in explained
        )
        return replace(self, findings=kept, blamed=kept[0].kind.value if kept else "")


def check_forces(
    statistics: ModelStatistics,
    gains: GainEstimate,
    joints: str,
    imus: Sequence[str],
    topics: Mapping[str, str],
    *,
    conversions: SignConversions = NO_CONVERSIONS,
) -> ForceVerdict:
    """Check signs, frames and gains of wrenches and efforts.

    Parameters
    ----------
    statistics : ModelStatistics
        Statistics of the log.
    gains : GainEstimate
        Gains estimated from the same statistics.
    joints, imus : str, sequence of str
        Topics.
    topics : mapping of str to str
        The wrench topic of each frame.
    conversions : SignConversions
        What the user's options have changed already.
    """
    frames = gains.sensors.wrench_frames
    loaded = np.flatnonzero(statistics.is_loaded).tolist()
    rotations = {
        index: fit_rotation(*gains.matrix(gains.sensors.wrench(index))) for index in loaded
    }
    efforts = {name: gains.effort(index) for index, name in enumerate(gains.sensors.joint_names)}
    hidden = {gains.sensors.joint_names[at]: share for at, share in gains.hidden_loads.items()}
    judged = {name: estimate for name, estimate in efforts.items() if _is_known(*estimate)}
    known = {name: estimate for name, estimate in judged.items() if name not in hidden}
    middle = _median_gain(rotations, known)
    common = _reference_gain(rotations, known)
    figures = {"gain": common}
    if statistics.model.floating:
        figures["weight_left"] = gains.before / statistics.weight
        figures["weight_left_with_gains"] = gains.after / statistics.weight
        figures["mass_ratio"] = gains.mass_ratio
    for index, turn in rotations.items():
        figures[f"{frames[index]}/gain"] = turn.sign * turn.scale
        figures[f"{frames[index]}/angle_deg"] = float(np.degrees(turn.angle))
    for name, (gain, std) in efforts.items():
        figures[f"{name}/effort_gain"], figures[f"{name}/effort_gain_std"] = gain, std
        figures |= {f"{name}/load_share": hidden[name]} if name in hidden else {}
    for name, (rms, _) in statistics.effort_limits.items():
        figures[f"{name}/effort_rms"] = rms
    if statistics.model.floating and _is_reversed(statistics, gains, rotations, known):
        return ForceVerdict((reversed_imu_finding(imus),), figures, Kind.IMU_MOUNTING.value)
    if statistics.model.floating and gains.before > MAX_UNEXPLAINED * statistics.weight:
        is_unexplained = any(turn.cost > MAX_ROTATION_COST for turn in rotations.values())
        vanishes = not _is_explained(middle) or _is_vanishing(rotations, known)
        if is_unexplained or not loaded or vanishes:
            return ForceVerdict(
                (_unexplained(statistics, gains, frames),), figures, Kind.WEIGHT.value
            )
    # Without any effort, the wrenches' gains shrink together with the inertias.
    is_anchored = bool(known) or not gains.sensors.driven
    found = [
        *(
            one
            for index, turn in rotations.items()
            for one in _wrench_findings(
                topics[frames[index]], frames[index], turn, common, conversions=conversions
            )
            if is_anchored or one.kind is not Kind.WRENCH_GAIN
        ),
        *effort_findings(
            joints,
            known,
            common,
            {name: one for name, one in efforts.items() if name not in known},
            hidden={
                name: hidden[name]
                for name, (gain, std) in judged.items()
                if name in hidden and abs(gain - common) > DEVIATIONS * std
            },
            limits=statistics.effort_limits,
            evidence=None if rotations else statistics.scale_evidence,
            conversions=conversions,
        ),
    ]
    shown = {name: one for name, one in efforts.items() if name in known or name not in judged}
    # The sign of one joint may be known alone, and be that of the others together.
    signs = [one for one in found if one.kind is Kind.TORQUE_SIGN]
    named = {each.removesuffix("/gain") for one in signs for each in one.figures}
    others = {name: one for name, one in shown.items() if name not in named}
    if signs == found and not statistics.model.floating and _are_reversed(others):
        reversed_gains = {name: gain for name, (gain, _) in efforts.items()}
        found = [sign_finding(joints, reversed_gains, conversions, are_all=True)]
    several = len(found) > MOST_FAULTS and len({one.kind for one in found}) > 1
    # Vanishing gains explain any log.
    vanishing = bool(found or rotations) and not EXPLAINED[0] <= common <= EXPLAINED[1]
    if several or vanishing:
        remark = _noise_remark(statistics) + _offset_remark(statistics, topics)
        if rotations and statistics.model.floating and gains.mass_ratio < 1 - MASS_ERROR:
            remark += (
                f"; the forces are those of {gains.mass_ratio:.2f} times the model's mass, as if a "
                "support without a sensor, such as a crane, carried the rest"
            )
        found = [_contradiction([joints, *topics.values()], remark)]
    if not found and rotations and statistics.model.floating:
        found = list(_weight_findings(statistics, gains.mass_ratio, frames))
    left_out: tuple[str, ...] = ()
    if rotations and not is_anchored:
        left_out = (
            "gains of the wrench sensors: no effort is known well enough to compare them with",
        )
    return ForceVerdict(tuple(found), figures, found[0].kind.value if found else "", left_out)


def _is_known(gain: float, std: float) -> bool:
    """Return whether a gain is known well enough to judge its sign and size."""
    return DEVIATIONS * std < max(abs(gain), 0.5)


def _are_reversed(efforts: Mapping[str, tuple[float, float]]) -> bool:
    """Return whether the gains of all joints are negative together.

    A log may be too short, or its motion too small, to judge single joints.
    """
    gain, std = np.array(list(efforts.values())).reshape(-1, 2).T
    # Squared deviations from gains of one, less those from gains of minus one.
    evidence = -4 * gain / std**2
    return bool(evidence.sum() > REVERSED and np.all(gain < std))


def _is_explained(gain: float) -> bool:
    return EXPLAINED[0] < gain < EXPLAINED[1]


def _is_vanishing(
    rotations: Mapping[int, RotationFit], known: Mapping[str, tuple[float, float]]
) -> bool:
    """Return whether the wrenches' gains explain nothing and most efforts contradict the motion.

    Wrenches in a wrong unit have such gains too, but the efforts are right then.
    """
    wrench = float(np.median([turn.scale for turn in rotations.values()])) if rotations else 1.0
    right = sum(_is_explained(gain) for gain, _ in known.values())
    return not _is_explained(wrench) and 2 * right <= len(known)


def _median_gain(
    rotations: Mapping[int, RotationFit], known: Mapping[str, tuple[float, float]]
) -> float:
    """Return the median gain, which absorbs an error of the whole model's mass.

    With fewer than three gains it is one, because two may have the same fault.
    """
    sizes = [turn.scale for turn in rotations.values()] + [abs(gain) for gain, _ in known.values()]
    return float(np.median(sizes)) if len(sizes) > 2 else 1.0


def _reference_gain(
    rotations: Mapping[int, RotationFit], known: Mapping[str, tuple[float, float]]
) -> float:
    """Return the reference gain that the other gains are compared with.

    A gain common to wrenches and efforts is due to the model's mass or to noise. If wrenches and
    efforts disagree, whichever is closer to the model is trusted. Efforts alone are trusted as long
    as they are close to the model.
    """
    if rotations and len(known) > 2:
        wrench = float(np.median([turn.scale for turn in rotations.values()]))
        effort = _median_gain({}, known)
        if not GAINS[0] < wrench / max(effort, 1e-9) < GAINS[1]:
            nearer = min((wrench, effort), key=lambda each: abs(np.log(max(each, 1e-9))))
            return float(np.clip(nearer, *EXPLAINED))
        return _median_gain(rotations, known)
    middle = _median_gain(rotations, known)
    return middle if EXPLAINED[0] < middle < EXPLAINED[1] else 1.0


def _is_reversed(
    statistics: ModelStatistics,
    gains: GainEstimate,
    rotations: Mapping[int, RotationFit],
    known: Mapping[str, tuple[float, float]],
) -> bool:
    """Return whether all forces and efforts look reversed, so that gravity is reversed."""
    if not rotations or not known or any(gain > 0 for gain, _ in known.values()):
        return False
    if gains.reversed_wrenches < MAX_UNEXPLAINED * statistics.weight < gains.before:
        return True
    forces = statistics.mean_forces
    if any(turn.cost > MAX_ROTATION_COST for turn in rotations.values()):
        return False
    return all(
        forces[i] @ gains.matrix(gains.sensors.wrench(i))[0] @ forces[i] < 0 for i in rotations
    )


def _unexplained(
    statistics: ModelStatistics, gains: GainEstimate, frames: Sequence[str]
) -> Finding:
    left, weight = gains.before / statistics.weight, statistics.weight
    figures = {"weight_left": left, "weight_n": weight}
    wrenches = f"the wrenches (frames: {', '.join(frames) or 'none'})"
    contradiction, advice = (
        f"{wrenches} do not balance the model's weight: {100 * left:.0f} % of {weight:.0f} N is "
        "unexplained by any sign, frame or gain",
        "record the wrench of every contact, or name those without a sensor in `contact`, and "
        "check the IMU's frame and for a joint's position with a wrong sign",
    )
    factor = unit_of(weight / statistics.carried) if statistics.carried > 0 else None
    g = float(np.linalg.norm(statistics.model.gravity))
    weighed, stated = _kilograms(statistics.carried / g), _kilograms(weight / g)
    if factor is None:
        contradiction += f", and they carry {weighed} of {stated}"
        if statistics.carried < (1 - MASS_ERROR) * weight:
            advice = f"take away what else carries the robot, such as a crane; {advice}"
    else:
        # Efforts may be right although forces are not, so their limits are no evidence.
        cause = ScaleEvidence(statistics.scale_evidence.density).cause(factor)
        faults = {
            Cause.MASSES: f"the masses in the model were {masses_fault(factor)}",
            Cause.UNIT: f"forces were in {unit_name(factor, 'N')}",
        }
        as_if = f"as if {' or '.join(faults.values()) if cause is None else faults[cause]}"
        if cause is Cause.MASSES:
            figures["masses_times"] = factor
            contradiction = f"the model weighs {stated}, {wrenches} carry {weighed}, {as_if}"
            advice = "correct its masses and inertias (kg, kg m²)"
        else:
            contradiction += f": they carry {weighed} and the model weighs {stated}, {as_if}"
    text = f"{contradiction}; {advice}"
    return Finding(Kind.WEIGHT, "", Severity.UNUSABLE, text, figures)


def _weight_findings(
    statistics: ModelStatistics, share: float, frames: Sequence[str]
) -> Iterator[Finding]:
    """Yield a finding if wrenches that agree with the efforts carry another mass than the model's.

    Where all gains differ from one by the same factor, no single sensor is at fault, and the masses
    of the links would change by that factor.
    """
    if is_plausible_mass(share):
        return
    stated = statistics.weight / float(np.linalg.norm(statistics.model.gravity))
    carried = _kilograms(share * stated)
    yield Finding(
        Kind.WEIGHT,
        "",
        Severity.WARNING,
        f"the wrenches (frames: {', '.join(frames)}) carry {carried}, {share:.2f} times the "
        f"{_kilograms(stated)} of the model: weigh the robot; if it weighs {carried}, correct the "
        f"model's masses; if it weighs what the model does, {load_cause(share - 1)}",
        {"mass_ratio": share},
    )


def _kilograms(mass: float) -> str:
    return f"{mass:.0f} kg" if mass > 100 else f"{mass:.3g} kg"


def _wrench_findings(
    topic: str,
    frame: str,
    turn: RotationFit,
    common: float,
    *,
    conversions: SignConversions = NO_CONVERSIONS,
) -> Iterator[Finding]:
    evidence = turn.plain - turn.cost
    if turn.sign < 0 and evidence > MIN_EVIDENCE:
        yield Finding(
            Kind.WRENCH_SIGN,
            topic,
            Severity.UNUSABLE,
            f"{topic}: has the wrong sign (gain {turn.sign * turn.scale / common:.2f} relative "
            f"to the others); give the wrench of the environment on the robot in {frame}, or "
            + (
                f"remove {frame} from `flip_wrench`, which reverses it"
                if frame in conversions.flipped
                else f"write {robot_file_line('flip_wrench', frame)}"
            ),
            {"gain": turn.sign * turn.scale / common, "evidence": evidence},
        )
    elif turn.angle > SMALLEST_ANGLE and evidence > MIN_EVIDENCE:
        angle = float(np.degrees(turn.angle))
        yield Finding(
            Kind.WRENCH_FRAME,
            topic,
            Severity.UNUSABLE,
            f"{topic}: is given in axes rotated by {angle:.0f} degrees from {frame}; correct "
            "the frame's orientation in the model, or header.frame_id",
            {"angle_deg": angle, "evidence": evidence},
        )
    reads = common / turn.scale
    if not GAINS[0] < reads < GAINS[1]:
        yield Finding(
            Kind.WRENCH_GAIN,
            topic,
            Severity.WARNING,
            f"{topic}: reads {reads:.3g} times what the other sensors imply{_wrench_advice(reads)}",
            {"reads": reads},
        )


def _wrench_advice(reads: float) -> str:
    """Return what to do about a wrench that reads so many times what it should."""
    unit = unit_of(1 / reads)
    if unit in (KGF, MILLI, 1 / MILLI):
        return f", as if in {unit_name(unit, 'N')}; multiply its forces and torques by {unit:.3g}"
    return (
        f"; inertia errors of 25 % explain only {GAINS[0]:g} to {GAINS[1]:g}; check its unit and "
        "calibration"
    )


def _noise_remark(statistics: ModelStatistics) -> str:
    """Return a remark about torques of the wrenches that are noisy beside the joints' efforts."""
    torque, force = statistics.wrench_noise
    usual = float(np.median(statistics.efforts or [np.inf]))
    if torque < NOISY * usual:
        return ""
    return (
        f"; white noise of the wrenches, {torque:.2g} Nm and {force:.2g} N, is large beside "
        f"efforts of {usual:.2g} Nm (N); average the readings in the driver"
    )


def _offset_remark(statistics: ModelStatistics, topics: Mapping[str, str]) -> str:
    """Return a remark about a foot that is never in the air, unlike all others."""
    frame, force = statistics.unloaded.suspect_force()
    if not frame:
        return ""
    return (
        f"; {topics[frame]} never reads less than {force:.2g} N, although all other feet are in "
        "the air at times; tare it if its foot is as well"
    )


def _contradiction(topics: Sequence[str], remark: str = "") -> Finding:
    """Return the finding that replaces several inconsistent ones."""
    return Finding(
        Kind.CONTRADICTION,
        "",
        Severity.UNUSABLE,
        f"{', '.join(topics)}: forces, efforts and motion contradict each other, and no "
        "fault of a single sensor explains it; check for efforts that are currents or in other "
        "units (`symbid init` finds their scales), exchanged topics, a contact without a sensor, "
        "a wrench in world axes, a joint's position with a wrong sign or zero, or another robot's "
        f"model{remark}",
    )


def rotated_imu_finding(topic: str, turn: RotationFit, evidence: float) -> Finding:
    """Return the finding that the accelerometer's axes are rotated."""
    angle = float(np.degrees(turn.angle))
    return Finding(
        Kind.IMU_MOUNTING,
        topic,
        Severity.UNUSABLE,
        f"{topic}: linear_acceleration is given in axes rotated by {angle:.0f} degrees "
        "from its frame in the model, according to wrenches and efforts; correct the frame's "
        "orientation in the model, or header.frame_id",
        {"angle_deg": angle, "evidence": evidence},
    )


def reversed_imu_finding(imus: Sequence[str]) -> Finding:
    """Return the finding that the accelerometer's sign is reversed."""
    return Finding(
        Kind.IMU_MOUNTING,
        imus[0] if len(imus) == 1 else "",
        Severity.UNUSABLE,
        f"{', '.join(imus)}: linear_acceleration has the wrong sign according to forces and "
        "efforts; at rest an accelerometer reads +9.81 upwards (REP-145); correct the driver's "
        "sign or the frame's orientation in the model",
        {"gain": -1.0},
    )
