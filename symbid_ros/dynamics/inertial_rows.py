"""Inertial columns of the regressor, and the generalised force of efforts and wrenches.

They are computed by the compiled :mod:`symbid_ros.dynamics.kernel`, or by NumPy. NumPy is the
reference for tests and needs no compiler; the environment variable ``SYMBID_KERNEL`` selects it.

Most columns of a joint's row are zero, because only links that a joint carries load it. *Packed*
rows omit these structural zeros.
"""

import os
import weakref
from dataclasses import dataclass
from functools import cache, cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.sparse import csr_array

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.kernel_arrays import Loads, Motion, Tree, Windows
from symbid_ros.dynamics.kinematics import (
    JointTable,
    LinkPoses,
    Posture,
    cache_blocks,
    component_first,
    link_motion,
    sample_first,
)
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.wrenches import wrenches_at_base
from symbid_ros.errors import OptionError
from symbid_ros.model.inertia import pseudo_inertia
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import STANDARD_GRAVITY, Link, RobotModel

if TYPE_CHECKING:
    from symbid_ros.dynamics.compiled_kernel import CompiledKernel

# Environment variable that selects how rows are computed.
KERNEL = "SYMBID_KERNEL"
NUMBA, NUMPY = "numba", "numpy"

# Pseudo-inertia J of one unit of each parameter, (10, 16).
UNIT_PSEUDO_INERTIA = pseudo_inertia(np.eye(10)).reshape(10, 16)

# Forces depend on mass and first moments alone, the first four of a link's ten parameters.
FORCE_COLUMNS = 4

NO_WINDOWS = np.zeros(0, dtype=np.int64), np.zeros(1, dtype=np.int64), np.zeros(0)


@dataclass(frozen=True, eq=False)
class PackedLayout:
    """Places of the structural non-zeros of a robot's inertial columns.

    Attributes
    ----------
    row, column : (w,) int64
        Coordinate and parameter of each, by coordinates and then by parameters.
    place : (w,) int64
        Their places in a flat K (n p).
    joints : tuple of arrays
        Fields of the kernel's ``Tree``.
    """

    row: IntArray
    column: IntArray
    place: IntArray
    joints: tuple[Any, ...]

    @cached_property
    def order(self) -> IntArray:
        """(w,) places of the non-zeros among themselves."""
        return np.arange(len(self))

    @classmethod
    def of(cls, parameters: ParameterSet) -> "PackedLayout":
        """Return the layout of the inertial columns of a robot, which is computed once."""
        # By identity, because parameters are immutable but hold arrays, which have no hash.
        key = id(parameters)
        if key not in _LAYOUTS:
            _LAYOUTS[key] = cls._computed(parameters)
            weakref.finalize(parameters, _LAYOUTS.pop, key, None).atexit = False
        return _LAYOUTS[key]

    @classmethod
    def _computed(cls, parameters: ParameterSet) -> "PackedLayout":
        model, links = parameters.model, parameters.links
        loads = model.ancestors[:, links]
        sizes = np.array([10 if one.kind == "revolute" else FORCE_COLUMNS for one in model.joints])
        if model.floating:
            loads = np.concatenate([np.ones((6, len(links)), dtype=bool), loads])
            sizes = np.concatenate([[10] * 3, [FORCE_COLUMNS] * 3, sizes])
        row, rank = np.nonzero(loads)
        size = sizes[row].astype(np.int64)
        end = np.cumsum(size)
        start = np.full((len(loads), len(model.links)), -1, dtype=np.int64)
        start[row, links[rank]] = end - size
        within = np.arange(end[-1] if len(end) else 0) - np.repeat(end - size, size)
        column = 10 * np.repeat(rank, size) + within
        row = np.repeat(row, size)
        joints = _joint_arrays(parameters, start[6 * model.floating :])
        return cls(row, column, row * len(parameters) + column, joints)

    def __len__(self) -> int:
        return len(self.row)


_LAYOUTS: dict[int, PackedLayout] = {}


def _joint_arrays(parameters: ParameterSet, start: IntArray) -> tuple[Any, ...]:
    """Return the fields of the kernel's ``Tree``.

    ``start`` (J, L) tells where the columns of a link begin in a joint's row, -1 for none.
    """
    joints = JointTable.of(parameters.model.joints)
    rank = np.full(start.shape[1], -1, dtype=np.int64)
    rank[parameters.links] = np.arange(len(parameters.links))
    link, joint = np.nonzero(start.T >= 0)
    return (
        joints.parent,
        joints.pose,
        joints.reference[:, 0].copy(),
        joints.revolute[:, 0].copy(),
        rank,
        len(parameters.links),
        parameters.model.floating,
        np.searchsorted(link, np.arange(start.shape[1] + 1)),
        joint.copy(),
        start[joint, link],
    )


