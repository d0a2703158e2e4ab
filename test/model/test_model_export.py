"""Exported models load everywhere, and the user's own file changes in numbers only."""

import re
from dataclasses import replace
from functools import cache
from pathlib import Path

import mujoco
import numpy as np
import pinocchio
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from random_robots import CONFIG, random_phi, random_robot

from symbid_ros.atomic_write import write_text
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.placements import displaced
from symbid_ros.errors import ModelError
from symbid_ros.model.export_mjcf import mjcf_files, mjcf_text, replaced_values
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.inertia import (
    TINY_MASS,
    com_from_phi,
    is_consistent,
    nearest_consistent,
    phi_from_com,
    pseudo_inertia,
    transform_phi,
)
from symbid_ros.model.load import load_model
from symbid_ros.model.urdf import UrdfReader
from symbid_ros.model.xml_file import read_xml

ROBOTS = Path(pinocchio.__file__).parents[4] / "share/example-robot-data/robots"


# An incomplete file, and one whose fingers mimic joints of other names than those it has.
BROKEN = {"ur3.urdf": "one root link", "alex_psyonic_hands.urdf": "mimics 'index_q1'"}


@cache
def example_robots():
    """Every robot of example-robot-data, with its file."""
    robots = {}
    for path in sorted(ROBOTS.rglob("*.urdf")):
        if path.name not in BROKEN:
            robots[path] = load_model(path)
            continue
        with pytest.raises(ModelError, match=BROKEN[path.name]):
            load_model(path)
    assert len(robots) > 60
    return robots


def own_phi(path):
    """Each link's φ about its own origin, as a URDF states it."""
    reader = UrdfReader(str(path), read_xml(path))
    return {name: reader.phi(name) for name in reader.links}


def identified(robot, rng, amount=0.05):
    """A robot whose links with mass have other inertias, possible wherever they were."""
    phi = robot.phi.copy()
    for index, row in enumerate(phi):
        if is_consistent(row) and np.any(row):
            stretch = np.eye(4) + amount * rng.uniform(-1, 1, (4, 4))
            matrix = stretch @ pseudo_inertia(row) @ stretch.T
            second = np.trace(matrix[:3, :3]) * np.eye(3) - matrix[:3, :3]
            phi[index] = [matrix[3, 3], *matrix[3, :3], *second[np.triu_indices(3)]]
    return robot.with_phi(phi)


def without_numbers(text):
    """A URDF without the numbers that identification may change."""

    def masked(match):
        return re.sub(r"[-+]?[\d.]+(?:[eE][-+]?\d+)?", "#", match[0])

    return re.sub(r"<inertial>.*?</inertial>|<dynamics[^>]*>", masked, text, flags=re.DOTALL)


def assert_loads_as_mjcf(robot, folder):
    """The robot's MJCF loads in MuJoCo and here, with equal links where MuJoCo takes them."""
    path = folder / "model.xml"
    path.write_text(mjcf_text(robot))
    compiled = mujoco.MjModel.from_xml_path(str(path))
    again = load_model(path)
    assert again.joint_names == robot.joint_names
    assert again.floating == robot.floating
    first = 0 if robot.floating else 1
    for link, phi, copy in zip(
        robot.links[first:], robot.phi[first:], again.phi[first:], strict=True
    ):
        if not link.virtual:
            name = link.name if link.name != "world" else "world_link"
            assert compiled.body(name).mass[0] == pytest.approx(copy[0], rel=1e-12)
            assert is_consistent(copy)
        if is_consistent(phi):
            size = np.abs(phi).max()
            np.testing.assert_allclose(copy, phi, rtol=1e-9, atol=1e-11 * size + 2e-9)
        elif phi[0] > 0:
            assert any(link.name in remark for remark in replaced_values(robot))


def test_every_example_robot_loads_in_mujoco_and_here(tmp_path):
    for robot in example_robots().values():
        assert_loads_as_mjcf(robot, tmp_path)


