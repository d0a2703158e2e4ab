"""The equation of motion, linear in the parameters: K φ = y (Eq. 6, 10–14, 2.46–2.49)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.body_integrals import body_integrals
from symbid_ros.dynamics.friction import coulomb_column
from symbid_ros.dynamics.joints import JointTable
from symbid_ros.dynamics.kinematics import LinkPoses, Posture, link_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.spatial import component_first, cross, passes, sample_first
from symbid_ros.model.parameters import ParameterSet, Term
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class Rows:
    """N samples of the equation of motion.

    Attributes
    ----------
    K : (N, n, p) float64
        Regressor. Base rows first: moment, then force, in base axes at the base's
        origin; then one row per joint.
    y : (N, n) float64
        Generalised force of motors and environment, less known joint terms, Nm and N.
    """

    K: FloatArray
    y: FloatArray


def equation_of_motion(parameters: ParameterSet, samples: Samples) -> Rows:
    """Return the rows of K φ = y for a block of samples.

    Joint terms that the model file states and φ does not hold are known: y is less by them.
    """
    model = parameters.model
    first_joint = 6 * model.floating
    joints = JointTable.of(model.joints)
    # Eq. 10's δ_j(l), column by column: a joint feels the links that it carries.
    carries = np.repeat(joints.path[parameters.links].T, 10, axis=1)
    K = np.empty((len(samples), model.dof, len(parameters)))
    y = np.empty((len(samples), model.dof))
    for part in passes(len(samples), len(model.links)):
        block = samples[part]
        posture = Posture.at(joints, component_first(block.position))
        axes = sample_first(posture.motion_axes)
        inertial = K[part, :, : parameters.inertial]
        shape = (len(block), 6, parameters.inertial)
        wrenches = inertial[:, :6] if model.floating else np.empty(shape)
        wrenches[:] = _link_wrenches(parameters, posture, block)
        rows = inertial[:, first_joint:]
        np.matmul(np.ascontiguousarray(axes), wrenches, out=rows)
        rows *= carries
        y[part] = generalised_force(model, block, posture.poses, axes)
    if parameters.terms:
        _fill_joint_terms(K, parameters, samples)
    if parameters.known_terms:
        y -= known_force(parameters, samples)
    model.fold_followers(K)
    return Rows(K, y)


def known_force(parameters: ParameterSet, samples: Samples) -> FloatArray:
    """Return what known friction and armature ask of the motors (N, n), zero at the base."""
    content = _joint_terms(samples)
    force = np.zeros((len(samples), parameters.model.dof))
    joints = force[:, 6 * parameters.model.floating :]
    for term, values in parameters.known_terms.items():
        joints += values * content[term]
    parameters.model.fold_followers(force)
    return force


def _link_wrenches(parameters: ParameterSet, posture: Posture, samples: Samples) -> FloatArray:
    """Return bX_l^F A_l (N, 6, inertial), Eq. 11 and 14: wrenches per unit parameter."""
    base = (
        component_first(samples.base_angular_velocity),
        component_first(samples.base_angular_acceleration),
        component_first(samples.base_specific_force),
    )
    rates = component_first(samples.velocity), component_first(samples.acceleration)
    motion = link_motion(posture, *rates, base)
    pose_acceleration = np.empty_like(posture.pose)
    rotation_acceleration = pose_acceleration[:, :3]
    np.einsum(
        "ikln,kjln->ijln", motion.lever_acceleration, posture.rotation, out=rotation_acceleration
    )
    pose_acceleration[:, 3] = motion.specific_force
    return body_integrals(parameters, posture.pose, pose_acceleration)


def _fill_joint_terms(K: FloatArray, parameters: ParameterSet, samples: Samples) -> None:
    """Write the columns of the joint terms, each joint's into its own row."""
    content = _joint_terms(samples)
    joints = np.arange(samples.velocity.shape[1])
    rows = K.shape[1] - len(joints) + joints
    K[:, :, parameters.inertial :] = 0.0
    for term, columns in parameters.term_columns.items():
        K[:, rows, columns.start + joints] = content[term]


def _joint_terms(samples: Samples) -> dict[Term, FloatArray]:
    """Return what multiplies each joint term (N, J), Eq. 2.49 with armature and offset.

    The armature is the inertia of rotor and gear as felt at the joint. It turns with q̇_j
    alone: the rotor's spin in inertial space, small beside its geared spin, is left out, as
    in MuJoCo (Featherstone 2008, sec. 9.6).
    """
    return {
        "viscous": samples.velocity,
        "coulomb": coulomb_column(samples.velocity),
        "armature": samples.acceleration,
        "offset": np.ones(1),
    }


def generalised_force(
    model: RobotModel, samples: Samples, poses: LinkPoses, axes: FloatArray
) -> FloatArray:
    """Return y = Sᵀ f_a + J_gᵀ f_e (N, n), Eq. 4, of motors and measured wrenches.

    Parameters
    ----------
    model : RobotModel
        The robot.
    samples : Samples
        Efforts and wrenches.
    poses : LinkPoses
        Of the same samples.
    axes : (N, J, 6) float64
        From :func:`symbid_ros.dynamics.kinematics.joint_axes`.
    """
    first_joint = 6 * model.floating
    frames = samples.wrench_frames
    at_base = wrenches_at_base(model, samples.wrenches, frames, poses)
    carries = model.ancestors[:, [model.frame(name).link for name in frames]].astype(np.float64)
    felt = component_first(axes) * (carries @ component_first(at_base))
    y = np.empty((len(samples), model.dof))
    if model.floating:
        y[:, :6] = at_base.sum(axis=1)
    y[:, first_joint:] = samples.effort + felt.sum(axis=0).T
    model.fold_followers(y)
    return y


def wrenches_at_base(
    model: RobotModel, wrenches: FloatArray, frames: Sequence[str], poses: LinkPoses
) -> FloatArray:
    """Return wrenches (N, F, 6) of sensor frames moved to the base's axes and origin."""
    mounts = [model.frame(name) for name in frames]
    links = [mount.link for mount in mounts]
    mount_rotation = np.array([mount.rotation for mount in mounts]).reshape(-1, 3, 3)
    lever = np.array([mount.translation for mount in mounts]).reshape(-1, 3).T
    in_sensor = component_first(wrenches).reshape(2, 3, len(frames), len(wrenches))
    in_link = np.einsum("fij,kjfn->kifn", mount_rotation, in_sensor)
    in_link[0] += cross(lever[:, :, None], in_link[1])
    rotation = component_first(poses.rotation[:, links])
    at_base = np.einsum("ijfn,kjfn->kifn", rotation, in_link)
    at_base[0] += cross(component_first(poses.position[:, links]), at_base[1])
    return sample_first(at_base.reshape(6, len(frames), len(wrenches)))
