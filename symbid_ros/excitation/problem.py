"""What a trajectory is designed for: a robot, its limits and sensors, and what is known of it."""

from dataclasses import dataclass, replace
from typing import cast

import numpy as np
from scipy.ndimage import minimum_filter1d

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.choices import Term
from symbid_ros.dynamics.friction import slipping
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import OptionError
from symbid_ros.estimation.prior import Prior, planning_prior
from symbid_ros.excitation.clearance import Clearance
from symbid_ros.excitation.fourier import DrivenJoints, FourierSeries
from symbid_ros.excitation.limits import JointLimits, joint_limits
from symbid_ros.excitation.objective import ExpectedInformation
from symbid_ros.excitation.optimizer import Design
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.identification.result_files import load_estimated_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.joint_sensors import JointSensorOptions
from symbid_ros.simulation.tracking import effort_capacity, effort_std, position_std

DESIGN_TERMS = "viscous", "coulomb", "armature", "offset"
DEFAULT_TERMS = "viscous", "coulomb", "armature"
# Window whose rows are expected, s: the noise of positions enters through their second derivative.
WINDOW = 0.161
# A window of length W weights readings by its Hann shape, and readings to be differentiated by the
# shape's derivatives. Their rms is (π / W) √(4/3) and 2 (π / W)² √(4/3) of the shape's own.
FIRST_DERIVATIVE = np.pi / WINDOW * np.sqrt(4 / 3)
SECOND_DERIVATIVE = 2 * (np.pi / WINDOW) ** 2 * np.sqrt(4 / 3)
SAMPLES_PER_HARMONIC = 20
POSTURES = 200  # random ones, for mean inertias and for pairs of links that are always close


@dataclass(frozen=True)
class ExcitationProblem:
    """A robot, its limits and sensors: everything that a trajectory is designed for.

    Attributes
    ----------
    options : ExciteOptions
    sensors : JointSensorOptions
    limits : JointLimits
        Complete limits of the joints that move; the trajectory uses shares of them.
    design : Design
    capacity : (J,) float64
        Largest effort of each joint, Nm or N, of which the noise of efforts is a share.
    unchecked : tuple of str
        Collisions that are not checked.
    prior : Prior or None
        Distribution before the motion; None if it is that of an earlier result.
    """

    options: ExciteOptions
    sensors: JointSensorOptions
    limits: JointLimits
    design: Design
    capacity: FloatArray
    unchecked: tuple[str, ...] = ()
    prior: Prior | None = None

    @property
    def parameters(self) -> ParameterSet:
        """The p parameters."""
        return self.design.expected.parameters

    @property
    def prior_std(self) -> FloatArray:
        """(p,) standard deviations before the motion."""
        return np.asarray(np.linalg.norm(self.design.expected.factor, axis=1))

    def expected_factor(self, coefficients: FloatArray) -> FloatArray:
        """Return L (p, r) of the covariance L Lᵀ after a recording of the trajectory.

        Unlike the gain that is optimised, this counts a joint with friction only while it slips
        during a whole window, as an identification does.
        """
        design, expected = self.design, self.design.expected
        count = round(design.series.period * self.sensors.rate)
        time = np.arange(count) / self.sensors.rate
        samples = expected.joints.samples(design.series.motion(coefficients, time))
        K = equation_of_motion(expected.parameters, samples).K
        if {"viscous", "coulomb"} & set(expected.parameters.terms):
            used = slipping(expected.parameters, samples.velocity)
            width = max(1, round(WINDOW * self.sensors.rate))
            kept = minimum_filter1d(used.astype(np.int8), width, axis=0, mode="wrap")
            _leave_out_sticking(expected.parameters, K, kept.astype(bool))
        information = expected.information(K) * design.seconds / design.series.period
        return expected.posterior_factor(information)


