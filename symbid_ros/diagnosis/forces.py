"""Wrench sensors and efforts against the equation of motion."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.diagnosis.findings import Finding, Kind, Severity
from symbid_ros.diagnosis.gains import GainEstimate
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.rotation_fit import RotationFit, fit_rotation

# Gains beside the others' that ±25 % of every inertia can bring about and calibration leave,
# readings over what they ought to be: one may be low by 0.75/1.25, another high by its inverse.
GAINS = 0.6, 1.6
# Share of the weight that no gain of one leaves over where sensors, IMU and model agree.
MOST_LEFT = 0.35
# No gains at all explain the log where the best of them are so far from one.
EXPLAINED = 0.4, 2.5
# A matrix is no turned sensor's that is further from every one, in squared deviations.
FURTHEST = 40.0
SMALLEST_ANGLE = np.radians(5.0)
# Squared deviations by which a turn must explain more than none.
PLAINER = 25.0
DEVIATIONS = 3.0
# Readings so many times too large are told as that many.
SMALLEST = 1e-4
# Faults of one kind may have one cause; more than so many of several kinds have one that is none
# of them.
MOST_FAULTS = 2


@dataclass(frozen=True)
class ForceVerdict:
    """What the forces of a log amount to.

    Attributes
    ----------
    findings : tuple of Finding
    figures : dict of str to float
    blamed : str
        What is wrong with so much of the log that nothing else can be asked; or empty.
    left_out : tuple of str
        Checks that could not be made, and why.
    """

    findings: tuple[Finding, ...]
    figures: dict[str, float]
    blamed: str = ""
    left_out: tuple[str, ...] = ()


def check_forces(
    watch: ModelStatistics,
    gains: GainEstimate,
    joints: str,
    imus: Sequence[str],
    topics: Mapping[str, str],
) -> ForceVerdict:
    """Return what is wrong with signs, frames and gains.

    Parameters
    ----------
    watch : ModelStatistics
        What was gathered.
    gains : GainEstimate
        Of its observations.
    joints, imus : str, sequence of str
        Topics.
    topics : mapping of str to str
        The wrench topic of each frame.
    """
    frames = gains.sensors.wrench_frames
    loaded = np.flatnonzero(watch.is_loaded).tolist()
    turned = {index: fit_rotation(*gains.matrix(gains.sensors.wrench(index))) for index in loaded}
    efforts = {name: gains.effort(index) for index, name in enumerate(gains.sensors.joint_names)}
    known = {name: told for name, told in efforts.items() if _is_known(*told)}
    middle = _middle(turned, known)
    common = _common(turned, known)
    figures = {"gain": common}
    if watch.model.floating:
        figures["weight_left"] = gains.before / watch.weight
        figures["weight_left_with_gains"] = gains.after / watch.weight
    for index, turn in turned.items():
        figures[f"{frames[index]}/gain"] = turn.sign * turn.scale
        figures[f"{frames[index]}/angle_deg"] = float(np.degrees(turn.angle))
    for name, (gain, std) in efforts.items():
        figures[f"{name}/effort_gain"], figures[f"{name}/effort_gain_std"] = gain, std
    if watch.model.floating and _is_reversed(watch, gains, turned, known):
        return ForceVerdict((reversed_finding(imus),), figures, Kind.IMU_MOUNTING.value)
    if watch.model.floating and gains.before > MOST_LEFT * watch.weight:
        far = any(turn.cost > FURTHEST for turn in turned.values())
        if far or not loaded or not EXPLAINED[0] < middle < EXPLAINED[1]:
            return ForceVerdict((_unexplained(watch, gains, frames),), figures, Kind.WEIGHT.value)
    # Without a single effort the wrenches' gains shrink together with the inertias.
    is_anchored = bool(known) or not gains.sensors.driven
    found = [
        *(
            one
            for index, turn in turned.items()
            for one in _of_wrench(topics[frames[index]], frames[index], turn, common)
            if is_anchored or one.kind is not Kind.WRENCH_GAIN
        ),
        *_of_efforts(joints, known, common),
    ]
    several = len(found) > MOST_FAULTS and len({one.kind for one in found}) > 1
    # Gains of nothing at all explain what no gains do.
    vanishing = bool(found) and not EXPLAINED[0] <= common <= EXPLAINED[1]
    if several or vanishing:
        found = [_contradiction([joints, *topics.values()])]
    left_out = () if is_anchored else ("wrench_gain: no joint's effort is known to compare with",)
    return ForceVerdict(tuple(found), figures, found[0].kind.value if found else "", left_out)


def _is_known(gain: float, std: float) -> bool:
    """Tell whether a gain is known well enough to have a sign and a size."""
    return DEVIATIONS * std < max(abs(gain), 0.5)


def _middle(turned: Mapping[int, RotationFit], known: Mapping[str, tuple[float, float]]) -> float:
    """Return the median gain: by how much the whole model is too light, if it is no more.

    Two could as well share a fault.
    """
    sizes = [turn.scale for turn in turned.values()] + [abs(gain) for gain, _ in known.values()]
    return float(np.median(sizes)) if len(sizes) > 2 else 1.0


def _common(turned: Mapping[int, RotationFit], known: Mapping[str, tuple[float, float]]) -> float:
    """Return the gain that counts as right.

    Gains that wrenches and efforts share say by how much the whole model is too light, or shrink
    together for the noise's sake. Where the two disagree, as with a unit, those are right who are
    nearer to the model; efforts alone are, as long as they are near it.
    """
    if turned and len(known) > 2:
        wrench = float(np.median([turn.scale for turn in turned.values()]))
        effort = _middle({}, known)
        if not GAINS[0] < wrench / max(effort, 1e-9) < GAINS[1]:
            nearer = min((wrench, effort), key=lambda each: abs(np.log(max(each, 1e-9))))
            return float(np.clip(nearer, *EXPLAINED))
        return _middle(turned, known)
    middle = _middle(turned, known)
    return middle if EXPLAINED[0] < middle < EXPLAINED[1] else 1.0


def _is_reversed(
    watch: ModelStatistics,
    gains: GainEstimate,
    turned: Mapping[int, RotationFit],
    known: Mapping[str, tuple[float, float]],
) -> bool:
    """Tell whether every force and effort looks reversed: then gravity is."""
    if not turned or not known or any(gain > 0 for gain, _ in known.values()):
        return False
    forces = watch.mean_forces
    if any(turn.cost > FURTHEST for turn in turned.values()):
        return False
    return all(forces[i] @ gains.matrix(gains.sensors.wrench(i))[0] @ forces[i] < 0 for i in turned)


def _unexplained(watch: ModelStatistics, gains: GainEstimate, frames: Sequence[str]) -> Finding:
    left = gains.before / watch.weight
    return Finding(
        Kind.WEIGHT,
        "",
        Severity.UNUSABLE,
        f"the wrenches (frames: {', '.join(frames) or 'none'}) miss what carries the model by "
        f"{100 * left:.0f} % of its {watch.weight:.0f} N and no sign, frame or gain "
        "explains it; record the wrench of every contact and check the IMU's frame",
        {"weight_left": left, "weight_n": watch.weight},
    )


def _of_wrench(topic: str, frame: str, turn: RotationFit, common: float) -> Iterator[Finding]:
    told = turn.plain - turn.cost
    if turn.sign < 0 and told > PLAINER:
        yield Finding(
            Kind.WRENCH_SIGN,
            topic,
            Severity.UNUSABLE,
            f"{topic}: has its sign reversed (gain {turn.sign * turn.scale / common:.2f} beside "
            f"the others'); give what the environment does to the robot in {frame}",
            {"gain": turn.sign * turn.scale / common, "evidence": told},
        )
    elif turn.angle > SMALLEST_ANGLE and told > PLAINER:
        angle = float(np.degrees(turn.angle))
        yield Finding(
            Kind.WRENCH_FRAME,
            topic,
            Severity.UNUSABLE,
            f"{topic}: is given in axes turned by {angle:.0f} degrees from {frame}; correct the "
            "frame's orientation in the model, or header.frame_id",
            {"angle_deg": angle, "evidence": told},
        )
    reads = common / turn.scale
    if not GAINS[0] < reads < GAINS[1]:
        yield Finding(
            Kind.WRENCH_GAIN,
            topic,
            Severity.WARNING,
            f"{topic}: reads {reads:.3g} of what the other sensors need, beyond what inertias "
            f"wrong by 25 % allow ({GAINS[0]:g} to {GAINS[1]:g}); check its unit and calibration",
            {"reads": reads},
        )


def _of_efforts(
    topic: str, known: Mapping[str, tuple[float, float]], common: float
) -> Iterator[Finding]:
    negative = [name for name, (gain, std) in known.items() if gain < -DEVIATIONS * std]
    if negative:
        whose = "all joints" if len(negative) > 2 and len(negative) == len(known) else ""
        figures = {f"{name}/gain": known[name][0] / common for name in negative}
        yield Finding(
            Kind.TORQUE_SIGN,
            topic,
            Severity.UNUSABLE,
            f"{topic}: effort of {whose or ', '.join(negative)} has its sign reversed (gain "
            f"{np.mean(list(figures.values())):.2f} beside the others'); give it along the "
            "joint's axis",
            figures,
        )
    wrong = {}
    for name, (gain, std) in known.items():
        # What inertias may be wrong by is in the deviation already.
        is_told = abs(gain - common) > DEVIATIONS * std
        reads = common / max(gain, SMALLEST * common)
        if gain > -DEVIATIONS * std and is_told and not GAINS[0] < reads < GAINS[1]:
            wrong[name] = reads
    for names in _alike(wrong):
        reads = float(np.median([wrong[name] for name in names]))
        whose = "all joints" if len(names) > 2 and len(names) == len(known) else ", ".join(names)
        yield Finding(
            Kind.TORQUE_GAIN,
            topic,
            Severity.WARNING,
            f"{topic}: effort of {whose} reads {reads:.3g} of what the motion needs, beyond "
            f"what inertias wrong by 25 % allow ({GAINS[0]:g} to {GAINS[1]:g}); check its unit, "
            "gear ratio or torque constant",
            {"reads": reads} | {f"{name}/reads": wrong[name] for name in names},
        )


def _alike(reads: Mapping[str, float]) -> Iterator[list[str]]:
    """Yield the names whose readings are as wrong as each other: a unit is many joints' fault."""
    names: list[str] = []
    for name in sorted(reads, key=lambda each: reads[each]):
        if names and reads[name] > GAINS[1] * reads[names[0]]:
            yield names
            names = []
        names.append(name)
    if names:
        yield names


