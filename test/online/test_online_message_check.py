"""Messages of the robot are accepted in any byte order and layout; others are dropped."""

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from symbid_ros.messages.topics import Topic
from symbid_ros.model.load import load_model
from symbid_ros.online.message_check import MessageCheck
from symbid_ros.package_paths import config_file

STORE = get_typestore(Stores.ROS2_JAZZY)
JOINT_STATE = "sensor_msgs/msg/JointState"
MILLISECOND = 1_000_000


@pytest.fixture
def check() -> MessageCheck:
    return MessageCheck(
        Topic("/joint_states", JOINT_STATE), load_model(config_file("symbitron.xml"))
    )


def message(milliseconds: int, *, names=("L_kfe",), effort=1.0, little_endian=True) -> bytes:
    types = STORE.types
    seconds, rest = divmod(milliseconds, 1000)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest * MILLISECOND)
    values = np.full(len(names), effort)
    state = types[JOINT_STATE](
        header=types["std_msgs/msg/Header"](stamp=stamp, frame_id=""),
        name=list(names),
        position=values,
        velocity=values,
        effort=values,
    )
    return bytes(STORE.serialize_cdr(state, JOINT_STATE, little_endian=little_endian))


@pytest.mark.parametrize("little_endian", [True, False])
def test_either_byte_order_is_read(check: MessageCheck, little_endian: bool) -> None:
    for stamp in (5, 6, 7):
        payload = message(stamp, little_endian=little_endian)
        assert check.take(payload) == ((stamp * MILLISECOND, payload),)
    assert not check.take(message(8, effort=1e7, little_endian=little_endian))
    assert check.dropped == 1


def test_alternating_layouts_are_accepted(check: MessageCheck) -> None:
    for stamp in range(20):
        names = ("L_kfe",) if stamp % 2 else ("R_kfe", "gripper")
        assert check.take(message(stamp, names=names))
    assert not check.take(message(20, names=("gripper",)))
    assert not check.take(message(20, names=("L_kfe", "L_kfe")))
    assert not check.take(message(20, names=()))
    assert check.dropped == 3


def test_nan_values_are_accepted(check) -> None:
    assert check.take(message(1, effort=np.nan))


def test_two_messages_confirm_a_clock_change(check: MessageCheck) -> None:
    def taken(stamp: int) -> list[int]:
        return [at // MILLISECOND for at, _ in check.take(message(stamp))]

    assert [taken(stamp) for stamp in (9000, 9001, 5)] == [[9000], [9001], []]
    assert taken(9002) == [9002]  # it was a single wrong stamp
    assert check.dropped == 1
    assert [taken(stamp) for stamp in (1, 2, 3)] == [[], [1, 2], [3]]
    assert [taken(stamp) for stamp in (60_000, 120_000)] == [[], [60_000, 120_000]]
