"""The motions that can be simulated, and what each of them needs."""

import copy
from collections.abc import Callable, Iterator
from dataclasses import dataclass

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
from symbid_ros.simulation.initial_pose import gravity_torques, settle_passive_joints
from symbid_ros.simulation.overhead_support import JointController, OverheadSupport
from symbid_ros.simulation.plant import Plant, RobotFailureError, Truth
from symbid_ros.simulation.trajectory import MoveRange, Trajectory, draw_trajectory

SOLES = ("left_sole", "right_sole")
SUPPORT_FRAME = "suspension"

# Standing: metres and m/s. Sideways both feet must keep a share of the weight, and low enough that
# knees stay bent, high enough that ankles keep off their end stops.
COM_MOVES = MoveRange(
    centre=np.array([-0.004, 0.0, -0.018]),
    half_widths=np.array([0.08, 0.08, 0.014]),
    slowest=0.015,
    fastest=0.085,
    shortest=0.07,
    rest=0.5,
)
# The trunk turns meanwhile, rad and rad/s; the legs allow little about yaw. Only a leaning trunk
# shows how high its mass is, and only turning brisker than the gyroscope's noise shows inertia
# (thesis, section IV-A: no torso stabilisation, for that reason).
TRUNK_TURNS = MoveRange(
    centre=np.zeros(3),
    half_widths=np.radians([6.5, 12.0, 6.0]),
    slowest=0.13,
    fastest=0.2,
    shortest=0.12,
    rest=0.5,
)
TURNS_PER_MOVE = 2

# Squatting: metres and m/s, nearly straight up and down. The ankles' end stops bound the depth; a
# trunk that leans forward keeps them off by letting the hips go back.
SQUAT_MOVES = MoveRange(
    centre=np.array([-0.004, 0.0, -0.032]),
    half_widths=np.array([0.01, 0.01, 0.028]),
    slowest=0.015,
    fastest=0.06,
    shortest=0.025,
    rest=0.5,
)
SQUAT_TURNS = MoveRange(
    centre=np.radians([0.0, 14.0, 0.0]),
    half_widths=np.radians([3.0, 5.0, 3.0]),
    slowest=0.08,
    fastest=0.13,
    shortest=0.07,
    rest=0.5,
)

# Those that stand on their balance alone.
STANDING = {"smooth": (COM_MOVES, TRUNK_TURNS), "squat": (SQUAT_MOVES, SQUAT_TURNS)}

# Suspended: rad and rad/s. The hook rocks by up to 15 degrees, sideways by less and never fast:
# the undriven ankle joints hang plumb like pendulums and must keep off their end stops.
HOOK_MOVES = MoveRange(
    centre=np.zeros(3),
    half_widths=np.radians([11.0, 15.0, 15.0]),
    slowest=0.06,
    fastest=0.16,
    shortest=0.2,
    rest=0.5,
)
# Each leg's driven joints: hip ab/adduction, hip flexion, knee, ankle flexion.
LEG_CENTRE, LEG_WIDTHS = (0.0, 0.0, -0.15, 0.0), (0.04, 0.25, 0.3, 0.15)
LEG_MOVES = MoveRange(
    centre=np.tile(LEG_CENTRE, 2),
    half_widths=np.tile(LEG_WIDTHS, 2),
    slowest=0.06,
    fastest=0.18,
    shortest=0.15,
    rest=0.5,
)
LIFT = 0.5  # m from standing to hanging
TARE = 5.0  # s

# Gives joint accelerations of 8 to 10 rad/s² (rms), most of it between 250 and 460 Hz. Friction
# calms the vibration, which takes more gain then.
VIBRATING_GAINS = BalanceGains(sole_damping=115.0)
VIBRATING_GAINS_WITH_FRICTION = BalanceGains(sole_damping=130.0)
FEEDBACK_NOISE = 0.05  # rad/s
FEEDBACK_DELAY = 3  # periods


@dataclass(frozen=True)
class Scenario:
    """A motion, ready to run.

    Attributes
    ----------
    controller : Controller
        Commands the drives.
    hoist : OverheadSupport or None
        Holds the base where the robot does not stand.
    duration : float
        Seconds.
    """

    controller: Controller
    hoist: OverheadSupport | None
    duration: float


def require_seed(name: str, seed: int) -> None:
    """Refuse a seed that no generator takes."""
    if seed < 0:
        raise SimulationError(f"{name} {seed} is negative; give 0 or more")


def standing_task(
    plant: Plant,
    moves: int,
    seed: int,
    com_moves: MoveRange = COM_MOVES,
    trunk_turns: MoveRange = TRUNK_TURNS,
) -> BalanceTask:
    """Draw what a standing robot is to do: moves of its centre of mass, turns of its trunk.

    Parameters
    ----------
    plant : Plant
        Robot, in the pose in which it starts.
    moves : int
        Number of moves of the centre of mass.
    seed : int
        Of the draw.
    com_moves, trunk_turns : MoveRange
        Metres in the world and rotation vectors (rad) in base axes, from where it starts.
    """
    plant.observe()
    reference = draw_trajectory(plant.com, moves, com_moves, np.random.default_rng([seed, 0]))
    attitude = plant.data.qpos[3:7].copy()
    turns = draw_trajectory(
        np.zeros(3), TURNS_PER_MOVE * moves, trunk_turns, np.random.default_rng([seed, 2])
    )
    return BalanceTask(reference, attitude, turns)


