"""Robots of example-robot-data by name: their files, postures and feet, without a table of robots.

The posture is that of the SRDF file, if there is one. Feet are the lowest ends of legs, branches of
the tree that share no joint and reach as far below the base. A robot with feet floats and stands.
"""

import xml.etree.ElementTree as ET
from functools import cache
from importlib.metadata import files
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import symbid_ros as sy
from symbid_ros.choices import Base
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses

FloatArray = NDArray[np.float64]

# Postures of SRDF files, the best first: legs bend in the first, so that feet can stay in place.
STANDING = "half_sitting", "standing"
REACH = 0.7  # Of the lowest foot below the base; the others reach as far.
# A leg of fewer joints stands on a point, as its foot cannot stay level.
LEVEL_JOINTS = 6
# Below three points a robot has no area to stand on, so each foot carries moments too.
POINTS = 3
TURNS, TOLERANCE = 60, 1e-9  # of Newton's method; m and rad
# Weight of the base's motion where legs alone can keep the feet in place.
BASE_WEIGHT = 1e-4


def load_robot(name: str, base: Base | None = None) -> tuple[sy.RobotModel, tuple[str, ...]]:
    """Return a robot and the frames of its feet; robots with feet float unless a base is named."""
    path = robot_file(name)
    robot = sy.load_model(path, base or "fixed")
    found = feet(robot)
    if not found:
        return robot, ()
    return (sy.load_model(path, "floating") if base is None else robot), found


@cache
def robot_file(name: str) -> Path:
    """Return the URDF of that stem, or the shortest file name that starts with it.

    A folder may precede it, as in ``anymal_c_simple_description/anymal``.
    """
    folder, _, stem = name.rpartition("/")
    paths = [each for each in files("example-robot-data") or () if each.suffix == ".urdf"]
    some = [each for each in paths if each.stem.startswith(stem) and folder in each.parts[:-1]]
    if not folder:
        some = [each for each in paths if each.stem.startswith(stem)]
    if not some:
        known = ", ".join(sorted({each.stem for each in paths}))
        raise SystemExit(f"example-robot-data has no {name}.urdf; name one of: {known}")
    return Path(str(min(some, key=lambda each: (len(each.stem), str(each))).locate()))


def posture(robot: sy.RobotModel) -> FloatArray:
    """Return joint positions (J,): of the SRDF file, else half way to the middle."""
    stated, position = _stated_posture(robot), []
    for joint in robot.joints:
        start = min(max(0.0, joint.lower), joint.upper)
        is_bounded = np.isfinite(joint.lower) and np.isfinite(joint.upper)
        middle = 0.5 * (joint.lower + joint.upper) if is_bounded else start
        position.append(stated.get(joint.name, 0.5 * (start + middle)))
    return robot.apply_mimics(np.array([position]))[0]


def _stated_posture(robot: sy.RobotModel) -> dict[str, float]:
    path, found = Path(robot.source), []
    for each in path.parent.parent.glob("srdf/*.srdf"):
        for state in ET.parse(each).getroot().iter("group_state"):
            values = {
                one.get("name", ""): one.get("value", "").split() for one in state.iter("joint")
            }
            single = {name: float(value[0]) for name, value in values.items() if len(value) == 1}
            known = {name: value for name, value in single.items() if name in robot.joint_names}
            rank = [state.get("name", "").startswith(one) for one in STANDING]
            found.append((rank, len(known), known))
    return max(found, key=lambda one: one[:2], default=([], 0, {}))[2]


def feet(robot: sy.RobotModel) -> tuple[str, ...]:
    """Return the frame at the lowest end of each leg; none if the robot has no legs."""
    poses = link_poses(robot, posture(robot)[None])
    parents = {joint.parent for joint in robot.joints}
    frames = [robot.frame(name) for name in robot.link_names[1:]] + list(robot.frames)
    height = {
        one.name: poses.position[0, one.link, 2]
        + (poses.rotation[0, one.link] @ one.translation)[2]
        for one in frames
    }
    ends = {}
    for link in range(1, len(robot.links)):
        if link not in parents and np.sum(robot.ancestors[:, link]) > 1:
            here = [one.name for one in frames if one.link == link]
            ends[link] = min(here, key=lambda name: (height[name], name))
    chosen: list[int] = []
    for link in sorted(ends, key=lambda one: height[ends[one]]):
        shares = robot.ancestors[:, chosen].any(axis=1) & robot.ancestors[:, link]
        if height[ends[link]] < min(0.0, REACH * min(height.values())) and not shares.any():
            chosen.append(link)
    return tuple(ends[link] for link in sorted(chosen)) if len(chosen) > 1 else ()


