"""Rows for joint placements and encoder offsets from pairs of soles at rest on the floor.

While two soles rest on the floor, the pose of one relative to the other is constant. What the
encoders and the model say of it varies if lengths, axes or offsets are wrong. These rows contain no
force, so that they tell the geometry apart from inertias. The constant pose itself is unknown.
"""

import logging
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.kinematics import joint_axes, link_poses
from symbid_ros.dynamics.placements import screws_at_base
from symbid_ros.estimation.posterior import PseudoMeasurements
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_errors import LinearizationPoint, SensorErrors

logger = logging.getLogger(__name__)

PERIOD = 50_000_000  # ns over which positions are averaged
RESTING_LOAD = 0.1  # share of the weight that a sole at rest carries
SHORTEST = 40  # poses of a stance
# Residuals depend on the posture, so that those of this many consecutive poses count as one.
BLOCK = 40
# RMS residuals above these, rad and m, mean that soles moved or are points.
LARGEST = np.repeat([np.radians(0.5), 3e-3], 3)
# Deviations that are always allowed for, rad and m: soles and floors yield with the posture, which
# wrong lengths can imitate.
LEAST = np.repeat([1e-4, 5e-5], 3)
PASSES = 3  # of the deviations of residuals


@dataclass(frozen=True)
class Stance:
    """Joint positions (N, J) while two soles, given by their frames, rest on the floor."""

    soles: tuple[str, str]
    position: FloatArray


def find_stances(segments: Iterable[Segment], model: RobotModel) -> list[Stance]:
    """Return the stances of a log of a robot with a floating base.

    Soles are frames of wrench sensors on moving links.
    """
    weight = float(np.linalg.norm(model.gravity) * model.phi[:, 0].sum())
    found = []
    for segment in segments:
        starts = np.flatnonzero(np.diff(segment.stamp // PERIOD, prepend=-1))
        counts = np.diff(starts, append=len(segment))
        position = np.add.reduceat(segment.position, starts) / counts[:, None]
        force = np.add.reduceat(segment.wrenches[..., 3:], starts) / counts[:, None, None]
        rests = np.linalg.norm(force, axis=2) > RESTING_LOAD * weight
        feet = [
            place
            for place, frame in enumerate(segment.wrench_frames)
            if model.loaded_link(frame) == model.frame(frame).link > 0
        ]
        for one, other in combinations(feet, 2):
            names = segment.wrench_frames[one], segment.wrench_frames[other]
            runs = _runs(rests[:, one] & rests[:, other])
            found += [Stance(names, position[run]) for run in runs]
    return found


def _runs(rests: BoolArray) -> list[slice]:
    """Return the runs of true values that are long enough."""
    edges = np.flatnonzero(np.diff(rests.astype(np.int8), prepend=0, append=0)).tolist()
    return [slice(a, b) for a, b in zip(edges[::2], edges[1::2], strict=True) if b - a >= SHORTEST]


def closure_rows(
    stances: Sequence[Stance],
    parameters: ParameterSet,
    errors: SensorErrors,
    point: LinearizationPoint,
) -> PseudoMeasurements | None:
    """Return rows of the p parameters and r sensor errors; None without stances of resting soles.

    The deviations of residuals are those of the rows' own best fit, in each of six components.
    """
    if not stances:
        return None
    placed = errors.placed(parameters, point.theta).model
    parts = [_relative_poses(one, placed, errors, parameters.model, point.theta) for one in stances]
    slopes = np.concatenate([slope for _, slope in parts])
    targets = slopes @ point.theta - np.concatenate([pose for pose, _ in parts])
    std = np.sqrt(BLOCK) * LEAST
    for _ in range(PASSES):
        A = (slopes / std[:, None]).reshape(-1, len(errors))
        b = (targets / std).reshape(-1)
        theta = np.linalg.solve(A.T @ A + np.diag(errors.std**-2), A.T @ b)
        left = targets - slopes @ theta
        if np.any(np.sqrt(np.mean(left**2, axis=0)) > LARGEST):
            logger.warning(
                "soles moved while they were loaded, or are points: their relative poses are not "
                "used for the geometry of the legs"
            )
            return None
        std = np.sqrt(BLOCK * (np.mean(left**2, axis=0) + LEAST**2))
    A, b = slopes / std[:, None], targets / std
    factor = np.linalg.qr(np.concatenate([A, b[..., None]], axis=2).reshape(-1, len(errors) + 1))[1]
    rows = np.zeros((len(errors), len(parameters) + len(errors)))
    rows[:, len(parameters) :] = factor[: len(errors), :-1]
    return PseudoMeasurements(rows, factor[: len(errors), -1])


def _relative_poses(
    stance: Stance,
    placed: RobotModel,
    errors: SensorErrors,
    nominal: RobotModel,
    theta: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return the pose (N, 6) of the second sole in the first, and its slopes (N, 6, r).

    Both are less their means over the stance. The pose is rotation vector and position.
    """
    offset = errors.of_kind("encoder_offset", theta)[:, 0]
    position = placed.apply_mimics(stance.position - offset)
    poses = link_poses(placed, position)
    first, second = (placed.frame(name) for name in stance.soles)
    turns = [poses.rotation[:, one.link] @ one.rotation for one in (first, second)]
    origins = [
        poses.position[:, one.link] + poses.rotation[:, one.link] @ one.translation
        for one in (first, second)
    ]
    to_first = turns[0].swapaxes(1, 2)
    relative = Rotation.from_matrix(to_first @ turns[1])
    deviation = (relative * relative.mean().inv()).as_rotvec()
    lever = (to_first @ (origins[1] - origins[0])[..., None])[..., 0]
    # Twists of joints that carry the second sole alone move it, those that carry the first alone
    # move it the other way.
    sign = placed.ancestors[:, second.link].astype(float) - placed.ancestors[:, first.link]

    def seen(twists: FloatArray) -> FloatArray:
        """Return twists (N, J, 6, m) about the base's origin as motion of the second sole."""
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
    errors.fill_placements(slopes, seen(screws).swapaxes(1, 2), nominal, theta)
    pose = np.concatenate([deviation, lever], axis=1)
    return pose - pose.mean(axis=0), slopes - slopes.mean(axis=0)
