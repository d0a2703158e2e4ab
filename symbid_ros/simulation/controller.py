"""Balance by control of the centroidal dynamics, one quadratic programme per period."""

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
from symbid_ros.simulation.trajectory import Trajectory


class _NarrowInstructions(ModuleType):
    """Stands in for the module that proxsuite asks about the processor, during its import.

    proxsuite's builds for AVX round differently when a vector is not aligned to 32 or 64 bytes, and
    alignment differs between processes: runs with equal seeds would differ by 1e-6 Nm. Problems
    with twenty unknowns are solved just as fast without AVX.
    """

    has_AVX2 = has_AVX512F = staticmethod(lambda: False)  # noqa: N815 (proxsuite's names)


sys.modules.setdefault("proxsuite.instructionset", _NarrowInstructions("proxsuite.instructionset"))

from proxsuite import proxqp  # noqa: E402 (the stand-in above must come first)

# r @ CROSS is the matrix [r ×], row by row.
CROSS = np.array(
    [
        [0, 0, 0, 0, 0, -1, 0, 1, 0],
        [0, 0, 1, 0, 0, 0, -1, 0, 0],
        [0, -1, 0, 1, 0, 0, 0, 0, 0],
    ],
    dtype=np.float64,
)


class Controller(Protocol):
    """Anything that turns a state into torques."""

    def torques(self, state: State) -> FloatArray:
        """Return the drives' torques (n_actuated,), Nm."""
        ...


