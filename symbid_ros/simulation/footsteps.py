"""Plans of steps: where the feet and the centre of mass go, and which feet carry load."""

from dataclasses import dataclass

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.controller import BalanceTask, Reference
from symbid_ros.simulation.controller_model import ControllerModel
from symbid_ros.simulation.plant import Plant
from symbid_ros.simulation.smooth_path import (
    MIDWAY_SPEED,
    CombinedPath,
    MinimumJerkPath,
    pendulum_path,
)

# The leg that is unloaded is the longer one, so the knees must be bent more than when standing; the
# trunk leans forward, which keeps the ankles away from their end stops.
LOWERING = 0.03  # m
LEANS = np.radians([8.0, 16.0])  # lowest and highest
BEGINNING, ENDING = 1.8, 1.8  # s, at rest on both feet
SHIFT = 1.0  # s, from one foot to the other
RAMP = 0.15  # s, of a foot's load after touch-down and before lift-off
# Steps are high and fast, since a leg that accelerates more tells more about its inertia. The
# limits are end stops: of the hip above a stance foot far ahead of the other foot, of the ankles
# between long steps, and of the undriven ankle joint of a foot that is lifted high.
SWING = 0.75  # s, of a step
LANDING = 1.0  # s, of a foot that has hovered
# Toes point down while a foot is lifted, because the ankle would reach its end stop; rad/m.
PITCH_PER_LIFT, HOVER_PITCH_PER_LIFT = 3.0, 2.0
STRIDES = 0.08  # m, forward or back, of a foot from a place beside the other
CLEARANCES = 0.14, 0.18  # m, of the ankle above its place on the ground
PRESSURES = 0.02  # m, forward or back from the middle of the sole
# Points where a foot hovers, forward, outward and up from where it stood, m. Fast moves outward
# would swing the foot, a pendulum about its undriven ankle joint, into its end stop.
HOVERS = np.array([[-0.08, -0.01, 0.04], [0.08, 0.03, 0.09]])
HOVER_TIMES = 1.0, 1.6  # s, from point to point


@dataclass(frozen=True)
class FootstepTask(BalanceTask):
    """Reference motion of a robot that lifts its feet.

    Attributes
    ----------
    feet : tuple of Reference
        Position in the world of the joint that carries each foot, and pitch of its sole (toes
        down), (3, 4), m and rad.
    loads : Reference
        For each foot, 1 while it may carry load, 0 while it is in the air, and a ramp between;
        (3, F).
    """

    feet: tuple[Reference, ...]
    loads: Reference


class FootstepPlanner:
    """Plans the motion of a robot on two feet, one event after the other.

    Parameters
    ----------
    com : (3,) float64
        Centre of mass at the start, m.
    feet : (2, 3) float64
        Joints that carry the feet at the start, m.
    """

    def __init__(self, com: FloatArray, feet: FloatArray) -> None:
        self._forward = np.array([com[0] - feet[:, 0].mean(), 0.0])
        self._pressure, self._height = MinimumJerkPath(com[:2]), MinimumJerkPath(com[2:])
        self._feet = [MinimumJerkPath(np.append(foot, 0.0)) for foot in feet]
        self._ground = feet[:, 2]
        self._loads, self._turn = MinimumJerkPath(np.ones(2)), MinimumJerkPath(np.zeros(3))
        self._now = 0.0

    def place(self, foot: int) -> FloatArray:
        """Return the place of a foot on the floor, (2,), m."""
        return self._feet[foot].end[:2]

    def wait(self, duration: float) -> None:
        """Let the feet rest for ``duration`` seconds."""
        self._now += duration

    def lower(self, depth: float, lean: float, duration: float) -> None:
        """Start to lower the centre of mass from its height, m, and to lean the trunk, rad."""
        self._height.rest_until(self._now)
        self._height.move_to(self._height.end - depth, duration)
        self.lean(lean, duration)

    def lean(self, angle: float, duration: float) -> None:
        """Start to lean the trunk forward, to ``angle`` (rad) from its attitude at the start."""
        self._turn.rest_until(self._now)
        self._turn.move_to(np.array([0.0, angle, 0.0]), duration)

    def shift(self, place: FloatArray, duration: float) -> None:
        """Move the centre of pressure to the sole of a foot at a place on the floor (2,), m."""
        self._pressure.rest_until(self._now)
        self._pressure.move_to(place + self._forward, duration)
        self._now += duration

    def load(self, foot: int, share: float) -> None:
        """Ramp the load of a foot: to 0 before lift-off, to 1 after touch-down."""
        self._loads.rest_until(self._now)
        loads = self._loads.end.copy()
        loads[foot] = share
        self._loads.move_to(loads, RAMP)
        self._now += RAMP

    def step(self, foot: int, place: FloatArray, clearance: float) -> None:
        """Swing a foot to a place (2,) on the floor; its joint rises by the clearance, m."""
        start, ground = self.place(foot), self._ground[foot]
        path = self._feet[foot]
        path.rest_until(self._now)
        top = np.append((start + place) / 2.0, [ground + clearance, PITCH_PER_LIFT * clearance])
        speed = np.append(MIDWAY_SPEED / SWING * (place - start), [0.0, 0.0])
        path.move_to(top, SWING / 2.0, speed)
        path.move_to(np.append(place, [ground, 0.0]), SWING / 2.0)
        self._now += SWING

    def hover(self, foot: int, place: FloatArray, height: float, duration: float) -> None:
        """Move a foot, in the air, to a height (m) above a place (2,) on the floor."""
        path = self._feet[foot]
        path.rest_until(self._now)
        raised = [self._ground[foot] + height, HOVER_PITCH_PER_LIFT * height]
        path.move_to(np.append(place, raised), duration)
        self._now += duration

    def task(self, attitude: FloatArray, pendulum_height: float, gravity: float) -> FootstepTask:
        """Return the motion so far.

        Parameters
        ----------
        attitude : (4,) float64
            Quaternion wxyz of the base in the world at the start.
        pendulum_height, gravity : float
            Of the inverted pendulum that the centre of mass follows, m and m/s².
        """
        for path in (self._pressure, self._height, self._turn, self._loads, *self._feet):
            path.rest_until(self._now)
        plane = pendulum_path(self._pressure.path(), pendulum_height, gravity)
        return FootstepTask(
            com=CombinedPath((plane, self._height.path())),
            attitude=attitude,
            turns=self._turn.path(),
            feet=tuple(foot.path() for foot in self._feet),
            loads=self._loads.path(),
        )


