"""Logs are checked against the model before they are identified."""

import numpy as np
import pytest
from bag_editing import Messages, edit_bag
from random_robots import CONFIG
from scipy.spatial.transform import Rotation

from symbid_ros.errors import DataError
from symbid_ros.identification.loaded_problem import LoadedProblem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.model.load import load_model
from symbid_ros.offline import bags
from symbid_ros.offline.bags import BagRequest

ALL = LogOptions()
RIGHT = "/right_foot/wrench"


@pytest.fixture(scope="module")
def log(simulated):
    return simulated("smooth", moves=2, motion_seed=7, noise_seed=3)


def load(bag, log: LogOptions = ALL, terms=("none",), **options) -> LoadedProblem:
    options = IdentifyOptions(window=0.081, joint_terms=terms, **options)
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


def test_a_doubtful_gain_is_told_once(log, tmp_path, caplog) -> None:
    """As an alarm, or as a warning if the method has no verdict that could hold it."""
    bag = edit_bag(log, tmp_path / "halved", {"/joint_states": halved_effort})
    problem = load(bag)
    found = problem.with_provenance(problem.solve())
    assert caplog.messages == []
    assert "/joint_states: effort of R_hfe reads 0." in found.estimate.verdict.alarms[0]
    problem.with_provenance(problem.solve("wls"))
    (message,) = caplog.messages
    assert "/joint_states: effort of R_hfe reads 0." in message


def test_a_wrong_gain_of_an_imu_is_an_alarm_of_the_estimate(log, tmp_path) -> None:
    def spoil(messages: Messages) -> None:
        messages.records["linear_acceleration"] *= 1.02

    problem = load(edit_bag(log, tmp_path / "gain", {"/imu/data": spoil}))
    (finding,) = problem.checks.findings
    assert problem.solve().estimate.verdict.alarms[0] == finding.message
    assert "+2.0 %" in finding.message
    assert problem.with_prior(problem.prior).checks == problem.checks


@pytest.mark.parametrize("degrees", [9.0, 20.0])
def test_an_imu_mounted_several_degrees_off_is_estimated(log, tmp_path, degrees) -> None:
    """The log is refused unless the mounting is estimated."""
    turn = Rotation.from_rotvec(np.radians(degrees) * np.array([0.6, -0.64, 0.48]))

    def spoil(messages: Messages) -> None:
        for name in ("angular_velocity", "linear_acceleration"):
            vectors = messages.records[name]
            messages.records[name] = turn.apply(vectors, inverse=True)
        messages.records["orientation"][:] = (
            Rotation.from_quat(messages.records["orientation"]) * turn
        ).as_quat()

    bag = edit_bag(log, tmp_path / "turned", {"/imu/data": spoil})
    with pytest.raises(DataError, match="roll"):
        load(bag)
    problem = BagRequest(
        (bag,),
        CONFIG / "symbitron.urdf",
        IdentifyOptions(sensor_errors=("imu_mounting",), joint_terms=("none",)),
    ).load()
    verdict = problem.solve().estimate.verdict
    found = np.array([one.value for one in verdict.sensors])
    std = np.array([one.std for one in verdict.sensors])
    assert np.all(np.abs(found - turn.as_rotvec()) < 4 * std)
    assert np.degrees(std.max()) < 0.3
    assert not any("roll" in alarm for alarm in verdict.alarms)


def test_an_offset_of_one_joint_is_chosen_though_its_links_could_replace_it(log, tmp_path) -> None:
    def spoil(messages: Messages) -> None:
        messages.records["effort"][:, messages.joints.index("R_hfe")] += 1.0

    bag = edit_bag(log, tmp_path / "offset", {"/joint_states": spoil})
    estimate = load(bag, terms=("auto",)).solve().estimate
    assert [one for one, terms in estimate.joint_terms.items() if "offset" in terms] == ["R_hfe"]
    place = estimate.names.index("R_hfe/offset")
    # An effort that reads 1 Nm too much looks like a constant torque of the joint.
    assert abs(abs(estimate.value[place]) - 1.0) < 4 * estimate.std[place]


def test_a_completed_request_reads_its_model_once(log, monkeypatch) -> None:
    read = []

    def counted(*arguments):
        read.append(arguments)
        return load_model(*arguments)

    monkeypatch.setattr(bags, "load_model", counted)
    request = BagRequest((log,), CONFIG / "symbitron.xml", IdentifyOptions(joint_terms=("none",)))
    assert request.completed().load().parameters.model.floating
    assert len(read) == 1