def test_only_numbers_change_in_example_robots(tmp_path):
    rng = np.random.default_rng(3)
    for path, robot in [*example_robots().items()][::2]:
        text = path.read_bytes().decode("utf-8", "surrogateescape")
        assert urdf_text(robot, path) == text
        changed = identified(robot, rng)
        out = urdf_text(changed, path)
        write_text(tmp_path / "model.urdf", out)
        again = load_model(tmp_path / "model.urdf")
        size = np.abs(changed.phi).max()
        np.testing.assert_allclose(again.phi, changed.phi, rtol=1e-9, atol=1e-12 * size)
        if out.count("<origin") == text.count("<origin"):
            assert without_numbers(out) == without_numbers(text), path
        before, after = own_phi(path), own_phi(tmp_path / "model.urdf")
        assert {n for n, p in before.items() if np.any(p)} == {
            n for n, p in after.items() if np.any(p)
        }
        assert_fixed_children_kept(changed, before, after)
        if all(is_consistent(phi) for phi in before.values()):
            assert all(is_consistent(phi) for phi in after.values()), path


def assert_fixed_children_kept(robot, before, after):
    """They differ only where the body that the joint moves could not take all of the change."""
    frames = {frame.name: frame for frame in robot.frames}
    rest, fixed = robot.phi.copy(), [[] for _ in robot.links]
    for name, phi in before.items():
        if name in frames and name not in robot.link_names:
            frame = frames[name]
            rest[frame.link] -= transform_phi(phi, frame.rotation, frame.translation)
            fixed[frame.link].append(name)
    for link, phi, names in zip(robot.links, rest, fixed, strict=True):
        if np.any(before[link.name]) and is_consistent(phi) and phi[0] > 0:
            for name in names:
                np.testing.assert_array_equal(after[name], before[name])


MASSES = {
    "none": None,
    "massless": np.zeros(10),
    "point": phi_from_com(0.7, np.array([0.1, -0.2, 0.05]), np.zeros((3, 3))),
    "lamina": phi_from_com(1.3, np.zeros(3), np.diag([0.1, 0.2, 0.1 + 0.2])),
    "impossible": phi_from_com(0.9, np.array([0, 0.1, 0]), np.diag([0.01, 0.01, 0.5])),
    "gram": phi_from_com(1e-3, np.array([0, 0, 1e-3]), 1e-10 * np.eye(3)),
}


@st.composite
def urdfs(draw):
    """A URDF of a random tree, in any of several ways to write one."""
    rng = np.random.default_rng(draw(st.integers(0, 10_000)))
    newline = draw(st.sampled_from(["\n", "\r\n", ""]))
    quote = draw(st.sampled_from(['"', "'"]))
    count = draw(st.integers(2, 6))
    names = [f"link_{index}" for index in range(count)]
    names[0] = draw(st.sampled_from(["base_link", "world"]))
    lines = ["<?xml version='1.0'?><!-- by hand: <link> -->", '<robot name="r">']
    for index, name in enumerate(names):
        kind = draw(st.sampled_from([*MASSES, "usual", "usual"]))
        phi = random_phi(rng) if kind == "usual" else MASSES[kind]
        if phi is None:
            lines.append(
                f"\t<link  name='{name}' />" if index % 2 else f"<link name='{name}'></link>"
            )
        else:
            mass, com, inertia = com_from_phi(phi)
            lines += [f'  <link name="{name}"> <!-- a link --> <inertial>']
            if np.any(com):
                lines.append(
                    f'<origin rpy="0 0 0"  xyz="{com[0]:.17g}  {com[1]:.17g}\t{com[2]:.17g}" />'
                )
            lines += [f'<mass value =" {mass!r}"/>', "<inertia"]
            lines += [
                f'  i{"xyz"[i]}{"xyz"[j]}="{inertia[i, j]:.17g}"'
                for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
            ]
            lines += ["/></inertial></link>"]
        if index == 0:
            continue
        joint = draw(st.sampled_from(["fixed", "fixed", "revolute", "continuous", "prismatic"]))
        parent = names[int(rng.integers(0, index))]
        x, y, z = rng.normal(size=3).round(3)
        lines += [
            f'  <joint type="{joint}" name="joint_{index}"><parent link="{parent}"/>',
            f'<child link="{name}"/><origin xyz="{x} {y} {z}" rpy="{y} 0 {z}"/>',
            draw(st.sampled_from(["", '<limit lower="1" upper="-1" effort="3" velocity="1"/>'])),
            draw(st.sampled_from(["", '<dynamics damping="0.50"/>', '<dynamics friction=".1"/>'])),
            "<axis xyz='0 .6 .8'/></joint>",
        ]
    text = newline.join([*lines, "</robot>"]).replace("'", quote if newline else "'")
    return text + newline


