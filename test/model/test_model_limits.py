"""Any model file gives a robot with finite numbers, or a one-line error that names the fix."""

import itertools
import os
import random
import re
import struct
from pathlib import Path

import mujoco
import numpy as np
import pytest
from random_robots import CONFIG

from symbid_ros.errors import ModelError, SimulationError
from symbid_ros.model import xml_file as xml_tree
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model

INERTIAL = '<inertial mass="1" pos="0 0 .1" diaginertia=".1 .1 .1"/>'
MJCF = f"""<mujoco model="arm">
  <worldbody>
    <body name="base">{INERTIAL}
      <body name="upper">
        <joint name="elbow" axis="0 1 0"/>
        {INERTIAL}
      </body>
    </body>
  </worldbody>
</mujoco>
"""
URDF = """<robot name="arm">
  <link name="base"/>
  <link name="upper">
    <inertial>
      <origin xyz="0 0 .1" rpy="0 0 0"/>
      <mass value="1"/>
      <inertia ixx=".1" ixy="0" ixz="0" iyy=".1" iyz="0" izz=".1"/>
    </inertial>
  </link>
  <joint name="elbow" type="revolute">
    <parent link="base"/><child link="upper"/>
    <axis xyz="0 1 0"/><limit lower="-1" upper="1" effort="5" velocity="9"/>
  </joint>
</robot>
"""


def written(folder: Path, text: str, name: str | None = None) -> Path:
    path = folder / (name or ("robot.urdf" if "<robot" in text else "robot.xml"))
    path.parent.mkdir(exist_ok=True)
    path.write_text(text)
    return path


def refusal(path: Path) -> str:
    with pytest.raises(ModelError) as caught:
        load_model(path)
    message = str(caught.value)
    assert "\n" not in message
    assert caught.value.code.startswith("E1")
    return message


BOMB = '<!DOCTYPE x [<!ENTITY a "aaaa"><!ENTITY b "&a;&a;&a;&a;">]>'
READER = '<!DOCTYPE x [<!ENTITY a SYSTEM "/etc/passwd">]>'


@pytest.mark.parametrize("text", [MJCF, URDF], ids=["mjcf", "urdf"])
class TestEveryFormat:
    def test_a_valid_model_loads(self, text, tmp_path):
        robot = load_model(written(tmp_path, text))
        assert robot.joint_names == ("elbow",)
        assert robot.phi[-1][0] == 1.0

    @pytest.mark.parametrize("declaration", [BOMB, READER, "<!DOCTYPE robot>"])
    def test_a_document_type_is_refused(self, text, declaration, tmp_path):
        path = written(tmp_path, text)
        path.write_text("\n" + declaration + "\n" + text)
        assert f"{path}: line 2: a <!DOCTYPE>" in refusal(path)

    def test_size_depth_and_number_of_elements_are_limited(self, text, tmp_path):
        end = text.rindex("</")
        # MuJoCo's parser compares each attribute with all before it: 100 000 take half a minute.
        many = " ".join(f'a{index}=""' for index in range(xml_tree.MAX_ATTRIBUTES + 1))
        for extra, message in (
            ("<!--" + " " * xml_tree.MAX_BYTES + "-->", "larger than 4 MiB"),
            ("<a>" * 300 + "</a>" * 300, "line 1.: <a> is more than 200 levels deep"),
            ("<a/>" * xml_tree.MAX_ELEMENTS, "more than 10000 elements"),
            (f"<a {many}/>", "line 1.: <a> has more than 200 attributes"),
        ):
            path = written(tmp_path, text[:end] + extra + text[end:])
            assert re.search(message, refusal(path))

    def test_files_that_are_not_text_are_rejected(self, text, tmp_path):
        path = written(tmp_path, text)
        path.unlink()
        os.mkfifo(path)  # reading it would wait for ever
        assert "not a regular file" in refusal(path)
        path.unlink()
        path.write_bytes(b"\x00\xff\xfe\x01" * 100)
        assert "not well-formed" in refusal(path)

    def test_a_line_is_named(self, text, tmp_path):
        for value in ("nan", "inf", "-inf", "1e400", "1e300", "-1"):
            broken = re.sub("(mass(?: value)?=)", rf'\1"{value}" was=', text)
            line = 1 + broken[: broken.index(value)].count("\n")
            assert f": line {line}: " in refusal(written(tmp_path, broken))


