"""Reading of all logs that the options name, and checks that do not depend on a method."""

import logging
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace

import numpy as np

from symbid_ros.choices import KINEMATIC_ERRORS
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.diagnosis.wrist_evidence import unnamed_sensors
from symbid_ros.errors import DataError, SymbidError
from symbid_ros.identification.options import IdentifyOptions, Source
from symbid_ros.identification.rows.aligned_log import AlignedLog, ChainedSegments
from symbid_ros.identification.rows.dataset import Dataset, Processing, fold_dataset, read_dataset
from symbid_ros.model.held_joints import with_held_joints
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.payload import Payload
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import reversed_sensor, sensor_frame
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment

logger = logging.getLogger(__name__)

MINUTE = 60_000_000_000  # ns
FIRST_PART = 4_000_000_000  # ns, whose joint states show which joints the log has
# Joints that a log lacks, from which on they count as rigid. Fewer, such as those of a gripper's
# fingers, cost little time, and their links keep parameters of their own.
MANY = 8


def read_log(
    log: Log,
    options: IdentifyOptions,
    parameters: ParameterSet,
    watch: Callable[[Segment], None] | None = None,
) -> tuple[Dataset, StreamChecks | None]:
    """Read a log; the checks of its streams are None if the options skip them.

    ``watch`` receives every segment.
    """
    checks = None if options.unchecked else StreamChecks(parameters.model)
    return read_dataset(log, parameters, Processing.of(options), checks, watch), checks


def first_segments(log: Log, robot: RobotModel, span: int = MINUTE) -> tuple[Segment, ...]:
    """Return the segments of the first ``span`` ns of a log; none if it is faulty."""
    found: list[Segment] = []
    with suppress(SymbidError):  # the checks report faults
        for segment in AlignedLog(log, robot, span=span, warns=False):
            found.append(segment)
            if segment.stamp[-1] - found[0].stamp[0] > span:
                break
    return tuple(found)


def with_rigid_joints(robot: RobotModel, log: Log, options: IdentifyOptions) -> RobotModel:
    """Return a robot in which many joints that the log lacks do not move.

    Links beyond them would have parameters that no row shows. Joints stay as they are if options
    name them, their links, or results with the parameters of these.
    """
    if len(robot.measured_joint_names) < MANY or options.wrist_sensors:
        return robot
    is_bound = options.prior is not None or options.information is not None
    if is_bound or options.choose_truncation is not None or options.loaded_logs:
        return robot
    if not set(KINEMATIC_ERRORS).isdisjoint(options.sensor_error_kinds):
        return robot
    positions = _held_positions(log)
    named = " ".join(
        str(getattr(options, one))
        for one in ("joint_terms", "drive_gain", "effort_side", "coupling", "ripple", "payload")
    )
    held = {
        joint.name: positions[joint.name]
        for joint, link in zip(robot.joints, robot.link_names[1:], strict=True)
        if joint.name in positions and joint.name not in named and link not in named
    }
    return with_held_joints(robot, held) if len(held) >= MANY else robot


def _held_positions(log: Log) -> dict[str, float]:
    """Return where joints that a log lacks are held, rad (m)."""
    with suppress(SymbidError):  # the checks report faults
        for part in log.slices(FIRST_PART, warn=False):
            if part.streams is not None:
                joints = part.streams.joints
                columns = [joints.names.index(name) for name in joints.held]
                return dict(zip(joints.held, joints.position[0, columns].tolist(), strict=True))
    return {}


def open_logs(sources: tuple[Source, ...], log: Log) -> list[Log]:
    """Return logs; all bags given by their paths form one log."""
    logs = [source for source in sources if isinstance(source, Log)]
    bags = tuple(source for source in sources if not isinstance(source, Log))
    return [*logs, *([log.other(bags)] if bags else [])]


def with_loaded_logs(
    options: IdentifyOptions, log: Log, dataset: Dataset, parameters: ParameterSet
) -> tuple[Dataset, ParameterSet]:
    """Return the log together with those of known payloads, and the parameters of all."""
    if not options.loaded_logs:
        return dataset, parameters
    model, logs = parameters.model, [dataset.segments]
    carried = [parameters.payloads]
    for source, text in options.loaded_logs:
        (further,) = open_logs((source,), log)
        logs.append(AlignedLog(further, model))
        carried.append((Payload.parse(text, model),))
    segments = ChainedSegments(logs)
    payloads = tuple(
        replace(payload, start=start, stop=stop + 1)
        for some, (start, stop) in zip(carried, segments.spans, strict=True)
        for payload in some
    )
    parameters = replace(parameters, payloads=payloads)
    return fold_dataset(segments, dataset.source, parameters, Processing.of(options)), parameters


def with_reversed(options: IdentifyOptions, wrong: Sequence[str], source: str) -> IdentifyOptions:
    """Return the options with the opposite sign of some wrist sensors, and log a warning."""
    frames = {sensor_frame(one) for one in wrong}
    named = [
        reversed_sensor(one) if sensor_frame(one) in frames else one
        for one in options.wrist_sensors
    ]
    logger.warning(
        "%s: the mass beyond %s would be negative, so its sign is reversed; give `wrist_sensor` %s",
        source,
        ", ".join(sorted(frames)),
        ",".join(named),
    )
    return replace(options, wrist_sensor=tuple(named))


def require_rows(dataset: Dataset, model: RobotModel) -> None:
    """Raise an error if no row is usable, so that the data say nothing."""
    if any(np.any(one.counts) for one in dataset.observations):
        return
    why = "each needs an effort"
    if model.contacts is not None:
        why = (
            "because the wrenches at contacts are unknown, each row needs the efforts of all "
            "joints that carry them; without efforts and wrenches not even the robot's mass can be "
            "identified"
        )
    raise DataError(
        f"{dataset.source}: no row of the equation of motion is usable: {why}; record the efforts "
        "of the joints (JointState.effort), or the wrenches of all contacts",
        "E326",
    )


def report_unnamed_sensors(model: RobotModel, dataset: Dataset) -> None:
    """Warn about wrench sensors that read the weight of a payload instead of a contact force."""
    for evidence in unnamed_sensors(model, dataset.samples):
        logger.warning(
            "%s: the force at %s is that of a body of %.3g kg fixed to it (%.0f %% of its "
            "variance); if it is a wrist sensor, give `wrist_sensor` %s",
            dataset.source,
            evidence.frame,
            abs(evidence.mass()[0]),
            100 * evidence.share,
            evidence.sensor,
        )
