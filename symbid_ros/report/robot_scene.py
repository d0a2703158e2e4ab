"""A robot with its inertias as a scene: data for the 3D view and the still picture."""

import base64
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.inertia import PARAMETERS, com_from_phi
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.model.tree import RobotModel
from symbid_ros.report.formatting import ABSENT, significant, with_std
from symbid_ros.report.inertia_shapes import (
    ComEllipsoid,
    InertiaBox,
    com_covariance,
    com_ellipsoid,
    inertia_box,
    link_covariance,
    principal_moments,
    total_com,
)
from symbid_ros.report.link_meshes import LinkMesh, link_meshes
from symbid_ros.report.palette import link_colour

# Vertices are sent as 16-bit integers: steps of 15 µm for a link of one metre.
_LARGEST = 32767
SHOWN_DEVIATIONS = 2.0  # semi-axes of the ellipsoids, in standard deviations


@dataclass(frozen=True)
class SceneLink:
    """A link of a scene.

    Attributes
    ----------
    name : str
    parent : int
        Index of its parent in the scene, -1 for the base.
    rotation, position : (3, 3) and (3,) float64
        Pose in the base's frame.
    determined : int or None
        Number of its ten parameters that the data determine; None if the method cannot tell.
    before, after : InertiaBox or None
        Inertia in the prior and in the estimate; None if no rigid body has it.
    com_before, com_after : (3,) float64 or None
        Centres of mass in the link's frame, m; None without a positive mass.
    uncertainty : ComEllipsoid or None
        Of the identified centre of mass.
    numbers : tuple of (str, str, str)
        Quantity with unit, prior and estimate as text.
    """

    name: str
    parent: int
    rotation: FloatArray
    position: FloatArray
    determined: int | None
    before: InertiaBox | None
    after: InertiaBox | None
    com_before: FloatArray | None
    com_after: FloatArray | None
    uncertainty: ComEllipsoid | None
    numbers: tuple[tuple[str, str, str], ...]


@dataclass(frozen=True)
class RobotScene:
    """A robot in one posture, with inertias before and after identification.

    Attributes
    ----------
    name : str
    up : (3,) float64
        Unit vector opposite to gravity, in the base's axes.
    links : tuple of SceneLink
        Links with parameters, parents first.
    meshes : tuple of LinkMesh
        Their triangles; ``link`` counts the links of this scene.
    com_before, com_after : (3,) float64
        Centre of mass of the whole robot in the base's frame, m.
    remarks : tuple of str
        Which shapes are missing, one sentence each.
    """

    name: str
    up: FloatArray
    links: tuple[SceneLink, ...]
    meshes: tuple[LinkMesh, ...]
    com_before: FloatArray
    com_after: FloatArray
    remarks: tuple[str, ...]

    def document(self) -> dict[str, Any]:
        """Return the scene as JSON, lengths in m and quaternions scalar last."""
        return {
            "name": self.name,
            "up": rounded(self.up),
            "deviations": SHOWN_DEVIATIONS,
            "parameters": len(PARAMETERS),
            "links": [link_document(link) for link in self.links],
            "meshes": [_mesh_document(mesh) for mesh in self.meshes],
            "com": {"before": rounded(self.com_before), "after": rounded(self.com_after)},
            "remarks": list(self.remarks),
        }


def robot_scene(
    parameters: ParameterSet,
    estimate: Estimate,
    posture: FloatArray | None = None,
    *,
    deviation_factor: FloatArray | None = None,
    meshes: Sequence[LinkMesh] | None = None,
) -> RobotScene:
    """Return the scene of an estimate.

    Parameters
    ----------
    parameters : ParameterSet
        The robot's parameters, in the order of the estimate.
    estimate : Estimate
        The estimate with its prior.
    posture : (J,) float64, optional
        Joint positions, rad or m; by default those nearest to zero within the limits.
    deviation_factor : (p, r) float64, optional
        L of the estimate's covariance L Lᵀ. Without it, ellipsoids neglect correlations.
    meshes : sequence of LinkMesh, optional
        Triangles by index of the model's links, if they are known already.
    """
    model = parameters.model
    remarks: tuple[str, ...] = ()
    if meshes is None:
        found = link_meshes(model)
        meshes, remarks = found.meshes, found.remarks
    rotations, positions = base_poses(model, posture)
    place = {int(link): index for index, link in enumerate(parameters.links)}
    links = []
    for index, link in enumerate(parameters.links):
        parent = int(link)
        while parent:
            parent = model.joints[parent - 1].parent
            if parent in place:
                break
        own = slice(10 * index, 10 * index + 10)
        shown = scene_link(
            parameters.link_names[index],
            estimate.prior[own],
            estimate.value[own],
            link_covariance(estimate, own.start, deviation_factor),
            None if estimate.determined is None else int(estimate.determined[own].sum()),
        )
        links.append(
            replace(
                shown,
                parent=place.get(parent, -1) if link else -1,
                rotation=rotations[link],
                position=positions[link],
            )
        )
    kept = parameters.links
    com_before, com_after = (
        total_com(parameters.link_phi(values), rotations[kept], positions[kept])
        for values in (estimate.prior, estimate.value)
    )
    return RobotScene(
        model.name,
        _up(model),
        tuple(links),
        tuple(
            LinkMesh(place[mesh.link], mesh.vertices, mesh.faces)
            for mesh in meshes
            if mesh.link in place
        ),
        com_before,
        com_after,
        remarks,
    )