@pytest.mark.parametrize(
    ("text", "old", "new"),
    [
        (MJCF, 'axis="0 1 0"', 'axis="0 0 0"'),
        (MJCF, 'axis="0 1 0"', 'axis="nan 1 0"'),
        (MJCF, 'axis="0 1 0"', 'axis="0 1 0" range="0 inf"'),
        (MJCF, 'name="upper"', 'name="upper" quat="0 0 0 0"'),
        (MJCF, 'pos="0 0 .1"', 'pos="0 0 1e30"'),
        (MJCF, 'mass="1"', 'mass="0x1p40"'),
        (URDF, 'xyz="0 1 0"', 'xyz="0 0 0"'),
        (URDF, 'xyz="0 1 0"', 'xyz="0 1e-200 0"'),
        (URDF, 'xyz="0 0 .1"', 'xyz="0 0 1e30"'),
        (URDF, 'lower="-1"', 'lower="nan"'),
        (URDF, 'effort="5"', 'effort="inf"'),
        (URDF, 'ixx=".1"', 'ixx="1e99"'),
        (URDF, 'value="1"', ""),
    ],
)
def test_numbers_outside_a_robots_range_are_rejected_with_their_line(text, old, new, tmp_path):
    assert old in text
    path = written(tmp_path, text.replace(old, new, 1))
    assert re.search(rf"{path}: .*line \d+", refusal(path))


class TestUrdf:
    def test_meshes_are_not_opened(self, tmp_path):
        shapes = "".join(
            f'<visual><geometry><mesh filename="{name}"/></geometry></visual>'
            for name in ("package://arm/upper.stl", "file:///etc/passwd", "../../secret.dae")
        )
        text = URDF.replace('<link name="base"/>', f'<link name="base">{shapes}</link>')
        assert load_model(written(tmp_path, text)).joint_names == ("elbow",)

    @pytest.mark.parametrize(
        ("old", "new"),
        [
            ('<link name="base"/>', '<link name="base"/><xacro:include filename="a.xacro"/>'),
            ('value="1"', 'value="${mass}"'),
        ],
    )
    def test_an_xacro_file_must_be_expanded_first(self, old, new, tmp_path):
        assert re.search(
            r"line \d+: .*run.*xacro", refusal(written(tmp_path, URDF.replace(old, new)))
        )

    @pytest.mark.parametrize(
        ("name", "expanded"),
        [
            ("a.urdf.xacro", "a.urdf"),
            ("a.xacro", "a.urdf"),
            ("a.urdf", "a_expanded.urdf"),
            ("a.v2.urdf.xacro", "a.v2.urdf"),
        ],
    )
    def test_the_expanded_file_gets_another_name(self, name, expanded, tmp_path):
        path = tmp_path / name
        path.write_text(URDF.replace('<link name="base"/>', "<xacro:arm/>"))
        assert f"run `xacro {name} > {expanded}` and give" in refusal(path)

    def test_an_xacro_namespace_alone_is_accepted(self, tmp_path):
        text = URDF.replace("<robot", '<robot xmlns:xacro="http://www.ros.org/wiki/xacro"')
        assert load_model(written(tmp_path, text)).name == "arm"

    def test_links_that_are_not_one_tree_are_rejected(self, tmp_path):
        def fixed(parent, child):
            return (
                f'<joint name="{parent}_{child}" type="fixed"><parent link="{parent}"/>'
                f'<child link="{child}"/></joint>'
            )

        loop = '<link name="a"/><link name="b"/>' + fixed("a", "b") + fixed("b", "a")
        twice = '<link name="base"/>'
        names = ["base", *(f"l{i}" for i in range(300))]
        chain = "".join(f'<link name="{name}"/>' for name in names[1:])
        chain += "".join(fixed(*pair) for pair in itertools.pairwise(names))
        for extra, message in (
            (loop, "in a loop of joints"),
            (twice, "'base' is used twice"),
            (chain, "more than 200 links"),
        ):
            text = URDF.replace("</robot>", extra + "</robot>")
            assert message in refusal(written(tmp_path, text))