def legs(robot: sy.RobotModel, feet: tuple[str, ...]) -> NDArray[np.bool_]:
    """Return which joints (J,) lie between the base and a foot."""
    links = [robot.frame(foot).link for foot in feet]
    carries: NDArray[np.bool_] = robot.ancestors[:, links].any(axis=1)
    return carries


def held_components(robot: sy.RobotModel, feet: tuple[str, ...]) -> NDArray[np.int64]:
    """Return the components of the feet's twists, six of each, that are zero on the ground."""
    joints = [np.sum(robot.ancestors[:, robot.frame(foot).link]) for foot in feet]
    return _components([count >= LEVEL_JOINTS for count in joints])


def carrying_components(feet: tuple[str, ...]) -> NDArray[np.int64]:
    """Return the components of the feet's wrenches, six of each, that carry the robot."""
    return _components([len(feet) < POINTS] * len(feet))


def _components(are_level: list[bool]) -> NDArray[np.int64]:
    some = [6 * index + np.arange(0 if level else 3, 6) for index, level in enumerate(are_level)]
    return np.concatenate(some)


def standing(
    robot: sy.RobotModel,
    feet: tuple[str, ...],
    rotation: Rotation,
    place: FloatArray,
    position: FloatArray,
) -> tuple[Rotation, FloatArray, FloatArray]:
    """Return the motion nearest to a wanted one whose feet stay where the posture has them.

    The base (place (N, 3), m) moves as wanted if the legs permit it. Legs, of the joint positions
    (N, J), follow by Newton's method, with the smallest steps where they have joints to spare.
    """
    held, first = held_components(robot, feet), 6 * robot.floating
    goal_rotation, goal_place = _poses(
        robot, feet, Rotation.identity(1), np.zeros((1, 3)), posture(robot)[None]
    )
    weight = np.concatenate([np.full(first, BASE_WEIGHT), legs(robot, feet)])
    for _ in range(TURNS):
        turned, here = _poses(robot, feet, rotation, place, position)
        back = np.swapaxes(turned, -1, -2)
        away = np.einsum("nfij,nfj->nfi", back, goal_place - here)
        turn = Rotation.from_matrix((back @ goal_rotation).reshape(-1, 3, 3)).as_rotvec()
        error = np.concatenate([turn.reshape(away.shape), away], axis=2)
        error = error.reshape(len(place), -1)[:, held]
        if np.abs(error).max() < TOLERANCE:
            return rotation, place, position
        jacobian = contact_jacobian(robot, feet, link_poses(robot, position))[:, held]
        back = weight[:, None] * np.swapaxes(jacobian, 1, 2)
        step = back @ (np.linalg.pinv(jacobian @ back, 1e-10, hermitian=True) @ error[..., None])
        step = step[..., 0]
        place = place + rotation.apply(step[:, 3:6])
        rotation = rotation * Rotation.from_rotvec(step[:, :3])
        position = robot.apply_mimics(position + step[:, 6:])
    raise SystemExit(f"{robot.source}: its feet cannot stay in place")


def _poses(
    robot: sy.RobotModel,
    feet: tuple[str, ...],
    rotation: Rotation,
    place: FloatArray,
    position: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Return rotations (N, F, 3, 3) and places (N, F, 3) of the feet in the world."""
    poses = link_poses(robot, position)
    frames = [robot.frame(foot) for foot in feet]
    base = rotation.as_matrix()
    turned = [base @ poses.rotation[:, one.link] @ one.rotation for one in frames]
    at = [
        poses.position[:, one.link] + poses.rotation[:, one.link] @ one.translation
        for one in frames
    ]
    return np.stack(turned, axis=1), np.stack([place + rotation.apply(one) for one in at], axis=1)