def _standing(plant: Plant, task: BalanceTask, gains: BalanceGains) -> Scenario:
    # A copy: what the plant is loaded with later is nothing that the controller knows of.
    belief = copy.copy(plant.model)
    return Scenario(BalanceController(belief, task, SOLES, gains), None, task.duration)


def _smooth(plant: Plant, moves: int, seed: int) -> Scenario:
    return _standing(plant, standing_task(plant, moves, seed), BalanceGains())


def _squat(plant: Plant, moves: int, seed: int) -> Scenario:
    task = standing_task(plant, moves, seed, *STANDING["squat"])
    return _standing(plant, task, BalanceGains())


def _vibrating(plant: Plant, moves: int, seed: int) -> Scenario:
    has_friction = np.any(plant.model.dof_damping) or np.any(plant.model.dof_frictionloss)
    gains = VIBRATING_GAINS_WITH_FRICTION if has_friction else VIBRATING_GAINS
    calm = _standing(plant, standing_task(plant, moves, seed), gains)
    controller = DegradedFeedback(
        calm.controller,
        FEEDBACK_DELAY,
        FEEDBACK_NOISE,
        len(plant.joint_names),
        np.random.default_rng([seed, 1]),
    )
    return Scenario(controller, None, calm.duration)


def _suspended(plant: Plant, moves: int, seed: int) -> Scenario:
    rocking = draw_trajectory(np.zeros(3), moves, HOOK_MOVES, np.random.default_rng([seed, 0]))
    legs = draw_trajectory(_leg_pose(plant), moves, LEG_MOVES, np.random.default_rng([seed, 1]))
    return _hanging(plant, rocking, legs)


def _tare(plant: Plant, moves: int, seed: int) -> Scenario:
    # At rest from the start: what is not driven and not damped would go on swinging.
    model, pose = plant.model, plant.data.qpos
    pose[:] = settle_passive_joints(model, pose)
    weight = gravity_torques(model, pose)[plant.driven]
    return _hanging(plant, _rest(np.zeros(3), TARE), _rest(_leg_pose(plant), TARE), weight)


def _hanging(
    plant: Plant, hook: Trajectory, legs: Trajectory, weight: FloatArray | None = None
) -> Scenario:
    plant.data.qpos[2] += LIFT
    controller = JointController(plant.model, plant.data.qpos.copy(), legs, weight)
    return Scenario(controller, OverheadSupport(plant, SUPPORT_FRAME, hook), hook.duration)


def _leg_pose(plant: Plant) -> FloatArray:
    driven = plant.model.jnt_qposadr[plant.model.actuator_trnid[:, 0]]
    return np.asarray(plant.data.qpos[driven])


def _rest(point: FloatArray, duration: float) -> Trajectory:
    return Trajectory(np.stack([point, point]), (0.0, duration), duration)


SCENARIOS: dict[str, Callable[[Plant, int, int], Scenario]] = {
    "smooth": _smooth,
    "squat": _squat,
    "vibrating": _vibrating,
    "suspended": _suspended,
    "tare": _tare,
}


# Long enough for feet and hoist to take the load; none of it counts.
SETTLING = 1.0  # s
# A robot whose base has come down this far does not stand any more.
FALLEN = 0.7  # of the height at the start


class ScenarioRun:
    """A plant under the command of a scenario.

    Parameters
    ----------
    plant : Plant
        Robot, in the pose in which it starts.
    motion : Scenario
        What it does.

    Attributes
    ----------
    steps : int
        Number of periods of the motion, those of settling not counted.
    torques : (n_actuated,) float64
        Of the drives in the period last taken, as commanded, Nm.
    """

    def __init__(self, plant: Plant, motion: Scenario) -> None:
        self._plant, self._motion = plant, motion
        self._lowest = FALLEN * float(plant.data.qpos[2])
        self.steps = round(motion.duration / plant.period)
        self.torques = np.zeros(plant.model.nu)

    def settle(self) -> Iterator[Truth]:
        """Yield the instants before the motion, at negative times.

        Raises
        ------
        RobotFailureError
            As `advance` does.
        """
        for step in range(-round(SETTLING / self._plant.period), 0):
            yield self.advance(step)

    def advance(self, step: int, torques: FloatArray | None = None) -> Truth:
        """Take one period and return the truth of the instant at its beginning.

        Parameters
        ----------
        step : int
            Periods since the motion's beginning.
        torques : (n_actuated,) float64 or None
            Of the drives, Nm; None for those of the scenario's controller.

        Raises
        ------
        RobotFailureError
            When the robot falls, a joint runs into its end stop, or the controller has no torques.
        """
        plant, motion = self._plant, self._motion
        # Time is counted, not summed up: sums drift off the stamps.
        time = plant.data.time = step * plant.period
        state = plant.observe()
        self.torques = motion.controller.torques(state) if torques is None else torques
        if motion.hoist is not None:
            motion.hoist.pull(time)
        truth = plant.advance(self.torques)
        if state.position[2] < self._lowest:
            raise RobotFailureError("the robot fell", time, "ask for slower or smaller moves")
        joint = plant.joint_at_limit
        if joint is not None:
            raise RobotFailureError(
                f"joint {joint} ran into its end stop",
                time,
                "no sensor sees the force there: widen its range or ask for smaller moves",
            )
        return truth