@given(urdfs(), st.sampled_from(["floating", "fixed"]), st.integers(0, 1000))
@settings(max_examples=60)
def test_any_urdf_that_loads_can_be_written_in_both_formats(tmp_path_factory, text, base, seed):
    folder = tmp_path_factory.mktemp("urdf")
    path = folder / "robot.urdf"
    path.write_bytes(text.encode())
    robot = load_model(path, base)
    if not robot.dof:
        return  # which an MJCF cannot be, and nothing of it can be identified
    assert_loads_as_mjcf(robot, folder)
    assert urdf_text(robot, path) == text
    changed = identified(robot, np.random.default_rng(seed))
    joints = tuple(replace(joint, damping=1.25) for joint in robot.joints)
    changed = replace(changed, joints=joints)
    assert_loads_as_mjcf(changed, folder)
    out = folder / "model.urdf"
    write_text(out, urdf_text(changed, path))
    again = load_model(out, base)
    np.testing.assert_allclose(again.phi, changed.phi, rtol=1e-9, atol=1e-12)
    assert [joint.damping for joint in again.joints] == [1.25] * len(joints)
    before, after = own_phi(path), own_phi(out)
    assert_fixed_children_kept(changed, before, after)
    assert {n for n, phi in before.items() if np.any(phi)} == {
        n for n, phi in after.items() if np.any(phi)
    }
    if text.count("<origin") == out.read_bytes().count(b"<origin"):
        added = r'\s*<dynamics [^>]*>| damping="#"'
        kept = re.sub(added, "", without_numbers(out.read_bytes().decode()))
        assert kept == re.sub(added, "", without_numbers(text))


@pytest.mark.parametrize("encoding", ["utf-8-sig", "iso-8859-1", "utf-16"])
def test_other_encodings_are_preserved(encoding, tmp_path):
    declared = {"utf-8-sig": "utf-8"}.get(encoding, encoding)
    text = (
        f'<?xml version="1.0" encoding="{declared}"?>\r\n<!-- Gerät -->\r\n<robot name="r">'
        '<link name="a"><inertial><mass value="2."/><inertia ixx="1" iyy="1" izz="1"/></inertial>'
        "</link></robot>\r\n"
    )
    path, out = tmp_path / "robot.urdf", tmp_path / "model.urdf"
    path.write_bytes(text.encode(encoding))
    robot = load_model(path)
    heavier = robot.phi.copy()
    heavier[0, 0] = 2.5
    write_text(out, urdf_text(robot.with_phi(heavier), path))
    np.testing.assert_allclose(load_model(out).phi, heavier)
    if encoding != "utf-16":
        assert out.read_bytes() == text.replace('"2."', '"2.5"').encode(encoding)


