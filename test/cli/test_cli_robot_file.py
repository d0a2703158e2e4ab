"""`symbid init` and `--robot`: from a foreign driver's bag to a validated robot."""

import re
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import rclpy
import yaml
from arm_log import arm_streams, without_load
from bag_editing import Messages, edit_bag
from documented_robots import ur5_urdf
from drive_logs import drives, light_wrist, log_of
from expected_errors import raises_code
from foreign_bags import joint_state, joints_only, write_rosbags
from hypothesis import given
from hypothesis import strategies as st
from rclpy.context import Context
from rclpy.node import Node
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import DataError, OptionError
from symbid_ros.messages.types import JOINT_STATE
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.load import load_model
from symbid_ros.offline.name_matching import match_names
from symbid_ros.offline.robot_file import OF_THE_NODE, load_robot_file
from symbid_ros.offline.robot_setup import inspect_robot
from symbid_ros.offline.robot_setup_file import DESCRIPTIONS, EXAMPLES, RobotSetup
from symbid_ros.package_paths import config_file
from symbid_ros.signals.segments import SECOND

# Nm per ampere of the motors, whose signs differ.
CONSTANTS = np.array([10.0, 9.0, -8.0, 11.0, 12.0, 10.0, 9.0, 8.0, -10.0, 12.0])
WRISTS = "wrist_1_joint", "wrist_2_joint", "wrist_3_joint"
ANGLES = (25.0, -10.0, 40.0)
MOUNTING = Rotation.from_euler("xyz", ANGLES, degrees=True)
ENTRY = re.compile(r"(.*):=(.*)")


def foreign_name(joint: str) -> str:
    return f"exo/{'left' if joint.startswith('L_') else 'right'}_{joint[2:].lower()}_motor"


def joints(messages: Messages) -> None:
    """Currents, and other names."""
    messages.records["effort"][:] /= CONSTANTS
    everything = np.ones(len(messages.records), dtype=bool)
    names = [foreign_name(name) for name in messages.joints]
    messages.rename(everything, range(len(names)), names)


def reversed_plate(messages: Messages) -> None:
    for name in ("wrench.force", "wrench.torque"):
        messages.records[name] *= -1
    messages.reframe("plate_left")


def imu(messages: Messages) -> None:
    """Another frame, and axes turned in it."""
    for name in ("angular_velocity", "linear_acceleration"):
        messages.records[name] = MOUNTING.inv().apply(messages.records[name])
    turned = Rotation.from_quat(messages.records["orientation"]) * MOUNTING
    messages.records["orientation"] = turned.as_quat()
    messages.reframe("exo/imu_link")


@pytest.fixture(scope="module")
def foreign(log, tmp_path_factory) -> Path:
    edits = {"/joint_states": joints, "/imu/data": imu, "/left_foot/wrench": reversed_plate}
    return edit_bag(log, tmp_path_factory.mktemp("foreign") / "bag", edits)


@pytest.fixture(scope="module")
def robot_file(symbid_here, foreign, tmp_path_factory) -> Path:
    model, out = config_file("symbitron.urdf"), tmp_path_factory.mktemp("robot") / "robot.yaml"
    ended = symbid_here("init", "--model", model, "--bag", foreign, "--out", out)
    assert (ended.returncode, ended.stderr) == (0, "")
    assert "flip_wrench: left_sole" in ended.stdout
    return out


def entries(values: list[str]) -> dict[str, str]:
    return dict(ENTRY.fullmatch(value).groups() for value in values)


def test_init_finds_names_signs_and_units(robot_file) -> None:
    (parameters,) = [
        one["ros__parameters"] for one in yaml.safe_load(robot_file.read_text()).values()
    ]
    robot = load_model(config_file("symbitron.urdf"))
    assert entries(parameters["rename_joint"]) == {
        foreign_name(name): name for name in robot.joint_names
    }
    assert entries(parameters["rename_frame"]) == {
        "exo/imu_link": "imu_link",
        "plate_left": "left_sole",
    }
    assert parameters["flip_wrench"] == ["left_sole"]
    angles = entries(parameters["rotate_imu"])["imu_link"].split(",")
    assert [float(angle) for angle in angles] == pytest.approx(ANGLES, abs=0.5)
    found = {name: float(value) for name, value in entries(parameters["effort_scale"]).items()}
    for name, constant in zip(robot.joint_names, CONSTANTS, strict=True):
        if name in found:
            assert found[name] == pytest.approx(constant, rel=0.15)
    assert parameters["drive_gain"] == list(found)
    assert len(found) >= 8  # the others have no drive


