"""Rows for joint placements and encoder offsets from soles at rest on the floor.

While two soles rest on the floor, the pose of one relative to the other is constant, and so is the
pose of each in the world if that of the base is measured, as by motion capture. What the encoders
and the model say of it varies if lengths, axes or offsets are wrong. These rows contain no force,
so that they separate the geometry from inertias. The constant pose itself is unknown.

Soles and floors yield a little under the load, which shifts from foot to foot with the posture and
so resembles wrong lengths. Their compliance is estimated and eliminated.

A measured pose also gives the common scale of all lengths. How the tracked frame is fixed to its
link, and how late the poses are, are unknown too. These unknowns are eliminated.
"""

import logging
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import KINEMATIC_ERRORS
from symbid_ros.dynamics.kinematics import joint_axes, link_poses
from symbid_ros.dynamics.placements import screws_at_base
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.calibrating_rows import LinearizationPoint
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_errors import SensorErrors, left_jacobian

logger = logging.getLogger(__name__)

PERIOD = 50_000_000  # ns over which positions are averaged
RESTING_LOAD = 0.1  # share of the weight that a sole at rest carries
SHORTEST = 40  # poses of a stance
# Residuals depend on the posture, so that those of this many consecutive poses count as one, and
# long logs, which repeat their postures, as this many.
BLOCK = 40
POSTURES = 25
# RMS residuals above these, rad and m, mean that soles moved or are points.
LARGEST = np.repeat([np.radians(0.5), 3e-3], 3)
# Deviations that are always allowed for, rad and m: soles creep.
LEAST = np.repeat([1e-4, 5e-5], 3)
PASSES = 3  # of the deviations of residuals
# Decrease of the cost by displaced joints from which these are evident. It is up to 32 for right
# lengths, as soles creep, and 140 to 700 for lengths that are wrong by 1 to 2 mm.
CONTRADICTION = 75.0

# Prior deviations of how much a sole yields, rad/Nm and m/N.
YIELDING = np.repeat([1e-3, 1e-4], 3)

# Prior deviations of a tracked frame's rotation and position on its link, and of its delay.
MOUNTING = np.array([*3 * [np.radians(1.0)], *3 * [0.01], 0.01])  # rad, m, s


@dataclass(frozen=True)
class Stance:
    """Two soles that rest on the floor.

    Attributes
    ----------
    soles : (str, str)
        Their frames.
    position : (N, J) float64
        Joint positions.
    wrenches : (N, 2, 6) float64
        Moment and force that act on each sole, in its frame.
    """

    soles: tuple[str, str]
    position: FloatArray
    wrenches: FloatArray


@dataclass(frozen=True)
class TrackedStance:
    """Poses of a tracked frame in the world while a sole rests on the floor.

    Attributes
    ----------
    frame, sole : str
        Frames of the robot.
    time : (N,) float64
        Seconds.
    position : (N, J) float64
        Joint positions.
    place : (N, 3) float64
        Origin of the tracked frame in the world, m.
    turn : (N, 4) float64
        Its orientation, a quaternion xyzw.
    """

    frame: str
    sole: str
    time: FloatArray
    position: FloatArray
    place: FloatArray
    turn: FloatArray


@dataclass(frozen=True)
class RestingSoles:
    """When soles rest on the floor: in pairs, and one by one under a measured pose."""

    pairs: tuple[Stance, ...] = ()
    tracked: tuple[TrackedStance, ...] = ()