def draw_stepping_task(
    plant: Plant, sole_frames: tuple[str, ...], steps: int, seed: int
) -> FootstepTask:
    """Draw steps on the spot, forward and back, high and low.

    Parameters
    ----------
    plant : Plant
        Robot in its initial pose.
    sole_frames : tuple of str
        Sites of the soles, left before right.
    steps : int
        Number of steps.
    seed : int
        Seed of strides, clearances and leans.
    """
    random = np.random.default_rng([seed, 0])
    planner, model = _start(plant, sole_frames)
    across = planner.place(0) - planner.place(1)
    for number in range(steps):
        swing = (number + seed) % 2
        stance = planner.place(1 - swing)
        planner.lean(random.uniform(*LEANS), SHIFT)
        ahead = np.array([random.uniform(-PRESSURES, PRESSURES), 0.0])
        planner.shift(stance + ahead, SHIFT)
        planner.load(swing, 0.0)
        beside = stance + (across if swing == 0 else -across)
        stride = np.array([random.uniform(-STRIDES, STRIDES), 0.0])
        planner.step(swing, beside + stride, random.uniform(*CLEARANCES))
        planner.load(swing, 1.0)
    return _finish(planner, model)


def draw_one_leg_task(
    plant: Plant, sole_frames: tuple[str, ...], moves: int, seed: int
) -> FootstepTask:
    """Draw a stance on each leg in turn, while the other foot moves from point to point.

    Parameters
    ----------
    plant, sole_frames
        As in `draw_stepping_task`.
    moves : int
        Number of moves of each foot in the air.
    seed : int
        Seed of the points, and of the leg that comes first.
    """
    random = np.random.default_rng([seed, 0])
    planner, model = _start(plant, sole_frames)
    across = planner.place(0) - planner.place(1)
    outward = across / np.linalg.norm(across)
    for swing in (seed % 2, 1 - seed % 2):
        planner.shift(planner.place(1 - swing), SHIFT)
        planner.load(swing, 0.0)
        start = planner.place(swing).copy()
        for _ in range(moves):
            forward, out, up = random.uniform(*HOVERS)
            planner.lean(random.uniform(*LEANS), SHIFT)
            place = start + np.array([forward, 0.0]) + (out if swing == 0 else -out) * outward
            planner.hover(swing, place, up, random.uniform(*HOVER_TIMES))
        planner.hover(swing, start, HOVERS[0, 2], LANDING)
        planner.hover(swing, start, 0.0, LANDING)
        planner.load(swing, 1.0)
    return _finish(planner, model)


def _start(plant: Plant, sole_frames: tuple[str, ...]) -> tuple[FootstepPlanner, ControllerModel]:
    model = ControllerModel(plant.model, sole_frames)
    model.update(plant.observe())
    planner = FootstepPlanner(plant.com, np.stack([model.pivot(0), model.pivot(1)]))
    planner.lower(LOWERING, float(LEANS.mean()), SHIFT)
    planner.wait(BEGINNING)
    return planner, model


def _finish(planner: FootstepPlanner, model: ControllerModel) -> FootstepTask:
    planner.shift((planner.place(0) + planner.place(1)) / 2.0, SHIFT)
    planner.wait(ENDING)
    # About the joint of the foot, and longer than the centre of mass is high, as the stance leg
    # turns with the pendulum.
    _, about_sway = model.roll_inertia(0)
    height = float(model.com[2] - model.pivot(0)[2]) - LOWERING - about_sway / model.mass
    attitude = np.zeros(4)
    mujoco.mju_mat2Quat(attitude, model.trunk_rotation.ravel())
    return planner.task(attitude, height, -float(model.model.opt.gravity[2]))
