"""One run of a scenario on a plant, a period at a time, watched for its breakdown."""

from collections.abc import Iterator

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
    """

    def __init__(self, plant: Plant, motion: Scenario) -> None:
        self._plant, self._motion = plant, motion
        self._lowest = FALLEN * float(plant.data.qpos[2])
        self.steps = round(motion.duration / plant.period)

    def settle(self) -> Iterator[Truth]:
        """Yield the instants before the motion, at negative times.

        Raises
        ------
        BreakdownError
            As `advance` does.
        """
        for step in range(-round(SETTLING / self._plant.period), 0):
            yield self.advance(step)

    def advance(self, step: int) -> Truth:
        """Take one period and return the truth of the instant at its beginning.

        Raises
        ------
        BreakdownError
            When the robot falls, a joint runs into its end stop, or the controller has no torques.
        """
        plant, motion = self._plant, self._motion
        # Time is counted, not summed up: sums drift off the stamps.
        time = plant.data.time = step * plant.period
        state = plant.observe()
        torques = motion.controller.torques(state)
        if motion.hoist is not None:
            motion.hoist.pull(time)
        truth = plant.advance(torques)
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