def setup_with_efforts(tmp_path, arm, factor, seconds=20.0, *, model=None, **motion) -> RobotSetup:
    """Return what is found in a log of an arm whose efforts are multiplied by factors."""
    read = arm_streams(arm, seconds, 1, **motion).joints
    columns = zip(read.stamp, read.position, read.velocity, factor * read.effort, strict=True)
    messages = [joint_state(int(stamp), arm.joint_names, *one) for stamp, *one in columns]
    bag = joints_only(tmp_path / "bag", *messages)
    return inspect_robot(model or ur5_urdf(), [bag], "fixed")


def test_efforts_in_newton_millimetres_get_one_exact_scale(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    setup = setup_with_efforts(tmp_path, arm, 1e3, friction=0.05)
    assert setup.options["effort_scale"] == [f"{name}:=0.001" for name in arm.joint_names]
    assert "drive_gain" not in setup.options
    assert any("mNm" in line for line in setup.comments["effort_scale"])


@pytest.mark.parametrize(("times", "is_certain"), [(1e3, True), (10.0, False)])
def test_masses_that_are_too_large_are_not_made_up_for_by_efforts(
    tmp_path, times, is_certain
) -> None:
    """A model of many tons would follow, which explains the log."""
    arm = load_model(ur5_urdf(), "fixed")
    heavy = tmp_path / "heavy.urdf"
    heavy.write_text(urdf_text(arm.with_phi(times * arm.phi), ur5_urdf()))
    setup = setup_with_efforts(tmp_path, arm, 1.0, model=heavy, friction=0.02)
    assert ("effort_scale" in setup.options) != is_certain
    comments = setup.comments["" if is_certain else "effort_scale"]
    assert any("masses in the model" in one for one in comments)


@pytest.mark.parametrize("limits", [(0.0,) * 6, (10.0,) * 5 + (0.0,)])
def test_a_model_without_drives_is_said_to_have_none(tmp_path, limits) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    joints = (replace(joint, effort=one) for joint, one in zip(arm.joints, limits, strict=True))
    (tmp_path / "arm.xml").write_text(mjcf_text(replace(arm, joints=tuple(joints))))
    messages = [
        joint_state(10**18 + i * 10**7, arm.joint_names, *np.ones((3, 6))) for i in range(9)
    ]
    bag = joints_only(tmp_path / "bag", *messages)
    setup = inspect_robot(tmp_path / "arm.xml", [bag], "fixed")
    said = [line for line in setup.comments[""] if " drive" in line]
    if any(limits):
        assert said == ["wrist_3_joint has no drive: its effort limit is 0."]
    else:
        assert said == ["The model states no drive; efforts in the log are used."]


@pytest.mark.parametrize("velocity_unit", [1.0, np.degrees(1.0)])
def test_degrees_are_converted(tmp_path, velocity_unit) -> None:
    """Velocities may be in rad/s nevertheless, which only the doctor compares."""
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 20.0, 1, friction=0.05).joints
    columns = read.stamp, np.degrees(read.position), velocity_unit * read.velocity, read.effort
    messages = [
        joint_state(int(stamp), arm.joint_names, *one) for stamp, *one in zip(*columns, strict=True)
    ]
    setup = inspect_robot(ur5_urdf(), [joints_only(tmp_path / "bag", *messages)], "fixed")
    found = entries(setup.options["position_scale"])
    assert found == dict.fromkeys(arm.joint_names, "0.0174532925")
    assert "effort_scale" not in setup.options
    assert setup.is_usable