MENAGERIE = f"""<mujocoinclude>
  <compiler angle="radian" meshdir="assets" texturedir="../textures" autolimits="true"/>
  <option integrator="implicitfast"/>
  <default>
    <default class="dog">
      <joint damping="2" armature="0.01"/>
      <motor ctrlrange="-23 23"/>
      <default class="visual"><geom type="mesh" contype="0" group="2" material="black"/></default>
    </default>
  </default>
  <asset>
    <material name="black" rgba="0 0 0 1" texture="skin"/>
    <texture name="skin" type="2d" file="skin.png"/>
    <mesh class="dog" file="trunk.obj"/>
    <mesh class="dog" name="far" file="../../elsewhere/thigh.stl"/>
  </asset>
  <worldbody>
    <light pos="0 0 3"/><geom type="plane" size="0 0 .1"/>
    <body name="trunk" pos="0 0 .4" childclass="dog">
      <freejoint/>{INERTIAL}
      <geom class="visual" mesh="trunk"/><camera name="eye"/>
      <site name="imu" pos=".1 0 0"/>
      <body name="thigh" pos=".2 0 0">
        <joint name="hip" axis="0 1 0" range="-1 2"/>
        {INERTIAL}
        <geom class="visual" mesh="far"/>
        <geom name="foot" size=".02" pos="0 0 -.2"/>
      </body>
    </body>
  </worldbody>
  <contact><exclude body1="trunk" body2="thigh"/></contact>
  <tendon><fixed name="cord"><joint joint="hip" coef="1"/></fixed></tendon>
  <actuator>
    <motor class="dog" name="hip" joint="hip"/><motor class="dog" name="cord" tendon="cord"/>
  </actuator>
  <sensor><gyro site="imu"/><touch site="imu"/></sensor>
  <keyframe><key name="home" qpos="0 0 .4 1 0 0 0 .5"/></keyframe>
</mujocoinclude>
"""
SCENE = '<mujoco model="scene"><include file="dog.xml"/><statistic extent="1"/></mujoco>'


