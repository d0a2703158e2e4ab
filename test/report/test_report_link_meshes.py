"""Triangles of links: sizes of primitives, files of each format, damaged files, capsules."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from documented_robots import ur5_urdf

from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.report import link_meshes as module
from symbid_ros.report.link_meshes import link_meshes

URDF = """<robot name="one"><link name="base"/><joint name="j" type="continuous">
  <parent link="base"/><child link="a"/></joint>
  <link name="a"><inertial><origin xyz="0 0 .2"/><mass value="1"/>
    <inertia ixx=".1" iyy=".1" izz=".1"/></inertial>
    <visual><origin xyz="0 1 0"/><geometry>{}</geometry></visual></link></robot>"""


def extents(tmp_path: Path, geometry: str) -> tuple[np.ndarray, tuple[str, ...]]:
    """Return the bounds of the second link's triangles around (0, 1, 0), and the remarks."""
    path = tmp_path / "robot.urdf"
    path.write_text(URDF.format(geometry), encoding="utf-8")
    found = link_meshes(load_model(path))
    (mesh,) = found.meshes
    assert mesh.link == 1
    return np.stack([mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)]), found.remarks


@pytest.mark.parametrize(
    ("geometry", "half"),
    [
        ('<box size=".2 .4 .6"/>', [0.1, 0.2, 0.3]),
        ('<cylinder radius=".1" length=".8"/>', [0.1, 0.1, 0.4]),
        ('<sphere radius=".3"/>', [0.3, 0.3, 0.3]),
        ('<capsule radius=".1" length=".8"/>', [0.1, 0.1, 0.5]),
    ],
)
def test_primitives_have_their_size(tmp_path, geometry, half) -> None:
    bounds, remarks = extents(tmp_path, geometry)
    assert remarks == ()
    np.testing.assert_allclose(bounds[1] - [0, 1, 0], half, rtol=0.05)
    np.testing.assert_allclose(bounds[0] - [0, 1, 0], np.negative(half), rtol=0.05)


@pytest.mark.parametrize("kind", ["stl", "obj", "dae", "ply"])
def test_files_of_each_format_are_read_and_scaled(tmp_path, kind) -> None:
    trimesh.creation.box(extents=[1, 2, 3]).export(tmp_path / f"m.{kind}")
    bounds, remarks = extents(tmp_path, f'<mesh filename="m.{kind}" scale=".1 .1 .2"/>')
    assert remarks == ()
    np.testing.assert_allclose(bounds[1] - bounds[0], [0.1, 0.2, 0.6], rtol=1e-5)


def test_the_unit_of_collada_counts(tmp_path) -> None:
    text = trimesh.exchange.dae.export_collada(trimesh.creation.box(extents=[1, 2, 3])).decode()
    asset = '<unit name="inch" meter="0.0254"/><up_axis>Z_UP</up_axis>'
    head, _, tail = text.partition("<asset>")
    inner, _, rest = tail.partition("</asset>")
    dates = inner.partition("<unit")[0].partition("<up_axis")[0]
    (tmp_path / "m.dae").write_text(f"{head}<asset>{dates}{asset}</asset>{rest}")
    bounds, remarks = extents(tmp_path, '<mesh filename="m.dae"/>')
    assert remarks == ()
    np.testing.assert_allclose(bounds[1] - bounds[0], 0.0254 * np.array([1, 2, 3]), rtol=1e-4)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("m.stl", b"solid nothing"),
        ("m.dae", b'<?xml version="1.0"?><!DOCTYPE x [<!ENTITY a "b">]><COLLADA/>'),
        ("m.obj", b"v 0 0 nan\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"),
        ("m.iges", b"triangles"),
    ],
)
def test_unreadable_meshes_become_a_capsule_and_a_remark(tmp_path, name, content) -> None:
    (tmp_path / name).write_bytes(content)
    bounds, remarks = extents(tmp_path, f'<mesh filename="{name}"/>')
    assert len(remarks) == 1
    assert name in remarks[0]
    # The capsule leads from the joint through the centre of mass.
    assert bounds[0, 2] < 0.0
    assert bounds[1, 2] > 0.4


def test_large_meshes_are_refused(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(module, "MAX_MESH_BYTES", 100)
    trimesh.creation.icosphere(subdivisions=3).export(tmp_path / "m.stl")
    _, remarks = extents(tmp_path, '<mesh filename="m.stl"/>')
    assert "limit" in remarks[0]


def test_decimated_meshes_keep_their_shape(tmp_path) -> None:
    full = link_meshes(load_model(ur5_urdf()), budget=10**9)
    fewer = link_meshes(load_model(ur5_urdf()), budget=8000)
    assert full.remarks == fewer.remarks == ()
    assert sum(len(mesh.faces) for mesh in fewer.meshes) < 12_000
    for mesh, coarse in zip(full.meshes, fewer.meshes, strict=True):
        size = np.ptp(mesh.vertices, axis=0).max()
        for bound in (np.min, np.max):
            np.testing.assert_allclose(
                bound(coarse.vertices, axis=0), bound(mesh.vertices, axis=0), atol=0.03 * size
            )
        assert coarse.faces.max() < len(coarse.vertices)


def test_a_robot_without_shapes_is_made_of_capsules() -> None:
    model = load_model(config_file("symbitron.xml"))
    found = link_meshes(replace(model, source="gone.xml"))
    assert "gone.xml" in found.remarks[0]
    assert [mesh.link for mesh in found.meshes] == list(range(len(model.links)))
    # Each reaches from the link's own joint to the next one.
    for joint in model.joints:
        mesh = found.meshes[joint.parent]
        nearest = np.linalg.norm(mesh.vertices - joint.translation, axis=1).min()
        assert nearest < 0.1