def _contradiction(topics: Sequence[str]) -> Finding:
    """Return the finding that stands for several that cannot all be true."""
    return Finding(
        Kind.CONTRADICTION,
        "",
        Severity.UNUSABLE,
        f"{', '.join(topics)}: forces, efforts and motion contradict one another and no fault of "
        "one sensor explains it; look for exchanged topics, a contact without a sensor, a wrench "
        "in world axes, a joint's position with a wrong sign or zero, or another robot's model",
    )


def turned_finding(topic: str, turn: RotationFit, evidence: float) -> Finding:
    """Return that only a turned accelerometer makes forces and efforts agree."""
    angle = float(np.degrees(turn.angle))
    return Finding(
        Kind.IMU_MOUNTING,
        topic,
        Severity.UNUSABLE,
        f"{topic}: linear_acceleration is given in axes turned by {angle:.0f} degrees "
        "from its frame in the model, as wrenches and efforts show together; correct the frame's "
        "orientation in the model, or header.frame_id",
        {"angle_deg": angle, "evidence": evidence},
    )


def reversed_finding(imus: Sequence[str]) -> Finding:
    """Return that gravity is upside down."""
    return Finding(
        Kind.IMU_MOUNTING,
        imus[0] if len(imus) == 1 else "",
        Severity.UNUSABLE,
        f"{', '.join(imus)}: linear_acceleration is reversed, forces and efforts contradict it; "
        "at rest an accelerometer reads +9.81 upwards (REP-145), correct the driver's sign or "
        "the frame's orientation in the model",
        {"gain": -1.0},
    )
