"""Balance control of a robot that lifts its feet."""

from dataclasses import dataclass

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.controller import CROSS, BalanceController, BalanceGains
from symbid_ros.simulation.footsteps import FootstepTask
from symbid_ros.simulation.plant import State


@dataclass(frozen=True)
class SteppingGains(BalanceGains):
    """Gains of the balance controller, of the swing foot and of balance on one leg.

    Attributes
    ----------
    wrench_weight : float
        Lower than for standing: the planned load of each foot is not that of the preference.
    swing_stiffness, swing_damping : float
        Feedback of the swing foot's position and pitch, 1/s² and 1/s.
    sway_rate : float
        Rate of each of the four poles of sideways balance on one leg, 1/s.
    """

    wrench_weight: float = 1e-5
    swing_stiffness: float = 150.0
    swing_damping: float = 24.0
    sway_rate: float = 4.0


class SteppingController(BalanceController):
    r"""Balance controller that also lifts, moves and lowers its feet.

    The QP's wrench at a sole is multiplied by the foot's load, which ramps to 0 before lift-off and
    from 0 after touch-down. A foot in the air follows its path: position of the joint that carries
    it, and pitch. Its roll is left to that joint, which has no drive. The trunk follows its pitch
    only: the legs cannot turn it about the vertical axis on flat feet.

    **Sideways balance on one leg.** The undriven joint transmits no moment about its axis, so the
    floor's force passes through it and the robot is an inverted pendulum on that axis. With y and
    z from the axis to the centre of mass, and L the angular momentum about the centre of mass,
    the angular momentum H about the axis changes by gravity alone::

        dH/dt = -m g y,    H = L + m (y dz/dt - z dy/dt)

    Only a change of L, a turn of trunk and swing leg, moves y. The integral of H, its first three
    derivatives H, -m g y and -m g dy/dt, and the commanded d²y/dt² are a chain of integrators.
    State feedback stabilises it with four equal poles (Azad & Featherstone 2016). For small
    motions, the integral of ``L = a droll/dt + b dy/dt`` gives that of H from the pose:
    ``a roll + (b - m z) y``. All are relative to those of the plan, a pendulum with upright trunk.

    Parameters
    ----------
    model, task, sole_frames, gains
        As in `BalanceController`; for two soles.
    """

    def __init__(
        self,
        model: mujoco.MjModel,
        task: FootstepTask,
        sole_frames: tuple[str, ...],
        gains: SteppingGains,
    ) -> None:
        super().__init__(model, task, sole_frames, gains)
        self._steps, self._gains = task, gains
        self._gravity = -float(model.opt.gravity[2])
        # Residuals of the CoM relative to the soles' weight, as in the base class.
        self._com_scale = float(np.sqrt(gains.com_weight / gains.sole_weight))
        self._moment_tasks = self._tasks[:6].copy()
        self._half_weights = self._preference[:, -1].copy()
        rate = gains.sway_rate
        weight = self._model.mass * self._gravity
        self._sway_gains = np.array(
            [rate**4 / weight, 4.0 * rate**3 / weight, -6.0 * rate**2, -4.0 * rate]
        )
        self._stance: int | None = None
        self._roll_inertia = np.zeros(2)

    def _set_tasks(self, state: State) -> None:
        model, tasks = self._model, self._tasks
        tasks[:6] = self._moment_tasks
        super()._set_tasks(state)
        tasks[6:9] = model.trunk_rotation @ tasks[6:9]
        loads = self._steps.loads.at(state.time)[0]
        feet = [foot.at(state.time) for foot in self._steps.feet]
        shares = self._planned_shares(state.time, feet)
        # The feet may have come down beside their planned places: move the CoM's path with them.
        offsets = [model.pivot(foot) - path[0, :3] for foot, path in enumerate(feet)]
        moved = np.append((shares @ np.stack(offsets))[:2], 0.0)
        tasks[:3, -1] -= self._com_scale * self._gains.com_stiffness * moved
        for foot, load in enumerate(loads.tolist()):
            block = slice(6 * foot, 6 * foot + 6)
            tasks[:, block] *= load
            self._preference[block, -1] = 2.0 * shares[foot] * self._half_weights[block]
            if load < 1.0:
                self._guide_foot(foot, 1.0 - load, feet[foot], state)
        airborne = 1.0 - float(loads.min())
        tasks[8] = 0.0
        tasks[3:7] *= 1.0 - airborne
        stance = int(np.argmax(loads)) if airborne else None
        if stance is not None:
            if stance != self._stance:
                self._roll_inertia = model.roll_inertia(stance)
            self._balance_sideways(stance, airborne, float(moved[1]), state)
        self._stance = stance

    def _planned_shares(self, time: float, feet: list[FloatArray]) -> FloatArray:
        """Return the share of the weight on each of the two feet, from the planned CoM, (2,)."""
        path, _, acceleration = self._task.com.at(time)[:, :2]
        pressure = path - float(self._model.com[2]) / self._gravity * acceleration
        right = feet[1][0, :2]
        across = feet[0][0, :2] - right
        share = min(max(float((pressure - right) @ across / (across @ across)), 0.0), 1.0)
        return np.array([share, 1.0 - share])

    def _guide_foot(self, foot: int, free: float, path: FloatArray, state: State) -> None:
        """Let a foot follow its path to the extent to which it is free of load, 0 to 1."""
        model, gains = self._model, self._gains
        rows = slice(6 * foot, 6 * foot + 6)
        tasks = self._tasks[9:][rows]
        place, rotation = model.sole_pose(foot)
        motion = np.dot(model.sole_jacobian[rows], state.velocity)
        spin, arm = motion[:3], model.pivot(foot) - place
        tasks[:, -1] -= free * gains.sole_damping * motion
        # From the sole's frame to the joint, whose motion does not depend on the undriven angle:
        # the sole cannot be moved sideways against the foot's swing.
        tasks[3:] -= free * np.dot((arm @ CROSS).reshape(3, 3), tasks[:3])
        error = np.append(model.pivot(foot), -np.arcsin(rotation[2, 0])) - path[0]
        rate = np.append(motion[3:] + np.cross(spin, arm), spin[1]) - path[1]
        wanted = path[2] - gains.swing_stiffness * error - gains.swing_damping * rate
        tasks[3:, -1] += free * (np.cross(spin, np.cross(spin, arm)) - wanted[:3])
        tasks[1, -1] -= free * wanted[3]
        tasks[[0, 2]] *= 1.0 - free

    def _balance_sideways(self, stance: int, airborne: float, moved: float, state: State) -> None:
        """Replace the feedback of the CoM's sideways motion by that of an inverted pendulum."""
        model, gains = self._model, self._gains
        path, speed, _ = self._task.com.at(state.time)[:, 1].tolist()
        _, y, z = (model.com - model.pivot(stance)).tolist()
        _, y_rate, z_rate = model.com_velocity.tolist()
        roll = float((model.trunk_rotation @ self._lean)[0])
        per_roll, per_sway = self._roll_inertia.tolist()
        upright = per_sway - model.mass * z
        ahead, ahead_rate = float(model.com[1]) - path - moved, y_rate - speed
        momentum = float(model.angular_momentum[0]) + model.mass * (y * z_rate - z * y_rate)
        chain = np.array(
            [per_roll * roll + upright * ahead, momentum - upright * speed, ahead, ahead_rate]
        )
        standing = -gains.com_stiffness * ahead - gains.com_damping * ahead_rate
        change = float(self._sway_gains @ chain) - standing
        self._tasks[1, -1] -= self._com_scale * airborne * change
