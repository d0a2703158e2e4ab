"""Known payloads, in the whole log or in a further one."""

import numpy as np
import pytest
from drive_logs import arm, drives, log_of
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.errors import DataError, EstimateError, ModelError, OptionError
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.frames import Frame
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.payload import Payload
from symbid_ros.online.initial_state import InitialState

MASS, PLACE = 1.5, (0.02, -0.1, 0.2)


@pytest.fixture(scope="module")
def robot():
    return arm(seed=2)


@pytest.fixture(scope="module")
def text(robot):
    return ",".join([robot.link_names[-1], str(MASS), *map(str, PLACE)])


@pytest.fixture(scope="module")
def loaded(robot):
    """The robot with its payload."""
    phi = robot.phi.copy()
    phi[-1] += phi_from_com(MASS, np.array(PLACE), np.zeros((3, 3)))
    return robot.with_phi(phi)


def log_with(robot, start=0.0, **fields):
    return log_of(robot, drives(robot), start=start, **fields)


def assert_equal(result, other):
    difference = (result.estimate.value - other.estimate.value) / result.estimate.std
    links = 10 * len(result.links)
    np.testing.assert_allclose(difference[:links], 0, atol=1e-3)


def test_the_payload_of_the_log_is_not_identified(robot, loaded, text):
    fields = {"unchecked": True, "no_holdout": True, "joint_terms": "none"}
    result = sy.identify(robot, log_with(loaded), payload=text, **fields)
    motion = np.random.default_rng(2).normal(size=(3, 50, 3))
    torque = sy.regressor(robot, *motion)
    true = torque @ robot.phi.ravel()
    error = torque @ result.estimate.value - true
    assert np.linalg.norm(error) < 0.01 * np.linalg.norm(true)


def test_logs_with_and_without_payload_are_identified_together(robot, loaded, text):
    fields = {"unchecked": True, "no_holdout": True, "joint_terms": "none"}
    without, log = log_with(robot), log_with(loaded, start=100.0, seed=1)
    together = sy.identify(robot, without, payload=[(log, text)], **fields)
    one = sy.identify(robot, without, **fields)
    other = sy.identify(robot, log, payload=text, **fields)
    merged = sy.identify(robot, sy.merge([one.information, other.information]), joint_terms="none")
    assert_equal(together, merged)
    assert np.all(together.estimate.std[:30] <= one.estimate.std[:30] * (1 + 1e-3))


def test_the_holdout_knows_the_payload(robot, loaded, text):
    result = sy.identify(robot, log_with(loaded), payload=text, unchecked=True)
    assert result.estimate.holdout.percent_after < 1.0


def test_overlapping_stamps_of_a_wall_clock_are_refused(robot, text):
    log, other = (log_with(robot, start=1.7e9, seed=seed) for seed in (0, 1))
    with pytest.raises(DataError, match="overlap") as refusal:
        sy.identify(robot, log, payload=[(other, text)], unchecked=True)
    assert refusal.value.code == "E530"


def test_copies_of_a_log_are_refused(robot, text):
    log = log_with(robot)
    with pytest.raises(DataError, match="leave copies out") as refusal:
        sy.identify(robot, log, payload=[(log, text)], unchecked=True)
    assert refusal.value.code == "E530"


def test_logs_whose_clocks_start_at_zero_are_kept_apart(robot, loaded, text):
    fields = {"unchecked": True, "no_holdout": True, "joint_terms": "none"}
    without = log_with(robot)
    found, expected = (
        sy.identify(
            robot, without, payload=[(log_with(loaded, start=start, seed=1), text)], **fields
        )
        for start in (0.0, 120.0)
    )
    assert_equal(found, expected)


def test_information_with_and_without_drive_gains_names_them(robot):
    fields = {"unchecked": True, "no_holdout": True, "joint_terms": "none"}
    first = sy.identify(robot, log_with(robot), **fields)
    joint = robot.joint_names[-1]
    second = sy.identify(robot, log_with(robot, seed=1), drive_gain=joint, **fields)
    with pytest.raises(EstimateError, match=f"only one of both runs has {joint}/drive_gain") as one:
        sy.merge([first.information, second.information])
    assert one.value.code == "E505"
    assert "`drive_gain`" in str(one.value)


def test_the_doctor_knows_the_payload(robot, loaded, text, caplog):
    sy.identify(robot, log_with(loaded), payload=text, no_holdout=True)
    assert "times what the motion implies" not in caplog.text