def _leave_out_sticking(parameters: ParameterSet, K: FloatArray, slips: BoolArray) -> None:
    """Set the rows (N, n, p) of joints that stick to zero, given which slip (N, J)."""
    first, contacts = 6 * parameters.model.floating, parameters.model.contacts
    K[:, first:] *= slips[..., None]
    if contacts is not None:  # one joint that sticks enters all combined rows
        loaded = np.asarray(np.any(contacts.loads, axis=0))
        K[:, loaded] *= np.all(slips[:, loaded[first:]], axis=1)[:, None, None]


def fixed_base_problem(
    robot: RobotModel, options: ExciteOptions, sensors: JointSensorOptions
) -> ExcitationProblem:
    """Check a robot on a fixed base, and return what a trajectory is designed for.

    Raises
    ------
    SymbidError
        When the base floats, no joint is driven, or an option is invalid.
    """
    if robot.floating:
        raise OptionError(
            f"{robot.source}: its base floats; give `feet` for a robot that stands on them, or "
            "`base` fixed for one whose base is clamped",
            "E581",
        )
    parameters, values, factor, prior = known_before(robot, options)
    indices = _moving(robot, options.joints)
    named = {robot.joint_names[index]: robot.joints[index] for index in indices}
    limits = joint_limits(named, {}, options.limits)
    used = limits.scaled(options.position_share, options.speed_share, options.effort_share)
    posture = np.array([min(max(0.0, joint.lower), joint.upper) for joint in robot.joints])
    posture[list(indices)] = limits.centre
    joints = DrivenJoints(parameters.model, indices, posture, used.effort)
    series = FourierSeries(options.period, options.harmonics)
    expected = ExpectedInformation(parameters, values, factor, np.eye(robot.dof), joints)
    postures = _random_postures(joints, used)
    capacity, remarks = _capacity(robot, limits)
    limits = replace(limits, assumed=(*limits.assumed, *remarks))
    precision = _precision(robot, sensors, capacity, expected, postures)
    # Random motions are about postures in the middle half of the ranges, so that two links that
    # are always close there leave none.
    clearance, unchecked = _clearance(
        parameters.model, options, joints, (used.centre + postures) / 2
    )
    return ExcitationProblem(
        options,
        sensors,
        limits,
        Design(
            series,
            replace(expected, precision=precision),
            used,
            clearance,
            SAMPLES_PER_HARMONIC * options.harmonics,
            sensors.rate,
            series.period * np.ceil(options.seconds / series.period - 1e-9),
        ),
        capacity,
        unchecked,
        prior,
    )


def _clearance(
    robot: RobotModel, options: ExciteOptions, joints: DrivenJoints, postures: FloatArray
) -> tuple[Clearance | None, tuple[str, ...]]:
    """Return the distances to keep, and what is not checked."""
    if options.no_collision:
        return None, ("collisions, as `no_collision` says",)
    motion = np.zeros((3, *postures.shape))
    motion[0] = postures
    position = joints.samples(motion).position
    clearance = Clearance(robot, options.clearance, position, options.floor)
    remarks = clearance.remarks
    if options.floor is None:
        remarks = (*remarks, "a floor or table; give `floor`")
    return (None if clearance.is_empty else clearance), remarks


