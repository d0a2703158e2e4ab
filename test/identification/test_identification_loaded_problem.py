"""Logs are checked against the model before they are identified."""

import numpy as np
import pytest
from bag_editing import Messages, edit_bag
from random_robots import CONFIG

from symbid_ros.errors import DataError
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.offline.bags import BagRequest

ALL = LogOptions()
RIGHT = "/right_foot/wrench"


@pytest.fixture(scope="module")
def log(simulated):
    return simulated("smooth", moves=2, motion_seed=7, noise_seed=3)


def load(bag, log: LogOptions = ALL, **options) -> LoadedProblem:
    options = IdentifyOptions(window=0.081, **options)
    return BagRequest((bag,), CONFIG / "symbitron.urdf", options, log).load()


def reversed_wrench(messages: Messages) -> None:
    messages.records["wrench.force"] *= -1
    messages.records["wrench.torque"] *= -1


def halved_effort(messages: Messages) -> None:
    messages.records["effort"][:, messages.joints.index("R_hfe")] *= 0.5


def test_a_clean_log_gives_no_warning(log, caplog) -> None:
    load(log)
    assert caplog.messages == []


def test_a_reversed_wrench_is_refused_unless_unchecked(log, tmp_path) -> None:
    bag = edit_bag(log, tmp_path / "reversed", {RIGHT: reversed_wrench})
    with pytest.raises(DataError, match=f"reversed: {RIGHT}: ") as refusal:
        load(bag)
    assert refusal.value.code == "E517"
    assert "`unchecked`" in str(refusal.value)
    assert "\n" not in str(refusal.value)
    wrong = load(bag, unchecked=True)
    right = load(log)
    assert np.array_equal(wrong.dataset.samples.stamp, right.dataset.samples.stamp)


def test_a_missing_contact_is_refused(log) -> None:
    left_alone = LogOptions(wrench_topic=("/left_foot/wrench",))
    with pytest.raises(DataError, match="record the wrench of every contact"):
        load(log, left_alone)


def test_a_doubtful_gain_gives_a_warning(log, tmp_path, caplog) -> None:
    bag = edit_bag(log, tmp_path / "halved", {"/joint_states": halved_effort})
    load(bag)
    (message,) = caplog.messages
    assert "/joint_states: effort of R_hfe reads 0." in message
