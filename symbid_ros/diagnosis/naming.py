"""Names in a log that the model does not know, and names of the model that the log lacks."""

from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.streams import ImuStream, Streams, WrenchStream


def check_names(streams: Streams, model: RobotModel) -> list[Finding]:
    """Compare joint names and frames with a model's."""
    joints = streams.joints
    found = []
    missing = [name for name in model.measured_joint_names if name not in joints.names]
    if missing:
        found.append(
            Finding(
                Kind.MISSING_JOINT,
                joints.topic,
                Severity.UNUSABLE,
                f"{joints.topic}: lacks {', '.join(missing)} of model {model.source}; record all "
                "of its joints or give the model of this robot",
                {"joints": len(missing)},
            )
        )
    unknown = [name for name in joints.names if name not in model.joint_names]
    if unknown:
        found.append(
            Finding(
                Kind.UNKNOWN_JOINT,
                joints.topic,
                Severity.WARNING,
                f"{joints.topic}: names {', '.join(unknown)}, which model {model.source} does not "
                "have: taken to be rigid; give a model that has what moves",
                {"joints": len(unknown)},
            )
        )
    sensors: list[ImuStream | WrenchStream] = [
        *(streams.imus if model.floating else ()),
        *streams.wrenches,
    ]
    for sensor in sensors:
        try:
            model.frame(sensor.frame_id)
        except ModelError as error:
            found.append(
                Finding(
                    Kind.UNKNOWN_FRAME, sensor.topic, Severity.UNUSABLE, f"{sensor.topic}: {error}"
                )
            )
    if model.floating and not streams.imus:
        found.append(
            Finding(
                Kind.SILENT,
                "",
                Severity.UNUSABLE,
                f"{streams.source}: the base of {model.source} floats, but no topic is of type "
                "sensor_msgs/msg/Imu; record the IMU, or give --base fixed if it is bolted down",
            )
        )
    return found
