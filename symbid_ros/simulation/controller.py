"""Whole-body balance control by one quadratic program (QP) per period."""

import sys
from collections import deque
from dataclasses import dataclass, replace
from types import ModuleType
from typing import Protocol

import mujoco
import numpy as np
import scipy.linalg

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.controller_model import ControllerModel
from symbid_ros.simulation.plant import RobotFailureError, State


class _NarrowInstructions(ModuleType):
    """Replaces the module that tells proxsuite which vector instructions the processor has.

    The AVX builds of proxsuite round differently when vectors are not aligned to 32 or 64 bytes.
    Alignment differs between processes, so runs with equal seeds would differ by 1e-6 Nm. Problems
    with twenty unknowns are solved just as fast without AVX.
    """

    has_AVX2 = has_AVX512F = staticmethod(lambda: False)  # noqa: N815 (proxsuite's names)


sys.modules.setdefault("proxsuite.instructionset", _NarrowInstructions("proxsuite.instructionset"))

from proxsuite import proxqp  # noqa: E402 (the replacement above must come first)

# r @ CROSS is the matrix [r ×], flattened row by row.
CROSS = np.array(
    [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ],
    dtype=np.float64,
)


class Controller(Protocol):
    """A controller with full-state feedback."""

    def torques(self, state: State) -> FloatArray:
        """Return the drive torques (n_actuated,), Nm."""
        ...


@dataclass(frozen=True)
class BalanceGains:
    """Feedback gains and task weights of the balance controller.

    Attributes
    ----------
    com_stiffness, com_damping : float
        Feedback of the centre of mass, 1/s² and 1/s.
    momentum_damping : float
        Feedback of the angular momentum about the centre of mass, 1/s.
    sole_damping : float
        Velocity feedback that keeps the soles at rest, 1/s.
    trunk_stiffness, trunk_damping : float
        Feedback of the base's orientation, 1/s² and 1/s.
    com_weight, momentum_weight, sole_weight, trunk_weight, wrench_weight : float
        Weights of the squared task errors, in m/s², Nm, rad/s² and m/s², rad/s², N and Nm.
    friction : float
        Friction coefficient of the planned contact forces; less than that of the floor.
    sole_margin : float
        Minimum distance of the planned centres of pressure from the soles' edges, m: a sole
        loaded at its edge tips and then hits the floor.
    """

    com_stiffness: float = 60.0
    com_damping: float = 16.0
    momentum_damping: float = 5.0
    sole_damping: float = 20.0
    trunk_stiffness: float = 60.0
    trunk_damping: float = 16.0
    com_weight: float = 10.0
    momentum_weight: float = 1e-3
    sole_weight: float = 10.0
    trunk_weight: float = 0.1
    wrench_weight: float = 1e-4
    friction: float = 0.6
    sole_margin: float = 0.02

    @property
    def feed_forward(self) -> "BalanceGains":
        """The same weights without feedback: torques follow from model and reference alone."""
        return replace(
            self,
            com_stiffness=0.0,
            com_damping=0.0,
            momentum_damping=0.0,
            sole_damping=0.0,
            trunk_stiffness=0.0,
            trunk_damping=0.0,
        )


class Reference(Protocol):
    """A motion over time, such as :class:`symbid_ros.simulation.trajectory.Trajectory`."""

    @property
    def duration(self) -> float:
        """Seconds."""
        ...

    def at(self, time: float) -> FloatArray:
        """Return position, velocity and acceleration at ``time`` (s) as the rows of a (3, D)."""
        ...


@dataclass(frozen=True)
class BalanceTask:
    """Reference motion of the balance controller.

    Attributes
    ----------
    com : Reference
        Centre of mass in the world, m.
    attitude : (4,) float64
        Initial quaternion wxyz of the base in the world.
    turns : Reference
        Rotation vectors of the base from there, in base axes, rad. Only the position is used:
        feedback without feed-forward smooths the jumps of the acceleration.
    """

    com: Reference
    attitude: FloatArray
    turns: Reference

    @property
    def duration(self) -> float:
        """End of both trajectories, s."""
        return max(self.com.duration, self.turns.duration)


