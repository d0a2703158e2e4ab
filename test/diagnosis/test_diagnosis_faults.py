"""One fault at a time, put into a simulated log: each is named, and nothing else is blamed."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from bag_editing import BagEdit, Messages, edit_bag
from json_schemas import require_valid
from random_robots import CONFIG
from scipy.spatial.transform import Rotation

from symbid_ros.bags import bag_log
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Diagnosis, Finding, Kind, Severity
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

JOINTS, IMU, LEFT, RIGHT = "/joint_states", "/imu/data", "/left_foot/wrench", "/right_foot/wrench"
TOPICS = (JOINTS, IMU, LEFT, RIGHT)
VECTORS = ("wrench.force", "wrench.torque")
RATES = ("angular_velocity", "linear_acceleration")


@pytest.fixture(scope="module")
def model():
    """The robot as its maker knows it: every link off by up to a quarter."""
    robot = load_model(CONFIG / "symbitron.xml")
    parameters = ParameterSet(robot)
    return robot.with_phi(parameters.link_phi(draw_prior(parameters, "consistent", 25, 8).mean))


def kept(messages: Messages, rows: np.ndarray) -> None:
    """Leave out all other messages."""
    messages.order = messages.order[rows]
    messages.log_time = messages.log_time[rows]


@pytest.fixture(scope="module")
def log(simulated, tmp_path_factory) -> Path:
    """The first 11 s of a standing log at 500 Hz, a third of the work of the whole."""
    bag = simulated("smooth", moves=3, motion_seed=21, noise_seed=5)

    def halved(messages: Messages) -> None:
        rows = np.arange(len(messages.records))
        kept(messages, (rows % 2 == 0) & (rows < 11_000))

    return edit_bag(bag, tmp_path_factory.mktemp("log") / "half", dict.fromkeys(TOPICS, halved))


@pytest.fixture
def judged(log, model, tmp_path) -> Callable[..., Diagnosis]:
    def judge(edits: dict[str, BagEdit], *, alone: bool = False, bag: Path = log) -> Diagnosis:
        spoilt = edit_bag(bag, tmp_path / "spoilt", edits)
        diagnosis = diagnose(bag_log([spoilt], model), None if alone else model)
        require_valid("diagnosis", json.loads(json.dumps(diagnosis.as_dict())))
        return diagnosis

    return judge


def only(diagnosis: Diagnosis, kind: Kind, stream: str, severity: Severity) -> Finding:
    """The one finding there is."""
    assert [(one.kind, one.stream) for one in diagnosis.findings] == [(kind, stream)], [
        one.message for one in diagnosis.findings
    ]
    (found,) = diagnosis.findings
    assert found.severity is diagnosis.severity is severity
    assert "; " in found.message
    assert "\n" not in found.message
    return found


def turned(degrees: float, axis: str, fields: tuple[str, ...]) -> BagEdit:
    """A sensor whose axes are turned by so much."""
    rotation = Rotation.from_euler(axis, degrees, degrees=True)

    def operation(messages: Messages) -> None:
        for name in fields:
            messages.records[name] = rotation.apply(messages.records[name], inverse=True)

    return operation


def scaled(factor: float, fields: tuple[str, ...]) -> BagEdit:
    def operation(messages: Messages) -> None:
        for name in fields:
            messages.records[name] *= factor

    return operation


def effort_scaled(joint: str, factor: float) -> BagEdit:
    def operation(messages: Messages) -> None:
        messages.records["effort"][:, messages.joints.index(joint)] *= factor

    return operation


def late(milliseconds: int) -> BagEdit:
    """What a sensor saw is stamped so much later."""

    def operation(messages: Messages) -> None:
        messages.stamp = messages.stamp + milliseconds * 1_000_000

    return operation


def test_gap(judged) -> None:
    def operation(messages: Messages) -> None:
        kept(messages, ~messages.between(2.0, 2.25))

    found = only(judged({IMU: operation}), Kind.GAP, IMU, Severity.WARNING)
    assert found.figures == {"gaps": 1, "missing": 125, "longest_gap_s": pytest.approx(0.252)}


@pytest.mark.parametrize(("start", "stop"), [(1.5, 99.0), (0.0, 3.0), (1.5, 3.0)])
def test_a_topic_that_begins_late_or_ends_early(judged, start, stop) -> None:
    def operation(messages: Messages) -> None:
        kept(messages, messages.between(start, stop))

    diagnosis = judged({LEFT: operation}, alone=True)
    found = only(diagnosis, Kind.GAP, LEFT, Severity.WARNING)
    (joints,) = (one for one in diagnosis.streams if one.topic == JOINTS)
    early = max(joints.duration_s - stop, 0.0)
    assert found.figures["late_s"] == pytest.approx(start, abs=5e-3)
    assert found.figures["early_s"] == pytest.approx(early, abs=5e-3)


def test_duplicate(judged) -> None:
    def operation(messages: Messages) -> None:
        stamp = messages.stamp
        stamp[100:200:2] = stamp[101:200:2]
        messages.stamp = stamp

    # The stamps that they should have are not gaps as well.
    found = only(judged({LEFT: operation}, alone=True), Kind.DUPLICATE, LEFT, Severity.WARNING)
    assert found.figures["messages"] == 50


def test_disorder(judged) -> None:
    def operation(messages: Messages) -> None:
        messages.order[300:320:2], messages.order[301:320:2] = (
            messages.order[301:320:2].copy(),
            messages.order[300:320:2].copy(),
        )

    found = only(judged({JOINTS: operation}, alone=True), Kind.DISORDER, JOINTS, Severity.WARNING)
    assert found.figures["messages"] == 10


def test_clock_jump(judged) -> None:
    def operation(messages: Messages) -> None:
        stamp = messages.stamp
        messages.stamp = stamp - 3_000_000_000 * messages.between(4.0, np.inf)

    found = only(judged({IMU: operation}), Kind.CLOCK_JUMP, IMU, Severity.UNUSABLE)
    assert "jump back by 2.998 s" in found.message


def test_clocks_that_share_no_time(judged) -> None:
    def operation(messages: Messages) -> None:
        messages.stamp = messages.stamp + 10**18

    diagnosis = judged({IMU: operation}, alone=True)
    assert Kind.SILENT in {one.kind for one in diagnosis.findings}
    assert diagnosis.severity is Severity.UNUSABLE


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_not_finite(judged, value) -> None:
    def operation(messages: Messages) -> None:
        messages.records["wrench.torque"][50:60, 1] = value

    found = only(judged({RIGHT: operation}), Kind.NOT_FINITE, RIGHT, Severity.WARNING)
    assert found.figures["messages"] == 10
    assert "wrench.torque.y" in found.message


def test_mostly_not_finite(judged) -> None:
    def operation(messages: Messages) -> None:
        messages.records["angular_velocity"][::2] = np.nan

    only(judged({IMU: operation}), Kind.NOT_FINITE, IMU, Severity.UNUSABLE)


@pytest.mark.parametrize(
    ("topic", "field", "column", "value"),
    [(JOINTS, "position", 2, 3.0), (JOINTS, "effort", 2, 1e5), (RIGHT, "wrench.force", 2, -3e4)],
    ids=["position", "effort", "wrench"],
)
def test_single_wrong_readings_are_the_only_finding(judged, topic, field, column, value) -> None:
    def operation(messages: Messages) -> None:
        messages.records[field][[1500, 3000], column] = value

    found = only(judged({topic: operation}), Kind.SPIKE, topic, Severity.WARNING)
    assert found.figures["messages"] == 2
    assert field in found.message


@pytest.mark.parametrize(
    ("topic", "fields"), [(IMU, (*RATES, "orientation")), (LEFT, VECTORS)], ids=["imu", "wrench"]
)
def test_frozen_sensor(judged, topic, fields) -> None:
    def operation(messages: Messages) -> None:
        still = messages.between(3.0, 3.3)
        for name in fields:
            messages.records[name][still] = messages.records[name][still][0]

    found = only(judged({topic: operation}, alone=True), Kind.FROZEN, topic, Severity.WARNING)
    assert found.figures["frozen_s"] == pytest.approx(0.3, abs=2e-3)


def test_frozen_encoder(judged) -> None:
    def operation(messages: Messages) -> None:
        still, knee = messages.between(3.0, 3.3), messages.joints.index("L_kfe")
        messages.records["position"][still, knee] = messages.records["position"][still, knee][0]

    found = only(judged({JOINTS: operation}, alone=True), Kind.FROZEN, JOINTS, Severity.WARNING)
    assert "position of L_kfe" in found.message


@pytest.mark.parametrize(
    ("topic", "name", "column", "label"),
    [
        (LEFT, "wrench.force", 2, "wrench.force.z"),
        (IMU, "angular_velocity", 1, "angular_velocity.y"),
        (JOINTS, "effort", 2, "effort of"),
    ],
)
def test_saturated(judged, topic, name, column, label) -> None:
    def operation(messages: Messages) -> None:
        values = messages.records[name]
        values[:, column] = np.minimum(values[:, column], np.quantile(values[:, column], 0.95))

    found = only(judged({topic: operation}, alone=True), Kind.SATURATED, topic, Severity.WARNING)
    assert label in found.message


def test_a_saturated_force_does_not_look_like_another_fault(judged) -> None:
    """Its messages are left out of the checks against the model."""

    def operation(messages: Messages) -> None:
        force = messages.records["wrench.force"]
        force[:, 2] = np.minimum(force[:, 2], np.quantile(force[:, 2], 0.6))

    only(judged({LEFT: operation}), Kind.SATURATED, LEFT, Severity.WARNING)


def test_quaternion_norm(judged) -> None:
    def operation(messages: Messages) -> None:
        messages.records["orientation"][:500] *= 1.01

    found = only(judged({IMU: operation}, alone=True), Kind.QUATERNION_NORM, IMU, Severity.WARNING)
    assert found.figures == {"messages": 500, "worst_norm": pytest.approx(1.01)}


def test_joints_that_some_messages_lack(judged) -> None:
    def operation(messages: Messages) -> None:
        rows = np.arange(len(messages.records)) % 1000 == 5
        messages.rename(rows, range(9), messages.joints[:9])

    diagnosis = judged({JOINTS: operation}, alone=True)
    assert {one.kind for one in diagnosis.findings} == {Kind.MISSING_JOINT}


def test_joint_that_the_model_has_and_the_log_lacks(judged) -> None:
    def operation(messages: Messages) -> None:
        rows = np.ones(len(messages.records), dtype=bool)
        messages.rename(rows, range(1, 10), messages.joints[1:])

    # It is held at zero. Since it moved, other checks fail as well.
    missing = [
        one for one in judged({JOINTS: operation}).findings if one.kind is Kind.MISSING_JOINT
    ]
    assert len(missing) == 1
    # No driver could fill its effort.
    assert "the log lacks R_haa, so its row" in missing[0].message
    assert "JointState" not in missing[0].message


def test_joint_that_the_model_does_not_have(judged) -> None:
    def operation(messages: Messages) -> None:
        rows = np.ones(len(messages.records), dtype=bool)
        messages.rename(rows, [*range(10), 0], [*messages.joints, "head"])

    found = only(judged({JOINTS: operation}), Kind.UNKNOWN_JOINT, JOINTS, Severity.WARNING)
    assert "head" in found.message


def test_joints_in_another_order(judged) -> None:
    def operation(messages: Messages) -> None:
        rows = ~messages.between(0.0, 5.0)
        messages.rename(rows, range(9, -1, -1), messages.joints[::-1])

    found = only(judged({JOINTS: operation}), Kind.REORDERED_JOINTS, JOINTS, Severity.WARNING)
    assert 0.5 < found.figures["share"] < 0.7


@pytest.mark.parametrize(
    ("topic", "severity"), [(IMU, Severity.WARNING), (LEFT, Severity.UNUSABLE)]
)
def test_unknown_frame(judged, topic, severity) -> None:
    """The only IMU is assumed to have the model's only frame of an IMU."""
    found = judged({topic: lambda messages: messages.reframe("nowhere")})
    only(found, Kind.UNKNOWN_FRAME, topic, severity)


