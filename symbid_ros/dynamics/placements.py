"""Displaced joints, and derivatives of the equation of motion by their displacements.

The frame of joint i is displaced by a small constant screw ξ (rotation vector; translation) in its
parent's axes about the joint's origin. It is a virtual joint with six degrees of freedom, at rest,
between the parent p and the joint. In base axes about the base's origin, all links l and axes s
that the joint carries are transformed by exp(ξ×), while the parent moves as before. With spatial
velocities v, accelerations a minus gravity, inertias I and wrenches W (Featherstone 2008, chapters
2 and 5) the change of a link's wrench is

    δW = ξ×* W + I (a_p × ξ + ν × (v - v_p)) + ν×* I v + v×* I ν,    ν = v_p × ξ.

An axis changes by ξ × s. The first term vanishes in the rows of joints that are carried themselves,
because their axes and the wrenches turn alike.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import LinkPoses, joint_axes, link_poses
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.wrenches import wrenches_at_base
from symbid_ros.model.inertia import inertia_matrix
from symbid_ros.model.tree import Joint, RobotModel


def displaced(model: RobotModel, screws: FloatArray) -> RobotModel:
    """Return the robot with displaced joints.

    Parameters
    ----------
    model : RobotModel
    screws : (J, 6) float64
        Rotation vector, rad, and translation, m, of each joint's frame in its parent's axes.
    """
    turns = Rotation.from_rotvec(screws[:, :3]).as_matrix()
    joints = tuple(
        replace(joint, rotation=turn @ joint.rotation, translation=joint.translation + screw[3:])
        for joint, turn, screw in zip(model.joints, turns, screws, strict=True)
    )
    return replace(model, joints=joints)


def displacement_columns(model: RobotModel, phi: FloatArray, samples: Samples) -> FloatArray:
    """Return ∂(y - K φ)/∂ξ (N, n, J, 6) of each joint's screw, with the base's motion unchanged.

    Parameters
    ----------
    model : RobotModel
        Kinematics; its inertias are not used.
    phi : (N or 1, L, 10) float64
        Inertial parameters of all links.
    samples : Samples
        N samples.
    """
    poses = link_poses(model, samples.position)
    axes = joint_axes(model, poses)
    inertia = _inertias(phi, poses)
    velocity, acceleration = _spatial_motion(model, axes, samples)
    momentum = _apply(inertia, velocity)
    crosses = motion_cross(velocity)
    wrench = _apply(inertia, acceleration) - _apply(crosses.swapaxes(2, 3), momentum)
    # Of the velocity ν that the displacement adds to a link.
    damping = force_cross(momentum) - crosses.swapaxes(2, 3) @ inertia - inertia @ crosses
    carries = model.ancestors.astype(np.float64)
    # Sums over the links that a joint carries.
    carried_inertia = np.einsum("jl,nlab->njab", carries, inertia)
    carried_damping = np.einsum("jl,nlab->njab", carries, damping)
    carried_wrench = np.einsum("jl,nla->nja", carries, wrench)

    frames, first = samples.wrench_frames, 6 * model.floating
    external = wrenches_at_base(model, samples.wrenches, frames, poses)
    loads = model.ancestors[:, [model.loaded_link(name) for name in frames]].astype(np.float64)
    mounted = model.ancestors[:, [model.frame(name).link for name in frames]].astype(np.float64)
    columns = np.zeros((len(samples), model.dof, len(model.joints), 6))
    for i, joint in enumerate(model.joints):
        parent = crosses[:, joint.parent]
        screw = screws_at_base(poses, joint)
        accelerated = (motion_cross(acceleration[:, joint.parent]) + parent @ parent) @ screw
        moved = parent @ screw
        turned = force_cross(carried_wrench[:, i]) @ screw
        outer = carried_inertia[:, i] @ accelerated + carried_damping[:, i] @ moved + turned
        if model.floating:
            columns[:, :6, i] = force_cross(mounted[i] @ external) @ screw - outer
        for j in range(len(model.joints)):
            # How much more the measured wrenches turn than the axis of joint j.
            if model.ancestors[i, j + 1]:
                change = carried_inertia[:, j] @ accelerated + carried_damping[:, j] @ moved
                factor = loads[j] * (mounted[i] - 1.0)
            elif model.ancestors[j, i + 1]:
                change, factor = outer, loads[j] * mounted[i]
            else:
                change, factor = np.zeros_like(outer), loads[j] * mounted[i]
            if factor.any():
                change = change - force_cross(factor @ external) @ screw
            columns[:, first + j, i] = -(axes[:, j, None] @ change)[:, 0]
    model.fold_followers(columns)
    return columns


def motion_cross(v: FloatArray) -> FloatArray:
    """Return v × (..., 6, 6) of spatial velocities (..., 6)."""
    matrix = np.zeros((*v.shape, 6))
    matrix[..., :3, :3] = matrix[..., 3:, 3:] = _skew(v[..., :3])
    matrix[..., 3:, :3] = _skew(v[..., 3:])
    return matrix


def force_cross(f: FloatArray) -> FloatArray:
    """Return (..., 6, 6) that maps velocities v to v ×* f, of spatial forces f (..., 6)."""
    matrix = np.zeros((*f.shape, 6))
    matrix[..., :3, :3] = -_skew(f[..., :3])
    matrix[..., :3, 3:] = matrix[..., 3:, :3] = -_skew(f[..., 3:])
    return matrix


def _skew(x: FloatArray) -> FloatArray:
    matrix: FloatArray = np.cross(x[..., None, :], np.eye(3)).swapaxes(-1, -2)
    return matrix


def _inertias(phi: FloatArray, poses: LinkPoses) -> FloatArray:
    """Return spatial inertias (N, L, 6, 6) in base axes about the base's origin."""
    own = np.zeros((*phi.shape[:2], 6, 6))
    own[..., :3, :3] = inertia_matrix(phi)
    own[..., :3, 3:] = _skew(phi[..., 1:4])
    own[..., 3:, :3] = -own[..., :3, 3:]
    own[..., 3:, 3:] = phi[..., 0, None, None] * np.eye(3)
    # From velocities in base axes to those in link axes.
    to_link = np.zeros((*poses.position.shape[:2], 6, 6))
    turn = poses.rotation.swapaxes(2, 3)
    to_link[..., :3, :3] = to_link[..., 3:, 3:] = turn
    to_link[..., 3:, :3] = -turn @ _skew(poses.position)
    inertias: FloatArray = to_link.swapaxes(2, 3) @ own @ to_link
    return inertias