def known_before(
    robot: RobotModel, options: ExciteOptions
) -> tuple[ParameterSet, FloatArray, FloatArray, Prior | None]:
    """Return the parameters, their expected values, L of their covariance, and their prior."""
    robot.require_mass()
    if options.information is not None:
        folder = options.information
        if not folder.exists():
            raise OptionError(
                f"`information`: {folder} does not exist; give the folder of an identification, or "
                "its information.npz",
                "E401",
            )
        known = load_estimated_model(folder if folder.is_dir() else folder.parent, robot)
        unknown = set(known.parameters.terms) - set(DESIGN_TERMS)
        found = known.parameters
        further = found.couplings or found.ripples or found.warming
        if known.deviation_factor is None or unknown or further:
            raise OptionError(
                f"{folder}: has no covariance of links, viscous, coulomb, armature and offset "
                "alone; identify with `method` map_lmi and name these `joint_terms`",
                "E582",
            )
        return known.parameters, known.values, known.deviation_factor, None
    named = [name for part in ",".join(options.joint_terms).split(",") if (name := part.strip())]
    terms = DEFAULT_TERMS if named in ([], ["auto"]) else tuple(named)
    if unknown_terms := set(terms) - {*DESIGN_TERMS, "none"}:
        raise OptionError(
            f"`joint_terms`: {min(unknown_terms)!r} cannot be planned; give none or any of "
            f"{', '.join(DESIGN_TERMS)}",
            "E501",
        )
    chosen = () if "none" in terms else cast(tuple[Term, ...], terms)
    parameters = ParameterSet(robot, chosen)
    prior = planning_prior(parameters, options.prior_percent)
    return parameters, prior.mean, prior.covariance_factor(), prior


def _moving(robot: RobotModel, names: tuple[str, ...]) -> tuple[int, ...]:
    """Return the joints that move: those named, or all that have a drive and a range."""
    named = [name for part in ",".join(names).split(",") if (name := part.strip())]
    for name in named:
        if name not in robot.measured_joint_names:
            raise OptionError(
                f"`joints`: {robot.source} has no joint {name!r} that moves by itself; name any of "
                f"{', '.join(robot.measured_joint_names)}",
                "E583",
            )
    chosen = []
    for name in named or robot.measured_joint_names:
        joint = robot.joints[robot.joint_names.index(name)]
        if joint.effort > 0 and joint.lower < joint.upper:
            chosen.append(robot.joint_names.index(name))
        elif named:
            raise OptionError(
                f"{robot.source}: joint {name} has no range or no effort, so no drive moves it; "
                "give them by `limits`, or leave it out of `joints`",
                "E583",
            )
    if not chosen:
        raise OptionError(
            f"{robot.source}: no joint has a range and an effort above zero; give them by "
            "`limits`, or correct the model",
            "E583",
        )
    return tuple(chosen)


def _random_postures(joints: DrivenJoints, limits: JointLimits) -> FloatArray:
    """Return positions (N, D) within the limits, the same in every call."""
    shares = np.random.default_rng(0).uniform(-1, 1, (POSTURES, len(limits.names)))
    return np.asarray(limits.centre + shares * limits.half_width)


def _capacity(robot: RobotModel, limits: JointLimits) -> tuple[FloatArray, tuple[str, ...]]:
    """Return the largest effort (J,) of each joint, and remarks about those without a limit."""
    capacity = effort_capacity(robot)
    remarks = []
    for name, effort in zip(limits.names, limits.effort.tolist(), strict=True):
        place = robot.joint_names.index(name)
        if np.isfinite(effort):
            capacity[place] = effort
        else:
            remarks.append(f"{name}: noise of efforts as for a drive of {capacity[place]:.3g}")
    return capacity, tuple(remarks)


def _precision(
    robot: RobotModel,
    sensors: JointSensorOptions,
    capacity: FloatArray,
    expected: ExpectedInformation,
    postures: FloatArray,
) -> FloatArray:
    """Return the precision (J, J) of one sample's rows, from the noise of efforts and positions.

    Positions are differentiated twice, as :data:`SECOND_DERIVATIVE` says.
    """
    variance = effort_std(sensors, capacity) ** 2
    acceleration = SECOND_DERIVATIVE * position_std(sensors, robot)
    moved = np.flatnonzero(np.isin(np.arange(len(robot.joints)), expected.joints.indices))
    motion = np.zeros((3, *postures.shape))
    motion[0] = postures
    rest = expected.rows(motion) @ expected.values
    for place, joint in enumerate(moved):
        motion[2] = 0.0
        motion[2, :, place] = 1.0
        inertia = expected.rows(motion) @ expected.values - rest
        variance = variance + np.mean(inertia**2, axis=0) * acceleration[joint] ** 2
    return np.diag(1.0 / variance)