def test_an_effort_far_beyond_its_limit_is_in_millinewton_metres(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    factors = np.array([1, 1, 1, 1, 1, 1e3])
    setup = setup_with_efforts(tmp_path, arm, factors, friction=0.2)
    assert setup.options["effort_scale"] == ["wrist_3_joint:=0.001"]
    assert "drive_gain" not in setup.options


@pytest.mark.parametrize("factor", [0.13, 700.0])
def test_drives_without_a_visible_load_have_the_unit_of_the_others(tmp_path, factor) -> None:
    """Otherwise they would tell the scale of the others, as joints in Nm do."""
    arm = load_model(ur5_urdf(), "fixed")
    setup = setup_with_efforts(tmp_path, arm, factor, friction=0.08, resting=arm.joint_names[4:])
    assert setup.options["drive_gain"] == list(arm.joint_names)
    assert any(
        "no load shows the factors of" in line and arm.joint_names[-1] in line
        for line in setup.comments["effort_scale"]
    )
    found = {name: float(one) for name, one in entries(setup.options["effort_scale"]).items()}
    assert list(found.values())[1:3] == pytest.approx([1 / factor] * 2, rel=0.3)


def test_an_effort_without_its_load_gets_no_factor(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 20.0, 1, friction=0.05).joints
    rows = zip(read.stamp, read.position, read.velocity, without_load(read, 1), strict=True)
    messages = [joint_state(int(stamp), arm.joint_names, *one) for stamp, *one in rows]
    setup = inspect_robot(ur5_urdf(), [joints_only(tmp_path / "bag", *messages)], "fixed")
    assert not {"effort_scale", "drive_gain"} & set(setup.options)
    assert any("does not show the load" in line for line in setup.comments[""])


def test_a_factor_of_the_others_keeps_an_effort_within_its_limit(tmp_path) -> None:
    """Where no load shows the factor of a joint, its limit may."""
    arm = load_model(ur5_urdf(), "fixed")
    factors = 0.13 * np.array([1, 1, 1, 1, 1, 20])
    setup = setup_with_efforts(tmp_path, arm, factors, friction=0.08)
    found = {name: float(one) for name, one in entries(setup.options["effort_scale"]).items()}
    last = arm.joint_names[-1]
    rms = setup.diagnosis.figures[f"{last}/effort_rms"]  # as it is read with these factors
    assert rms == pytest.approx(arm.joints[-1].effort, rel=0.01)
    assert min(one for name, one in found.items() if name != last) > 2 * found[last]


def test_a_load_that_the_model_lacks_is_no_unit(tmp_path) -> None:
    """Few joints that read more than the model implies would tell the scale of all others."""
    model = load_model(ur5_urdf(), "fixed")
    phi = model.phi.copy()
    phi[-1] = phi_from_com(8.0, np.zeros(3), 0.05 * np.eye(3))
    loaded, resting = model.with_phi(phi), ("elbow_joint", *WRISTS)
    setup = setup_with_efforts(tmp_path, loaded, 1.0, friction=0.02, resting=resting)
    assert not {"effort_scale", "drive_gain"} & set(setup.options)
    said = [line for lines in setup.comments.values() for line in lines]
    assert any("add the tool or payload to the model" in line for line in said)
    assert Kind.MISSING_BODY in {one.kind for one in setup.diagnosis.findings}


def test_factors_that_a_missing_body_explains_as_well_are_comments_only(tmp_path) -> None:
    """A light tool multiplies the load of a light wrist, as a factor of its effort would."""
    robot, model = light_wrist(4)
    phi = robot.phi.copy()
    phi[-1] += phi_from_com(0.2, np.array([0.1, 0.0, 0.0]), np.zeros((3, 3)))
    log = log_of(robot, drives(robot.with_phi(phi), viscous=0.02, coulomb=0.05))
    read = log.streams().joints
    columns = zip(read.stamp, read.position, read.velocity, read.effort, strict=True)
    messages = [joint_state(int(stamp), robot.joint_names, *one) for stamp, *one in columns]
    urdf = tmp_path / "robot.urdf"
    urdf.write_text(urdf_text(model))
    setup = inspect_robot(urdf, [joints_only(tmp_path / "bag", *messages)], "fixed")
    assert not {"effort_scale", "drive_gain"} & set(setup.options)
    (line,) = (one for one in setup.comments["effort_scale"] if "so would a body of about" in one)
    assert line.startswith(f"CHECK: {robot.joint_names[-1]}:=")
    assert setup.has_open_question


def test_one_joint_does_not_tell_the_unit_of_all_others(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    resting = [name for name in arm.joint_names if name != "elbow_joint"]
    setup = setup_with_efforts(tmp_path, arm, 0.1, friction=0.02, resting=resting)
    assert not {"effort_scale", "drive_gain"} & set(setup.options)


def test_two_joints_in_far_units_tell_those_of_all_others(tmp_path) -> None:
    """Shares of a rated torque, of which no model's error is a hundredth."""
    arm = load_model(ur5_urdf(), "fixed")
    resting = [name for name in arm.joint_names if name not in arm.joint_names[1:3]]
    setup = setup_with_efforts(tmp_path, arm, 150.0, friction=0.02, resting=resting)
    found = [float(one) for one in entries(setup.options["effort_scale"]).values()]
    assert found == pytest.approx([1 / 150.0] * 6, rel=0.3)
    assert set(setup.options["drive_gain"]) == set(arm.joint_names)


@pytest.mark.parametrize("sign", [1, -1])
def test_a_wrist_whose_friction_would_drive_it_has_the_wrong_sign(tmp_path, sign) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 10.0, 1, friction=0.3).joints
    signs = np.array([1, 1, 1, 1, 1, sign])
    rows = zip(read.stamp, read.position, read.velocity, signs * read.effort, strict=True)
    messages = [joint_state(int(stamp), arm.joint_names, *one) for stamp, *one in rows]
    bag = joints_only(tmp_path / "bag", *messages)
    setup = inspect_robot(ur5_urdf(), [bag], "fixed")
    assert setup.options.get("effort_scale", []) == ["wrist_3_joint:=-1"] * (sign < 0)
    assert "drive_gain" not in setup.options
    log = sy.load_bag(bag, arm)
    kinds = [one.kind.value for one in sy.diagnose(arm, log).findings]
    assert ("joint_readings" in kinds) == (sign < 0)
    alarms = sy.identify(arm, log, no_holdout=True).alarms
    said = "give `effort_scale` wrist_3_joint:=-1.0"
    assert any(said in one for one in alarms) == (sign < 0)
    assert sign > 0 or not any("likely cause" in one for one in alarms)


def test_efforts_that_are_wrong_together_get_the_other_sign(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    setup = setup_with_efforts(tmp_path, arm, -1.0, seconds=8.0, friction=0.05)
    assert setup.options["effort_scale"] == [f"{name}:=-1.0" for name in arm.joint_names]
    assert "drive_gain" not in setup.options
    assert setup.diagnosis.findings == ()


def test_a_joint_with_the_unit_of_the_model_leaves_unseen_ones_alone(log, tmp_path) -> None:
    def one_current(messages: Messages) -> None:
        messages.records["effort"][:, messages.joints.index("L_hfe")] /= 10.0

    bag = edit_bag(log, tmp_path / "bag", {"/joint_states": one_current})
    setup = inspect_robot(config_file("symbitron.urdf"), [bag])
    assert setup.options["drive_gain"] == ["L_hfe"]


def test_the_file_serves_the_commands(symbid_here, foreign, robot_file, tmp_path) -> None:
    healthy = symbid_here("bag", "doctor", foreign, "--robot", robot_file)
    assert healthy.returncode < 2
    out = tmp_path / "result"
    options = ("--no-holdout", "--joint-terms", "none", "--out", out)
    ended = symbid_here("identify", foreign, "--robot", robot_file, *options)
    assert ended.returncode < 2, ended.stderr
    ended = symbid_here("validate", out, "--bag", foreign, "--robot", robot_file)
    assert ended.returncode < 2, ended.stderr
    assert "all joints" in ended.stdout
    # The result remembers names, units and signs.
    again = symbid_here("validate", out, "--bag", foreign)
    assert (again.returncode, again.stdout) == (ended.returncode, ended.stdout)


def test_an_option_of_the_command_line_comes_first(
    symbid_here, foreign, robot_file, tmp_path
) -> None:
    ended = symbid_here(
        *("identify", foreign, "--robot", robot_file, "--out", tmp_path / "result"),
        *("--rename-joint", "a:=b"),
    )
    assert ended.returncode == 2
    assert "has none of the joints" in ended.stderr
    assert "`symbid init` finds them and writes a robot file" in ended.stderr


def test_a_model_is_needed(symbid_here, foreign, tmp_path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text("/**: {ros__parameters: {base: fixed}}")
    ended = symbid_here("identify", foreign, "--robot", file, "--out", tmp_path / "result")
    assert (ended.returncode, "give --model, or a --robot file" in ended.stderr) == (2, True)


def test_an_existing_file_is_kept(symbid_here, foreign, robot_file) -> None:
    before = robot_file.read_bytes()
    model = config_file("symbitron.urdf")
    ended = symbid_here("init", "--model", model, "--bag", foreign, "--out", robot_file)
    assert (ended.returncode, "--overwrite" in ended.stderr) == (2, True)
    assert robot_file.read_bytes() == before


def test_relative_paths_start_at_the_file(tmp_path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(
        "identifier:\n  ros__parameters:\n    model: robot.urdf\n    tare: [a, /b]\n"
        "    joint_topic: ['']\n    prior: ''\n    solve_period: 2.0\n    window: 0.1\n"
    )
    assert load_robot_file(file) == {
        "model": tmp_path / "robot.urdf",
        "tare": [tmp_path / "a", Path("/b")],
        "window": 0.1,
    }


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("- a", "the file is not a mapping"),
        ("/**: {model: a.urdf}", "ros__parameters is not a mapping"),
        ("bridge: {ros__parameters: {}}", "'bridge' is not a node of a robot file"),
        ("/**: {ros__parameters: {wrench_topik: a}}", "did you mean wrench_topic?"),
        ("/**: {ros__parameters: {zzz: a}}", "there is no parameter zzz; remove it"),
        ("/**: {ros__parameters: {base: loose}}", "'loose' is not valid; give one of"),
        ("{", "not valid YAML"),
        ("/**: {ros__parameters: {effort_scale: [0.001]}}", "effort_scale: 0.001 is not valid"),
        ("/**: {ros__parameters: {joint_topic: [3]}}", "joint_topic: 3 is not valid"),
        ("/**: {ros__parameters: {contact: [1]}}", "contact: 1 is not valid"),
        ("/**: {ros__parameters: {tare: [{a: 1}]}}", "tare: {'a': 1} is not valid"),
        ("/**: {ros__parameters: {rank: .inf}}", "rank: inf is not valid; give an integer"),
        ("/**: {ros__parameters: {prior_percent: -3}}", "prior_percent: -3 is not valid"),
        ("/**: {ros__parameters: {model: 3}}", "model: 3 is not valid; give the path"),
        ("/**: {ros__parameters: {model: [arm.urdf]}}", "model: ['arm.urdf'] is not valid"),
    ],
)
def test_an_invalid_file_is_refused(text: str, reason: str, tmp_path) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(text)
    with pytest.raises(OptionError, match=re.escape(reason)) as refused:
        load_robot_file(file)
    assert str(file) in str(refused.value)


def test_a_value_that_the_command_refuses_is_named_with_its_file(
    symbid_here, foreign, tmp_path
) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(
        f"/**: {{ros__parameters: {{model: {config_file('symbitron.urdf')}, "
        "effort_scale: ['L_haa:=a']}}"
    )
    ended = symbid_here("bag", "doctor", foreign, "--robot", file)
    assert ended.returncode == 2
    assert f"{file}: effort_scale: 'L_haa:=a' is not valid" in ended.stderr


def test_every_parameter_of_the_node_may_be_in_a_robot_file() -> None:
    from symbid_ros.identification.options import IdentifyOptions
    from symbid_ros.messages.log_options import LogOptions
    from symbid_ros.ros.identifier_parameters import PARAMETERS

    options = {each.name for kind in (IdentifyOptions, LogOptions) for each in fields(kind)}
    others = {one.name for one in PARAMETERS} - options - {"model", "base"}
    assert set(OF_THE_NODE) == others | {"use_sim_time"}
    assert set(DESCRIPTIONS) == set(EXAMPLES) <= options


def test_ros_reads_every_example_of_a_robot_file(domain: int, tmp_path) -> None:
    """Its parser refuses some plain texts in lists that other parsers of YAML accept."""
    file = tmp_path / "robot.yaml"
    lines = [f"    {name}: {value}" for name, value in EXAMPLES.items()]
    file.write_text("\n".join(["/**:", "  ros__parameters:", *lines, ""]))
    context = Context()
    arguments = ["--ros-args", "--params-file", str(file)]
    rclpy.init(args=arguments, context=context, domain_id=domain)
    node = Node("reader", context=context, automatically_declare_parameters_from_overrides=True)
    try:
        for name, value in EXAMPLES.items():
            read = node.get_parameter(name).value
            expected = yaml.safe_load(value)
            assert (list(read) if isinstance(expected, list) else read) == expected
    finally:
        node.destroy_node()
        context.try_shutdown()


def test_an_arm_whose_log_lacks_joints_and_names_others(simulated, tmp_path) -> None:
    """A log of the right leg alone, on a fixed base: the left leg is held."""
    bag = simulated("smooth", moves=1, motion_seed=21, noise_seed=5)

    def right_leg(messages: Messages) -> None:
        columns = [i for i, name in enumerate(messages.joints) if name.startswith("R_")]
        names = [messages.joints[i] for i in columns]
        messages.rename(np.ones(len(messages.records), dtype=bool), columns, names)

    short = edit_bag(bag, tmp_path / "bag", {"/joint_states": right_leg})
    setup = inspect_robot(config_file("symbitron.urdf"), [short])
    left = [name for name in load_model(setup.model).joint_names if name.startswith("L_")]
    assert setup.options["hold_joint"] == [f"{name}:=0.0" for name in left]
    assert "rename_joint" not in setup.options


def test_xacro_is_expanded_beside_the_file(symbid_here, log, tmp_path) -> None:
    text = config_file("symbitron.urdf").read_text()
    declared = text.replace("<robot ", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro" ', 1)
    end = declared.index(">", declared.index("<robot ")) + 1
    property_ = '<xacro:property name="heavy" value="${2 * 6.75}"/>'
    (tmp_path / "exo.urdf.xacro").write_text(
        (declared[:end] + property_ + declared[end:]).replace('"13.5"', '"${heavy}"')
    )
    call = ("init", "--model", tmp_path / "exo.urdf.xacro", "--bag", log)
    ended = symbid_here(*call, "--out", tmp_path / "robot.yaml")
    assert ended.returncode == 0, ended.stderr
    found = load_robot_file(tmp_path / "robot.yaml")
    assert found["model"] == tmp_path / "exo.urdf"
    np.testing.assert_allclose(
        load_model(found["model"]).phi, load_model(config_file("symbitron.urdf")).phi
    )
    again = symbid_here(*call, "--out", tmp_path / "second.yaml")
    assert again.returncode == 0, again.stderr
    expanded = found["model"].read_text()
    found["model"].write_text("<robot name='mine'/>")
    refused = symbid_here(*call, "--out", tmp_path / "third.yaml")
    assert (refused.returncode, "--overwrite" in refused.stderr) == (2, True)
    assert found["model"].read_text() == "<robot name='mine'/>"
    found["model"].write_text(expanded)
    other = tmp_path / "other"
    failed = symbid_here(*call[:-1], tmp_path / "no bag", "--out", other / "robot.yaml")
    assert (failed.returncode, other.exists() and [*other.iterdir()]) == (2, [])
    (tmp_path / "exo.urdf.xacro").write_text('<robot xmlns:xacro="x"><xacro:nothing/></robot>')
    ended = symbid_here(*call, "--out", tmp_path / "robot.yaml", "--overwrite")
    assert (ended.returncode, "xacro: " in ended.stderr) == (2, True)
    (tmp_path / "exo.urdf.xacro").write_text(
        '<robot xmlns:xacro="http://www.ros.org/wiki/xacro">'
        '<xacro:include filename="$(find nosuch)/part.xacro"/></robot>'
    )
    ended = symbid_here(*call, "--out", tmp_path / "robot.yaml", "--overwrite")
    assert (ended.returncode, ended.stderr.count("AMENT_PREFIX_PATH")) == (2, 1)


ARM = ("shoulder_pan_joint", "shoulder_lift_joint", "elbow_joint", "wrist_1_joint", "wrist_2_joint")


@pytest.mark.parametrize(
    ("recorded", "is_certain"),
    [
        ([f"ur5_{name}" for name in ARM], True),
        (["ShoulderPan", "ShoulderLift", "Elbow", "Wrist1", "Wrist2"], True),
        (["j1", "j2", "j3", "j4", "j5"], False),
        (["joint_5", "joint_4", "joint_3", "joint_2", "joint_1"], False),
    ],
)
def test_names_of_an_arm_are_matched(recorded: list[str], is_certain: bool) -> None:
    found, guessed = match_names(recorded, ARM)
    assert guessed == (() if is_certain else tuple(recorded))
    order = recorded if recorded[0] != "joint_5" else recorded[::-1]
    assert found == dict(zip(order, ARM, strict=True))


SO101 = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")
# Names of the SO-100 in the MuJoCo Menagerie, in its order.
OTHERS = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")


def test_names_that_are_guessed_keep_the_order_of_the_log() -> None:
    found, guessed = match_names(OTHERS, SO101)
    assert found == dict(zip(OTHERS, SO101, strict=True))
    assert guessed == ("Rotation", "Pitch", "Wrist_Pitch", "Jaw")
    # Nothing resembles anything, and the names have no numbers.
    words = ("yaw", "bow", "fold", "tilt", "spin", "grip")
    assert match_names(words, SO101) == (dict(zip(words, SO101, strict=True)), words)
    # A driver that sorts its names.
    found, _ = match_names(sorted(OTHERS), SO101)
    assert (found["Elbow"], found["Wrist_Pitch"], found["Wrist_Roll"]) == SO101[2:5]


@given(st.permutations(OTHERS))
def test_shared_words_tell_more_than_the_order(recorded: list[str]) -> None:
    found, _ = match_names(recorded, SO101)
    assert (found["Elbow"], found["Wrist_Pitch"], found["Wrist_Roll"]) == SO101[2:5]


def test_a_guess_of_names_is_marked(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 8.0, 1, friction=0.05).joints
    names = ("Turn", "Raise", "Elbow", "Bend", "Sway", "Spin")
    columns = zip(read.stamp, read.position, read.velocity, read.effort, strict=True)
    messages = [joint_state(int(stamp), names, *one) for stamp, *one in columns]
    setup = inspect_robot(ur5_urdf(), [joints_only(tmp_path / "bag", *messages)], "fixed")
    assert entries(setup.options["rename_joint"]) == dict(zip(names, arm.joint_names, strict=True))
    setup.write(tmp_path / "robot.yaml")
    assert (
        "    # CHECK: guessed from words and order: Turn, Raise, Bend, Sway, Spin. Correct wrong "
        "pairs.\n"
    ) in (tmp_path / "robot.yaml").read_text()


@pytest.mark.parametrize("order", [[0, 2, 1, 3, 4, 5], [2, 0, 1, 3, 4, 5]], ids=str)
@pytest.mark.parametrize("is_named", [True, False])
def test_exchanged_joints_are_found_rather_than_scales(tmp_path, order, is_named) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 10.0, 1, friction=0.05).joints
    names = arm.joint_names if is_named else [f"motor_{number}" for number in range(6)]
    columns = [each[:, order] for each in (read.position, read.velocity, read.effort)]
    rows = zip(read.stamp, *columns, strict=True)
    messages = [joint_state(int(stamp), names, *one) for stamp, *one in rows]
    setup = inspect_robot(ur5_urdf(), [joints_only(tmp_path / "bag", *messages)], "fixed")
    expected = {name: arm.joint_names[own] for name, own in zip(names, order, strict=True)}
    found = entries(setup.options["rename_joint"])
    assert found == {name: own for name, own in expected.items() if name != own}
    assert "effort_scale" not in setup.options
    assert any("the log exchanges" in line for line in setup.comments["rename_joint"])


def arm_messages(read, names) -> list:
    rows = zip(read.stamp, read.position, read.velocity, read.effort, strict=True)
    return [joint_state(int(stamp), names, *one) for stamp, *one in rows]


def test_joints_of_two_robots_in_one_topic_are_told_apart(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 8.0, 1, friction=0.05).joints
    names = [f"{side}_{name}" for side in ("left", "right") for name in arm.joint_names]
    columns = {name: np.tile(getattr(read, name), 2) for name in ("position", "velocity", "effort")}
    bag = joints_only(tmp_path / "bag", *arm_messages(replace(read, **columns), names))
    setup = inspect_robot(ur5_urdf(), [bag], "fixed")
    found = entries(setup.options["rename_joint"])
    assert found == {f"left_{name}": name for name in arm.joint_names}
    assert any(
        line.startswith("CHECK:") and "2 robots: left_, right_" in line
        for line in setup.comments["rename_joint"]
    )


@pytest.mark.parametrize("topics", [["/arm/joint_command"], ["/arm/command", "/arm/state"]])
def test_commands_are_marked_if_nothing_else_is_recorded(tmp_path, topics) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 8.0, 1, friction=0.05).joints
    payloads = arm_messages(read, arm.joint_names)
    bag = tmp_path / "bag"
    write_rosbags(bag, [(topic, JOINT_STATE, one) for one in payloads for topic in topics])
    setup = inspect_robot(ur5_urdf(), [bag], "fixed")
    marked = [one for one in setup.comments["joint_topic"] if "the name of commands" in one]
    assert setup.options["joint_topic"] == topics[-1:]
    assert len(marked) == (len(topics) == 1)


def test_a_joint_whose_driver_starts_late_is_not_held(tmp_path) -> None:
    """Names are usually those of the first seconds."""
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 20.0, 1, friction=0.05).joints
    late = np.searchsorted(read.stamp, read.stamp[0] + 6 * SECOND)
    names = arm.joint_names
    messages = arm_messages(read, names)
    columns = {one: getattr(read, one)[:, :-1] for one in ("position", "velocity", "effort")}
    messages[:late] = arm_messages(replace(read, names=names[:-1], **columns), names[:-1])[:late]
    setup = inspect_robot(ur5_urdf(), [joints_only(tmp_path / "bag", *messages)], "fixed")
    assert "hold_joint" not in setup.options
    assert "rename_joint" not in setup.options
    assert any("have no effort of wrist_3_joint" in line for line in setup.comments[""])