class BalanceController:
    """Whole-body controller that moves the centre of mass along a reference.

    The unknowns of its QP are the drive torques and a wrench at each sole. The accelerations
    follow from the equation of motion. The rate of the centroidal momentum follows from the
    wrenches: ``m a = Σ f + m g``, ``dL/dt = Σ n + r × f`` about the centre of mass.

    Constraints are the torque limits and, for each sole, the friction pyramid and a centre of
    pressure within its contact points. The feet stand flat with their toes along world x. The
    weighted tasks accelerate the centre of mass, damp the angular momentum, keep the soles at rest
    and let the trunk follow its turns.

    Parameters
    ----------
    model : mujoco.MjModel
        The controller's model of the robot; it may differ from the plant's.
    task : BalanceTask
        Reference motion of centre of mass and trunk.
    sole_frames : tuple of str
        Sites of the soles.
    gains : BalanceGains
        Feedback gains and weights.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        task: BalanceTask,
        sole_frames: tuple[str, ...],
        gains: BalanceGains,
    ) -> None:
        self._model = dynamics = ControllerModel(model, sole_frames)
        self._task = task
        self._wrenches = wrenches = len(dynamics.sole_jacobian)
        unknowns = wrenches + model.nu
        com, momentum, trunk = np.sqrt(
            np.array([gains.com_weight, gains.momentum_weight, gains.trunk_weight])
            / gains.sole_weight
        )
        dynamics.outputs[:3] *= trunk
        # Task residuals (centre of mass, momentum, trunk, soles), relative to the soles' weight:
        # one column per unknown; the last column holds the residuals at zero unknowns.
        self._tasks = np.zeros((9 + wrenches, unknowns + 1))
        self._feedback = _feedback(gains, com, momentum, trunk)
        self._com_offset = com * np.array(model.opt.gravity)
        self._lean = np.zeros(3)
        self._sole_damping = np.array(gains.sole_damping)
        self._cross = momentum * CROSS
        force, moment = slice(3, 6), slice(0, 3)
        self._moment_blocks = []
        for column in range(0, wrenches, 6):
            self._tasks[:3, column : column + 6][:, force] = com / dynamics.mass * np.eye(3)
            self._tasks[3:6, column : column + 6][:, moment] = momentum * np.eye(3)
            self._moment_blocks.append(self._tasks[3:6, column : column + 6][:, force])
        self._preference = _preference(dynamics, gains, unknowns)
        cones = scipy.linalg.block_diag(
            *(_contact_cone(bounds, gains) for bounds in dynamics.sole_bounds())
        )
        limits = model.actuator_ctrlrange
        constraints = scipy.linalg.block_diag(cones, np.eye(model.nu))
        lower = np.concatenate([np.full(len(cones), -np.inf), limits[:, 0]])
        upper = np.concatenate([np.zeros(len(cones)), limits[:, 1]])
        self._qp = proxqp.dense.QP(unknowns, 0, len(constraints))
        settings = self._qp.settings
        settings.eps_abs = 1e-6
        settings.eps_rel = 0.0
        # Zero wrenches and torques are always feasible: "infeasible" would be a false alarm.
        settings.eps_primal_inf = settings.eps_dual_inf = 1e-14
        settings.max_iter = 200
        settings.initial_guess = proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        # No preconditioner: it would be computed for this first, meaningless objective.
        self._qp.init(
            np.eye(unknowns), np.zeros(unknowns), None, None, constraints, lower, upper, False
        )

    def torques(self, state: State) -> FloatArray:
        """Return the drive torques (n_actuated,), Nm, for one state.

        Raises
        ------
        RobotFailureError
            When the QP has no solution or the model's mass matrix is not positive definite.
        """
        self._model.update(state)
        self._set_tasks(state)
        products = np.dot(self._tasks.T, self._tasks)
        np.add(products, self._preference, products)
        qp = self._qp
        qp.update(products[:-1, :-1], products[:-1, -1])
        qp.solve()
        results = qp.results
        if results.info.status != proxqp.PROXQP_SOLVED:
            raise RobotFailureError(
                f"no torques keep the robot standing ({results.info.status.name})",
                state.time,
                "choose another motion seed or raise the torque limits in the MJCF",
                "E614",
            )
        return np.array(results.x[self._wrenches :])

    def _set_tasks(self, state: State) -> None:
        model, tasks = self._model, self._tasks
        for block, arm in zip(self._moment_blocks, model.sole_arms, strict=True):
            block[:] = np.dot(arm, self._cross).reshape(3, 3)
        np.dot(model.outputs, model.response.T, tasks[6:])
        goal = self._task.attitude.copy()
        mujoco.mju_quatIntegrate(goal, self._task.turns.at(state.time)[0], 1.0)
        mujoco.mju_subQuat(self._lean, state.position[3:7], goal)
        errors = np.concatenate(
            [
                self._task.com.at(state.time).ravel(),
                model.com,
                model.com_velocity,
                model.angular_momentum,
                self._lean,
                state.velocity[3:6],
            ]
        )
        feedback = np.dot(self._feedback, errors)
        tasks[:3, -1] = feedback[:3] + self._com_offset
        tasks[3:6, -1] = feedback[3:6]
        tasks[6:9, -1] += feedback[6:]
        tasks[9:, -1] += model.sole_drift + self._sole_damping * np.dot(
            model.sole_jacobian, state.velocity
        )


def _feedback(gains: BalanceGains, com: float, momentum: float, trunk: float) -> FloatArray:
    """Return the (9, 24) matrix from feedback signals to residuals of CoM, momentum and trunk.

    The signals are position, velocity and acceleration of the reference, position and velocity of
    the centre of mass, angular momentum, and lean and angular velocity of the trunk.
    """
    blocks = np.zeros((3, 8))
    stiffness, damping = com * gains.com_stiffness, com * gains.com_damping
    blocks[0, :5] = -stiffness, -damping, -com, stiffness, damping
    blocks[1, 5] = momentum * gains.momentum_damping
    blocks[2, 6:] = trunk * gains.trunk_stiffness, trunk * gains.trunk_damping
    return np.asarray(np.kron(blocks, np.eye(3)), dtype=np.float64)


def _preference(model: ControllerModel, gains: BalanceGains, unknowns: int) -> FloatArray:
    """Return the quadratic form that distributes the weight, (unknowns + 1, unknowns + 1).

    Standing on two feet leaves the distribution of the wrenches undetermined. This form prefers
    half the weight on each sole, with the centre of pressure in its middle.
    """
    weight = gains.wrench_weight / gains.sole_weight
    bounds = model.sole_bounds()
    force = -model.mass * np.array(model.model.opt.gravity) / len(bounds)
    form = np.zeros((unknowns + 1, unknowns + 1))
    for sole, (back, front, right, left) in enumerate(bounds):
        middle = np.array([back + front, right + left, 0.0]) / 2.0
        about_middle = np.eye(6)
        about_middle[:3, 3:] = -(middle @ CROSS).reshape(3, 3)
        preferred = about_middle @ np.concatenate([np.cross(middle, force), force])
        block = slice(6 * sole, 6 * sole + 6)
        form[block, block] = weight * about_middle.T @ about_middle
        form[block, -1] = -weight * about_middle.T @ preferred
    return form


def _contact_cone(bounds: FloatArray, gains: BalanceGains) -> FloatArray:
    """Return C (10, 6) such that C (moment; force) ≤ 0 for feasible wrenches at a flat sole.

    The rows are the friction pyramid, a centre of pressure (x = -n_y / f_z, y = n_x / f_z)
    within ``bounds`` (min x, max x, min y, max y) minus the margin, and a yaw moment of at most
    the friction force at half the sole's length.
    """
    margin, friction = gains.sole_margin, gains.friction
    back, front, right, left = bounds + margin * np.array([1.0, -1.0, 1.0, -1.0])
    twist = friction * (front - back) / 2.0
    return np.array(
        [
            [0, 0, 0, 1, 0, -friction],
            [0, 0, 0, -1, 0, -friction],
            [0, 0, 0, 0, 1, -friction],
            [0, 0, 0, 0, -1, -friction],
            [0, -1, 0, 0, 0, -front],
            [0, 1, 0, 0, 0, back],
            [1, 0, 0, 0, 0, -left],
            [-1, 0, 0, 0, 0, right],
            [0, 0, 1, 0, 0, -twist],
            [0, 0, -1, 0, 0, -twist],
        ]
    )


class DegradedFeedback:
    """Feeds a controller delayed states with noisy joint velocities.

    With a stiff controller the legs vibrate as in the thesis's data (chapter 4). The noise changes
    the motion; it is not added to the sensor readings.

    Parameters
    ----------
    controller : Controller
        Receives the states.
    delay : int
        Periods.
    velocity_noise : float
        Standard deviation, rad/s. The noise is the difference of two noisy encoder readings one
        period apart, so most of it is at high frequency.
    joints : int
        Number of joints.
    random : numpy.random.Generator
        Source of the noise.
    """

    def __init__(
        self,
        controller: Controller,
        delay: int,
        velocity_noise: float,
        joints: int,
        random: np.random.Generator,
    ) -> None:
        self._controller = controller
        self._states: deque[State] = deque(maxlen=delay + 1)
        self._sigma = velocity_noise
        self._random = random
        self._last = np.zeros(joints)

    def torques(self, state: State) -> FloatArray:
        """Return the controller's torques for the state ``delay`` periods ago."""
        velocity = state.velocity.copy()
        reading = self._random.standard_normal(len(velocity) - 6)
        velocity[6:] += self._sigma / np.sqrt(2.0) * (reading - self._last)
        self._last = reading
        self._states.append(replace(state, velocity=velocity))
        return self._controller.torques(self._states[0])
