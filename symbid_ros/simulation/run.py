"""One run of a scenario on a plant, a period at a time, watched for its breakdown."""

from collections.abc import Iterator

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.simulation.breakdown import BreakdownError
from symbid_ros.simulation.plant import Plant, Truth
from symbid_ros.simulation.scenario import Scenario

# Long enough for feet and hoist to take the load; none of it counts.
SETTLING = 1.0  # s
# A robot whose base has come down this far does not stand any more.
FALLEN = 0.7  # of the height at the start


class Run:
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
        BreakdownError
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
        BreakdownError
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
            raise BreakdownError("the robot fell", time, "ask for slower or smaller moves")
        joint = plant.joint_at_limit
        if joint is not None:
            raise BreakdownError(
                f"joint {joint} ran into its end stop",
                time,
                "no sensor sees the force there: widen its range or ask for smaller moves",
            )
        return truth