def test_a_log_without_stamps_is_refused_for_that_reason(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 8.0, 1, friction=0.05).joints
    still = replace(read, stamp=np.zeros_like(read.stamp))
    bag = joints_only(tmp_path / "bag", *arm_messages(still, arm.joint_names))
    with pytest.raises(DataError, match=r"all header stamps are 0\.000 s"):
        inspect_robot(ur5_urdf(), [bag], "fixed")


def test_warnings_of_the_doctor_are_comments(tmp_path) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 20.0, 1, friction=0.05).joints
    wrong = replace(read, position=read.position + np.radians([0, 0, 15, 0, 0, 0]))
    bag = joints_only(tmp_path / "bag", *arm_messages(wrong, arm.joint_names))
    setup = inspect_robot(ur5_urdf(), [bag], "fixed")
    assert setup.is_usable
    assert any(line.startswith("Doctor: /joint_states: position of") for line in setup.comments[""])


@pytest.mark.parametrize("joint", [0, 2, 3])
@pytest.mark.parametrize("is_axis", [False, True])
def test_reversed_joints_are_found_rather_than_scales(tmp_path, joint, is_axis) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 10.0, 1, friction=0.05).joints
    columns = [one.copy() for one in (read.position, read.velocity, read.effort)]
    for column in columns[: 3 if is_axis else 2]:
        column[:, joint] *= -1
    rows = zip(read.stamp, *columns, strict=True)
    messages = [joint_state(int(stamp), arm.joint_names, *one) for stamp, *one in rows]
    bag, name = joints_only(tmp_path / "bag", *messages), arm.joint_names[joint]
    setup = inspect_robot(ur5_urdf(), [bag], "fixed")
    assert setup.options["flip_joint"] == [name]
    assert setup.options.get("effort_scale", []) == [f"{name}:=-1"] * is_axis
    assert setup.diagnosis is not None
    assert not setup.diagnosis.findings
    found = sy.diagnose(arm, sy.load_bag(bag, arm))
    (finding,) = found.findings
    assert finding.kind.value == "joint_readings"
    assert f"of {name} have the opposite sign" in finding.message
    assert f'flip_joint: ["{name}"]' in finding.message
    assert ("effort_scale" in finding.message) == is_axis