LEG = """<mujocoinclude>
  <!-- the leg -->
  <compiler meshdir="meshes"/>
  <asset><mesh name="shell" file="shell.stl"/></asset>
  <default><default class="drive"><joint damping="0.30" armature="0.010"/></default></default>
</mujocoinclude>
"""
BODY = """<mujocoinclude>
    <body name="thigh" pos="0 0 -.1">\t<!-- by hand -->
      <joint class="drive"   name="hip" axis="0 1 0" frictionloss='0.50' />
      <inertial pos="0 0 -.1" mass="1.50" diaginertia=".02 .02 .01" quat="1 0 0 0"/>
      <body name="foot" pos="0 0 -.2"><geom size=".02" mass="0"/></body>
      <body name="pad" pos="0 .1 -.2"><geom size=".02" mass=".125"/></body>
    </body>
</mujocoinclude>
"""
SCENE = """<?xml version="1.0"?>
<!-- a scene -->
<mujoco model="scene">
  <include file="model.xml"/>
  <worldbody>
    <body name="trunk"><freejoint/><geom size=".1" mass="4"/>
      <include  file="parts/body.xml"/>
    </body>
  </worldbody>
  <actuator><motor name="hip" joint="hip" gear="5"/></actuator>
</mujoco>
"""


@pytest.fixture
def scene(tmp_path):
    home = tmp_path / "home"
    (home / "parts").mkdir(parents=True)
    (home / "model.xml").write_text(LEG)
    (home / "parts/body.xml").write_text(BODY)
    (home / "scene.xml").write_text(SCENE)
    return home / "scene.xml"


def saved(files, folder):
    for place, text in files.items():
        write_text(folder / place, text)
    return load_model(folder / next(iter(files)))


def test_an_mjcf_with_includes_keeps_its_files(scene, tmp_path):
    robot = load_model(scene)
    phi = robot.phi.copy()
    phi[1] *= 1.5
    (hip,) = robot.joints
    changed = replace(robot.with_phi(phi), joints=(replace(hip, damping=0.75),))
    out = tmp_path / "out"
    files = mjcf_files(changed, scene, out)
    names = ["model.xml", "model_identified.xml", "parts/body.xml"]
    assert [str(place) for place in files] == names
    again = saved(files, out)
    np.testing.assert_allclose(again.phi, phi, rtol=1e-12, atol=1e-15)
    assert again.joints[0].damping == 0.75
    main, leg, body = files.values()
    assert main == SCENE.replace('"model.xml"', '"model_identified.xml"')
    assert leg == LEG.replace('"meshes"', '"../home/meshes"')
    lines = zip(body.splitlines(), BODY.splitlines(), strict=True)
    different = [old.strip().split()[0] for new, old in lines if new != old]
    assert different == ["<joint", "<inertial"]
    assert 'quat="1 0 0 0"' not in body
    assert "frictionloss='0.50'  damping=" not in body
    assert [path.read_text() for path in (scene, scene.parent / "parts/body.xml")] == [SCENE, BODY]


def test_an_unchanged_mjcf_with_includes_is_the_same_and_replaces_no_input(scene):
    robot = load_model(scene)
    files = mjcf_files(robot, scene, scene.parent, name="robot.xml")
    assert [str(place) for place in files] == [
        "robot.xml",
        "model_identified.xml",
        "parts/body_identified.xml",
    ]
    assert next(iter(files.values())) == SCENE.replace("model.xml", "model_identified.xml").replace(
        "body.xml", "body_identified.xml"
    )
    assert list(files.values())[1:] == [LEG, BODY]


def test_a_massless_welded_foot_stays_without_inertia(scene, tmp_path):
    robot = load_model(scene)
    heavier = robot.with_phi(1.25 * robot.phi)
    saved(mjcf_files(heavier, scene, tmp_path / "out"), tmp_path / "out")
    (scene.parent / "meshes").mkdir()
    text = (tmp_path / "out/model_identified.xml").read_text()
    (tmp_path / "out/model_identified.xml").write_text(re.sub("<asset>.*</asset>", "", text))
    compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "out/model.xml"))
    assert compiled.body("foot").mass[0] == 0
    assert compiled.body("pad").mass[0] == pytest.approx(0.125)
    assert compiled.body("thigh").mass[0] == pytest.approx(1.25 * 1.625 - 0.125)
    assert compiled.body("trunk").mass[0] == pytest.approx(5.0)


