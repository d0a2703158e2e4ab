"""Checks that a log has the sensors and the frames that a model needs."""

from collections.abc import Iterator
from dataclasses import replace

from symbid_ros.dynamics.unmeasured_contacts import MOST_FLAGGED, touched_frame
from symbid_ros.errors import DataError, ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import robot_file_line
from symbid_ros.signals.base_pose import PoseStream
from symbid_ros.signals.streams import ImuStream, Streams, WrenchStream


def check_sensors(streams: Streams, model: RobotModel) -> None:
    """Check that a log has the IMU, the wrenches and the frames that a model needs.

    Raises
    ------
    DataError, ModelError
        When one is missing.
    """
    if fault := missing_imu(streams, model):
        raise DataError(f"{streams.source}: {fault}", "E307")
    sensors: list[ImuStream | WrenchStream | PoseStream] = [*streams.wrenches]
    if model.floating:
        sensors = [*streams.imus, *streams.poses, *sensors]
    for sensor in sensors:
        _check_frame(sensor, model, streams.source)
    for fault in wrist_sensor_faults(streams, model):
        raise DataError(f"{streams.source}: {fault}", "E324")
    for fault in contact_flag_faults(streams, model):
        raise DataError(f"{streams.source}: {fault}", "E366")


def missing_imu(streams: Streams, model: RobotModel) -> str:
    """Return that a floating robot lacks an IMU, and the remedy; empty if it has what it needs."""
    if not model.floating or streams.imus:
        return ""
    fault = f"the base of {model.source} floats, but there is no "
    if streams.is_arrays:
        fault += (
            "array of an IMU; give Log.from_arrays imus={FRAME: values} with (N, 6) values of "
            "angular velocity and specific force, or poses={FRAME: values} with (N, 7) values of "
            "position and quaternion xyzw, or load the model with"
        )
    else:
        fault += (
            "topic of type sensor_msgs/msg/Imu; record the IMU, name the topic of a measured pose "
            "(`pose_topic`), or give"
        )
    return f"{fault} `base` fixed if it is bolted down"


def wrist_sensor_faults(streams: Streams, model: RobotModel) -> Iterator[str]:
    """Yield what is wrong with each wrist sensor whose frame not exactly one topic has."""
    for frame in model.wrist_sensors:
        topics = [one.topic for one in streams.wrenches if one.frame_id == frame]
        if len(topics) == 1:
            continue
        others = sorted({one.frame_id for one in streams.wrenches} - {frame})
        nothing = "no array of wrenches" if streams.is_arrays else "no WrenchStamped topic"
        found = f"{' and '.join(topics)} have" if topics else f"{nothing} has"
        also = f" (others have {', '.join(others)})" if others else ""
        action = (
            "record its topic, name it by `wrench_topic` if its name does not end in wrench, or "
            "correct `wrist_sensor`"
        )
        if streams.is_arrays:
            action = "give Log.from_arrays wrenches={FRAME: values}, or correct `wrist_sensor`"
        if others:
            action += f", or write {robot_file_line('wrist_sensor', *others)}"
        if topics:
            line = robot_file_line("wrench_topic", topics[0])
            action = f"name one of them by `wrench_topic`, or write {line}"
        yield f"{found} the frame {frame} of the wrist sensor{also}; {action}"


def contact_flag_faults(streams: Streams, model: RobotModel) -> Iterator[str]:
    """Yield what is wrong with each topic of contact flags that belongs to no named contact."""
    names = () if model.contacts is None else model.contacts.frames
    for one in streams.flags:
        if touched_frame(model, one.frame_id) not in names:
            named = ", ".join(names) or "none"
            yield (
                f"{one.topic}: its flags are for {one.frame_id}, but the named contacts are "
                f"{named}; add {one.frame_id} to `contact`, or correct `contact_flag`, or write "
                f"{robot_file_line('contact', *names, one.frame_id)}"
            )
    if streams.flags and len(names) > MOST_FLAGGED:
        yield (
            f"flags of more than {MOST_FLAGGED} contacts cannot be used; leave `contact_flag` out"
        )


def _check_frame(
    sensor: ImuStream | WrenchStream | PoseStream, model: RobotModel, source: str
) -> None:
    """Check that the model has a sensor's frame; if not, suggest the prefix to remove."""
    frame = sensor.frame_id
    try:
        model.frame(frame)
    except ModelError as error:
        prefix = suggested_prefix(frame, model)
        if not prefix:
            likely = _only_imu_frame(model) if isinstance(sensor, ImuStream) else ""
            pair = f"{frame}:={likely or 'NAME'}"
            if_so = f" if it is mounted as {likely} is" if likely else ""
            raise ModelError(
                f"{source}: {sensor.topic}: {error}, or give `rename_frame` {pair}{if_so}, or "
                f"write {robot_file_line('rename_frame', pair)}",
                "E308",
            ) from error
        raise ModelError(
            f"{source}: {sensor.topic}: frame {frame!r} is not in model {model.source}, but "
            f"{frame.removeprefix(prefix)!r} is; give `frame_prefix` {prefix}, or write "
            f"frame_prefix: {prefix} in robot.yaml",
            "E308",
        ) from error


def with_only_imu_frame(streams: Streams, model: RobotModel) -> tuple[Streams, str]:
    """Return streams in which the only IMU has the model's only IMU frame, and a warning.

    The streams are the same, and the warning is empty, if the model has the IMU's own frame, if the
    choice is not unique, or if arrays name their frames themselves.
    """
    frame = _only_imu_frame(model)
    if not frame or not model.floating or streams.is_arrays or len(streams.imus) != 1:
        return streams, ""
    (imu,) = streams.imus
    if imu.frame_id in _frame_names(model) or suggested_prefix(imu.frame_id, model):
        return streams, ""
    pair = f"{imu.frame_id}:={frame}"
    warning = (
        f"{imu.topic}: the model has no frame {imu.frame_id!r}, so the readings "
        f"are assumed to be in the axes of {frame}, the model's only frame of an IMU; give "
        f"`rename_frame` {pair} if that is right, or correct header.frame_id"
    )
    return replace(streams, imus=(replace(imu, frame_id=frame),)), warning


def _only_imu_frame(model: RobotModel) -> str:
    """Return the only frame or link that is named after an IMU; empty if there is none."""
    named = [name for name in _frame_names(model) if "imu" in name.lower()]
    return named[0] if len(named) == 1 else ""


def _frame_names(model: RobotModel) -> set[str]:
    return {*(one.name for one in model.frames), *model.link_names}


def suggested_prefix(frame: str, model: RobotModel) -> str:
    """Return the prefix of a sensor's frame without which the model has it; empty if none."""
    known = _frame_names(model)
    cuts = [index + 1 for index, letter in enumerate(frame) if letter == "/"]
    return next((frame[:cut] for cut in cuts if frame[cut:] in known), "")