@dataclass(frozen=True)
class BalanceGains:
    """Feedback gains and task weights of the balance controller.

    Attributes
    ----------
    com_stiffness, com_damping : float
        Of the centre of mass, 1/s² and 1/s.
    momentum_damping : float
        Of the angular momentum about the centre of mass, 1/s.
    sole_damping : float
        Velocity feedback that keeps the soles still, 1/s.
    trunk_stiffness, trunk_damping : float
        Of the base's orientation, 1/s² and 1/s.
    com_weight, momentum_weight, sole_weight, trunk_weight, wrench_weight : float
        Weights of the squared task errors, in m/s², Nm, rad/s² and m/s², rad/s², N and Nm.
    friction : float
        Coefficient the planned contact forces keep to; less than the floor's.
    sole_margin : float
        Distance the planned centres of pressure keep from the soles' edges, m: a sole loaded
        at its very edge tips, and falls back with a blow.
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
        """The same weights without any feedback: what is left comes from model and reference."""
        return replace(
            self,
            com_stiffness=0.0,
            com_damping=0.0,
            momentum_damping=0.0,
            sole_damping=0.0,
            trunk_stiffness=0.0,
            trunk_damping=0.0,
        )


@dataclass(frozen=True)
class BalanceTask:
    """What the balance controller is to do.

    Attributes
    ----------
    com : Trajectory
        Path of the centre of mass in the world, m.
    attitude : (4,) float64
        Quaternion wxyz of the base in the world that its turns start from.
    turns : Trajectory
        Rotation vectors of the base from there, in base axes, rad. Only their position is
        followed: feedback without feed-forward rounds the jumps of their acceleration.
    """

    com: Trajectory
    attitude: FloatArray
    turns: Trajectory

    @property
    def duration(self) -> float:
        """End of both, s."""
        return max(self.com.duration, self.turns.duration)


class BalanceController:
    """Whole-body controller that moves the centre of mass along a reference.

    Unknowns are the drives' torques and a wrench at each sole; the accelerations follow from the
    equation of motion, the centroidal momentum's rate from the wrenches (Newton and Euler about
    the centre of mass: ``m a = Σ f + m g``, ``dL/dt = Σ n + r × f``). Constraints: torque limits,
    and for each sole the friction pyramid and a centre of pressure within its contact points, as
    the feet stand flat with their toes along world x. Tasks, weighted against each other:
    acceleration of the centre of mass, damped angular momentum about it, soles that stay still,
    and a trunk that softly follows its turns.

    Parameters
    ----------
    model : mujoco.MjModel
        What the controller believes the robot to be; it may differ from the plant's.
    task : BalanceTask
        Where centre of mass and trunk are to go.
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
        self._belief = belief = ControllerModel(model, sole_frames)
        self._task = task
        self._wrenches = wrenches = len(belief.sole_jacobian)
        unknowns = wrenches + model.nu
        com, momentum, trunk = np.sqrt(
            np.array([gains.com_weight, gains.momentum_weight, gains.trunk_weight])
            / gains.sole_weight
        )
        belief.outputs[:3] *= trunk
        # Residuals of the tasks (centre of mass, momentum, trunk, soles) in units of the soles'
        # weight: what each unknown adds, and in the last column what there is without them.
        self._tasks = np.zeros((9 + wrenches, unknowns + 1))
        self._feedback = _feedback(gains, com, momentum, trunk)
        self._com_offset = com * np.array(model.opt.gravity)
        self._lean = np.zeros(3)
        self._sole_damping = np.array(gains.sole_damping)
        self._cross = momentum * CROSS
        force, moment = slice(3, 6), slice(0, 3)
        self._moment_blocks = []
        for column in range(0, wrenches, 6):
            self._tasks[:3, column : column + 6][:, force] = com / belief.mass * np.eye(3)
            self._tasks[3:6, column : column + 6][:, moment] = momentum * np.eye(3)
            self._moment_blocks.append(self._tasks[3:6, column : column + 6][:, force])
        self._preference = _preference(belief, gains, unknowns)
        cones = scipy.linalg.block_diag(
            *(_contact_cone(bounds, gains) for bounds in belief.sole_bounds())
        )
        limits = model.actuator_ctrlrange
        constraints = scipy.linalg.block_diag(cones, np.eye(model.nu))
        lower = np.concatenate([np.full(len(cones), -np.inf), limits[:, 0]])
        upper = np.concatenate([np.zeros(len(cones)), limits[:, 1]])
        self._programme = proxqp.dense.QP(unknowns, 0, len(constraints))
        settings = self._programme.settings
        settings.eps_abs = 1e-6
        settings.eps_rel = 0.0
        # No wrench and no torque is always allowed, so that "infeasible" would be a false alarm.
        settings.eps_primal_inf = settings.eps_dual_inf = 1e-14
        settings.max_iter = 200
        settings.initial_guess = proxqp.InitialGuess.WARM_START_WITH_PREVIOUS_RESULT
        # Its preconditioner would be computed for this first, meaningless objective.
        self._programme.init(
            np.eye(unknowns), np.zeros(unknowns), None, None, constraints, lower, upper, False
        )

    def torques(self, state: State) -> FloatArray:
        """Return the drives' torques (n_actuated,), Nm, for one state.

        Raises
        ------
        RobotFailureError
            When there are none, or the believed inertias are of no use in this state.
        """
        self._belief.update(state)
        self._set_tasks(state)
        products = np.dot(self._tasks.T, self._tasks)
        np.add(products, self._preference, products)
        programme = self._programme
        programme.update(products[:-1, :-1], products[:-1, -1])
        programme.solve()
        results = programme.results
        if results.info.status != proxqp.PROXQP_SOLVED:
            raise RobotFailureError(
                f"no torques keep the robot standing ({results.info.status.name})",
                state.time,
                "ask for slower or smaller moves",
            )
        return np.array(results.x[self._wrenches :])

    def _set_tasks(self, state: State) -> None:
        belief, tasks = self._belief, self._tasks
        for block, arm in zip(self._moment_blocks, belief.sole_arms, strict=True):
            block[:] = np.dot(arm, self._cross).reshape(3, 3)
        np.dot(belief.outputs, belief.response.T, tasks[6:])
        aim = self._task.attitude.copy()
        mujoco.mju_quatIntegrate(aim, self._task.turns.at(state.time)[0], 1.0)
        mujoco.mju_subQuat(self._lean, state.position[3:7], aim)
        errors = np.concatenate(
            [
                self._task.com.at(state.time).ravel(),
                belief.com,
                belief.com_velocity,
                belief.angular_momentum,
                self._lean,
                state.velocity[3:6],
            ]
        )
        feedback = np.dot(self._feedback, errors)
        tasks[:3, -1] = feedback[:3] + self._com_offset
        tasks[3:6, -1] = feedback[3:6]
        tasks[6:9, -1] += feedback[6:]
        tasks[9:, -1] += belief.sole_drift + self._sole_damping * np.dot(
            belief.sole_jacobian, state.velocity
        )


