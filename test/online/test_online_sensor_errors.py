"""Sensor errors that the identifier estimates live, the tare, and errors that change."""

import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from live_feed import Feed, feed_of

from symbid_ros.bags import bag_log
from symbid_ros.errors import DataError
from symbid_ros.identification.calibration.tares import Tare, read_tare
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import BagRequest
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.online.tare import TareRecording
from symbid_ros.package_paths import config_file

MODEL = config_file("symbitron.xml")
ROBOT = {"errors": "typical", "error_seed": 11}
OPTIONS = {
    "prior_percent": 25.0,
    "method": "map",
    "joint_terms": ("none",),
    "sensor_errors": ("typical",),
    "total_mass": 41.05,
    "total_mass_std": 0.02,
}
# Deviations by which a live estimate may differ from that of the bag: both are linearized about
# estimates, but not about the same.
TOLERANCE = 0.05
CHANGED = 11.5  # s
BIAS = 0.1  # m/s²


@pytest.fixture(scope="module")
def bag(simulated) -> Path:
    return simulated("smooth", moves=6, motion_seed=5, noise_seed=6, **ROBOT)


@pytest.fixture(scope="module")
def tare(simulated) -> Path:
    return simulated("tare", noise_seed=7, **ROBOT)


@pytest.fixture(scope="module")
def tares(tare) -> dict[str, Tare]:
    return read_tare(bag_log([tare]))


@pytest.fixture(scope="module")
def feed(bag) -> Feed:
    return feed_of(bag)


def begin(feed, tares, memory=np.inf):
    state = InitialState.of(load_model(MODEL), IdentifyOptions(**OPTIONS), tares)
    return OnlineIdentification(state, feed.selected, Pace(memory, share=1.0, in_step=True))


def test_live_sensor_errors_are_those_of_the_bag(bag, tare, tares, feed) -> None:
    live = begin(feed, tares)
    feed.into(live, solving=1.0)
    found = live.solve(exactly=True).found
    live.close()
    offline = BagRequest((bag,), MODEL, IdentifyOptions(**OPTIONS, tare=(tare,))).load()
    expected = offline.solve()
    estimate, other = found.estimate, expected.estimate
    assert np.all(np.abs(estimate.value - other.value) < TOLERANCE * other.std)
    std = np.linalg.norm(expected.factor, axis=1)
    assert np.all(np.abs(found.unknowns - expected.unknowns) < TOLERANCE * std)
    np.testing.assert_allclose(estimate.std, other.std, rtol=0.02)
    names, wanted = ([error.name for error in one.verdict.sensors] for one in (estimate, other))
    assert names == wanted
    assert estimate.verdict.alarms == other.verdict.alarms


def biased(payload: bytes) -> bytes:
    """Return an Imu message with more acceleration along x."""
    place = len(payload) - 9 * 8 - 3 * 8  # before the covariance
    (x,) = struct.unpack_from("<d", payload, place)
    return payload[:place] + struct.pack("<d", x + BIAS) + payload[place + 8 :]


def test_a_sensor_whose_error_changes_is_named(tares, feed) -> None:
    messages = tuple(
        (stamp, topic, biased(payload))
        if topic.name == "/imu/data" and stamp * 1e-9 > CHANGED
        else (stamp, topic, payload)
        for stamp, topic, payload in feed.messages
    )
    live = begin(feed, tares, memory=10.0)
    results = replace(feed, messages=messages).into(live, solving=1.0)
    live.close()
    seen = [(one.until * 1e-9, one.change) for one in results if one is not None and one.change]
    assert CHANGED < seen[0][0] < CHANGED + 4.0
    change = next(one for time, one in seen if time > CHANGED + 4.0)
    (suspect,) = change.suspects
    assert suspect.subject == "imu_link/imu_bias"
    assert abs(change.since * 1e-9 - CHANGED) < 2.0
    assert re.fullmatch(
        r"imu_link/imu_bias has changed since \d+\.\d s: accelerometer_x \+0\.\d+ ± \S+ m/s\^2",
        str(change),
    )
    place = suspect.sensor.names.index("imu_link/imu_bias_accelerometer_x")
    assert suspect.error[place] == pytest.approx(BIAS, abs=max(4 * suspect.std[place], 0.01))


def recorded(feed, names=()):
    """Return a recording of a tare from some messages of a feed."""
    live = begin(feed, {})
    recording = TareRecording(feed.selected, live.intake.checks)
    for _, topic, payload in feed.messages:
        if not names or topic.name in names:
            recording.add(topic, payload)
    live.close()
    return recording


def test_a_live_tare_reads_what_a_bag_does(tare, tares) -> None:
    found = recorded(feed_of(tare)).tares()
    assert found.keys() == tares.keys() == {"left_sole", "right_sole"}
    for frame, one in found.items():
        np.testing.assert_allclose(one.mean, tares[frame].mean, rtol=1e-9)
        np.testing.assert_allclose(one.std, tares[frame].std, rtol=1e-9)


def test_a_clock_that_jumps_back_does_not_spoil_a_tare(tare, tares) -> None:
    """As of a bag that is played again and again: what follows the jump counts."""
    feed = feed_of(tare)
    again = replace(feed, messages=feed.between(4.0, 4.5).messages + feed.messages)
    for frame, one in recorded(again).tares().items():
        np.testing.assert_allclose(one.mean, tares[frame].mean, rtol=1e-9)


def test_a_loaded_or_silent_sensor_is_not_tared(feed) -> None:
    with pytest.raises(DataError, match="no unloaded wrench sensor"):
        recorded(feed.between(1.0, 1.2)).tares()
    with pytest.raises(DataError, match="no wrench sensor published"):
        recorded(feed.between(1.0, 1.2), names=("/imu/data",)).tares()


def test_a_tare_is_a_prior_and_discards_data_that_contradict_it(tares, feed) -> None:
    live = begin(feed, {})
    feed.between(0.0, 5.0).into(live, solving=1.0)
    assert "agree" in live.set_tares(tares)
    prior = live._problem.prior
    places = [prior.names.index(f"left_sole/wrench_offset_force_{axis}") for axis in "xyz"]
    np.testing.assert_array_equal(prior.mean[places], tares["left_sole"].mean[3:])
    np.testing.assert_allclose(prior.std[places], tares["left_sole"].std[3:])
    feed.between(5.0, 8.0).into(live, solving=1.0)
    other = {"left_sole": replace(tares["left_sole"], mean=tares["left_sole"].mean + 40.0)}
    assert "discarded" in live.set_tares(other)
    assert live.solve() is None
    feed.between(8.0, 9.0).into(live)
    live.solve()
    assert live._problem.prior.mean[places[0]] == other["left_sole"].mean[3]
    live.close()