def find_stances(segments: Iterable[Segment], model: RobotModel) -> RestingSoles:
    """Return the stances of a log of a robot with a floating base.

    Soles are frames of wrench sensors on moving links.
    """
    weight = float(np.linalg.norm(model.gravity) * model.phi[:, 0].sum())
    pairs: list[Stance] = []
    tracked: list[TrackedStance] = []
    for segment in segments:
        starts = np.flatnonzero(np.diff(segment.stamp // PERIOD, prepend=-1))
        mean = partial(_means, starts=starts)
        position = mean(segment.position)
        wrenches = mean(segment.wrenches)
        rests = np.linalg.norm(wrenches[..., 3:], axis=2) > RESTING_LOAD * weight
        feet = [
            place
            for place, frame in enumerate(segment.wrench_frames)
            if model.loaded_link(frame) == model.frame(frame).link > 0
        ]
        for one, other in combinations(feet, 2):
            names = segment.wrench_frames[one], segment.wrench_frames[other]
            runs = _runs(rests[:, one] & rests[:, other])
            pairs += [Stance(names, position[run], wrenches[run][:, [one, other]]) for run in runs]
        if segment.poses is None:
            continue
        time = mean(1e-9 * (segment.stamp - segment.stamp[0]))
        for index, frame in enumerate(segment.pose_frames):
            pose = mean(segment.poses[:, index])
            is_measured = np.isfinite(pose).all(axis=1)
            for one in feet:
                sole = segment.wrench_frames[one]
                tracked += [
                    TrackedStance(
                        frame, sole, time[run], position[run], pose[run, :3], pose[run, 3:]
                    )
                    for run in _runs(rests[:, one] & is_measured)
                ]
    return RestingSoles(tuple(pairs), tuple(tracked))


def _means(values: FloatArray, starts: IntArray) -> FloatArray:
    """Return the means of values (N, ...) over consecutive groups that begin at ``starts``."""
    counts = np.diff(starts, append=len(values)).reshape((-1,) + (1,) * (values.ndim - 1))
    means: FloatArray = np.add.reduceat(values, starts) / counts
    return means


def _runs(rests: BoolArray) -> list[slice]:
    """Return the runs of true values that are long enough."""
    edges = np.flatnonzero(np.diff(rests.astype(np.int8), prepend=0, append=0)).tolist()
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= SHORTEST]


def closure_rows(
    stances: RestingSoles,
    parameters: ParameterSet,
    errors: SensorErrors,
    point: LinearizationPoint,
) -> PseudoMeasurements | None:
    """Return rows of the p parameters and r sensor errors; None without resting soles.

    The deviations of residuals are those of the rows' own best fit, in each of six components.
    """
    placed = errors.placed(parameters, point.theta).model
    geometry = _Geometry(errors, placed, parameters.model, point.theta)
    kinds = [geometry.of_pairs(stances.pairs)] if stances.pairs else []
    kinds += [
        geometry.of_tracked([one for one in stances.tracked if one.frame == frame])
        for frame in dict.fromkeys(one.frame for one in stances.tracked)
    ]
    found = [factor for kind in kinds if (factor := kind.factor(geometry)) is not None]
    if not found:
        return None
    stacked = np.concatenate(found)
    rows = np.zeros((len(stacked), len(parameters) + len(errors)))
    rows[:, len(parameters) :] = stacked[:, :-1]
    return PseudoMeasurements(rows, stacked[:, -1])


def contradicted_geometry(stances: RestingSoles, model: RobotModel) -> str:
    """Return the alarm that soles at rest contradict the model's lengths; empty if they do not.

    Encoder offsets alone are compared with offsets and displaced joints. Predictions of forces
    hardly separate the two, because inertias and gains imitate wrong lengths.
    """
    if not stances.pairs:
        return ""
    frames = tuple(dict.fromkeys(name for one in stances.pairs for name in one.soles))
    costs, left = [], np.zeros((1, 6))
    for kinds in (("encoder_offset", *KINEMATIC_ERRORS), ("encoder_offset",)):
        errors = SensorErrors.of(kinds, model, frames, ())
        geometry = _Geometry(errors, model, model, np.zeros(len(errors)))
        closures = geometry.of_pairs(stances.pairs)
        pose, slopes = closures.linearized(np.zeros(len(closures.others)))
        prior = np.concatenate([closures.others, errors.std])
        std = np.sqrt(_repeats(len(pose))) * LEAST
        A, b = (slopes / std[:, None]).reshape(-1, len(prior)), (-pose / std).reshape(-1)
        best = np.linalg.solve(A.T @ A + np.diag(prior**-2), A.T @ b)
        left = -pose - slopes @ best
        costs.append(float(np.sum((left / std) ** 2) + np.sum((best / prior) ** 2)))
    size = np.sqrt(np.mean(left**2, axis=0))
    # Points and feet that move are no evidence of lengths.
    if costs[1] - costs[0] < CONTRADICTION or np.any(size > LARGEST):
        return ""
    return (
        f"{Alarm.SOLES} with the posture by {1e3 * np.linalg.norm(size[3:]):.2g} "
        "mm (RMS) more than encoder offsets explain: link lengths or joint axes of the model are "
        "wrong; add link_length, or link_length,joint_axis, to `sensor_errors`"
    )


@dataclass(frozen=True)
class _Closures:
    """Poses that are constant in each stance.

    Attributes
    ----------
    linearized : callable
        Maps k further unknowns to the poses (N, 6) and their slopes (N, 6, k + r), both less their
        means over each stance.
    others : (k,) float64
        Prior deviations of these unknowns, which are eliminated.
    is_next : (N - 1,) bool
        Whether the next pose is of the same stance.
    """

    linearized: Callable[[FloatArray], tuple[FloatArray, FloatArray]]
    others: FloatArray
    is_next: BoolArray

    def factor(self, geometry: "_Geometry") -> FloatArray | None:
        """Return rows (r, r + 1) of the sensor errors and their target, with deviations of one.

        They are None if soles do not rest.
        """
        k, at = len(self.others), np.concatenate([np.zeros(len(self.others)), geometry.theta])
        prior = np.concatenate([self.others, geometry.errors.std]) ** -2
        repeats = _repeats(len(self.is_next) + 1)
        std = np.sqrt(repeats) * LEAST
        for _ in range(PASSES):
            pose, slopes = self.linearized(at[:k])
            targets = slopes @ at - pose
            A, b = (slopes / std[:, None]).reshape(-1, len(at)), (targets / std).reshape(-1)
            best = np.linalg.solve(A.T @ A + np.diag(prior), A.T @ b)
            left = targets - slopes @ best
            size = np.mean(left**2, axis=0)
            if np.any(np.sqrt(size) > LARGEST):
                logger.warning(
                    "soles moved while they were loaded, or are points: their poses are not used "
                    "for the geometry of the legs"
                )
                return None
            # Consecutive values of white noise are independent.
            white = np.mean(np.diff(left, axis=0)[self.is_next] ** 2, axis=0) / 2
            white = np.minimum(white, size)
            std = np.sqrt(white + repeats * (size - white + LEAST**2))
            at[:k] = best[:k]
        rows = np.concatenate([slopes / std[:, None], (targets / std)[..., None]], axis=2)
        known = np.eye(k, len(at) + 1) / self.others[:, None]
        wide = np.concatenate([known, rows.reshape(-1, len(at) + 1)])
        triangle = np.asarray(np.linalg.qr(wide, mode="r"), dtype=np.float64)
        return triangle[k : len(at), k:]


@dataclass(frozen=True)
class _Geometry:
    """The robot's geometry at a linearization point θ (r,), and without errors."""

    errors: SensorErrors
    placed: RobotModel
    nominal: RobotModel
    theta: FloatArray

    def of_pairs(self, stances: Sequence[Stance]) -> _Closures:
        """Return the poses of second soles in first ones: rotation vectors and positions.

        Further unknowns are how much a sole turns by a moment about each of its axes, and moves by
        a force along each.
        """
        poses, slopes = [], []
        for one in stances:
            relative, lever, slope = self._relative(*one.soles, one.position)
            pose = np.concatenate([_deviation(relative), lever], axis=1)
            slope = np.concatenate([_yielding(one.wrenches, relative, lever), slope], axis=2)
            poses.append(pose - pose.mean(axis=0))
            slopes.append(slope - slope.mean(axis=0))
        pose, slope = np.concatenate(poses), np.concatenate(slopes)

        def linearized(others: FloatArray) -> tuple[FloatArray, FloatArray]:
            return pose + slope[:, :, : len(others)] @ others, slope

        return _Closures(linearized, YIELDING, _is_next(poses))

    def of_tracked(self, stances: Sequence[TrackedStance]) -> _Closures:
        """Return the poses of soles in the world.

        Further unknowns are rotation and position of the tracked frame, and the poses' delay.
        """
        seen = [self._relative(one.frame, one.sole, one.position) for one in stances]

        def linearized(others: FloatArray) -> tuple[FloatArray, FloatArray]:
            parts = [_in_world(*pair, others) for pair in zip(stances, seen, strict=True)]
            poses = np.concatenate([pose - pose.mean(axis=0) for pose, _ in parts])
            return poses, np.concatenate([slope - slope.mean(axis=0) for _, slope in parts])

        return _Closures(linearized, MOUNTING, _is_next([one.position for one in stances]))

    def _relative(
        self, first_frame: str, second_frame: str, read: FloatArray
    ) -> tuple[Rotation, FloatArray, FloatArray]:
        """Return the second frame in the first: rotations, origins (N, 3), slopes (N, 6, r)."""
        errors, placed = self.errors, self.placed
        offset = errors.of_kind("encoder_offset", self.theta)[:, 0]
        position = placed.apply_mimics(read - offset)
        poses = link_poses(placed, position)
        first, second = placed.frame(first_frame), placed.frame(second_frame)
        turns = [poses.rotation[:, one.link] @ one.rotation for one in (first, second)]
        origins = [
            poses.position[:, one.link] + poses.rotation[:, one.link] @ one.translation
            for one in (first, second)
        ]
        to_first = turns[0].swapaxes(1, 2)
        relative = Rotation.from_matrix(to_first @ turns[1])
        lever = (to_first @ (origins[1] - origins[0])[..., None])[..., 0]
        # Twists of joints that carry the second frame alone move it, those that carry the first
        # alone move it the other way.
        sign = placed.ancestors[:, second.link].astype(float) - placed.ancestors[:, first.link]

        def seen(twists: FloatArray) -> FloatArray:
            """Return twists (N, J, 6, m) about the base's origin as motion of the second frame."""
            angular = to_first[:, None] @ twists[:, :, :3]
            moved = twists[:, :, 3:] + np.cross(
                twists[:, :, :3], origins[1][:, None, :, None], axisa=2, axisb=2, axisc=2
            )
            both = np.concatenate([angular, to_first[:, None] @ moved], axis=2)
            return np.asarray(sign[:, None, None] * both)

        slopes = np.zeros((len(position), 6, len(errors)))
        if "encoder_offset" in errors.kinds:
            change = -seen(joint_axes(placed, poses)[..., None])[..., 0]
            for joint, mimic in placed.followers.items():
                change[:, mimic.leader] += mimic.multiplier * change[:, joint]
                change[:, joint] = 0.0
            slopes[:, :, errors.places["encoder_offset"]] = change.swapaxes(1, 2)
        screws = np.stack([screws_at_base(poses, joint) for joint in placed.joints], axis=1)
        errors.fill_placements(slopes, seen(screws).swapaxes(1, 2), self.nominal, self.theta)
        return relative, lever, slopes


def _yielding(wrenches: FloatArray, relative: Rotation, lever: FloatArray) -> FloatArray:
    """Return how the second sole's pose in the first changes if soles yield, (N, 6, 6).

    Wrenches (N, 2, 6) act on both soles, each in its own axes. ``relative`` and ``lever`` (N, 3)
    are rotation and position of the second sole in the first.
    """
    first = wrenches[:, 0].reshape(-1, 2, 3)
    second = np.stack([relative.apply(wrenches[:, 1, k : k + 3]) for k in (0, 3)], axis=1)
    change = (second - first).reshape(-1, 6)
    columns = change[:, :, None] * np.eye(6)
    columns[:, 3:, :3] = _cross_matrix(lever) * first[:, None, 0]
    return columns


def _in_world(
    stance: TrackedStance,
    seen: tuple[Rotation, FloatArray, FloatArray],
    others: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the pose (N, 6) of a sole in the world, and its slopes (N, 6, 7 + r).

    ``seen`` has rotation, origin and slopes of the sole in the tracked frame of the model, and
    ``others`` (7,) rotation vector and position of that frame in the one that is tracked, and the
    delay.
    """
    relative, lever, slopes = seen
    fixed = Rotation.from_rotvec(others[:3])
    measured = Rotation.from_quat(stance.turn)
    # Poses that are late are advanced.
    before, after = (np.clip(np.arange(len(lever)) + step, 0, len(lever) - 1) for step in (-1, 1))
    period = (stance.time[after] - stance.time[before])[:, None]
    spin = (measured[after] * measured[before].inv()).as_rotvec() / period
    speed = (stance.place[after] - stance.place[before]) / period
    turn = Rotation.from_rotvec(others[6] * spin) * measured
    to_world = (turn * fixed).as_matrix()
    lever = (to_world @ lever[..., None])[..., 0]
    moved = turn.apply(others[3:6]) + lever
    place = stance.place + others[6] * speed + moved
    pose = np.concatenate([_deviation(turn * fixed * relative), place], axis=1)
    columns = np.zeros((len(pose), 6, 7))
    about = turn.as_matrix() @ left_jacobian(others[:3])
    columns[:, :3, :3] = about
    columns[:, 3:, :3] = -_cross_matrix(lever) @ about
    columns[:, 3:, 3:6] = turn.as_matrix()
    columns[:, :3, 6] = spin
    columns[:, 3:, 6] = speed + np.cross(spin, moved)
    parts = slopes.reshape(len(pose), 2, 3, -1)
    turned = (to_world[:, None] @ parts).reshape(slopes.shape)
    return pose, np.concatenate([columns, turned], axis=2)


def _is_next(stances: Sequence[FloatArray]) -> BoolArray:
    """Return whether each of the poses of all stances but the first follows one of its own."""
    starts = np.cumsum([len(one) for one in stances])
    follows: BoolArray = ~np.isin(np.arange(1, starts[-1]), starts)
    return follows


def _repeats(count: int) -> float:
    """Return how many of ``count`` poses count as one."""
    return max(float(BLOCK), count / POSTURES)


def _deviation(turns: Rotation) -> FloatArray:
    """Return rotations as rotation vectors (N, 3) from their mean."""
    deviation: FloatArray = (turns * turns.mean().inv()).as_rotvec()
    return deviation


def _cross_matrix(vectors: FloatArray) -> FloatArray:
    """Return the matrices (N, 3, 3) of v × of vectors (N, 3)."""
    matrix: FloatArray = np.cross(vectors[:, None], np.eye(3)).swapaxes(1, 2)
    return matrix
