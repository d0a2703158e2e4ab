"""What may enter an identification: valid messages of this robot, on its clock."""

import logging
import time

from symbid_ros.errors import DataError
from symbid_ros.messages.layout import Layout
from symbid_ros.messages.single_message import MessagePattern, SingleMessageDecoder
from symbid_ros.messages.topics import Topic
from symbid_ros.messages.types import IMU, JOINT_STATE, NANO, WRENCH
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.stamps import CLOCK_JUMP, seconds

logger = logging.getLogger(__name__)

WARNING_PERIOD = 60.0  # s between two warnings about one topic
# rad, rad/s, Nm, N or m/s². No robot's sensor reads more, and one such value would outweigh all
# that has been learnt.
LARGEST = 1e6
VALUES = {
    JOINT_STATE: ("position", "velocity", "effort"),
    IMU: ("angular_velocity", "linear_acceleration"),
    WRENCH: ("wrench.force", "wrench.torque"),
}
MOST_PATTERNS = 8  # layouts of a topic's messages that are recognised at once
MOST_NAMES = 3  # of a foreign robot's joints, in a warning


class MessageCheck:
    """Checks the messages of one topic and drops those that cannot be this robot's.

    Dropped are bytes that do not decode, joint states of other joints, messages of another
    sensor's frame, values that no sensor reads, and single messages whose stamp lies far from
    those before and behind.

    Parameters
    ----------
    topic : Topic
        Name and type.
    model : RobotModel
        Its joints and frames.
    frame_prefix : str
        What ``header.frame_id`` begins with and the model's frames do not.

    Attributes
    ----------
    dropped : int
        Messages dropped so far.
    reason : str
        Why the last of them was; empty before the first.
    frame : str or None
        ``header.frame_id`` of the topic's sensor; None before its first message.
    """

    def __init__(self, topic: Topic, model: RobotModel, frame_prefix: str = "") -> None:
        self._topic = topic
        self._messages = SingleMessageDecoder(topic)
        self._patterns: list[MessagePattern] = []
        self._joints = frozenset(model.measured_joint_names)
        self._frames, self._prefix = known_frames(model), frame_prefix
        self._last: int | None = None
        self._held: tuple[int, bytes] | None = None
        self._warned = float("-inf")
        self.dropped = 0
        self.reason = ""
        self.frame: str | None = None

    def take(self, payload: bytes) -> tuple[tuple[int, bytes], ...]:
        """Return what may be used now that a message has come, as stamps (ns) and payloads.

        A message whose stamp leaps by more than a second waits for the next one, which shows
        whether the clock has changed or that one stamp is wrong.
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
            self._drop(f"{self._topic.name}: the stamp {seconds(held[0])} is another clock's")
        if abs(stamp - self._reference(stamp)) > CLOCK_JUMP:
            self._held = stamp, payload
            return ()
        self._last = stamp
        return ((stamp, payload),)

    def _reference(self, otherwise: int) -> int:
        return otherwise if self._last is None else self._last

    def _stamp(self, payload: bytes) -> int:
        """Return the stamp of a message of this robot, ns."""
        pattern, numbers = self._read(payload)
        second, nanosecond = pattern.stamp(numbers)
        if nanosecond >= NANO:
            raise DataError(f"{self._topic.name}: header.stamp.nanosec is a second or more", "E323")
        # NaN passes: what lacks a value is reported with its joint or axis later on.
        field = pattern.field_beyond(numbers, LARGEST)
        if field:
            raise DataError(f"{self._topic.name}: {field} exceeds {LARGEST:g}", "E323")
        return second * NANO + nanosecond

    def _read(self, payload: bytes) -> tuple[MessagePattern, bytes]:
        """Return the pattern of a message of this robot, and the message in little-endian bytes."""
        for pattern in self._patterns:
            if pattern.matches(payload):
                return pattern, payload
        layout, record = self._messages.decode(payload)
        objection = self._objection(layout)
        if objection:
            raise DataError(f"{self._topic.name}: {objection}", "E323")
        pattern = MessagePattern(layout, VALUES[self._topic.msgtype])
        if pattern.matches(payload):
            self._patterns = [pattern, *self._patterns[: MOST_PATTERNS - 1]]
        return pattern, record.tobytes()

    def _objection(self, layout: Layout) -> str:
        """Return why messages of a layout are not this robot's; empty if they may be."""
        if self._topic.msgtype == JOINT_STATE:
            return self._joint_objection(layout.text["name"])
        frame = layout.text["header.frame_id"][0]
        if self.frame is None and frame.removeprefix(self._prefix) in self._frames:
            self.frame = frame
        if frame == self.frame:
            return ""
        if self.frame is None:
            return f"the model has no frame {frame!r}"
        return f"header.frame_id is {frame!r}, not {self.frame!r} as in its first message"

    def _joint_objection(self, names: tuple[str, ...]) -> str:
        if len(set(names)) != len(names):
            return "a joint is named twice"
        if self._joints.isdisjoint(names):
            others = ", ".join(names[:MOST_NAMES]) or "none at all"
            return f"it names none of the model's joints ({others})"
        return ""

    def _drop(self, reason: str) -> None:
        self.dropped += 1
        self.reason = reason
        now = time.monotonic()
        if now - self._warned >= WARNING_PERIOD:
            self._warned = now
            logger.warning("%s; dropped (%d so far)", reason, self.dropped)


def known_frames(model: RobotModel) -> frozenset[str]:
    """Return every ``header.frame_id`` that a model can place: its frames and links."""
    return frozenset([*(frame.name for frame in model.frames), *model.link_names])