@pytest.mark.parametrize("text", ["tool", "{0},1,0,0", "{0},-1,0,0,0", "{0},a,0,0,0", "b,1,0,0,0"])
def test_invalid_payloads_are_refused(robot, text):
    with pytest.raises(ModelError) as refusal:
        Payload.parse(text.format(robot.link_names[-1]), robot)
    assert refusal.value.code in ("E122", "E116")
    assert "`payload`: " in str(refusal.value)


def test_a_live_run_has_one_payload(robot, text):
    assert InitialState.of(robot, sy.IdentifyOptions(payload=text)).problem.parameters.payloads
    with pytest.raises(OptionError, match="payload"):
        InitialState.of(robot, sy.IdentifyOptions(payload=f"bag:{text}"))
    with pytest.raises(OptionError, match="place"):
        InitialState.of(robot, sy.IdentifyOptions(payload=f"{robot.link_names[-1]},{MASS}"))


def test_a_place_that_is_not_given_is_identified(robot, loaded):
    text = f"{robot.link_names[-1]},{MASS}"
    fields = {"unchecked": True, "no_holdout": True}
    together = sy.identify(
        robot, log_with(robot), payload=[(log_with(loaded, start=100.0, seed=1), text)], **fields
    )
    place = together.estimate.verdict.sensors
    error = np.array([one.value for one in place]) - PLACE
    deviation = np.array([one.std for one in place])
    assert np.all(deviation < 2e-3)
    assert np.all(np.abs(error) < 4 * deviation)


def test_validation_knows_what_the_robot_carries_in_its_log(robot, loaded, text):
    fields = {"unchecked": True, "no_holdout": True, "joint_terms": "none"}
    empty, carrying = log_with(robot, seed=8), log_with(loaded, seed=9)
    for result in (
        sy.identify(robot, log_with(robot), **fields),
        sy.identify(robot, log_with(loaded), payload=text, **fields),
    ):
        assert sy.validate(result, empty).percent_after < 1.0
        assert sy.validate(result, carrying, payload=text).percent_after < 1.0
        assert sy.validate(result, carrying).percent_after > 5.0
        with pytest.raises(OptionError, match=r"`payload`: .* give text"):
            sy.validate(result, carrying, payload=[1.5])
        with pytest.raises(OptionError, match="has no position for this payload"):
            sy.validate(result, carrying, payload=[f"{robot.link_names[-1]},{MASS}"])


def test_validation_knows_a_place_that_was_identified(tmp_path, robot, loaded):
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_text(robot))
    text = f"{robot.link_names[-1]},{MASS}"
    further = log_with(loaded, start=100.0, seed=1)
    result = sy.identify(
        sy.load_model(path, base="fixed"),
        log_with(robot),
        payload=[(further, text)],
        unchecked=True,
        no_holdout=True,
    )
    result.save(tmp_path / "result")
    for one in (result, tmp_path / "result"):
        assert sy.validate(one, log_with(loaded, seed=9), payload=[text]).percent_after < 1.0
        assert sy.validate(one, log_with(robot, seed=9)).percent_after < 1.0


def test_inertia_changes_with_the_place_as_that_of_a_point_mass(robot):
    turn = Rotation.from_rotvec([0.3, -0.8, 0.5]).as_matrix()
    frame = Frame("tool", len(robot.links) - 1, turn, np.array([0.1, 0.2, -0.3]))
    payload = Payload(frame.link, np.array([MASS, *np.zeros(9)]), frame=frame).moved(
        np.array(PLACE)
    )
    com = turn @ PLACE + frame.translation
    for axis, slope in zip(turn.T, payload.place_slope().T, strict=True):
        inertia = 2 * com @ axis * np.eye(3) - np.outer(com, axis) - np.outer(axis, com)
        moments = inertia[np.triu_indices(3)]
        np.testing.assert_allclose(slope, MASS * np.array([0.0, *axis, *moments]), atol=1e-12)


@pytest.mark.parametrize(
    "fields",
    [
        {"method": "ols"},
        {"filter": "butterworth", "cutoff": 30.0},
        {"contact": ("tool",)},
        {"drive_gain": "all"},
    ],
)
def test_an_unknown_place_needs_windows_of_measured_forces(fields):
    with pytest.raises(OptionError, match="payload"):
        sy.IdentifyOptions(payload="tool0,2.5", **fields)
