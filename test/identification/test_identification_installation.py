"""Identified numbers in the user's own files: nothing else changes, and every reader takes them."""

import re
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
import xacro
import yaml
from arm_log import arm_streams
from drive_logs import arm, drives, log_of
from expected_errors import raises_code
from written_results import write_result

import symbid_ros as sy
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.identification import installation
from symbid_ros.identification.installation import inertials_yaml, install, unheld_terms
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.signals.log import Log

ROBOTS = Path(pinocchio.__file__).parents[4] / "share/example-robot-data/robots"
PAGE = Path(__file__).resolve().parents[2] / "docs" / "install-result.md"
NUMBER = re.compile(rb"-?\d+\.?\d*(e[-+]?\d+)?")
COMMENT = re.compile(rb"\s*<!-- symbid_ros: [^>]*-->")


@pytest.fixture
def ur5(tmp_path) -> Path:
    """Return a UR5 as a user has it: with drivers, comments and carriage returns."""
    text = (ROBOTS / "ur_description/urdf/ur5_robot.urdf").read_text()
    drivers = (
        '  <ros2_control name="arm" type="system"><!-- drivers -->\n'
        '    <joint name="elbow_joint"><command_interface name="position"/></joint>\n'
        "  </ros2_control>\n"
        '  <gazebo reference="tool0"><mu1 value="0.2"/></gazebo>\n</robot>'
    )
    path = tmp_path / "robot.urdf"
    path.write_bytes(text.replace("</robot>", drivers).replace("\n", "\r\n").encode())
    path.chmod(0o640)
    return path


def without_numbers(content: bytes) -> bytes:
    return NUMBER.sub(b"#", COMMENT.sub(b"", content))


def require_same_links(path: Path, expected) -> None:
    read = load_model(path, "floating" if expected.floating else "fixed")
    np.testing.assert_allclose(read.phi, expected.phi, rtol=1e-9, atol=1e-12)


def test_only_numbers_of_inertials_change_and_the_earlier_file_is_kept(ur5, tmp_path) -> None:
    before = ur5.read_bytes()
    identified = write_result(tmp_path / "result", ur5)
    done = install(tmp_path / "result", ur5)
    assert done.files == (ur5,)
    assert done.backups == (tmp_path / "robot.urdf.orig",)
    assert done.backups[0].read_bytes() == before
    after = ur5.read_bytes()
    assert without_numbers(after) == without_numbers(before)
    assert after.count(b"\r\n") == before.count(b"\r\n") + 1
    assert ur5.stat().st_mode & 0o777 == 0o640
    (comment,) = COMMENT.findall(after)
    for words in (b"2026-03-01", b"map_lmi", b"my_bag_0.mcap (sha256 abababababab)"):
        assert words in comment
    require_same_links(ur5, identified)


def test_a_link_of_which_the_log_tells_nothing_keeps_every_digit(ur5, tmp_path) -> None:
    robot = load_model(ur5, "fixed")
    log = Log.from_streams(arm_streams(robot, 12.0, 1))
    found = sy.identify(robot, log, no_holdout=True)
    base = [index for index, name in enumerate(found.estimate.names) if "base_link/" in name]
    np.testing.assert_array_equal(found.estimate.value[base], found.estimate.prior[base])
    found.save(tmp_path / "result")
    before = ur5.read_text()
    install(tmp_path / "result", ur5)

    def inertial(text: str, link: str) -> str:
        start = text.index("<inertial>", text.index(f'<link name="{link}">'))
        return text[start : text.index("</inertial>", start)]

    assert inertial(ur5.read_text(), "base_link") == inertial(before, "base_link")
    assert inertial(ur5.read_text(), "forearm_link") != inertial(before, "forearm_link")


def test_a_robot_with_a_welded_base_keeps_its_free_joint(tmp_path) -> None:
    """It was identified hanging, and walks afterwards."""
    path = tmp_path / "robot.xml"
    arm_mjcf = mjcf_text(arm(seed=2))
    base = arm_mjcf.index(">", arm_mjcf.index("<body")) + 1
    path.write_text(f"{arm_mjcf[:base]}<freejoint/>{arm_mjcf[base:]}")
    assert load_model(path).floating
    robot = load_model(path, "fixed")
    truth = drives(robot, viscous=0.4)
    found = sy.identify(robot, log_of(robot, truth), no_holdout=True)
    found.save(tmp_path / "result")
    assert not ForcePredictor.load(tmp_path / "result").parameters.model.floating
    install(tmp_path / "result", path)
    assert load_model(path).floating
    require_same_links(path, found.robot)