@pytest.mark.parametrize(("sign", "never"), [(1.0, "negative"), (-1.0, "positive")])
def test_no_sign_or_factor_is_written_for_magnitudes(tmp_path, sign, never) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 20.0, 5).joints
    sizes = replace(read, effort=sign * np.abs(read.effort))
    bag = joints_only(tmp_path / "bag", *arm_messages(sizes, arm.joint_names))
    setup = inspect_robot(ur5_urdf(), [bag], "fixed")
    assert not {"effort_scale", "drive_gain", "flip_joint", "gravity"} & set(setup.options)
    assert any(f"never {never}" in line for line in setup.comments[""])


@pytest.mark.parametrize("joint", [1, 2, 4])
@pytest.mark.parametrize("is_axis", [False, True])
def test_a_wrong_unit_does_not_hide_a_reversed_joint(tmp_path, joint, is_axis) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    read = arm_streams(arm, 10.0, 1, friction=0.05).joints
    columns = [read.position.copy(), read.velocity.copy(), 1e3 * read.effort]
    for column in columns[: 3 if is_axis else 2]:
        column[:, joint] *= -1
    rows = zip(read.stamp, *columns, strict=True)
    messages = [joint_state(int(stamp), arm.joint_names, *one) for stamp, *one in rows]
    setup = inspect_robot(ur5_urdf(), [joints_only(tmp_path / "bag", *messages)], "fixed")
    assert setup.options["flip_joint"] == [arm.joint_names[joint]]
    factors = {name: float(one) for name, one in entries(setup.options["effort_scale"]).items()}
    signs = {name: -1 if is_axis and name == arm.joint_names[joint] else 1 for name in factors}
    assert factors == {name: 1e-3 * signs[name] for name in arm.joint_names}
    assert setup.is_usable
    assert setup.diagnosis is not None
    assert not setup.diagnosis.findings


