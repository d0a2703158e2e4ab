"""Plain weighted least squares, the reference for identification from logs of real robots.

The steps are those of textbooks (Khalil and Dombre 2002, ch. 12; Gautier 1997): a zero-phase
low-pass of the motion, central differences, the same low-pass for columns and torques ("parallel
filtering"), one row for each joint and instant, rows weighted by the standard deviation of their
joint's residuals, and the solution of least norm. There is no prior.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from real_data import FloatArray, Recording, base_readings, low_pass
from scipy.interpolate import make_interp_spline
from scipy.spatial.transform import Rotation
from scipy.stats import t as student_t

import symbid_ros as sy
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses

SLIPPING = 0.02  # rad/s; below it, a joint may stick
RATE = 500.0  # Hz at most, at which columns are computed; a divisor of the log's rate
ROWS_PER_SECOND = 100.0
EDGE = 2.0  # periods of the low-pass that its transient disturbs at both ends
MOTION = 4.0  # cutoff of the motion, in cutoffs of the rows: the motion drives faster terms
REWEIGHTINGS = 5
BLOCK, FEWEST_BLOCKS = 1.0, 5  # s of errors that are taken as one, and least number of these
LEVELLING = 4.0  # s over which the base hardly accelerates in the mean


@dataclass(frozen=True)
class Sampled:
    """A recording after filtering and differentiation.

    Attributes
    ----------
    position, velocity, acceleration : (N, J) float64
        On a uniform clock.
    base : BaseMotion or None
        Of a floating base, on the same clock.
    force : (M, n) float64
        Measured generalised forces after the low-pass, every ``stride`` instants without the
        edges; NaN where there are none.
    period : float
        Of the clock, s.
    cutoff : float
        Of the rows' low-pass, Hz.
    kept : slice
        Instants of the rows.
    contacts : (N, n, n) float64 or None
        Projections onto the generalised forces that no force at a contact changes.
    slipping : float
        Speed below which a joint may stick, rad/s; its rows are not used.
    """

    position: FloatArray
    velocity: FloatArray
    acceleration: FloatArray
    base: sy.BaseMotion | None
    force: FloatArray
    period: float
    cutoff: float
    kept: slice
    slipping: float = SLIPPING
    contacts: FloatArray | None = None

    def filtered(self, values: FloatArray) -> FloatArray:
        """Return values (N, ...) as rows (M, ...), filtered as the measured forces are."""
        if self.contacts is not None:
            values = np.einsum("tij,tj...->ti...", self.contacts, values)
        return low_pass(values, self.period, self.cutoff)[self.kept]

    @property
    def is_used(self) -> np.ndarray:
        """(M, n) rows that are measured and whose joint slips."""
        used = np.isfinite(self.force)
        joints = self.velocity.shape[1]
        if self.contacts is None and np.isfinite(self.force[:, -joints:]).any():
            used[:, -joints:] &= np.abs(self.velocity[self.kept]) >= self.slipping
        return used


def sample(
    robot: sy.RobotModel,
    recording: Recording,
    cutoff: float,
    slipping: float = SLIPPING,
    contacts: Sequence[str] = (),
) -> Sampled:
    """Resample to a uniform clock, filter, differentiate, and choose the instants of the rows.

    Rows near pauses of the recording are not used.
    """
    measured = float(np.median(np.diff(recording.time)))
    thinning = max(1, int(1 / (RATE * measured)))
    period = thinning * measured
    clock = np.arange(recording.time[0], recording.time[-1], measured)

    def uniform(values: FloatArray, limit: float) -> FloatArray:
        linear = make_interp_spline(recording.time, values, k=1)(clock)
        return low_pass(linear, measured, limit)

    position = uniform(recording.position, MOTION * cutoff)
    velocity = np.gradient(position, measured, axis=0)
    acceleration = np.gradient(velocity, measured, axis=0)
    force = np.full_like(position, np.nan)
    has_effort = np.isfinite(recording.effort).any(axis=0)
    force[:, has_effort] = uniform(recording.effort[:, has_effort], cutoff)
    base = None
    if recording.pose is not None:
        readings = base_readings(recording, robot.gravity)
        imu, wrench = uniform(readings.imu, np.inf), uniform(readings.wrench, cutoff)
        force = np.hstack([wrench[:, 3:], wrench[:, :3], force])
        turn = np.gradient(imu[:, :3], measured, axis=0)
        base = sy.BaseMotion(*(each[::thinning] for each in (imu[:, :3], turn, imu[:, 3:])))
    if recording.imu is not None:
        imu = uniform(recording.imu, MOTION * cutoff)
        turn = np.gradient(imu[:, :3], measured, axis=0)
        base = sy.BaseMotion(*(each[::thinning] for each in (imu[:, :3], turn, imu[:, 3:])))
        force = np.hstack([np.zeros((len(force), 6)), uniform(recording.effort, MOTION * cutoff)])
    position, velocity, acceleration, force, clock = (
        each[::thinning] for each in (position, velocity, acceleration, force, clock)
    )
    edge = round(EDGE / cutoff / period)
    kept = slice(edge, len(force) - edge, max(1, round(1 / (ROWS_PER_SECOND * period))))
    motion = position, velocity, acceleration, base
    paused = is_near_pause(recording.time, clock[kept], EDGE / cutoff)
    if not contacts:
        force = force[kept]
        force[paused] = np.nan
        return Sampled(*motion, force, period, cutoff, kept, slipping)
    above = np.zeros_like(position[:, :3]) if base is None else upward(base, period)
    projections = contact_projections(robot, position, contacts, above)
    found = Sampled(*motion, force[kept], period, cutoff, kept, slipping, projections)
    projected = found.filtered(force)
    projected[paused] = np.nan
    return replace(found, force=projected)


def upward(base: sy.BaseMotion, period: float) -> FloatArray:
    """Return the direction away from the earth (N, 3) in base axes.

    The mean specific force over a few seconds points there, in axes that the gyroscope holds.
    """
    above = np.empty_like(base.specific_force)
    for start in range(0, len(above), round(LEVELLING / period)):
        part = slice(start, start + round(LEVELLING / period))
        turn = Rotation.identity()
        turned = []
        for rate in base.angular_velocity[part]:
            turned.append(turn)
            turn = turn * Rotation.from_rotvec(rate * period)
        axes = Rotation.concatenate(turned)
        mean = axes.apply(base.specific_force[part]).mean(axis=0)
        above[part] = axes.inv().apply(mean / np.linalg.norm(mean))
    return above


def contact_projections(
    robot: sy.RobotModel, position: FloatArray, contacts: Sequence[str], above: FloatArray
) -> FloatArray:
    """Return P (N, n, n): onto the generalised forces that no force at a contact changes.

    P = 1 - J⁺ J with the Jacobian J of the contacts' points (Mistry, Buchli and Schaal 2010, ICRA):
    the lowest points of the feet's balls, for the directions ``above`` (N, 3) in base axes.
    """
    poses = link_poses(robot, position)
    jacobian = contact_jacobian(robot, tuple(contacts), poses)
    J = np.empty((len(position), 3 * len(contacts), jacobian.shape[2]))
    for index, frame in enumerate(map(robot.frame, contacts)):
        axes = poses.rotation[:, frame.link] @ frame.rotation
        bottom = -frame.radius * np.einsum("tji,tj->ti", axes, above)
        moments, forces = (jacobian[:, 6 * index + k : 6 * index + k + 3] for k in (0, 3))
        lever = np.cross(bottom[:, None], np.eye(3))  # of unit forces, their moments
        J[:, 3 * index : 3 * index + 3] = forces + lever @ moments
    P: FloatArray = np.eye(J.shape[2]) - np.linalg.pinv(J) @ J
    return P


def is_near_pause(time: FloatArray, clock: FloatArray, margin: float) -> np.ndarray:
    """Return which instants (M,) are within a margin (s) of a pause of a recording."""
    steps = np.diff(time)
    pauses = np.flatnonzero(steps > 20 * np.median(steps))
    near = np.zeros(len(clock), bool)
    for index in pauses:
        near |= (clock > time[index] - margin) & (clock < time[index + 1] + margin)
    return near


def columns(
    robot: sy.RobotModel,
    samples: Sampled,
    terms: Sequence[str],
    extra: FloatArray | None = None,
) -> FloatArray:
    """Return the filtered regressor (M, n, p), with further columns from (N, n, k)."""
    links = sy.regressor(
        robot, samples.position, samples.velocity, samples.acceleration, base=samples.base
    )
    factors = {
        "viscous": samples.velocity,
        "coulomb": np.sign(samples.velocity),
        "offset": np.ones_like(samples.velocity),
        "armature": samples.acceleration,
    }
    count, joints = samples.velocity.shape
    first = links.shape[1] - joints
    parts = [links]
    for term in terms:
        part = np.zeros((count, links.shape[1], joints))
        part[:, first + np.arange(joints), np.arange(joints)] = factors[term]
        parts.append(part)
    if extra is not None:
        parts.append(extra)
    return np.concatenate([samples.filtered(part) for part in parts], axis=2)


def solve(regressor: FloatArray, samples: Sampled) -> FloatArray:
    """Return the parameters (p,) of weighted least squares."""
    used = samples.is_used
    force = np.where(used, samples.force, 0.0)
    weight = np.ones(force.shape[1])
    for _ in range(REWEIGHTINGS):
        rows = (regressor * weight[:, None])[used]
        # A column that differs from a combination of others by rounding or noise of the
        # differentiation alone counts as dependent.
        scale = np.linalg.norm(rows, axis=0)
        scale[scale < 1e-12 * scale.max()] = 1.0  # zero but for rounding
        found = np.linalg.lstsq(rows / scale, (force * weight)[used], rcond=1e-8)[0] / scale
        squares = np.where(used, force - regressor @ found, 0.0) ** 2
        spread = np.sqrt(squares.sum(axis=0) / np.maximum(used.sum(axis=0), 1))
        weight = 1.0 / np.maximum(spread, 1e-9)
    return found


@dataclass(frozen=True)
class Score:
    """Prediction errors, percent of the measured force, on rows that are used.

    Attributes
    ----------
    each : (n,) float64
        100 ‖e‖/‖y‖ of each coordinate.
    overall : float
        The same of all coordinates together.
    squares : (M,) float64
        Squared errors of the rows, summed over the coordinates.
    """

    each: FloatArray
    overall: float
    squares: FloatArray


def score(samples: Sampled, predicted: FloatArray) -> Score:
    used = samples.is_used
    error = np.where(used, samples.force - predicted, 0.0)
    force = np.where(used, samples.force, 0.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        each = 100.0 * np.linalg.norm(error, axis=0) / np.linalg.norm(force, axis=0)
    overall = float(100.0 * np.linalg.norm(error) / np.linalg.norm(force))
    return Score(each, overall, (error**2).sum(axis=1))


def error_ratio(found: Score, reference: Score, samples: Sampled) -> tuple[float, float, float]:
    """Return the ratio of two errors, and the ends of its 90 % interval.

    Errors of neighbouring rows are alike, those of blocks of a second are taken as independent, in
    short logs those of shorter blocks (Cochran 1977, Sampling Techniques, section 6.4, with
    Student's t for few blocks).
    """
    rate = 1.0 / (samples.period * (samples.kept.step or 1))
    count = max(FEWEST_BLOCKS, round(len(found.squares) / (BLOCK * rate)))
    ours, theirs = (
        np.array([part.sum() for part in np.array_split(one.squares, count)])
        for one in (found, reference)
    )
    ratio = ours.sum() / theirs.sum()
    spread = np.sqrt(((ours - ratio * theirs) ** 2).sum() * count / (count - 1)) / theirs.sum()
    margin = student_t.ppf(0.95, count - 1) * spread
    low, high = max(ratio - margin, 0.0), ratio + margin
    return float(np.sqrt(ratio)), float(np.sqrt(low)), float(np.sqrt(high))