def _feedback(gains: BalanceGains, com: float, momentum: float, trunk: float) -> FloatArray:
    """(9, 24) residuals of centre of mass, momentum and trunk per unit of what is fed back.

    That is the reference's position, velocity and acceleration, the centre of mass's position
    and velocity, the angular momentum, the trunk's lean and its angular velocity.
    """
    blocks = np.zeros((3, 8))
    stiffness, damping = com * gains.com_stiffness, com * gains.com_damping
    blocks[0, :5] = -stiffness, -damping, -com, stiffness, damping
    blocks[1, 5] = momentum * gains.momentum_damping
    blocks[2, 6:] = trunk * gains.trunk_stiffness, trunk * gains.trunk_damping
    return np.asarray(np.kron(blocks, np.eye(3)), dtype=np.float64)


def _preference(belief: ControllerModel, gains: BalanceGains, unknowns: int) -> FloatArray:
    """(unknowns + 1, unknowns + 1) quadratic form that draws each sole to its share of the weight.

    Standing on two feet leaves the wrenches' split between them open; this settles it: half the
    weight each, in the middle of the sole.
    """
    weight = gains.wrench_weight / gains.sole_weight
    bounds = belief.sole_bounds()
    force = -belief.mass * np.array(belief.model.opt.gravity) / len(bounds)
    form = np.zeros((unknowns + 1, unknowns + 1))
    for sole, (back, front, right, left) in enumerate(bounds):
        middle = np.array([back + front, right + left, 0.0]) / 2.0
        about_middle = np.eye(6)
        about_middle[:3, 3:] = -(middle @ CROSS).reshape(3, 3)
        aim = about_middle @ np.concatenate([np.cross(middle, force), force])
        block = slice(6 * sole, 6 * sole + 6)
        form[block, block] = weight * about_middle.T @ about_middle
        form[block, -1] = -weight * about_middle.T @ aim
    return form


def _contact_cone(bounds: FloatArray, gains: BalanceGains) -> FloatArray:
    """Rows C with C (moment; force) ≤ 0 for wrenches a flat sole can bear, (10, 6).

    Friction pyramid, centre of pressure (x = -n_y / f_z, y = n_x / f_z) within ``bounds``
    (low x, high x, low y, high y) less the margin, and a twist no larger than friction at half
    the sole's length gives.
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
    """Gives a controller states that are late and whose joint velocities are noisy.

    With a stiff controller this makes the legs vibrate as they do in the thesis's data
    (chapter 4). The noise belongs to the motion, not to the sensors.

    Parameters
    ----------
    controller : Controller
        Who gets the states.
    delay : int
        Periods.
    velocity_noise : float
        Standard deviation, rad/s: the difference of two noisy encoder readings a period apart,
        hence mostly of high frequency.
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
        """Return the controller's torques for a state ``delay`` periods ago."""
        velocity = state.velocity.copy()
        reading = self._random.standard_normal(len(velocity) - 6)
        velocity[6:] += self._sigma / np.sqrt(2.0) * (reading - self._last)
        self._last = reading
        self._states.append(replace(state, velocity=velocity))
        return self._controller.torques(self._states[0])
