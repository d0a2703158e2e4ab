"""The equation of motion, linear in the parameters: K φ = y (Eq. 6, 10–14, 2.46–2.49)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.body_integrals import body_integrals
from symbid_ros.dynamics.joints import JointTable
from symbid_ros.dynamics.kinematics import LinkPoses, Posture, link_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.spatial import component_first, cross, passes, sample_first
from symbid_ros.model.parameters import ParameterSet
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
        Generalised force of motors and environment, Nm and N.
    """

    K: FloatArray
    y: FloatArray


def equation_of_motion(parameters: ParameterSet, samples: Samples) -> Rows:
    """Return the rows of K φ = y for a block of samples."""
    model = parameters.model
    first_joint = 6 * model.floating
    joints, branches = JointTable.of(model.joints), _branches(parameters)
    K = np.zeros((len(samples), model.dof, len(parameters)))
    y = np.empty((len(samples), model.dof))
    for part in passes(len(samples), len(model.links)):
        block = samples[part]
        posture = Posture.at(joints, component_first(block.position))
        axes = posture.motion_axes
        wrenches = _link_wrenches(parameters, posture, block)
        if model.floating:
            K[part, :6, : parameters.inertial] = wrenches
        _project(K[part, first_joint:], branches, axes, wrenches)
        y[part] = generalised_force(model, block, posture.poses, sample_first(axes))
    if parameters.friction:
        _fill_friction(K, parameters, samples.velocity)
    return Rows(K, y)


def _link_wrenches(parameters: ParameterSet, posture: Posture, samples: Samples) -> FloatArray:
    """Return bX_l^F A_l (N, 6, p), Eq. 11 and 14: the links' wrenches per unit parameter."""
    base = (
        component_first(samples.base_angular_velocity),
        component_first(samples.base_angular_acceleration),
        component_first(samples.base_specific_force),
    )
    motion = link_motion(
        posture, component_first(samples.velocity), component_first(samples.acceleration), base
    )
    pose_acceleration = np.empty_like(posture.pose)
    np.einsum(
        "ikln,kjln->ijln",
        motion.lever_acceleration,
        posture.rotation,
        out=pose_acceleration[:, :3],
    )
    pose_acceleration[:, 3] = motion.specific_force
    return body_integrals(parameters, posture.pose, pose_acceleration)


@dataclass(frozen=True)
class _Branch:
    """Joint rows and parameter columns of what hangs on one joint of the base.

    ``gaps`` are the stretches among them where a joint does not carry a link.
    """

    rows: slice
    columns: slice
    gaps: tuple[tuple[int, slice], ...]


def _branches(parameters: ParameterSet) -> list[_Branch]:
    """Return the branches: one leg's joints feel no other leg."""
    model = parameters.model
    carries = np.repeat(model.ancestors[:, parameters.links], 10, axis=1)
    branches = []
    for root, joint in enumerate(model.joints):
        if joint.parent != 0:
            continue
        rows = _hull(model.ancestors[root, 1:])
        columns = _hull(carries[root])
        branches.append(_Branch(rows, columns, _gaps(carries, rows, columns)))
    return branches


def _project(
    K: FloatArray, branches: list[_Branch], axes: FloatArray, wrenches: FloatArray
) -> None:
    """Write Eq. 10's joint rows (N, J, p): a link's wrench as each joint below it feels it."""
    axes = np.ascontiguousarray(sample_first(axes))
    for branch in branches:
        rows, columns = branch.rows, branch.columns
        np.matmul(axes[:, rows], wrenches[:, :, columns], out=K[:, rows, columns])
        for row, gap in branch.gaps:
            K[:, row, gap] = 0.0


def _hull(mask: BoolArray) -> slice:
    """Return the shortest slice with every True of a mask (m,)."""
    found = np.flatnonzero(mask)
    return slice(int(found[0]), int(found[-1]) + 1) if len(found) else slice(0, 0)


def _gaps(carries: BoolArray, rows: slice, columns: slice) -> tuple[tuple[int, slice], ...]:
    """Return row and columns of the stretches of False in a part of a table (J, p)."""
    edges = np.diff(~carries[rows, columns], axis=1, prepend=False, append=False)
    places = np.add(np.argwhere(edges), (rows.start, columns.start)).tolist()
    return tuple(
        (row, slice(start, stop))
        for (row, start), (_, stop) in zip(places[::2], places[1::2], strict=True)
    )


def _fill_friction(K: FloatArray, parameters: ParameterSet, velocity: FloatArray) -> None:
    """Write Eq. 2.49: viscous columns q̇ and Coulomb columns sign(q̇)."""
    joints = np.arange(velocity.shape[1])
    rows, viscous = K.shape[1] - len(joints) + joints, parameters.inertial + joints
    K[:, rows, viscous] = velocity
    K[:, rows, viscous + len(joints)] = np.sign(velocity)


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
    at_base = component_first(wrenches_at_base(model, samples.wrenches, frames, poses))
    carries = model.ancestors[:, [model.frame(name).link for name in frames]]
    y = np.empty((model.dof, len(samples)))
    y[first_joint:] = component_first(samples.effort)
    y[first_joint:] += np.einsum("cjn,cjn->jn", component_first(axes), carries @ at_base)
    if model.floating:
        y[:6] = at_base.sum(axis=1)
    return y.T


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
    rotation, position = poses.rotation[:, links], poses.position[:, links]
    at_base = np.einsum("ijfn,kjfn->kifn", component_first(rotation), in_link)
    at_base[0] += cross(component_first(position), at_base[1])
    return sample_first(at_base.reshape(6, len(frames), len(wrenches)))