def test_rate(judged) -> None:
    def operation(messages: Messages) -> None:
        kept(messages, np.arange(len(messages.records)) % 12 == 0)

    found = only(judged({RIGHT: operation}, alone=True), Kind.RATE, RIGHT, Severity.WARNING)
    assert found.figures["rate_hz"] == pytest.approx(500 / 12)


def test_jitter(judged) -> None:
    def operation(messages: Messages) -> None:
        noise = np.random.default_rng(0).uniform(-0.9e6, 0.9e6, len(messages.records))
        messages.stamp = messages.stamp + noise.astype(np.int64)

    diagnosis = judged({IMU: operation}, alone=True)
    assert Kind.RATE in {one.kind for one in diagnosis.of(IMU)}


@pytest.mark.parametrize("topics", [(LEFT,), (LEFT, RIGHT)], ids=["one", "both"])
def test_wrench_sign(judged, topics) -> None:
    diagnosis = judged(dict.fromkeys(topics, scaled(-1, VECTORS)))
    assert {(one.kind, one.stream) for one in diagnosis.findings} == {
        (Kind.WRENCH_SIGN, topic) for topic in topics
    }
    assert diagnosis.severity is Severity.UNUSABLE


@pytest.mark.parametrize(("axis", "degrees"), [("x", 90), ("z", 90), ("z", 20), ("y", 180)])
def test_wrench_frame(judged, axis, degrees) -> None:
    diagnosis = judged({LEFT: turned(degrees, axis, VECTORS)})
    found = only(diagnosis, Kind.WRENCH_FRAME, LEFT, Severity.UNUSABLE)
    assert found.figures["angle_deg"] == pytest.approx(degrees, abs=1)


