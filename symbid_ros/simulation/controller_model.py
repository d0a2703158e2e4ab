"""The controller's model of the robot: its inertias and its dynamics in world axes."""

import copy
from collections.abc import Mapping

import mujoco
import numpy as np
from scipy.linalg import lapack

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.body_inertia import disable_shortcuts, set_body_phi
from symbid_ros.simulation.plant import RobotFailureError, State, driven_dofs, model_name, site_ids


def replace_inertias(
    plant_model: mujoco.MjModel, inertias: Mapping[str, FloatArray]
) -> mujoco.MjModel:
    """Return a copy of a model with other inertias, which may be physically impossible.

    MuJoCo's compiler rejects negative masses and indefinite inertias, which estimates can have.
    MuJoCo's smooth dynamics accept them, as they are sums over the links. Use the copy for smooth
    dynamics alone: its constants of contacts and constraints are those of the plant.

    Parameters
    ----------
    plant_model : mujoco.MjModel
        The robot; not modified.
    inertias : mapping of str to (10,) float64
        By body name, [m, m·c, Ixx, Ixy, Ixz, Iyy, Iyz, Izz] about the body's origin, products as
        matrix elements. Other bodies keep their inertias.

    Raises
    ------
    SimulationError
        When a body does not exist, or a body or the whole robot has no centre of mass.
    """
    model = copy.copy(plant_model)
    for name, phi in inertias.items():
        body = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, name)
        if body < 0:
            raise SimulationError(
                f"{model_name(model)}: no body {name}; name a body of the model", "E609"
            )
        if not np.all(np.isfinite(phi)) or (phi[0] == 0.0 and np.any(phi[1:4])):
            raise SimulationError(
                f"{model_name(model)}: body {name} has mass {phi[0]:g} kg and first moment "
                f"{phi[1:4]} kg m, hence no centre of mass; give finite numbers and a mass",
                "E610",
            )
        set_body_phi(model, body, phi)
    disable_shortcuts(model)
    model.body_subtreemass[:] = model.body_mass
    for body in range(model.nbody - 1, 0, -1):
        model.body_subtreemass[model.body_parentid[body]] += model.body_subtreemass[body]
    if model.body_subtreemass[model.jnt_bodyid[0]] == 0.0:
        raise SimulationError(
            f"{model_name(model)}: the masses sum to 0 kg, so the robot has no centre of mass; "
            "give its links mass",
            "E610",
        )
    return model