@given(st.permutations(ARM), st.sampled_from(["robot1_", "left/", ""]))
def test_matching_is_one_to_one_and_independent_of_order(names: list[str], prefix: str) -> None:
    found, guessed = match_names([f"{prefix}{name}" for name in names], ARM)
    assert not guessed
    assert found == {f"{prefix}{name}": name for name in ARM}


@given(st.lists(st.text(max_size=8), unique=True), st.lists(st.text(max_size=8), unique=True))
def test_any_names_are_matched_one_to_one(recorded: list[str], wanted: list[str]) -> None:
    found, _ = match_names(recorded, wanted)
    assert set(found) <= set(recorded)
    assert len(set(found.values())) == len(found)
    assert set(found.values()) <= set(wanted)


def test_a_reversed_sensor_is_found_in_the_frame_of_a_link(log, tmp_path) -> None:
    """A driver may name the link that carries the sensor."""
    model = config_file("symbitron.urdf")
    robot = load_model(model)
    link = robot.link_names[robot.frame("left_sole").link]

    def plate(messages: Messages) -> None:
        """About the origin of the link, in its axes, reversed."""
        sole = robot.frame("left_sole")
        force = messages.records["wrench.force"] @ sole.rotation.T
        torque = messages.records["wrench.torque"] @ sole.rotation.T
        messages.records["wrench.force"] = -force
        messages.records["wrench.torque"] = -(torque + np.cross(sole.translation, force))
        messages.reframe(link)

    reversed_ = edit_bag(log, tmp_path / "bag", {"/left_foot/wrench": plate})
    setup = inspect_robot(model, [reversed_])
    assert setup.options["flip_wrench"] == [link]
    assert setup.diagnosis is not None
    assert not setup.diagnosis.findings


def test_a_log_whose_names_resemble_no_joint_is_told_how_to_name_pairs(tmp_path):
    bag = joints_only(tmp_path / "bag", *(joint_state(n, ["qq", "xx"], [0, 0]) for n in (1, 2)))
    with raises_code("E306", r'rename_joint: \["qq:=shoulder_pan_joint"\] in robot\.yaml'):
        inspect_robot(Path(ur5_urdf()), [bag])
