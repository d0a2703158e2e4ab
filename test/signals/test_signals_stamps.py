"""Lost messages as header stamps show them."""

import numpy as np
from foreign_bags import imu
from hypothesis import given
from hypothesis import strategies as st

from symbid_ros.messages.types import has_stamp, read_leading_stamp
from symbid_ros.signals.stamps import find_gaps

PERIOD = 1_000_000


@given(st.integers(20, 200), st.data())
def test_every_message_taken_out_is_missed(count: int, data: st.DataObject) -> None:
    inner = st.lists(st.integers(1, count - 2), max_size=count // 4, unique=True)
    lost = data.draw(inner)
    stamps = np.delete(np.arange(count) * PERIOD, lost)
    gaps = find_gaps(stamps)
    runs = sum(1 for place in lost if place - 1 not in lost)
    assert (gaps.period, gaps.missing, gaps.gaps) == (PERIOD, len(lost), runs)
    assert gaps.disordered == 0


def test_jitter_below_half_a_period_is_no_gap() -> None:
    jitter = np.random.default_rng(0).integers(-200_000, 200_000, 1000)
    gaps = find_gaps(np.arange(1000) * PERIOD + jitter)
    assert (gaps.gaps, gaps.missing, gaps.disordered) == (0, 0, 0)


def test_order_of_arrival_is_judged_apart_from_gaps() -> None:
    gaps = find_gaps(np.array([0, 2, 1, 3, 3, 4]) * PERIOD)
    assert (gaps.missing, gaps.disordered, gaps.longest) == (0, 2, PERIOD)


def test_single_message_has_no_period() -> None:
    assert find_gaps(np.array([5])).period == 0


def test_stamp_is_read_from_the_bytes() -> None:
    assert read_leading_stamp(imu(12_000_000_345)) == 12_000_000_345
    assert has_stamp("sensor_msgs/msg/Imu")
    assert has_stamp("rosgraph_msgs/msg/Clock")
    assert not has_stamp("std_msgs/msg/String")
