"""A designed trajectory, with what it will tell before anyone moves."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.estimation.directions import DETERMINED, count_determined, describe_determined
from symbid_ros.excitation.limits import with_stated_limits
from symbid_ros.excitation.objective import MotionSpace
from symbid_ros.excitation.options import STANDING, ExciteOptions
from symbid_ros.excitation.problem import ExcitationProblem, fixed_base_problem
from symbid_ros.excitation.standing import standing_problem
from symbid_ros.excitation.standing_motion import StandingMotion
from symbid_ros.model.tree import RobotModel
from symbid_ros.options import options_of, refuse_unused
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions
from symbid_ros.simulation.tracking import effort_std


def excitation_problem(
    robot: RobotModel,
    options: ExciteOptions,
    sensors: JointSensorOptions,
    base_sensors: BaseSensorOptions | None = None,
) -> ExcitationProblem:
    """Check a robot and options, and return what a trajectory is designed for.

    Raises
    ------
    SymbidError
        When the base floats and no feet are named, no joint is driven, the robot cannot stand, or
        an option is invalid.
    """
    robot = robot.with_gravity(options.gravity)
    if options.limits is not None:
        robot = with_stated_limits(robot, options.limits)
    if options.feet:
        return standing_problem(robot, options, sensors, base_sensors or BaseSensorOptions())
    # A robot file may name contacts.
    standing = {one.name for one in options_of(ExciteOptions) if one.group == STANDING}
    refuse_unused(options, "without `feet`; leave it out", standing - {"contact"})
    refuse_unused(base_sensors or BaseSensorOptions(), "without `feet`; leave it out")
    return fixed_base_problem(robot, options, sensors)


@dataclass(frozen=True)
class ExcitationPlan:
    """A designed trajectory with its expected result.

    Attributes
    ----------
    problem : ExcitationProblem
    coefficients : (m, D) float64
        Of the Fourier series of each coordinate.
    validation : (m, D) float64
        Of another, random trajectory within the limits, to validate the result.
    is_complete : bool
        Whether the search ended by itself.
    """

    problem: ExcitationProblem
    coefficients: FloatArray
    validation: FloatArray
    is_complete: bool = True

    @property
    def joints(self) -> MotionSpace:
        """The coordinates and joints that move."""
        return self.problem.design.expected.joints

    @cached_property
    def factor(self) -> FloatArray:
        """(p, r) L of the covariance expected after the recording."""
        return self.problem.expected_factor(self.coefficients)

    @cached_property
    def std(self) -> FloatArray:
        """(p,) expected standard deviations."""
        return np.asarray(np.linalg.norm(self.factor, axis=1))

    @property
    def determined(self) -> BoolArray:
        """(p,) parameters that the recording is expected to determine."""
        return np.asarray(self.std < DETERMINED * self.problem.prior_std)

    def describe_determined(self) -> str:
        """Return how many parameter combinations and single parameters will be determined."""
        combinations = count_determined(self.problem.design.expected.factor, self.factor)
        return describe_determined(combinations, int(np.sum(self.determined)), len(self.std))

    @property
    def gain(self) -> float:
        """Expected gain of information, bit."""
        return self.problem.design.gain(self.coefficients) / float(np.log(2))

    def motion(self, time: FloatArray) -> FloatArray:
        """Return position, velocity and acceleration of the joints that move, (3, N, D)."""
        samples, moved = self.joints.samples(self.course(time)), list(self.joints.indices)
        orders = samples.position, samples.velocity, samples.acceleration
        return np.ascontiguousarray(np.stack([order[:, moved] for order in orders]))

    def course(self, time: FloatArray) -> FloatArray:
        """Return coordinates, their rates and accelerations (3, N, C) at times (N,), s."""
        return self.problem.design.series.motion(self.coefficients, time)

    def torque(self, time: FloatArray) -> FloatArray:
        """Return the torques (N, D) that the model's values need, Nm or N."""
        expected, course = self.problem.design.expected, self.course(time)
        return self.joints.torques(course, expected.rows(course) @ expected.values)

    def usage(self) -> dict[str, FloatArray]:
        """Return the largest share (D,) of each complete limit that is used, by its name."""
        return self.problem.limits.usage(self.motion(self._period), self.torque(self._period))

    @property
    def independent(self) -> list[tuple[int, str]]:
        """Indices (of D) and names of the joints that do not just follow another one."""
        followers = self.joints.model.followers
        moved = zip(self.joints.indices, self.joints.names, strict=True)
        return [
            (index, name) for index, (place, name) in enumerate(moved) if place not in followers
        ]

    @property
    def noisy(self) -> list[str]:
        """Names of the joints whose planned efforts, root mean square, are below their noise."""
        planned = np.sqrt(np.mean(self.torque(self._period) ** 2, axis=0))
        noise = effort_std(self.problem.sensors, self.problem.capacity)[list(self.joints.indices)]
        return [name for index, name in self.independent if planned[index] < noise[index]]

    @cached_property
    def contact_usage(self) -> dict[str, float]:
        """Largest share of each limit of the contacts, by its name; none on a fixed base."""
        if not isinstance(self.joints, StandingMotion):
            return {}
        expected, course = self.problem.design.expected, self.course(self._period)
        shares = self.joints.contact_shares(course, expected.rows(course) @ expected.values)
        return {name: float(each.max()) for name, each in shares.items()}

    @property
    def _period(self) -> FloatArray:
        """Dense instants of one period, s."""
        design = self.problem.design
        return np.linspace(0, design.series.period, 20 * design.samples)

    @cached_property
    def closest(self) -> tuple[float, str] | None:
        """Smallest distance, m, and names of the two links; None if nothing has a shape."""
        clearance = self.problem.design.clearance
        if clearance is None:
            return None
        time = self.problem.design.instants(4 * self.problem.design.samples)
        return clearance.smallest(self.joints.samples(self.course(time)).position)

    @property
    def approach(self) -> float:
        """Seconds in which any posture within the limits reaches the start at a safe speed."""
        limits = self.problem.design.limits
        # A quintic from rest to rest has 15/8 of its mean speed in the middle.
        return float(np.ceil(1.875 * np.max(2 * limits.half_width / limits.speed)))
