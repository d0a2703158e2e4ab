"""Centre of mass and centroidal momentum, both as functions of the parameters."""

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import LinkPoses, joint_pose, link_poses
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.spatial import cross, inertia_action, rotate, rotate_back, skew
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel


def com_position(parameters: ParameterSet, values: FloatArray, poses: LinkPoses) -> FloatArray:
    """Return the centre of mass (N, 3) in the base frame, m, for parameters (p,)."""
    phi = parameters.link_phi(values)
    first = rotate(poses.rotation[:, parameters.links], phi[:, 1:4])
    first += phi[:, :1] * poses.position[:, parameters.links]
    com: FloatArray = first.sum(axis=1) / phi[:, 0].sum()
    return com


def momentum_regressor(
    parameters: ParameterSet, samples: Samples, base_velocity: FloatArray, poses: LinkPoses
) -> FloatArray:
    """Return M (N, 6, p): M φ is the momentum (angular; linear) about the base's origin.

    Parameters
    ----------
    parameters : ParameterSet
        The robot and its columns; friction has none of it.
    samples : Samples
        Joint positions and velocities, and the base's angular velocity.
    base_velocity : (N, 3) float64
        Linear velocity of the base's origin, in base axes, m/s.
    poses : LinkPoses
        Of the same samples.
    """
    model = parameters.model
    omega, velocity = _link_velocities(model, samples, base_velocity)
    M = np.zeros((len(samples), 6, len(parameters)))
    for index, link in enumerate(parameters.links):
        local = np.zeros((len(samples), 6, 10))
        local[:, :3, 1:4] = -skew(velocity[:, link])
        local[:, :3, 4:] = inertia_action(omega[:, link])
        local[:, 3:, 0] = velocity[:, link]
        local[:, 3:, 1:4] = skew(omega[:, link])
        rotation, position = poses.rotation[:, link], poses.position[:, link]
        block = M[:, :, 10 * index : 10 * index + 10]
        block[:, 3:] = rotation @ local[:, 3:]
        block[:, :3] = rotation @ local[:, :3] + skew(position) @ block[:, 3:]
    return M


def centroidal_momentum(
    parameters: ParameterSet, values: FloatArray, samples: Samples, base_velocity: FloatArray
) -> FloatArray:
    """Return the momentum (N, 6), angular about the model's own centre of mass, then linear.

    In base axes, Nms and Ns; arguments as in :func:`momentum_regressor`.
    """
    poses = link_poses(parameters.model, samples.position)
    momentum = momentum_regressor(parameters, samples, base_velocity, poses) @ values
    momentum[:, :3] -= cross(com_position(parameters, values, poses), momentum[:, 3:])
    return momentum


def _link_velocities(
    model: RobotModel, samples: Samples, base_velocity: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return angular and linear velocities (N, L, 3) of the link origins, in link axes."""
    shape = (len(samples), len(model.links), 3)
    omega, velocity = np.empty(shape), np.empty(shape)
    omega[:, 0], velocity[:, 0] = samples.base_angular_velocity, base_velocity
    for index, joint in enumerate(model.joints):
        turn, shift = joint_pose(joint, samples.position[:, index])
        w = omega[:, joint.parent]
        omega[:, index + 1] = rotate_back(turn, w)
        velocity[:, index + 1] = rotate_back(turn, velocity[:, joint.parent] + cross(w, shift))
        moved = omega if joint.kind == "revolute" else velocity
        moved[:, index + 1] += samples.velocity[:, index, None] * joint.axis
    return omega, velocity
