"""Balance by the robot's own sensors: a controller that can run beside the plant."""

from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.controller import BalanceController, BalanceGains
from symbid_ros.simulation.leg_odometry import BalanceReadings, LegOdometry
from symbid_ros.simulation.plant import Plant
from symbid_ros.simulation.scenario import SOLES, STANDING, require_seed, standing_task


class StandingController:
    """Stands and moves as a scenario says, told nothing but readings of the sensors.

    With the plant it shares the model file and the numbers from which the moves are drawn.
    Stamps that run back are a new beginning, of the moves and of the odometry.

    Parameters
    ----------
    scenario : str
        ``smooth`` or ``squat``.
    moves : int
        Number of moves.
    motion_seed : int
        Decides the moves.
    model_path : Path or None
        MJCF that it believes the robot to be; None for config/symbitron.xml.

    Attributes
    ----------
    joint_names : tuple of str
        Order of joint arrays.
    drive_names : tuple of str
        The joint of each drive, order of torques.
    duration : float
        Of the moves, s; it goes on standing after them.
    """

    def __init__(
        self,
        scenario: str = "smooth",
        *,
        moves: int = 20,
        motion_seed: int = 0,
        model_path: Path | None = None,
    ) -> None:
        if scenario not in STANDING:
            raise SimulationError(
                f"no standing in scenario {scenario!r}; choose one of {', '.join(STANDING)}"
            )
        require_seed("motion seed", motion_seed)
        robot = Plant(model_path or config_file("symbitron.xml"), SOLES)
        self.joint_names, self.drive_names = robot.joint_names, robot.drive_names
        self._period = robot.period
        self._limits = robot.torque_limits
        self._robot, self._stamp = robot, 0
        self._task = standing_task(robot, moves, motion_seed, *STANDING[scenario])
        self.duration = self._task.duration
        self._restart()

    def _restart(self) -> None:
        robot = self._robot
        self._odometry = LegOdometry(robot.model, robot.data.qpos, SOLES)
        # A new one, lest its programme's last solution be where the next begins.
        self._controller = BalanceController(robot.model, self._task, SOLES, BalanceGains())

    def torques(self, readings: BalanceReadings) -> FloatArray:
        """Return the drives' torques (n_actuated,), Nm, that answer readings of one instant.

        Raises
        ------
        BreakdownError
            When there are none.
        """
        if readings.stamp < self._stamp:
            self._restart()
        self._stamp = readings.stamp
        # The motion's first instant is stamped with one period: 0 is no time.
        time = 1e-9 * readings.stamp - self._period
        wanted = self._controller.torques(self._odometry.state(time, readings))
        # The programme keeps to the limits within its tolerance, a plant may not forgive that.
        return np.clip(wanted, *self._limits.T)