class ControllerModel:
    """Dynamics of the robot according to the controller's model.

    `update` refills the arrays in place. Generalised vectors are ordered like MuJoCo's ``qvel``;
    spatial vectors are angular first, in world axes, about the origin of the sole's frame.

    Parameters
    ----------
    model : mujoco.MjModel
        May differ from the plant's model, for example in its inertias, which may be physically
        impossible.
    sole_frames : tuple of str
        Sites of the F soles; the collision geoms on their links are the contact points.

    Attributes
    ----------
    mass : float
        kg.
    response : (6 F + A + 1, nv) float64
        Generalised accelerations caused by unit wrenches at the soles, by unit torques of the A
        drives, and (last row) by motion and gravity.
    outputs : (3 + 6 F, nv) float64
        Jacobian of the angular velocity of the trunk (base axes) and of the soles' velocities.
    sole_jacobian : (6 F, nv) float64
        The rows of ``outputs`` for the soles, a view.
    sole_drift : (6 F,) float64
        Soles' acceleration at q̈ = 0, rad/s² and m/s².
    sole_arms : (F, 3) float64
        Vectors from the centre of mass to the soles' frames, m.
    com, com_velocity, angular_momentum : (3,) float64
        m, m/s, and kg m²/s about the centre of mass.
    """

    def __init__(self, model: mujoco.MjModel, sole_frames: tuple[str, ...]) -> None:
        self.model, self._data = model, mujoco.MjData(model)
        self._soles = np.array(site_ids(model, sole_frames))
        self._feet = model.site_bodyid[self._soles].tolist()
        base, nv, rows = int(model.jnt_bodyid[0]), model.nv, 6 * len(self._soles)
        self.mass = float(model.body_subtreemass[base])
        # One contiguous block (trunk, soles, drives, motion), so that products and solutions need
        # no copies. `outputs` is its first part; the rows below the trunk cause the `response`.
        block = np.zeros((3 + rows + model.nu + 1, nv))
        block[:3, 3:6] = np.eye(3)
        block[3 + rows + np.arange(model.nu), driven_dofs(model)] = 1.0
        self.outputs, self._causes = block[: 3 + rows], block[3:]
        self.sole_jacobian, self._motion = block[3 : 3 + rows], block[-1]
        self.response = np.zeros_like(self._causes)
        self.sole_drift = np.zeros(rows)
        self.sole_arms = np.zeros((len(self._soles), 3))
        self._rate = np.zeros((rows, nv))
        self._inertia = np.zeros((nv, nv))
        # MuJoCo divides a subtree's momentum by its mass, which it limits to positive values.
        self._has_nonpositive_mass = bool(np.any(model.body_subtreemass[base:] <= 0.0))
        # Views into MuJoCo's arrays, whose addresses are fixed: each lookup costs 1 µs.
        data = self._data
        self.com = data.subtree_com[base]
        self.com_velocity = data.subtree_linvel[base]
        self.angular_momentum = data.subtree_angmom[base]
        self._position, self._velocity = data.qpos, data.qvel
        self._sites = data.site_xpos
        self._rows = [
            (foot, data.site_xpos[site], *np.split(jacobian, 2), *np.split(jacobian_rate, 2))
            for foot, site, jacobian, jacobian_rate in zip(
                self._feet,
                self._soles,
                np.split(self.sole_jacobian, len(self._soles)),
                np.split(self._rate, len(self._soles)),
                strict=True,
            )
        ]

    def update(self, state: State) -> None:
        """Recompute all arrays for a state.

        Raises
        ------
        RobotFailureError
            When the mass matrix is not positive definite in this state.
        """
        model, data = self.model, self._data
        self._position[:], self._velocity[:] = state.position, state.velocity
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_makeM(model, data)
        self._require_definite(state.time)
        mujoco.mj_factorM(model, data)
        mujoco.mj_comVel(model, data)
        mujoco.mj_subtreeVel(model, data)
        if self._has_nonpositive_mass:
            self._sum_angular_momentum()
        mujoco.mj_rne(model, data, 0, self._motion)
        np.negative(self._motion, self._motion)
        for foot, origin, angular, linear, angular_rate, linear_rate in self._rows:
            mujoco.mj_jac(model, data, linear, angular, origin, foot)
            mujoco.mj_jacDot(model, data, linear_rate, angular_rate, origin, foot)
        np.dot(self._rate, self._velocity, self.sole_drift)
        np.subtract(self._sites.take(self._soles, 0), self.com, self.sole_arms)
        mujoco.mj_solveM(model, data, self.response, self._causes)

    @property
    def trunk_rotation(self) -> FloatArray:
        """(3, 3) rotation from base to world axes."""
        return np.asarray(self._data.xmat[self.model.jnt_bodyid[0]].reshape(3, 3))

    def sole_pose(self, sole: int) -> tuple[FloatArray, FloatArray]:
        """Return position (3,) and rotation (3, 3) to world axes of a sole's frame, m."""
        site = self._soles[sole]
        return self._data.site_xpos[site], self._data.site_xmat[site].reshape(3, 3)

    def pivot(self, sole: int) -> FloatArray:
        """Return the position (3,) of the joint that carries a foot, in the world, m."""
        return np.asarray(self._data.xanchor[self.model.body_jntadr[self._feet[sole]]])

    def roll_inertia(self, stance: int) -> FloatArray:
        """Return the roll momentum caused by unit rates of trunk roll and of sideways motion, (2,).

        The angular momentum about the centre of mass and world x, per roll rate of the trunk
        (kg m²) and per sideways velocity of the centre of mass (kg m), while it moves in no other
        direction, the trunk does not pitch, the stance sole is at rest, and the other soles
        neither move nor roll or pitch.
        """
        model, data = self.model, self._data
        momentum, com = np.zeros((3, model.nv)), np.zeros((3, model.nv))
        base = int(model.jnt_bodyid[0])
        mujoco.mj_angmomMat(model, data, momentum, base)
        mujoco.mj_jacSubtreeCom(model, data, com, base)
        trunk = np.zeros((3, model.nv))
        trunk[:, 3:6] = self.trunk_rotation
        rows = [com, trunk[:2]]
        for sole in range(len(self._soles)):
            jacobian = self.sole_jacobian[6 * sole : 6 * sole + 6]
            rows.append(jacobian if sole == stance else jacobian[[0, 1, 3, 4, 5]])
        causes = np.zeros((sum(map(len, rows)), 2))
        causes[3, 0] = causes[1, 1] = 1.0
        return np.asarray(momentum[0] @ np.linalg.lstsq(np.vstack(rows), causes, rcond=None)[0])

    def _require_definite(self, time: float) -> None:
        # MuJoCo would replace a negative pivot by a tiny positive one and continue.
        mujoco.mj_fullM(self.model, self._data, self._inertia)
        if lapack.dpotrf(self._inertia)[1]:
            raise RobotFailureError(
                "the mass matrix of the controller's model is not positive definite",
                time,
                "give the controller physically possible inertias",
                "E615",
            )

    def _sum_angular_momentum(self) -> None:
        data = self._data
        inertia = np.empty((3, 3, len(data.cinert)))
        inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]] = data.cinert[:, :6].T
        inertia[[1, 2, 2], [0, 0, 1]] = data.cinert[:, 3:6].T
        spin, velocity = data.cvel[:, :3], data.cvel[:, 3:]
        spins = np.einsum("ijb,bj->i", inertia, spin)
        self.angular_momentum[:] = spins + np.cross(data.cinert[:, 6:9], velocity).sum(axis=0)

    def sole_bounds(self) -> FloatArray:
        """Return min x, max x, min y, max y of the contact points in sole axes, (F, 4), m."""
        model = self.model
        bounds = []
        for site, foot in zip(self._soles, self._feet, strict=True):
            geoms = (model.geom_bodyid == foot) & (model.geom_conaffinity > 0)
            rotation = np.zeros(9)
            mujoco.mju_quat2Mat(rotation, model.site_quat[site])
            points = (model.geom_pos[geoms] - model.site_pos[site]) @ rotation.reshape(3, 3)
            low, high = points.min(axis=0), points.max(axis=0)
            bounds.append([low[0], high[0], low[1], high[1]])
        return np.array(bounds)