def test_pinocchio_reads_the_identified_inertias(ur5, tmp_path) -> None:
    identified = write_result(tmp_path / "result", ur5)
    install(tmp_path / "result", ur5)
    read = pinocchio.buildModelFromUrdf(str(ur5))
    for joint in identified.joints:
        index = read.getJointId(joint.name)
        found = read.inertias[index].toDynamicParameters()
        m, first = found[0], found[1:4]
        # Ixx, Ixy, Iyy, Ixz, Iyz, Izz
        moments = found[[4, 5, 7, 6, 8, 9]]
        phi = identified.links[identified.joint_names.index(joint.name) + 1].phi
        np.testing.assert_allclose([m, *first, *moments], phi, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "name", ["anymal_c_simple_description/urdf/anymal.urdf", "panda_description/urdf/panda.urdf"]
)
def test_other_robots_are_changed_in_place(name, tmp_path) -> None:
    source = ROBOTS / name
    robot = tmp_path / source.name
    robot.write_bytes(source.read_bytes())
    identified = write_result(tmp_path / "result", robot)
    install(tmp_path / "result", robot)
    assert without_numbers(robot.read_bytes()) == without_numbers(source.read_bytes())
    require_same_links(robot, identified)


def test_a_second_result_replaces_the_comment_and_keeps_all_earlier_files(ur5, tmp_path) -> None:
    first = write_result(tmp_path / "first", ur5, seed=1)
    second = write_result(tmp_path / "second", ur5, seed=2)
    install(tmp_path / "first", ur5)
    require_same_links(ur5, first)
    again = install(tmp_path / "first", ur5)
    assert (again.files, again.backups) == ((), ())
    done = install(tmp_path / "second", ur5)
    assert done.backups == (tmp_path / "robot.urdf.orig.1",)
    require_same_links(ur5, second)
    require_same_links(tmp_path / "robot.urdf.orig.1", first)
    assert len(COMMENT.findall(ur5.read_bytes())) == 1


def test_another_file_may_be_written(ur5, tmp_path) -> None:
    before = ur5.read_bytes()
    identified = write_result(tmp_path / "result", ur5)
    done = install(tmp_path / "result", ur5, tmp_path / "new" / "robot.urdf")
    assert (done.files, done.backups) == ((tmp_path / "new" / "robot.urdf",), ())
    assert ur5.read_bytes() == before
    require_same_links(done.files[0], identified)


@pytest.mark.parametrize(
    ("old", "new", "names"),
    [
        ('"wrist_3_link"', '"flange"', "no link 'wrist_3_link'"),
        ('name="elbow_joint"', 'name="elbow"', "no joint 'elbow_joint'"),
        ('xyz="0.0 -0.1197 0.425"', 'xyz="0.0 -0.1197 0.435"', "'elbow_joint' has another"),
    ],
)
def test_another_robot_is_refused(ur5, tmp_path, old, new, names) -> None:
    write_result(tmp_path / "result", ur5)
    text = ur5.read_bytes().decode()
    assert old in text
    ur5.write_bytes(text.replace(old, new).encode())
    changed = ur5.read_bytes()
    with raises_code("E575", names):
        install(tmp_path / "result", ur5)
    assert ur5.read_bytes() == changed
    assert not list(tmp_path.glob("*.orig"))