def test_settings_that_would_change_inertias_again_are_removed(scene, tmp_path):
    text = SCENE.replace(
        "  <include", '  <compiler settotalmass="11.25" angle="radian"/>\n  <include', 1
    )
    scene.write_text(text)
    robot = load_model(scene)
    assert robot.phi[:, 0].sum() == pytest.approx(11.25)
    heavier = robot.with_phi(1.5 * robot.phi)
    files = mjcf_files(heavier, scene, tmp_path / "out")
    again = saved(files, tmp_path / "out")
    np.testing.assert_allclose(again.phi, heavier.phi, rtol=1e-11, atol=1e-15)
    assert '<compiler angle="radian"/>' in next(iter(files.values()))


def test_bodies_without_an_element_in_the_file_give_a_minimal_tree(tmp_path):
    text = """<mujoco><worldbody><body name="base"><inertial mass="1" pos="0 0 0"
      diaginertia="1 1 1"/><replicate count="3" offset="0 1 0"><body name="leg">
      <joint name="hip"/><geom size=".1"/></body></replicate></body></worldbody></mujoco>"""
    path = tmp_path / "robot.xml"
    path.write_text(text)
    robot = load_model(path)
    changed = robot.with_phi(1.25 * robot.phi)
    again = saved(mjcf_files(changed, path, tmp_path / "out"), tmp_path / "out")
    np.testing.assert_allclose(again.phi, changed.phi, rtol=1e-12, atol=1e-15)


def test_an_inconsistent_link_is_written_as_the_nearest_consistent_one():
    impossible = phi_from_com(0.9, np.array([0, 0.1, 0]), np.diag([0.01, 0.01, 0.5]))
    mass, com, inertia = com_from_phi(nearest_consistent(impossible))
    assert mass == pytest.approx(0.9)
    np.testing.assert_allclose(com, [0, 0.1, 0], atol=1e-15)
    # ∫z² = (Ixx + Iyy - Izz)/2 < 0 becomes zero: Ixx and Iyy grow to half of Izz.
    np.testing.assert_allclose(inertia, np.diag([0.25, 0.25, 0.5]), atol=1e-11)
    assert is_consistent(nearest_consistent(-impossible))
    assert is_consistent(nearest_consistent(np.r_[1e-13, 0.1, np.zeros(8)]))
    rng = np.random.default_rng(1)
    for _ in range(20):
        phi = random_phi(rng)
        np.testing.assert_array_equal(nearest_consistent(phi), phi)


def test_a_link_written_as_an_empty_element_gets_its_identified_inertia(tmp_path):
    path, out = tmp_path / "arm.urdf", tmp_path / "out.urdf"
    path.write_text(
        '<robot name="arm"><link name="world"/><link name="arm"/>'
        '<joint name="hinge" type="revolute"><parent link="world"/><child link="arm"/>'
        '<limit lower="-1" upper="1"/></joint></robot>'
    )
    arm = load_model(path, "fixed")
    phi = arm.phi.copy()
    phi[1] = [2.0, 0.1, 0.0, 0.2, 0.3, 0.0, -0.01, 0.3, 0.0, 0.2]
    out.write_text(urdf_text(arm.with_phi(phi), path))
    np.testing.assert_allclose(load_model(out, "fixed").phi, phi, atol=1e-15)


def test_a_slide_without_a_range_has_finite_limits_in_a_urdf(tmp_path):
    """urdfdom reads no infinity."""
    (tmp_path / "rail.xml").write_text(
        '<mujoco><worldbody><body name="cart"><joint name="rail" type="slide" axis="1 0 0"/>'
        '<geom size=".1"/></body></worldbody></mujoco>'
    )
    text = urdf_text(load_model(tmp_path / "rail.xml"))
    assert pinocchio.buildModelFromXML(text).nq == 1
    (tmp_path / "rail.urdf").write_text(text)
    (joint,) = load_model(tmp_path / "rail.urdf", "fixed").joints
    assert (joint.lower, joint.upper) == (-np.inf, np.inf)