def base_poses(
    model: RobotModel, posture: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (L, 3, 3) and positions (L, 3) of all links in the base's frame."""
    if posture is None:
        lower = np.array([joint.lower for joint in model.joints])
        upper = np.array([joint.upper for joint in model.joints])
        posture = np.clip(np.zeros(len(model.joints)), lower, upper)
    poses = link_poses(model, model.apply_mimics(posture[None]))
    return poses.rotation[0], poses.position[0]


def _up(model: RobotModel) -> FloatArray:
    size = float(np.linalg.norm(model.gravity))
    return -model.gravity / size if size > 0 else np.array([0.0, 0.0, 1.0])


def scene_link(
    name: str,
    before: FloatArray,
    after: FloatArray,
    covariance: FloatArray | None,
    determined: int | None,
) -> SceneLink:
    """Return a link at the base's origin.

    Parameters
    ----------
    name : str
        Name of the link.
    before, after : (10,) float64
        Its parameters in the prior and in the estimate.
    covariance : (10, 10) float64 or None
        Covariance of the estimate.
    determined : int or None
        Number of parameters that the data determine.
    """
    has_com = after[0] > 0
    return SceneLink(
        name=name,
        parent=-1,
        rotation=np.eye(3),
        position=np.zeros(3),
        determined=determined,
        before=inertia_box(before),
        after=inertia_box(after),
        com_before=com_from_phi(before)[1] if before[0] > 0 else None,
        com_after=com_from_phi(after)[1] if has_com else None,
        uncertainty=com_ellipsoid(after, covariance)
        if has_com and covariance is not None
        else None,
        numbers=_numbers(before, after, covariance),
    )


def _numbers(
    before: FloatArray, after: FloatArray, covariance: FloatArray | None
) -> tuple[tuple[str, str, str], ...]:
    """Return mass, centre of mass and principal moments as text, before and after."""
    mass_std = 0.0 if covariance is None else float(np.sqrt(covariance[0, 0]))
    com_std = np.zeros(3)
    if covariance is not None and after[0] > 0:
        com_std = np.sqrt(np.diag(com_covariance(after, covariance)))
    old, new = (com_from_phi(phi)[1] for phi in (before, after))
    rows = [("mass, kg", significant(float(before[0]), 4), with_std(float(after[0]), mass_std))]
    for axis, name in enumerate("xyz"):
        rows.append(
            (
                f"CoM {name}, mm",
                significant(1e3 * float(old[axis])) if before[0] else ABSENT,
                with_std(1e3 * float(new[axis]), 1e3 * float(com_std[axis]))
                if after[0]
                else ABSENT,
            )
        )
    moments = zip(principal_moments(before), principal_moments(after), strict=True)
    rows += [
        (f"principal inertia {count}, kg m²", significant(float(one)), significant(float(other)))
        for count, (one, other) in enumerate(moments, start=1)
    ]
    return tuple(
        (name, prior.replace("-", "−"), estimate.replace("-", "−"))
        for name, prior, estimate in rows
    )


def link_document(link: SceneLink) -> dict[str, Any]:
    """Return a link of a scene as JSON."""
    ellipsoid = link.uncertainty
    return {
        "name": link.name,
        "parent": link.parent,
        "position": rounded(link.position),
        "quaternion": quaternion_document(link.rotation),
        "determined": link.determined,
        "colour": link_colour(link.determined),
        "before": _box_document(link.before),
        "after": _box_document(link.after),
        "com": {
            key: None if com is None else rounded(com)
            for key, com in (("before", link.com_before), ("after", link.com_after))
        },
        "uncertainty": ellipsoid
        and {"quaternion": quaternion_document(ellipsoid.rotation), "std": rounded(ellipsoid.std)},
        "numbers": [list(row) for row in link.numbers],
    }


def _box_document(box: InertiaBox | None) -> dict[str, Any] | None:
    if box is None:
        return None
    return {
        "mass": float(f"{box.mass:.6g}"),
        "com": rounded(box.com),
        "quaternion": quaternion_document(box.rotation),
        "size": rounded(box.size),
    }


def _mesh_document(mesh: LinkMesh) -> dict[str, Any]:
    """Return triangles as base64: int16 of ``centre + scale * vertex``, and uint16 or uint32."""
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    centre = (low + high) / 2
    scale = max(float((high - low).max()) / 2, 1e-9) / _LARGEST
    vertices = np.round((mesh.vertices - centre) / scale).astype("<i2")
    wide = len(vertices) > 0xFFFF
    return {
        "link": mesh.link,
        "centre": rounded(centre),
        "scale": scale,
        "vertices": base64.b64encode(vertices.tobytes()).decode(),
        "faces": base64.b64encode(mesh.faces.astype("<u4" if wide else "<u2").tobytes()).decode(),
        "wide": wide,
    }


def quaternion_document(rotation: FloatArray) -> list[float]:
    """Return the quaternion of a rotation (3, 3), scalar last, as JSON."""
    return rounded(np.roll(quaternion_from_rotation(rotation), -1))


def rounded(numbers: FloatArray) -> list[float]:
    """Return numbers to a micrometre or microradian, which no picture shows."""
    return [float(f"{number:.6f}") + 0.0 for number in numbers]