def test_wrench_gain(judged) -> None:
    found = only(judged({LEFT: scaled(0.5, VECTORS)}), Kind.WRENCH_GAIN, LEFT, Severity.WARNING)
    assert found.figures["reads"] == pytest.approx(0.5, abs=0.05)


def test_missing_wrench(judged, log, model, tmp_path) -> None:
    selection = TopicSelection(wrenches=(RIGHT,))
    only(diagnose(bag_log([log], model, selection), model), Kind.WEIGHT, "", Severity.UNUSABLE)


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_masses_of_the_model_in_another_unit(log, model, factor) -> None:
    """The wrenches weigh the robot, and links of its size have densities of solids."""
    wrong = model.with_phi(factor * model.phi)
    found = only(diagnose(bag_log([log], wrong), wrong), Kind.WEIGHT, "", Severity.UNUSABLE)
    assert found.figures["masses_times"] == pytest.approx(factor)
    assert "record the wrench" not in found.message


@pytest.mark.parametrize("wrenches", [(LEFT,), (LEFT, RIGHT)])
def test_forces_in_kgf(judged, wrenches) -> None:
    diagnosis = judged(dict.fromkeys(wrenches, scaled(1 / 9.80665, VECTORS)))
    found = [(one.kind, one.stream) for one in diagnosis.findings]
    assert found == [(Kind.WRENCH_GAIN, topic) for topic in wrenches]
    for one in diagnosis.findings:
        assert "as if in kgf; multiply its forces and torques by 9.81" in one.message