@pytest.mark.parametrize("write", [urdf_text, mjcf_text])
@pytest.mark.parametrize("seed", range(3))
def test_reference_positions_survive_both_formats(write, seed, tmp_path):
    """A URDF has none, so they are part of its poses; limits and positions stay."""
    rng = np.random.default_rng(seed)
    robot = random_robot(seed, links=6)
    joints = tuple(replace(joint, reference=rng.normal()) for joint in robot.joints)
    robot = replace(robot, joints=joints)
    path = tmp_path / ("robot.urdf" if write is urdf_text else "robot.xml")
    path.write_text(write(robot))
    again = load_model(path)
    position = rng.uniform(-2, 2, (5, 5))
    expected, found = link_poses(robot, position), link_poses(again, position)
    np.testing.assert_allclose(found.rotation, expected.rotation, atol=1e-12)
    np.testing.assert_allclose(found.position, expected.position, atol=1e-12)
    assert [(one.lower, one.upper) for one in again.joints] == [(-3.0, 3.0)] * 5


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("bare", [0, 1, 3])
def test_only_moving_links_without_mass_get_a_tiny_one(floating, bare, tmp_path):
    robot = random_robot(2, links=4, floating=floating)
    phi = robot.phi.copy()
    phi[bare] = 0.0
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(robot.with_phi(phi)))
    expected = phi[:, 0].copy()
    expected[bare] = TINY_MASS if floating or bare else 0.0
    masses = [compiled.body(name).mass[0] for name in robot.link_names]
    np.testing.assert_allclose(masses, expected, rtol=1e-12)
    assert (f"link_{bare}" in " ".join(replaced_values(robot.with_phi(phi)))) is bool(
        floating or bare
    )


@pytest.mark.parametrize("floating", [True, False])
@pytest.mark.parametrize("index", [0, 3])
def test_a_link_may_have_mjcfs_name_of_the_world(floating, index, tmp_path):
    robot = random_robot(1, links=4, floating=floating)
    links = [replace(one, name="world") if i == index else one for i, one in enumerate(robot.links)]
    path = tmp_path / "robot.xml"
    path.write_text(mjcf_text(replace(robot, links=tuple(links))))
    again = load_model(path)
    names = list(robot.link_names)
    # A fixed base of that name is MuJoCo's world, which cannot have inertia.
    names[index] = "world" if index == 0 and not floating else "world_link"
    assert list(again.link_names) == names
    first = 1 if index == 0 and not floating else 0
    np.testing.assert_allclose(again.phi[first:], robot.phi[first:], atol=1e-9)


SHELL = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
MESH = """<mujoco>{compiler}
  <asset><mesh name="shell" file="shell.obj"/></asset>
  <worldbody><body name="trunk"><freejoint/><inertial pos="0 0 0" mass="1" diaginertia="1 1 1"/>
  </body></worldbody>
</mujoco>
"""


@pytest.mark.parametrize(
    ("compiler", "written"),
    [
        ("", '<compiler assetdir="../home"/>'),
        ('<compiler angle="radian"/>', '<compiler angle="radian" assetdir="../home"/>'),
        ('<compiler meshdir="m"/>', '<compiler meshdir="../home/m"/>'),
        (
            '<compiler texturedir="t" assetdir="a"/>',
            '<compiler texturedir="../home/t" assetdir="../home/a"/>',
        ),
        (
            '<compiler angle="radian"/><compiler coordinate="local"/>',
            '<compiler angle="radian" assetdir="../home"/><compiler coordinate="local"/>',
        ),
    ],
)
def test_meshes_are_found_from_another_folder(compiler, written, tmp_path):
    home, out = tmp_path / "home", tmp_path / "out"
    for each in (home / "m", home / "a", out):
        each.mkdir(parents=True)
    for each in (home, home / "m", home / "a"):
        (each / "shell.obj").write_text(SHELL)
    source = home / "robot.xml"
    source.write_text(MESH.format(compiler=compiler))
    robot = load_model(source)
    (same,) = mjcf_files(robot, source, home).values()
    assert same == source.read_text()
    heavier = robot.with_phi(2 * robot.phi)
    again = saved(mjcf_files(heavier, source, out), out)
    np.testing.assert_allclose(again.phi, 2 * robot.phi)
    assert written in next(out.glob("*.xml")).read_text()