def test_a_file_that_does_not_load_is_put_back(ur5, tmp_path, monkeypatch) -> None:
    before = ur5.read_bytes()
    write_result(tmp_path / "result", ur5)

    def damaged(path: Path, text: str) -> None:
        path.write_text(text[: len(text) // 2])

    monkeypatch.setattr(installation, "write_text", damaged)
    with raises_code("E576", "not well-formed"):
        install(tmp_path / "result", ur5)
    assert ur5.read_bytes() == before
    assert not list(tmp_path.glob("*.orig"))
    with raises_code("E576"):
        install(tmp_path / "result", ur5, tmp_path / "new.urdf")
    assert not (tmp_path / "new.urdf").exists()


def test_parameters_that_are_lost_are_noticed(ur5, tmp_path, monkeypatch) -> None:
    write_result(tmp_path / "result", ur5)
    write = installation.write_text
    monkeypatch.setattr(
        installation,
        "write_text",
        lambda path, text: write(path, re.sub(r'<mass value="[^"]*"', '<mass value="9"', text)),
    )
    with raises_code("E576", "has other parameters"):
        install(tmp_path / "result", ur5)


def test_an_mjcf_changes_in_place_with_its_included_files(tmp_path) -> None:
    text = config_file("symbitron.xml").read_text()
    start, stop = text.index("<worldbody>"), text.index("</worldbody>") + len("</worldbody>")
    robot, included = tmp_path / "robot.xml", tmp_path / "parts" / "bodies.xml"
    included.parent.mkdir()
    included.write_text(f"<mujoco>\n{text[start:stop]}\n</mujoco>\n")
    robot.write_text(text[:start] + '<include file="parts/bodies.xml"/>' + text[stop:])
    before = {path: path.read_bytes() for path in (robot, included)}
    identified = write_result(tmp_path / "result", robot)
    done = install(tmp_path / "result", robot)
    assert set(done.files) == {robot, included}
    for path, backup in zip(done.files, done.backups, strict=True):
        assert backup.name == f"{path.name}.orig"
        assert backup.read_bytes() == before[path]
    assert b'<include file="parts/bodies.xml"/>' in robot.read_bytes()
    assert len(COMMENT.findall(robot.read_bytes())) == 1
    compiled = mujoco.MjModel.from_xml_path(str(robot))
    masses = {link.name: link.phi[0] for link in identified.links}
    found = {name: compiled.body(name).mass[0] for name in masses}
    assert found == pytest.approx(masses, rel=1e-9)


def test_terms_that_a_format_cannot_hold_are_named(ur5, tmp_path) -> None:
    write_result(tmp_path / "result", ur5)
    estimate = load_estimate(tmp_path / "result" / "estimate.json")
    terms = {"viscous": 2.0, "armature": 0.1, "offset": 0.5, "stribeck": 0.0}
    extended = replace(
        estimate,
        names=(*estimate.names, *(f"elbow_joint/{term}" for term in terms)),
        value=np.array([*estimate.value, *terms.values()]),
    )
    assert unheld_terms(extended, mjcf=False) == ("armature", "offset")
    assert unheld_terms(extended, mjcf=True) == ("offset",)
    assert unheld_terms(estimate, mjcf=False) == ()


def test_utf_16_is_refused(ur5, tmp_path) -> None:
    write_result(tmp_path / "result", ur5)
    text = re.sub(r"<\?xml[^>]*\?>", "", ur5.read_bytes().decode())
    ur5.write_bytes(text.encode("utf-16"))
    with raises_code("E577", "UTF-16"):
        install(tmp_path / "result", ur5)


def test_an_empty_folder_is_no_result(ur5, tmp_path) -> None:
    with pytest.raises(SymbidError):
        install(tmp_path, ur5)


def test_a_xacro_file_reads_the_yaml_as_the_documentation_shows(ur5, tmp_path) -> None:
    write_result(tmp_path / "result", ur5)
    (tmp_path / "inertials.yaml").write_text(inertials_yaml(tmp_path / "result"))
    content = yaml.safe_load((tmp_path / "inertials.yaml").read_text())
    assert all(isinstance(one["ixx"], float) for one in content["links"].values())

    blocks = re.findall(r"```xml\n(.*?)```", PAGE.read_text(), re.DOTALL)
    (macro,) = (block for block in blocks if "load_yaml" in block)
    inside = re.sub(r"</?robot[^>]*>", "", macro)
    inside = re.sub(r"<link.*?</link>", "", inside, flags=re.DOTALL)
    text = (tmp_path / "result" / "model.urdf").read_bytes().decode()
    names = iter(re.findall(r'<link\s+name="([^"]+)"(?:(?!</link>).)*?<inertial>', text, re.DOTALL))
    text = re.sub(
        r"<inertial>.*?</inertial>",
        lambda _: f'<xacro:identified_inertial link="{next(names)}"/>',
        text,
        flags=re.DOTALL,
    )
    head = re.search(r"<robot[^>]*>", text)
    assert head is not None
    assert "xmlns:xacro" in head[0]
    text = text[: head.end()] + inside + text[head.end() :]
    (tmp_path / "robot.urdf.xacro").write_text(text)
    (tmp_path / "expanded.urdf").write_text(
        xacro.process_file(str(tmp_path / "robot.urdf.xacro")).toxml()
    )
    expected = load_model(tmp_path / "result" / "model.urdf")
    np.testing.assert_allclose(
        load_model(tmp_path / "expanded.urdf").phi, expected.phi, rtol=1e-9, atol=1e-12
    )
