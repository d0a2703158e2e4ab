"""Centre of mass and centroidal momentum, both as functions of the parameters."""

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.body_integrals import body_integrals
from symbid_ros.dynamics.joints import JointTable
from symbid_ros.dynamics.kinematics import LinkPoses, Posture, link_velocity
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.spatial import component_first, cross, passes
from symbid_ros.model.parameters import ParameterSet


def com_position(parameters: ParameterSet, values: FloatArray, poses: LinkPoses) -> FloatArray:
    """Return the centre of mass (N, 3) in the base frame, m, for parameters (p,)."""
    com: FloatArray = first_moment_regressor(parameters, poses) @ values
    com /= parameters.link_phi(values)[:, 0].sum()
    return com


def first_moment_regressor(parameters: ParameterSet, poses: LinkPoses) -> FloatArray:
    """Return C (N, 3, p): C φ is the robot's first moment in the base frame, kg m."""
    links, count = parameters.links, parameters.inertial
    C = np.zeros((len(poses.position), 3, len(parameters)))
    by_link = C[:, :, :count].reshape(len(C), 3, len(links), 10)
    by_link[..., 0] = poses.position[:, links].transpose(0, 2, 1)
    by_link[..., 1:4] = poses.rotation[:, links].transpose(0, 2, 1, 3)
    C[:, :, :count] = by_link.reshape(len(C), 3, count)
    return C


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
    joints = JointTable.of(parameters.model.joints)
    M = np.zeros((len(samples), 6, len(parameters)))
    for part in passes(len(samples), len(parameters.model.links)):
        posture = Posture.of(joints, LinkPoses(poses.rotation[part], poses.position[part]))
        omega, velocity = link_velocity(
            posture,
            component_first(samples.velocity[part]),
            component_first(samples.base_angular_velocity[part]),
            component_first(base_velocity[part]),
        )
        pose_rate = np.empty_like(posture.pose)
        pose_rate[:, :3] = cross(omega[:, None], posture.rotation)
        pose_rate[:, 3] = velocity
        M[part, :, : parameters.inertial] = body_integrals(parameters, posture.pose, pose_rate)
    return M


def centroidal(momentum: FloatArray, com: FloatArray) -> FloatArray:
    """Return momentum (N, 6) moved from the base's origin to the centre of mass (N, 3)."""
    moved = momentum.copy()
    moved[:, :3] -= cross(com.T, momentum[:, 3:].T).T
    return moved