def dense_rows(parameters: ParameterSet, samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Return K (N, n, p) with zeros beside its inertial columns, and y (N, n)."""
    model = parameters.model
    K = np.empty((len(samples), model.dof, len(parameters)))
    kernel = _kernel()
    if kernel is None:
        K[:, :, parameters.inertial :] = 0.0
        return K, _fill_by_numpy(parameters, samples, K[:, :, : parameters.inertial])
    rows = K.reshape(len(samples), model.dof * len(parameters))
    places = PackedLayout.of(parameters).place
    return K, _evaluate(kernel, parameters, samples, rows=(places, rows))


def packed_rows(parameters: ParameterSet, samples: Samples) -> tuple[FloatArray, FloatArray]:
    """Return the packed inertial columns (N, w) and y (N, n); see :class:`PackedLayout`."""
    layout, kernel = PackedLayout.of(parameters), _kernel()
    if kernel is None:
        K, y = dense_rows(parameters, samples)
        return K[:, layout.row, layout.column], y
    rows = np.empty((len(samples), len(layout)))
    return rows, _evaluate(kernel, parameters, samples, rows=(layout.order, rows))


def averaged_rows(
    parameters: ParameterSet, samples: Samples, weights: csr_array, phi: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return weighted sums of packed rows, without storing the rows of single samples.

    Parameters
    ----------
    parameters : ParameterSet
    samples : Samples
    weights : (W, N) csr_array
        Weights of the samples in each window; a window's samples are consecutive.
    phi : (V, inertial) float64
        Inertial parameters of which the generalised force is wanted.

    Returns
    -------
    sums : (W, w) float64
        Of the packed inertial columns.
    y : (N, n) float64
        Generalised force of efforts and wrenches.
    forces : (V, N, n) float64
        K φ of each of the parameters.
    """
    layout, kernel = PackedLayout.of(parameters), _kernel()
    sums = np.zeros((weights.shape[0], len(layout)))
    forces = np.empty((len(phi), len(samples), parameters.model.dof))
    if kernel is None:
        y = np.empty((len(samples), parameters.model.dof))
        for part in cache_blocks(len(samples), len(parameters.model.links)):
            K, y[part] = dense_rows(parameters, samples[part])
            sums += weights[:, part] @ K[:, layout.row, layout.column]
            forces[:, part] = np.moveaxis(K[:, :, : parameters.inertial] @ phi.T, 2, 0)
        return sums, y, forces
    y = _evaluate(kernel, parameters, samples, sums=(weights, sums), forces=(phi, forces))
    return sums, y, forces


def compile_kernel() -> None:
    """Compile the kernel for this computer, if it is selected and was not compiled before."""
    fixed = RobotModel("link", (Link("link", np.zeros(10)),), (), (), False, STANDARD_GRAVITY, "")
    dense_rows(ParameterSet(fixed), Samples.none(()))


def _kernel() -> "CompiledKernel | None":
    """Return the compiled kernel, or None if NumPy is selected."""
    return _loaded_kernel(os.environ.get(KERNEL, NUMBA))


@cache
def _loaded_kernel(choice: str) -> "CompiledKernel | None":
    if choice == NUMPY:
        return None
    if choice != NUMBA:
        raise OptionError(
            f"environment variable {KERNEL} is {choice!r}; set it to {NUMBA} or {NUMPY}, or "
            "unset it",
            "E940",
        )
    try:
        from symbid_ros.dynamics.compiled_kernel import load_kernel  # noqa: PLC0415

        return load_kernel()
    except ImportError as error:
        raise OptionError(
            f"the compiled kernel needs Numba, which cannot be imported ({error}); install numba, "
            f"or set the environment variable {KERNEL}={NUMPY}",
            "E941",
        ) from error


def _evaluate(
    kernel: "CompiledKernel",
    parameters: ParameterSet,
    samples: Samples,
    *,
    rows: tuple[IntArray, FloatArray] | None = None,
    sums: tuple[csr_array, FloatArray] | None = None,
    forces: tuple[FloatArray, FloatArray] | None = None,
) -> FloatArray:
    """Let the kernel write rows, sums over windows or forces, and return y (N, n)."""
    model, count = parameters.model, len(samples)
    layout = PackedLayout.of(parameters)
    motion = Motion(
        _plain(samples.position),
        _plain(samples.velocity),
        _plain(samples.acceleration),
        _plain(samples.base_angular_velocity),
        _plain(samples.base_angular_acceleration),
        _plain(samples.base_specific_force),
    )
    frames = samples.wrench_frames
    mounts = [model.frame(name) for name in frames]
    loads = Loads(
        _plain(samples.effort),
        _plain(samples.wrenches),
        np.array([model.loaded_link(name) for name in frames], dtype=np.int64),
        np.array([mount.link for mount in mounts], dtype=np.int64),
        np.array([mount.rotation for mount in mounts]).reshape(-1, 3, 3),
        np.array([mount.translation for mount in mounts]).reshape(-1, 3),
        model.ancestors,
    )
    if rows is None:
        rows = layout.place, np.empty((count, 0))
    windows, totals = Windows(*NO_WINDOWS), np.empty((0, 0))
    if sums is not None:
        weights, totals = sums
        first = np.append(weights.indices, 0)[weights.indptr[:-1]]
        starts = weights.indptr.astype(np.int64)
        windows = Windows(first.astype(np.int64), starts, _plain(weights.data))
    phi, products = np.empty((0, 0)), np.empty((0, 0, 0))
    if forces is not None:
        phi, products = forces[0][:, layout.column], forces[1]
    y = np.empty((count, model.dof))
    tree = Tree(*layout.joints)
    kernel.evaluate(
        tree,
        motion,
        loads,
        windows,
        rows=rows,
        sums=totals,
        row=layout.row,
        phi=_plain(phi),
        forces=products,
        y=y,
    )
    model.fold_followers(y)
    return y


def _plain(values: FloatArray) -> FloatArray:
    """Return an array of the one kind that the kernel is compiled for."""
    is_plain = values.dtype == np.float64 and values.flags.c_contiguous and values.flags.writeable
    return values if is_plain else np.require(values, np.float64, ["C", "W"])


def _fill_by_numpy(parameters: ParameterSet, samples: Samples, K: FloatArray) -> FloatArray:
    """Write the inertial columns of K (N, n, inertial) and return y (N, n)."""
    model = parameters.model
    first_joint = 6 * model.floating
    joints = JointTable.of(model.joints)
    # δ_j(l) of Eq. 10, column by column: only links that a joint carries load it.
    carries = np.repeat(joints.path[parameters.links].T, 10, axis=1)
    y = np.empty((len(samples), model.dof))
    for part in cache_blocks(len(samples), len(model.links)):
        block = samples[part]
        posture = Posture.at(joints, component_first(block.position))
        axes = sample_first(posture.motion_axes)
        inertial = K[part]
        shape = (len(block), 6, parameters.inertial)
        wrenches = inertial[:, :6] if model.floating else np.empty(shape)
        wrenches[:] = _link_wrenches(parameters, posture, block)
        rows = inertial[:, first_joint:]
        np.matmul(np.ascontiguousarray(axes), wrenches, out=rows)
        rows *= carries
        y[part] = generalised_force(model, block, posture.poses, axes)
    return y


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


def body_integrals(parameters: ParameterSet, pose: FloatArray, pose_rate: FloatArray) -> FloatArray:
    """Return ∫ (x × u; u) dm about the base's origin per unit parameter, (N, 6, inertial).

    A body's points x = X ξ, ξ homogeneous in link axes, have rates u = U ξ, so that
    ∫ x uᵀ dm = X J Uᵀ with the pseudo-inertia J = ∫ ξξᵀ dm, linear in the parameters
    (Wensing, Kim and Slotine 2018). With u = ẋ the integral is the body's momentum. With
    u = ẍ - g it is the wrench on the body, bX_l^F A_l of Eq. 11 and 14. This corrects -S(ṗ) of
    the thesis's Eq. 2.38 to -S(p̈).

    Parameters
    ----------
    parameters : ParameterSet
        The links with parameters.
    pose, pose_rate : (3, 4, L, N) float64
        X and U of all links, in base axes: rotation (or its rate), then origin (or its rate).
    """
    if len(parameters.links) < pose.shape[2]:
        pose, pose_rate = pose[:, :, parameters.links], pose_rate[:, :, parameters.links]
    links, count = pose.shape[2:]
    integrals = np.empty((6, links, 10, count))
    for axis, (i, j) in enumerate(((1, 2), (2, 0), (0, 1))):
        # One axis at a time, because the products of all three do not fit the cache.
        products = pose[i, :, None] * pose_rate[j]
        products -= pose[j, :, None] * pose_rate[i]
        moment = UNIT_PSEUDO_INERTIA @ products.reshape(16, links * count)
        integrals[axis] = moment.reshape(10, links, count).swapaxes(0, 1)
    integrals[3:, :, 0] = pose_rate[:, 3]
    integrals[3:, :, 1:4] = pose_rate[:, :3].swapaxes(1, 2)
    integrals[3:, :, 4:] = 0.0
    return integrals.reshape(6, parameters.inertial, count).transpose(2, 0, 1)


def generalised_force(
    model: RobotModel, samples: Samples, poses: LinkPoses, axes: FloatArray
) -> FloatArray:
    """Return y = Sᵀ f_a + J_gᵀ f_e (N, n), Eq. 4, from efforts and measured wrenches.

    Parameters
    ----------
    model : RobotModel
        The robot.
    samples : Samples
        Efforts and wrenches.
    poses : LinkPoses
        Link poses of the samples.
    axes : (N, J, 6) float64
        Joint axes from :func:`symbid_ros.dynamics.kinematics.joint_axes`.
    """
    first_joint = 6 * model.floating
    frames = samples.wrench_frames
    at_base = wrenches_at_base(model, samples.wrenches, frames, poses)
    carries = model.ancestors[:, [model.loaded_link(name) for name in frames]].astype(np.float64)
    joint_forces = component_first(axes) * (carries @ component_first(at_base))
    y = np.empty((len(samples), model.dof))
    if model.floating:
        y[:, :6] = at_base.sum(axis=1)
    y[:, first_joint:] = samples.effort + joint_forces.sum(axis=0).T
    model.fold_followers(y)
    return y