class TestMjcf:
    def test_a_scene_loads_without_visual_meshes(self, tmp_path):
        written(tmp_path, MENAGERIE, "dog.xml")
        robot = load_model(written(tmp_path, SCENE))
        assert robot.floating
        assert robot.link_names == ("trunk", "thigh")
        (hip,) = robot.joints
        assert (hip.damping, hip.armature, hip.effort) == (2.0, 0.01, 23.0)
        assert (hip.lower, hip.upper) == (-1.0, 2.0)
        np.testing.assert_array_equal(robot.frame("imu").translation, [0.1, 0, 0])

    def test_the_reduced_model_is_the_same_robot(self, tmp_path):
        written(tmp_path, MENAGERIE, "dog.xml")
        robot = load_model(written(tmp_path, SCENE))
        whole = re.sub(r"<(mesh|texture|material)[^>]*/>|mesh=.\w+.|material=.\w+.", "", MENAGERIE)
        whole = whole.replace('type="mesh"', 'type="sphere" size=".1"')
        written(tmp_path, whole, "dog.xml")
        compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.xml"))
        np.testing.assert_array_equal(compiled.body_mass[1:], robot.phi[:, 0])
        np.testing.assert_array_equal(compiled.body("thigh").pos, robot.joints[0].translation)

    def test_the_packages_robot_equals_mujocos_own_compilation(self):
        compiled = mujoco.MjModel.from_xml_path(str(CONFIG / "symbitron.xml"))
        robot = load_model(CONFIG / "symbitron.xml")
        names = [compiled.body(i).name for i in range(compiled.nbody)]
        for name, phi in zip(robot.link_names, robot.phi, strict=True):
            assert compiled.body_mass[names.index(name)] == phi[0]

    def test_an_estimate_saved_elsewhere_loads_again(self, tmp_path):
        path = written(tmp_path, MENAGERIE.replace("mujocoinclude", "mujoco"), "dog.xml")
        robot = load_model(path)
        result = tmp_path / "result"
        again = load_model(written(result, mjcf_text(robot, path, result), "model.xml"))
        np.testing.assert_allclose(again.phi, robot.phi, rtol=1e-12, atol=1e-15)

    def test_a_mesh_that_determines_an_inertia_is_read(self, tmp_path):
        text = MJCF.replace("<worldbody>", ASSET).replace(INERTIAL, SHAPE)
        (tmp_path / "assets").mkdir()
        (tmp_path / "assets" / "box.stl").write_bytes(box_stl(0.1, 0.2, 0.3))
        robot = load_model(written(tmp_path, text))
        mass = 8 * 0.1 * 0.2 * 0.3 * 1000
        assert robot.phi[-1][0] == pytest.approx(mass, rel=1e-6)
        assert robot.phi[-1][4] == pytest.approx(mass * (0.2**2 + 0.3**2) / 3, rel=1e-6)

    @pytest.mark.parametrize("file", ["box.stl", "../../box.stl", "/tmp/box.stl", "link.stl"])
    def test_such_a_mesh_must_be_in_the_models_folder(self, file, tmp_path):
        home = tmp_path / "home"
        (home / "assets").mkdir(parents=True)
        (tmp_path / "box.stl").write_bytes(box_stl(0.1, 0.1, 0.1))
        (home / "assets" / "link.stl").symlink_to(tmp_path / "box.stl")
        text = MJCF.replace("<worldbody>", ASSET.replace("box.stl", file)).replace(INERTIAL, SHAPE)
        message = refusal(written(home, text))
        expected = "takes its inertia from this mesh" if file == "box.stl" else "not in the model's"
        assert "line 3: " in message
        assert expected in message

    @pytest.mark.parametrize("file", ["../a.xml", "{outside}", "link.xml", "", "a\u0100" * 3000])
    def test_an_include_stays_in_the_models_folder(self, file, tmp_path):
        home = tmp_path / "home"
        outside = written(tmp_path, "<mujoco/>", "a.xml")
        home.mkdir()
        (home / "link.xml").symlink_to(outside)
        include = f'<include file="{file.format(outside=outside)}"/>'
        message = refusal(written(home, MJCF.replace("<worldbody>", include + "<worldbody>")))
        assert "robot.xml: line 2: " in message or "cannot read" in message

    def test_includes_in_a_circle_are_refused(self, tmp_path):
        written(tmp_path, '<mujoco><include file="robot.xml"/></mujoco>', "b.xml")
        message = refusal(written(tmp_path, '<mujoco><include file="b.xml"/></mujoco>'))
        assert "b.xml: line 1: " in message
        assert "included twice" in message

    @pytest.mark.parametrize(
        "element",
        [
            '<extension><plugin plugin="mujoco.pid"/></extension>',
            '<asset><model file="other.xml"/></asset>',
            '<worldbody><body><flexcomp type="grid" count="99 99 99"/></body></worldbody>',
            '<worldbody><replicate count="1000000"><site/></replicate></worldbody>',
            '<worldbody><replicate count="2001"><body/></replicate></worldbody>',
            "<worldbody>" + "<body/>" * 2001 + "</worldbody>",
            "<worldbody><body>" + "<joint/>" * 1001 + "</body></worldbody>",
        ],
    )
    def test_elements_that_load_code_or_generate_bodies_are_rejected(self, element, tmp_path):
        message = refusal(written(tmp_path, MJCF.replace("</mujoco>", element + "</mujoco>")))
        assert "remove it" in message or "the limit; reduce the model" in message

    def test_a_model_near_the_limits_loads(self, tmp_path):
        joint = f'<joint name="%d"/>{INERTIAL}'
        chain = "".join(f'<body name="b{i}">{joint % i}' for i in range(190)) + "</body>" * 190
        wide = "".join(f'<body name="w{i}">{joint % (i + 190)}</body>' for i in range(800))
        sites = "".join(f'<site name="s{i}"/>' for i in range(3000))
        motors = "".join('<muscle joint="0"/>' for _ in range(3000))
        text = MJCF.replace("</body>\n  </worldbody>", chain + wide + sites + "</body></worldbody>")
        text = text.replace("</mujoco>", f"<actuator>{motors}</actuator></mujoco>")
        robot = load_model(written(tmp_path, text))
        assert len(robot.joints) == 991

    def test_a_built_in_mesh_cannot_determine_an_inertia(self, tmp_path):
        mesh = '<asset><mesh name="box" builtin="supersphere" params="4000 1 1"/></asset>'
        text = MJCF.replace("<worldbody>", mesh + "<worldbody>")
        assert load_model(written(tmp_path, text)).name == "arm"
        assert "built-in mesh" in refusal(written(tmp_path, text.replace(INERTIAL, SHAPE)))

    def test_the_simulator_opens_no_file_outside_the_folder_either(self, tmp_path):
        from symbid_ros.simulation.plant import load_model as compile_whole

        written(tmp_path, MENAGERIE, "dog.xml")
        with pytest.raises(
            SimulationError, match=r"dog\.xml: line 13: .*not in the model's folder"
        ):
            compile_whole(written(tmp_path, SCENE))

    def test_mujocos_messages_name_the_users_line(self, tmp_path):
        message = refusal(written(tmp_path, MJCF.replace("<worldbody>", "\n\n<worldbody>\n<gem/>")))
        assert f"{tmp_path / 'robot.xml'}: line 5" in message


