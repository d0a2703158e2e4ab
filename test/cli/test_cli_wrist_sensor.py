"""A bag of an arm with a wrist sensor, by the command and live."""

import json

import numpy as np
import pytest
import yaml
from documented_robots import ur5_urdf, write_inaccurate
from json_schemas import require_valid
from live_feed import feed_of
from payload_arm import COM, INERTIA, MASS, OFFSET, payload_arm_log, write_payload_bag

from symbid_ros.errors import DataError
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.inertia import phi_from_com, transform_phi
from symbid_ros.model.load import load_model
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState

SENSOR = ("--wrist-sensor", "tool0")
FAST = ("--joint-terms", "none", "--window", "0.161")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    folder = tmp_path_factory.mktemp("wrist")
    arm = load_model(ur5_urdf())
    write_inaccurate(ur5_urdf(), folder / "arm.urdf", seed=1)
    log = payload_arm_log(arm, "tool0", seconds=13.0)
    write_payload_bag(log, arm, "tool0", folder / "bag")
    return folder


@pytest.fixture(scope="module")
def document(folder, symbid_here):
    ended = symbid_here(
        "identify", folder / "bag", "--model", folder / "arm.urdf", *SENSOR, *FAST, "--out",
        folder / "out",
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "beyond tool0: 1.700 ±" in ended.stdout
    document = json.loads((folder / "out" / "estimate.json").read_text())
    require_valid("estimate", document)
    return document


def payload(parameters, value=lambda one: one["value"]):
    mass = value(parameters["tool0/m"])
    com = [value(parameters[f"tool0/mc_{axis}"]) / mass for axis in "xyz"]
    offset = [
        value(parameters[f"tool0/offset_{kind}_{axis}"])
        for kind in ("force", "moment")
        for axis in "xyz"
    ]
    return mass, com, offset


def assert_payload(mass, com, offset):
    assert mass == pytest.approx(MASS, rel=5e-3)
    np.testing.assert_allclose(com, COM, atol=1e-3)
    np.testing.assert_allclose(offset, OFFSET, atol=0.05)


def test_the_command_finds_the_payload(document, folder):
    assert document["wrist_sensors"] == ["tool0:tool0"]
    assert_payload(*payload(document["parameters"]))
    # The file's own link beyond the sensor holds the payload.
    written = load_model(folder / "out" / "model.urdf")
    (tool,) = (body for body in written.bodies if body.name == "tool0")
    assert tool.phi[0] == pytest.approx(MASS, rel=5e-3)


@pytest.fixture(scope="module")
def truth(folder):
    """The true model, and an ideal bag with ground truth."""
    arm = load_model(ur5_urdf())
    load = np.zeros((len(arm.links), 10))
    mount = arm.frame("tool0")
    about_tool = phi_from_com(MASS, COM, INERTIA)
    load[mount.link] = transform_phi(about_tool, mount.rotation, mount.translation)
    (folder / "true.urdf").write_text(urdf_text(arm.with_phi(arm.phi + load)))
    ideal = payload_arm_log(arm, "tool0", seconds=4.0, seed=7, noise=0.0)
    write_payload_bag(ideal, arm, "tool0", folder / "ideal", truth=True)
    return folder / "true.urdf", folder / "ideal"


def test_the_ground_truth_judges_the_arm_with_its_payload(document, folder, truth, symbid_here):
    model, bag = truth
    given = "--truth", model, "--bag", bag, "--json"
    ended = symbid_here("evaluate", folder / "out", *given)
    assert (ended.returncode, ended.stderr) == (0, "")
    found = json.loads(ended.stdout)
    effort = rms(payload_arm_log(load_model(ur5_urdf()), "tool0", seconds=1.0).effort)
    assert found["torque_rmse"] < 0.01 * effort
    assert 0.7 < found["intervals"]["torque_coverage"] <= 1
    page = folder / "report.html"
    ended = symbid_here(
        "report", folder / "out", "--model", folder / "arm.urdf", "--bag", bag, "--truth", model,
        "--out", page,
    )  # fmt: skip
    assert (ended.returncode, ended.stderr) == (0, "")
    assert page.stat().st_size > 10_000


def rms(values):
    return float(np.sqrt(np.mean(np.sum(values**2, axis=1))))


def test_the_doctor_takes_the_sensor_for_what_it_is(folder, symbid_here):
    given = "bag", "doctor", folder / "bag", "--model", folder / "arm.urdf", "--json"
    kinds = {}
    for sensor in ("", "tool0", "-tool0", "wrist_1_link"):
        named = ("--wrist-sensor", sensor) if sensor else ()
        found = json.loads(symbid_here(*given, *named).stdout)["findings"]
        kinds[sensor] = [(one["kind"], one["message"]) for one in found]
    ((kind, message),) = kinds[""]
    assert kind == "wrist_sensor"
    assert "fixed to tool0 (100 %" in message
    assert 'give `wrist_sensor` tool0, or write wrist_sensor: ["tool0"] in robot.yaml' in message
    assert kinds["tool0"] == []
    ((kind, message),) = kinds["-tool0"]
    assert kind == "wrench_sign"
    assert message.endswith('or write wrist_sensor: ["tool0:tool0"] in robot.yaml')
    ((kind, message),) = kinds["wrist_1_link"]
    assert kind == "unknown_frame"
    assert "no WrenchStamped topic has the frame wrist_1_link" in message


def test_a_robot_file_names_the_sensor(folder, symbid_here):
    file = folder / "robot.yaml"
    ended = symbid_here(
        "init", "--model", folder / "arm.urdf", "--bag", folder / "bag", "--out", file
    )
    assert ended.returncode == 0, ended.stderr
    options = yaml.safe_load(file.read_text())["/**"]["ros__parameters"]
    assert options["wrist_sensor"] == ["tool0"]


def test_a_saved_result_is_validated(document, folder, symbid_here):
    ended = symbid_here("validate", folder / "out", "--bag", folder / "bag")
    assert ended.returncode == 0
    assert "tool0/force_z" in ended.stdout


@pytest.mark.parametrize("sensor", ["tool0", "-tool0"])
def test_live_messages_give_the_same_payload(document, folder, sensor):
    options = IdentifyOptions(wrist_sensor=(sensor,), joint_terms=("none",), window=0.161)
    initial = InitialState.of(load_model(folder / "arm.urdf", "fixed"), options)
    feed = feed_of(folder / "bag")
    live = OnlineIdentification(initial, feed.selected, Pace(share=1.0))
    try:
        if sensor.startswith("-"):
            with pytest.raises(DataError, match="restart with `wrist_sensor` tool0"):
                feed.into(live, solving=5.0)
            return
        feed.into(live, solving=6.0)
        found = live.solve(exactly=True).found.estimate
    finally:
        live.close()
    values = dict(zip(found.names, found.value.tolist(), strict=True))
    assert_payload(*payload(values, float))
    for name, entry in document["parameters"].items():
        assert values[name] == pytest.approx(entry["value"], abs=1e-6 + 1e-3 * entry["std"])