@pytest.mark.parametrize(("axis", "degrees"), [("x", 180), ("z", 90), ("y", 10)])
def test_imu_mounting(judged, axis, degrees) -> None:
    diagnosis = judged({IMU: turned(degrees, axis, RATES)})
    found = only(diagnosis, Kind.IMU_MOUNTING, IMU, Severity.UNUSABLE)
    assert found.figures["angle_deg"] == pytest.approx(degrees, abs=0.5)


def test_mirrored_gyroscope(judged) -> None:
    diagnosis = judged({IMU: scaled(-1, ("angular_velocity",))})
    only(diagnosis, Kind.IMU_MOUNTING, IMU, Severity.UNUSABLE)


def test_reversed_accelerometer(judged) -> None:
    diagnosis = judged({IMU: scaled(-1, ("linear_acceleration",))})
    found = only(diagnosis, Kind.IMU_MOUNTING, IMU, Severity.UNUSABLE)
    assert "REP-145" in found.message


@pytest.mark.parametrize("milliseconds", [10, -20])
def test_late_imu(judged, milliseconds) -> None:
    diagnosis = judged({IMU: late(milliseconds)})
    found = only(diagnosis, Kind.DELAY, IMU, Severity.WARNING)
    assert found.figures["delay_ms"] == pytest.approx(milliseconds, abs=1)


@pytest.mark.parametrize("milliseconds", [10, -20])
def test_late_wrench(judged, milliseconds) -> None:
    diagnosis = judged({LEFT: late(milliseconds)})
    found = only(diagnosis, Kind.DELAY, LEFT, Severity.WARNING)
    assert found.figures["delay_ms"] == pytest.approx(milliseconds, rel=0.25)


@pytest.mark.parametrize("joint", ["R_haa", "L_kfe", "R_adp"])
def test_torque_sign(judged, joint) -> None:
    diagnosis = judged({JOINTS: effort_scaled(joint, -1)})
    found = only(diagnosis, Kind.TORQUE_SIGN, JOINTS, Severity.UNUSABLE)
    assert found.figures == {f"{joint}/gain": pytest.approx(-1, abs=0.1)}


def test_all_torque_signs(judged) -> None:
    diagnosis = judged({JOINTS: scaled(-1, ("effort",))})
    found = only(diagnosis, Kind.TORQUE_SIGN, JOINTS, Severity.UNUSABLE)
    assert "all joints" in found.message


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_torque_gain(judged, factor) -> None:
    diagnosis = judged({JOINTS: effort_scaled("L_hfe", factor)})
    found = only(diagnosis, Kind.TORQUE_GAIN, JOINTS, Severity.WARNING)
    assert found.figures["reads"] == pytest.approx(factor, rel=0.1)


def test_excitation(log, model, tmp_path) -> None:
    def beginning(messages: Messages) -> None:
        kept(messages, messages.between(0.0, 1.0))

    bag = edit_bag(log, tmp_path / "still", dict.fromkeys(TOPICS, beginning))
    only(diagnose(bag_log([bag], model), model), Kind.EXCITATION, "", Severity.WARNING)
