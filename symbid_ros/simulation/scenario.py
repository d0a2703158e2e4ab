"""The scenarios that can be simulated, and the run of a scenario on a plant."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.controller import (
    BalanceController,
    BalanceGains,
    BalanceTask,
    Controller,
    DegradedFeedback,
)
from symbid_ros.simulation.footsteps import (
    FootstepTask,
    draw_one_leg_task,
    draw_stepping_task,
)
from symbid_ros.simulation.overhead_support import (
    JointController,
    OverheadSupport,
    gravity_torques,
    settle_passive_joints,
)
from symbid_ros.simulation.plant import Plant, RobotFailureError, Truth
from symbid_ros.simulation.stepping_controller import SteppingController, SteppingGains
from symbid_ros.simulation.trajectory import MoveRange, Trajectory, draw_trajectory

SOLES = ("left_sole", "right_sole")
SUPPORT_FRAME = "suspension"

# Standing: metres and m/s. Sideways, both feet must carry part of the weight. Vertically, the knees
# must stay bent and the ankles away from their end stops.
COM_MOVES = MoveRange(
    centre=np.array([-0.004, 0.0, -0.018]),
    half_widths=np.array([0.08, 0.08, 0.014]),
    speeds=(0.015, 0.085),
    shortest=0.07,
)
# Turns of the trunk at the same time, rad and rad/s; the legs allow little yaw. The height of the
# trunk's mass is identifiable only if it leans, and its inertia only if its angular acceleration
# exceeds the gyroscope's noise (thesis, section IV-A: no torso stabilisation, for that reason).
TRUNK_TURNS = MoveRange(
    centre=np.zeros(3),
    half_widths=np.radians([6.5, 12.0, 6.0]),
    speeds=(0.13, 0.2),
    shortest=0.12,
)
TURNS_PER_MOVE = 2

# Wide: as far and as fast as a robot with a good model of itself stands. If heights and turns of
# `smooth` are scaled as well, and by 1.3, ankles and knees reach their end stops.
WIDER = 1.2
WIDE_MOVES = replace(
    COM_MOVES,
    half_widths=COM_MOVES.half_widths * np.array([WIDER, WIDER, 1.0]),
    speeds=(WIDER * COM_MOVES.speeds[0], WIDER * COM_MOVES.speeds[1]),
    shortest=WIDER * COM_MOVES.shortest,
)

# Squatting: metres and m/s, nearly vertical. The ankles' end stops limit the depth; leaning the
# trunk forward moves the hips back and keeps the ankles away from them.
SQUAT_MOVES = MoveRange(
    centre=np.array([-0.004, 0.0, -0.032]),
    half_widths=np.array([0.01, 0.01, 0.028]),
    speeds=(0.015, 0.06),
    shortest=0.025,
)
SQUAT_TURNS = MoveRange(
    centre=np.radians([0.0, 14.0, 0.0]),
    half_widths=np.radians([3.0, 5.0, 3.0]),
    speeds=(0.08, 0.13),
    shortest=0.07,
)

# Scenarios that a balance controller can execute from sensor readings alone.
STANDING = {
    "smooth": (COM_MOVES, TRUNK_TURNS),
    "wide": (WIDE_MOVES, TRUNK_TURNS),
    "squat": (SQUAT_MOVES, SQUAT_TURNS),
}

# Suspended: rad and rad/s. The hook rotates by up to 15 degrees, sideways by less, and slowly: the
# undriven ankle joints swing like pendulums and must stay away from their end stops.
HOOK_TURNS = MoveRange(
    centre=np.zeros(3),
    half_widths=np.radians([11.0, 15.0, 15.0]),
    speeds=(0.06, 0.16),
    shortest=0.2,
)
# Driven joints of each leg: hip ab/adduction, hip flexion, knee, ankle flexion.
LEG_CENTRE, LEG_WIDTHS = (0.0, 0.0, -0.15, 0.0), (0.04, 0.25, 0.3, 0.15)
LEG_MOVES = MoveRange(
    centre=np.tile(LEG_CENTRE, 2),
    half_widths=np.tile(LEG_WIDTHS, 2),
    speeds=(0.06, 0.18),
    shortest=0.15,
)
LIFT = 0.5  # height of hanging above standing, m
TARE_DURATION = 5.0  # s

# Joint accelerations of 8 to 10 rad/s² (rms), mostly between 250 and 460 Hz. Friction damps the
# vibration, so it takes a higher gain.
VIBRATING_GAINS = BalanceGains(sole_damping=115.0)
VIBRATING_GAINS_WITH_FRICTION = BalanceGains(sole_damping=130.0)
FEEDBACK_NOISE = 0.05  # rad/s
FEEDBACK_DELAY = 3  # periods
# Time for feet and support to take the load before the motion starts; not part of the log.
SETTLING_TIME = 1.0  # s
# The robot has fallen when its base is below this fraction of its initial height, or of the lowest
# height that the motion reaches.
FALL_HEIGHT = 0.7


@dataclass(frozen=True)
class Scenario:
    """A motion, ready to run.

    Attributes
    ----------
    controller : Controller
        Commands the drives.
    support : OverheadSupport or None
        Holds the base; None if the robot stands.
    duration : float
        Seconds.
    lowest : float
        Lowest height of the base, m, that the motion reaches, if that is below the first one.
    another : str
        How the user gets another motion.
    """

    controller: Controller
    support: OverheadSupport | None
    duration: float
    lowest: float = np.inf
    another: str = "choose another motion seed"


def require_seed(name: str, seed: int) -> None:
    """Raise an error if a seed is negative, which random generators do not accept."""
    if seed < 0:
        raise SimulationError(f"{name} {seed} is negative; give 0 or more", "E605")


def draw_standing_task(
    plant: Plant,
    moves: int,
    seed: int,
    com_moves: MoveRange = COM_MOVES,
    trunk_turns: MoveRange = TRUNK_TURNS,
) -> BalanceTask:
    """Draw the reference motion of a standing robot: moves of its CoM and turns of its trunk.

    Parameters
    ----------
    plant : Plant
        Robot in its initial pose.
    moves : int
        Number of moves of the centre of mass.
    seed : int
        Seed of the random moves and turns.
    com_moves, trunk_turns : MoveRange
        Metres in the world and rotation vectors (rad) in base axes, from the initial pose.
    """
    plant.observe()
    com = draw_trajectory(plant.com, moves, com_moves, np.random.default_rng([seed, 0]))
    attitude = plant.data.qpos[3:7].copy()
    turns = draw_trajectory(
        np.zeros(3), TURNS_PER_MOVE * moves, trunk_turns, np.random.default_rng([seed, 2])
    )
    return BalanceTask(com, attitude, turns)


def _standing(plant: Plant, task: BalanceTask, gains: BalanceGains) -> Scenario:
    # A copy: the controller does not know payloads attached to the plant later.
    model = copy.copy(plant.model)
    return Scenario(BalanceController(model, task, SOLES, gains), None, task.duration)


def _smooth(plant: Plant, moves: int, seed: int) -> Scenario:
    return _standing(plant, draw_standing_task(plant, moves, seed), BalanceGains())


def _wide(plant: Plant, moves: int, seed: int) -> Scenario:
    task = draw_standing_task(plant, moves, seed, *STANDING["wide"])
    return _standing(plant, task, BalanceGains())


def _squat(plant: Plant, moves: int, seed: int) -> Scenario:
    task = draw_standing_task(plant, moves, seed, *STANDING["squat"])
    return _standing(plant, task, BalanceGains())


def _vibrating(plant: Plant, moves: int, seed: int) -> Scenario:
    has_friction = np.any(plant.model.dof_damping) or np.any(plant.model.dof_frictionloss)
    gains = VIBRATING_GAINS_WITH_FRICTION if has_friction else VIBRATING_GAINS
    standing = _standing(plant, draw_standing_task(plant, moves, seed), gains)
    controller = DegradedFeedback(
        standing.controller,
        FEEDBACK_DELAY,
        FEEDBACK_NOISE,
        len(plant.joint_names),
        np.random.default_rng([seed, 1]),
    )
    return Scenario(controller, None, standing.duration)


def _one_leg(plant: Plant, moves: int, seed: int) -> Scenario:
    return _stepping_scenario(plant, draw_one_leg_task(plant, SOLES, moves, seed))


def _stepping(plant: Plant, moves: int, seed: int) -> Scenario:
    return _stepping_scenario(plant, draw_stepping_task(plant, SOLES, moves, seed))


def _stepping_scenario(plant: Plant, task: FootstepTask) -> Scenario:
    # A copy, as in `_standing`.
    controller = SteppingController(copy.copy(plant.model), task, SOLES, SteppingGains())
    return Scenario(controller, None, task.duration)


def _suspended(plant: Plant, moves: int, seed: int) -> Scenario:
    hook = draw_trajectory(np.zeros(3), moves, HOOK_TURNS, np.random.default_rng([seed, 0]))
    legs = draw_trajectory(_leg_pose(plant), moves, LEG_MOVES, np.random.default_rng([seed, 1]))
    return _hanging(plant, hook, legs)


def _tare(plant: Plant, moves: int, seed: int) -> Scenario:
    # At equilibrium from the start: undriven joints without damping would swing forever.
    model, pose = plant.model, plant.data.qpos
    pose[:] = settle_passive_joints(model, pose)
    gravity_torque = gravity_torques(model, pose)[plant.driven]
    hook, legs = _constant(np.zeros(3), TARE_DURATION), _constant(_leg_pose(plant), TARE_DURATION)
    return _hanging(plant, hook, legs, gravity_torque)


def _hanging(
    plant: Plant, hook: Trajectory, legs: Trajectory, gravity_torque: FloatArray | None = None
) -> Scenario:
    plant.data.qpos[2] += LIFT
    controller = JointController(plant.model, plant.data.qpos.copy(), legs, gravity_torque)
    return Scenario(controller, OverheadSupport(plant, SUPPORT_FRAME, hook), hook.duration)


def _leg_pose(plant: Plant) -> FloatArray:
    driven = plant.model.jnt_qposadr[plant.model.actuator_trnid[:, 0]]
    return np.asarray(plant.data.qpos[driven])


def _constant(point: FloatArray, duration: float) -> Trajectory:
    return Trajectory(np.stack([point, point]), (0.0, duration), duration)


SCENARIOS: dict[str, Callable[[Plant, int, int], Scenario]] = {
    "smooth": _smooth,
    "wide": _wide,
    "squat": _squat,
    "vibrating": _vibrating,
    "one_leg": _one_leg,
    "stepping": _stepping,
    "suspended": _suspended,
    "tare": _tare,
}


class ScenarioRun:
    """A plant that executes a scenario, one period at a time.

    Parameters
    ----------
    plant : Plant
        Robot in its initial pose.
    scenario : Scenario
        The motion.

    Attributes
    ----------
    steps : int
        Number of periods of the motion, without settling.
    torques : (n_actuated,) float64
        Commanded drive torques of the last period, Nm.
    """

    def __init__(self, plant: Plant, scenario: Scenario) -> None:
        self._plant, self._scenario = plant, scenario
        self._lowest = FALL_HEIGHT * min(float(plant.data.qpos[2]), scenario.lowest)
        self.steps = round(scenario.duration / plant.period)
        self.torques = np.zeros(plant.model.nu)

    def settle(self) -> Iterator[Truth]:
        """Yield the instants before the motion, at negative times.

        Raises
        ------
        RobotFailureError
            As in `advance`.
        """
        for step in range(-round(SETTLING_TIME / self._plant.period), 0):
            yield self.advance(step)

    def advance(self, step: int, torques: FloatArray | None = None) -> Truth:
        """Simulate one period and return the truth at its start.

        Parameters
        ----------
        step : int
            Number of periods since the start of the motion.
        torques : (n_actuated,) float64 or None
            Drive torques, Nm; None to use the scenario's controller.

        Raises
        ------
        RobotFailureError
            When the robot falls, a joint reaches its end stop, or the controller finds no torques.
        """
        plant, scenario = self._plant, self._scenario
        # Computed from the step: a running sum would drift away from the stamps.
        time = plant.data.time = step * plant.period
        state = plant.observe()
        self.torques = scenario.controller.torques(state) if torques is None else torques
        if scenario.support is not None:
            scenario.support.apply(time)
        truth = plant.advance(self.torques)
        if state.position[2] < self._lowest:
            raise RobotFailureError(
                "the robot fell", time, f"{scenario.another} or a lighter payload", "E612"
            )
        joint = plant.joint_at_limit
        if joint is not None:
            raise RobotFailureError(
                f"joint {joint} ran into its end stop",
                time,
                "no sensor measures the force there: widen the joint's range in the model or "
                f"{scenario.another}",
                "E613",
            )
        return truth