def _spatial_motion(
    model: RobotModel, axes: FloatArray, samples: Samples
) -> tuple[FloatArray, FloatArray]:
    """Return spatial velocities and accelerations minus gravity (N, L, 6) of all links.

    In the inertial frame in which the base's origin is momentarily at rest, both acceleration of
    the origin and spatial acceleration are the same.
    """
    velocity = np.zeros((len(samples), len(model.links), 6))
    acceleration = np.zeros_like(velocity)
    velocity[:, 0, :3] = samples.base_angular_velocity
    acceleration[:, 0, :3] = samples.base_angular_acceleration
    acceleration[:, 0, 3:] = samples.base_specific_force
    for j, joint in enumerate(model.joints):
        axis, parent = axes[:, j], velocity[:, joint.parent]
        spin = axis * samples.velocity[:, j, None]
        velocity[:, j + 1] = parent + spin
        acceleration[:, j + 1] = acceleration[:, joint.parent] + _apply(motion_cross(parent), spin)
        acceleration[:, j + 1] += axis * samples.acceleration[:, j, None]
    return velocity, acceleration


def screws_at_base(poses: LinkPoses, joint: Joint) -> FloatArray:
    """Return (N, 6, 6) from screws in a parent's axes about a joint's origin to the base's."""
    turn = poses.rotation[:, joint.parent]
    origin = poses.position[:, joint.parent] + turn @ joint.translation
    screw = np.zeros((len(turn), 6, 6))
    screw[:, :3, :3] = screw[:, 3:, 3:] = turn
    screw[:, 3:, :3] = _skew(origin) @ turn
    return screw


def _apply(matrix: FloatArray, vector: FloatArray) -> FloatArray:
    product: FloatArray = (matrix @ vector[..., None])[..., 0]
    return product