def test_a_model_elsewhere_needs_no_mesh_for_its_inertias(tmp_path):
    """A welded body has its inertia from a mesh, another one only shows it, and so does a table."""
    home, out = tmp_path / "home", tmp_path / "out"
    home.mkdir()
    out.mkdir()
    (home / "shell.obj").write_text(SHELL)
    geom, show = '<geom type="mesh" mesh="shell" {}/>', 'mass="0" contype="0" conaffinity="0"'
    inside = (
        f'<body name="mount">{geom.format("")}</body><body name="badge">{geom.format(show)}</body>'
    )
    text = MESH.format(compiler="").replace("</body></worldbody>", inside + "</body></worldbody>")
    text = text.replace("</worldbody>", f'<body name="table">{geom.format("")}</body></worldbody>')
    source = home / "robot.xml"
    source.write_text(text)
    robot = load_model(source)
    heavier = robot.with_phi(1.2 * robot.phi)
    again = saved(mjcf_files(heavier, source, out), out)
    np.testing.assert_allclose(again.phi, heavier.phi, rtol=1e-9, atol=1e-9)
    # In its own folder, nothing that did not change is written.
    (same,) = mjcf_files(robot, source, home).values()
    assert same == text


def _assert_same_placements(one, other):
    for first, second in zip(one.joints, other.joints, strict=True):
        np.testing.assert_allclose(first.rotation, second.rotation, atol=1e-9)
        np.testing.assert_allclose(first.translation, second.translation, atol=1e-9)


@pytest.mark.parametrize("name", ["symbitron.urdf", "symbitron.xml"])
def test_displaced_joints_are_written_into_the_users_file(name, tmp_path):
    source = CONFIG / name
    before = load_model(source)
    rng = np.random.default_rng(3)
    screws = np.where(rng.random((len(before.joints), 1)) < 0.5, 0.0, 0.01)
    after = displaced(before, screws * rng.standard_normal((len(before.joints), 6)))
    written = tmp_path / name
    if name.endswith("urdf"):
        written.write_text(urdf_text(after, source, before=before))
    else:
        written.write_text(next(iter(mjcf_files(after, source, tmp_path, before=before).values())))
    _assert_same_placements(load_model(written), after)
    # Otherwise the file is that of the robot without displacements.
    if name.endswith("urdf"):
        assert urdf_text(before, source, before=before) == urdf_text(before, source)


def test_a_displaced_joint_off_its_bodys_origin_moves_the_body(tmp_path):
    source = tmp_path / "arm.xml"
    source.write_text(
        "<mujoco><compiler angle='radian'/><worldbody><body name='upper' pos='0 0 .1'>"
        "<joint name='one' axis='0 1 0'/><inertial mass='1' pos='0 0 .1' diaginertia='.1 .1 .1'/>"
        "<body name='lower' pos='0 .1 .3' euler='.3 0 .2'><joint name='two' pos='.02 0 -.03' "
        "axis='1 0 0'/><inertial mass='1' pos='0 0 .1' diaginertia='.1 .1 .1'/></body></body>"
        "</worldbody></mujoco>"
    )
    before = load_model(source)
    after = displaced(before, np.array([np.zeros(6), [0.02, -0.01, 0.03, 0.004, 0.003, -0.002]]))
    written = tmp_path / "written.xml"
    written.write_text(next(iter(mjcf_files(after, source, tmp_path, before=before).values())))
    _assert_same_placements(load_model(written), after)