ASSET = '<compiler meshdir="assets"/>\n<asset><mesh name="box" file="box.stl"/></asset><worldbody>'
SHAPE = '<geom type="mesh" mesh="box"/>'


def box_stl(x: float, y: float, z: float) -> bytes:
    """A box of half lengths x, y, z."""
    corners = np.array([[i, j, k] for i in (-x, x) for j in (-y, y) for k in (-z, z)])
    faces = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
    triangles = [t for a, b, c, d in faces for t in ((a, b, c), (a, c, d))]
    body = b"".join(struct.pack("<12fH", 0, 0, 0, *corners[list(t)].ravel(), 0) for t in triangles)
    return bytes(80) + struct.pack("<I", len(triangles)) + body


WORDS = (
    *("nan", "inf", "-1", "0", "1e400", "1e308", "1e-320", "0x1p40", "", "x", "../..", "9" * 400),
    *("&amp;", "\u00e9", "true", "0 0 0", "1 1 1 1 1", "mesh", "ball", "free", "base", "elbow"),
)


def mutated(text: str, rng: random.Random) -> str:
    """A text with one or two spots altered: values, tags, bytes, elements."""
    for _ in range(rng.randint(1, 2)):
        kind = rng.randrange(5)
        if kind == 0:
            spots = [m.span(1) for m in re.finditer(r'"([^"]*)"', text)]
            start, end = rng.choice(spots) if spots else (0, 0)
            text = text[:start] + rng.choice(WORDS) + text[end:]
        elif kind == 1:
            spots = [m.span() for m in re.finditer(r"<[^>]*>", text)]
            (a, b), (c, d) = sorted(rng.choices(spots or [(0, 0)], k=2))
            text = text[:a] + text[c:d] + text[b:c] + text[a:b] + text[d:] if b <= c else text
        elif kind == 2:
            spot = rng.randrange(len(text) + 1)
            text = (
                text[:spot] + chr(rng.choice((0, 9, 34, 38, 45, 60, 62, 0xD7))) + text[spot + 1 :]
            )
        elif kind == 3:
            spots = [m.span() for m in re.finditer(r"\b\w+\b", text)]
            (a, b), (c, d) = rng.choices(spots or [(0, 0)], k=2)
            text = text[:a] + text[c:d] + text[b:]
        else:
            start, end = sorted(rng.choices(range(len(text) + 1), k=2))
            end = min(end, start + 60)
            text = text[:start] + text[start:end] * 2 + text[end:]
    return text


LIGHT = MJCF.replace(
    INERTIAL, '<inertial mass="1e-13" pos="0 0 0" diaginertia="1e-14 1e-14 1e-14"/>'
)


def test_mujocos_warnings_leave_no_file_in_the_users_folder(tmp_path, monkeypatch, capfd):
    monkeypatch.chdir(tmp_path)
    text = LIGHT.replace("<joint ", '<joint name="far" pos="1e9 0 0"/><joint ')
    load_model(written(tmp_path, text))
    assert [file.name for file in tmp_path.iterdir()] == ["robot.xml"]
    assert capfd.readouterr().err == ""


DOG = MENAGERIE.replace("mujocoinclude", "mujoco")


@pytest.mark.parametrize("text", [MJCF, URDF, DOG], ids=["mjcf", "urdf", "menagerie"])
def test_a_mutated_model_is_valid_or_rejected(text, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # where MuJoCo's MUJOCO_LOG.TXT would lie
    path = tmp_path / "robot"
    rng = random.Random(7)
    robots, refusals = [], []
    for _ in range(400):
        path.write_text(mutated(text, rng))
        try:
            robots.append(load_model(path))
        except ModelError as error:
            refusals.append(str(error))
            continue
        if text is URDF:
            assert urdf_text(robots[-1], path) == path.read_bytes().decode()
    assert len(robots) > 40
    assert len(refusals) > 40
    assert all(message.startswith(str(tmp_path)) for message in refusals)
    assert not any("\n" in message for message in refusals)
    for robot in robots:
        assert np.all(np.isfinite(robot.phi))
        assert np.all(robot.phi[:, 0] >= 0)
        for joint in robot.joints:
            assert np.linalg.norm(joint.axis) == pytest.approx(1.0)
            assert np.all(np.isfinite(joint.translation))
            np.testing.assert_allclose(joint.rotation @ joint.rotation.T, np.eye(3), atol=1e-12)
    assert [file.name for file in tmp_path.iterdir()] == ["robot"]
