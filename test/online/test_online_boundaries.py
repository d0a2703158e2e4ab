"""A slow topic that is not on the joint states' clock is smooth across block boundaries."""

from pathlib import Path

import numpy as np
import pytest
from bag_editing import Messages, edit_bag
from live_feed import feed_of
from scipy.interpolate import CubicSpline

from symbid_ros.bags import bag_log, read_streams
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.load import load_model
from symbid_ros.online.block_scheduler import BlockScheduler
from symbid_ros.package_paths import config_file
from symbid_ros.signals.weak_form import BLOCK

SLOW = "/left_foot/wrench"


@pytest.fixture(scope="module")
def model():
    return load_model(config_file("symbitron.xml"))


@pytest.fixture(scope="module")
def bag(simulated, tmp_path_factory) -> Path:
    """Return a log of which one wrench came at 100 Hz, between the joint states' ticks."""

    def slowed(messages: Messages) -> None:
        messages.stamp = messages.stamp + 370_000
        messages.order = messages.order[::10]
        messages.log_time = messages.log_time[::10] + 370_000

    fast = simulated("smooth", moves=2, motion_seed=7, noise_seed=3)
    return edit_bag(fast, tmp_path_factory.mktemp("slow") / "bag", {SLOW: slowed})


def live(bag: Path, model):
    feed = feed_of(bag)
    scheduler = BlockScheduler(feed.selected, model, 0.5, "live")
    found = []
    for stamp, topic, payload in feed.messages:
        scheduler.streams.add(topic, stamp, payload)
        found += scheduler.complete_blocks()
    found.append(scheduler.open_block())
    assert not [stretch.fault for stretch in found if stretch.fault]
    return [segment for stretch in found for segment in stretch.segments]


def offline(bag: Path, model):
    return list(AlignedLog(bag_log([bag], model), model, span=BLOCK))


@pytest.mark.parametrize("read", [live, offline])
def test_a_slow_topic_is_interpolated_across_block_boundaries(bag, model, read) -> None:
    streams = read_streams([bag])
    (wrench,) = (one for one in streams.wrenches if one.topic == SLOW)
    assert 8 * len(wrench.stamp) < len(streams.joints.stamp)
    segments = read(bag, model)
    stamp = np.concatenate([segment.stamp for segment in segments])
    ticks = streams.joints.stamp
    inside = ticks[(ticks >= wrench.stamp[0]) & (ticks <= wrench.stamp[-1])]
    np.testing.assert_array_equal(stamp, inside)
    assert {segment.stamp[0] // BLOCK for segment in segments} == set(stamp // BLOCK)
    assert len(segments) > 2
    values = np.concatenate([wrench.torque, wrench.force], axis=1)
    spline = CubicSpline((wrench.stamp - stamp[0]) * 1e-9, values)
    at = segments[0].wrench_frames.index(wrench.frame_id)
    found = np.concatenate([segment.wrenches[:, at] for segment in segments])
    expected = spline((stamp - stamp[0]) * 1e-9)
    # A message ten messages away has a weight of 0.27 ** 10 = 2e-6.
    largest = np.abs(np.diff(values, axis=0)).max(axis=0)
    assert np.all(np.abs(found - expected) < 1e-5 * largest)
