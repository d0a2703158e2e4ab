"""The shapes of a model file, against MuJoCo's placement of the same shapes."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.model.load import load_model
from symbid_ros.model.visual_shapes import resolve_mesh, visual_shapes
from symbid_ros.package_paths import config_file

URDF = """<robot name="arm">
  <link name="base"><visual><origin xyz="0 0 .1" rpy="0 0 1.5"/><geometry>
    <box size=".2 .4 .1"/></geometry></visual></link>
  <joint name="j" type="revolute"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 .2" rpy=".3 0 0"/><limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
  <link name="upper"><inertial><mass value="1"/><inertia ixx=".1" iyy=".1" izz=".1"/></inertial>
    <visual><geometry><mesh filename="{mesh}" scale="2 2 2"/></geometry></visual></link>
  <joint name="weld" type="fixed"><parent link="upper"/><child link="tool"/>
    <origin xyz="0 0 .5" rpy="0 .7 0"/></joint>
  <link name="tool"><collision><origin xyz=".1 0 0"/><geometry><sphere radius=".05"/></geometry>
    </collision></link>
</robot>"""


def write_urdf(folder: Path, mesh: str) -> Path:
    path = folder / "arm.urdf"
    path.write_text(URDF.format(mesh=mesh), encoding="utf-8")
    return path


def test_shapes_of_an_mjcf_are_where_mujoco_has_them() -> None:
    path = config_file("symbitron.xml")
    model, m = load_model(path), mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(m)
    rng = np.random.default_rng(0)
    position = rng.uniform(-0.5, 0.5, len(model.joints))
    data.qpos[7:] = position
    mujoco.mj_kinematics(m, data)
    base = m.body(model.links[0].name).id
    base_rotation = data.xmat[base].reshape(3, 3)
    shown = [g for g in range(m.ngeom) if m.geom_group[g] == 2 and m.geom_bodyid[g]]
    shapes = visual_shapes(model).shapes
    assert len(shapes) == len(shown)
    poses = link_poses(model, position[None])
    for geom, shape in zip(shown, shapes, strict=True):
        rotation = poses.rotation[0, shape.link]
        centre = rotation @ shape.translation + poses.position[0, shape.link]
        true = base_rotation.T @ (data.geom_xpos[geom] - data.xpos[base])
        np.testing.assert_allclose(centre, true, atol=1e-12)
        axes = base_rotation.T @ data.geom_xmat[geom].reshape(3, 3)
        np.testing.assert_allclose(rotation @ shape.rotation, axes, atol=1e-12)


def test_shapes_of_welded_links_belong_to_the_link_that_moves(tmp_path: Path) -> None:
    model = load_model(write_urdf(tmp_path, "none.stl"))
    found = visual_shapes(model)
    box, sphere = found.shapes
    assert (box.kind, box.link) == ("box", 0)
    np.testing.assert_allclose(box.size, [0.2, 0.4, 0.1])
    np.testing.assert_allclose(box.translation, [0, 0, 0.1])
    assert (sphere.kind, sphere.link) == ("sphere", 1)
    np.testing.assert_allclose(sphere.size, 0.1)
    tilted = [0.1 * np.cos(0.7), 0, 0.5 - 0.1 * np.sin(0.7)]
    np.testing.assert_allclose(sphere.translation, tilted, atol=1e-12)
    assert len(found.remarks) == 1
    assert "none.stl" in found.remarks[0]


@pytest.mark.parametrize("variable", ["AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH", None])
def test_packages_are_found_by_environment_and_above_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, variable: str | None
) -> None:
    for name in ("AMENT_PREFIX_PATH", "ROS_PACKAGE_PATH"):
        monkeypatch.delenv(name, raising=False)
    home = tmp_path / ("robots" if variable is None else "elsewhere")
    if variable:
        monkeypatch.setenv(variable, f"/nowhere:{home}")
    share = home / "share" if variable == "AMENT_PREFIX_PATH" else home
    mesh = share / "my_robot" / "meshes" / "a b.stl"
    mesh.parent.mkdir(parents=True)
    mesh.touch()
    model = tmp_path / "robots" / "my_robot" / "urdf" / "arm.urdf"
    assert resolve_mesh("package://my_robot/meshes/a%20b.stl", model) == mesh
    assert resolve_mesh("package://other/meshes/a%20b.stl", model) is None
    assert resolve_mesh(f"file://{mesh.parent}/a%20b.stl", model) == mesh


def test_names_that_no_file_can_have_are_missing(tmp_path: Path) -> None:
    model = tmp_path / "arm.urdf"
    for name in ("", "a\0b.stl", "x" * 5000, "package://[/a.stl", "http://localhost/a.stl"):
        assert resolve_mesh(name, model) is None


def test_a_file_that_has_gone_gives_a_remark(tmp_path: Path) -> None:
    path = write_urdf(tmp_path, "none.stl")
    model = load_model(path)
    path.unlink()
    found = visual_shapes(model)
    assert found.shapes == ()
    assert str(path) in found.remarks[0]


def test_meshes_of_an_mjcf_are_in_the_frame_of_the_link(tmp_path: Path) -> None:
    (tmp_path / "m.obj").write_text(
        "v 1 0 0\nv 0 1 0\nv 0 0 1\nv 0 0 0\nf 1 2 3\nf 1 3 4\nf 2 1 4\nf 3 2 4\n"
    )
    path = tmp_path / "robot.xml"
    path.write_text(
        '<mujoco><asset><mesh name="m" file="m.obj"/></asset><worldbody><body name="a">'
        '<joint name="j" type="hinge" pos="0 0 .5"/><inertial pos="0 0 0" mass="1" '
        'diaginertia="1 1 1"/><geom type="mesh" mesh="m" pos="2 0 0"/></body></worldbody></mujoco>'
    )
    (shape,) = visual_shapes(load_model(path)).shapes
    assert shape.vertices is not None
    corners = shape.vertices @ shape.rotation.T + shape.translation
    true = np.array([[3, 0, -0.5], [2, 1, -0.5], [2, 0, 0.5], [2, 0, -0.5]])
    assert sorted(map(tuple, np.round(corners, 6) + 0.0)) == sorted(map(tuple, true))
