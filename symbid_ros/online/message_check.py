"""Drops invalid messages and those of other robots or clocks before an identification."""

import logging
import time

from symbid_ros.errors import DataError
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.sensor_mapping import SAME, SensorMapping
from symbid_ros.messages.single_message import MessagePattern, SingleMessageDecoder
from symbid_ros.messages.topics import Topic
from symbid_ros.messages.types import IMU, JOINT_STATE, NANO, ODOMETRY, POSE, WRENCH
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.defects import CLOCK_JUMP, seconds

logger = logging.getLogger(__name__)

WARNING_PERIOD = 60.0  # s between two warnings about one topic
# rad, rad/s, Nm, N or m/s². No robot's sensor reads more, and one larger value would outweigh all
# other data.
LARGEST_VALUE = 1e6
VALUES = {
    JOINT_STATE: ("position", "velocity", "effort"),
    IMU: ("angular_velocity", "linear_acceleration"),
    WRENCH: ("wrench.force", "wrench.torque"),
    POSE: ("pose.position", "pose.orientation"),
    ODOMETRY: ("pose.pose.position", "pose.pose.orientation"),
}
MAX_PATTERNS = 8  # layouts of a topic's messages that are decoded quickly
MAX_NAMES = 3  # of another robot's joints, in a warning


class MessageCheck:
    """Checks the messages of one topic and drops the invalid ones.

    A message is dropped if it cannot be decoded, has none of the robot's joints or another frame,
    has a value beyond any sensor's range, or has a stamp far from both of its neighbours' stamps.

    Parameters
    ----------
    topic : Topic
        Name and type.
    model : RobotModel
        The robot's joints and frames.
    mapping : SensorMapping
        Names of joints and frames in the messages.
    takes_any_frame : bool
        Whether messages may have a frame that the model lacks, such as one of the world.

    Attributes
    ----------
    dropped : int
        Messages dropped so far.
    reason : str
        Why the last message was dropped; empty before the first.
    frame : str or None
        ``header.frame_id`` of the topic's sensor; None before its first message.
    """

    def __init__(
        self,
        topic: Topic,
        model: RobotModel,
        mapping: SensorMapping = SAME,
        *,
        takes_any_frame: bool = False,
    ) -> None:
        self._topic = topic
        self._messages = SingleMessageDecoder(topic)
        self._patterns: list[MessagePattern] = []
        self._joints = mapping.recorded_joints(model.measured_joint_names)
        self._frames, self._mapping = known_frames(model), mapping
        self._takes_any_frame = takes_any_frame
        self._last: int | None = None
        self._held: tuple[int, bytes] | None = None
        self._warned = float("-inf")
        self.dropped = 0
        self.reason = ""
        self.frame: str | None = None

    def take(self, payload: bytes) -> tuple[tuple[int, bytes], ...]:
        """Check a message and return the usable ones as stamps (ns) and payloads.

        A message whose stamp jumps by more than a second is held until the next one, which shows
        whether the clock changed or this stamp is wrong.
        """
        try:
            stamp = self._stamp(payload)
        except DataError as error:
            self._drop(str(error))
            return ()
        held, self._held = self._held, None
        if held is not None:
            if abs(stamp - held[0]) < abs(stamp - self._reference(held[0])):
                self._last = stamp
                return (held, (stamp, payload))
            self._drop(
                f"{self._topic.name}: the stamp {seconds(held[0])} is not on the topic's clock"
            )
        if abs(stamp - self._reference(stamp)) > CLOCK_JUMP:
            self._held = stamp, payload
            return ()
        self._last = stamp
        return ((stamp, payload),)

    def _reference(self, default: int) -> int:
        return default if self._last is None else self._last

    def _stamp(self, payload: bytes) -> int:
        """Return the stamp of a valid message, ns."""
        pattern, numbers = self._read(payload)
        second, nanosecond = pattern.stamp(numbers)
        if nanosecond >= NANO:
            raise DataError(f"{self._topic.name}: header.stamp.nanosec is a second or more", "E323")
        # NaN is accepted: missing values are reported later with their joint or axis.
        field = pattern.field_beyond(numbers, LARGEST_VALUE)
        if field:
            raise DataError(f"{self._topic.name}: {field} exceeds {LARGEST_VALUE:g}", "E323")
        return second * NANO + nanosecond

    def _read(self, payload: bytes) -> tuple[MessagePattern, bytes]:
        """Return the pattern of a valid message, and the message in little-endian bytes."""
        for pattern in self._patterns:
            if pattern.matches(payload):
                return pattern, payload
        layout, record = self._messages.decode(payload)
        reason = self._rejection_reason(layout)
        if reason:
            raise DataError(f"{self._topic.name}: {reason}", "E323")
        pattern = MessagePattern(layout, VALUES[self._topic.msgtype])
        if pattern.matches(payload):
            self._patterns = [pattern, *self._patterns[: MAX_PATTERNS - 1]]
        return pattern, record.tobytes()

    def _rejection_reason(self, layout: Layout) -> str:
        """Return why messages of this layout are invalid; empty if they are valid."""
        if self._topic.msgtype == JOINT_STATE:
            return self._joint_rejection_reason(layout.text["name"])
        frame = layout.text["header.frame_id"][0]
        is_known = self._takes_any_frame or self._mapping.frame(frame) in self._frames
        if self.frame is None and is_known:
            self.frame = frame
        if frame == self.frame:
            return ""
        if self.frame is None:
            return f"the model has no frame {frame!r}"
        return f"header.frame_id is {frame!r}, not {self.frame!r} as in its first message"

    def _joint_rejection_reason(self, names: tuple[str, ...]) -> str:
        if len(set(names)) != len(names):
            return "a joint is listed twice"
        if self._joints.isdisjoint(names):
            others = ", ".join(names[:MAX_NAMES]) or "no joint"
            return (
                f"it has none of the model's joints ({others}); give `rename_joint` NAME:=JOINT, "
                "or let `symbid init` find the names"
            )
        return ""

    def _drop(self, reason: str) -> None:
        self.dropped += 1
        self.reason = reason
        now = time.monotonic()
        if now - self._warned >= WARNING_PERIOD:
            self._warned = now
            logger.warning("%s; dropped (%d so far)", reason, self.dropped)


def known_frames(model: RobotModel) -> frozenset[str]:
    """Return every valid ``header.frame_id`` of a model: its frames and links."""
    return frozenset([*(frame.name for frame in model.frames), *model.link_names])
