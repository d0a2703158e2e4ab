"""The stance of a robot: the feet and the posture that options, model file or habit name."""

from dataclasses import replace
from itertools import product
from pathlib import Path

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.stance import Foot, Stance
from symbid_ros.dynamics.unmeasured_contacts import contact_radius
from symbid_ros.errors import ModelError, OptionError
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.identification.robot_options import is_contact_kind
from symbid_ros.model.frames import Frame
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.visual_shapes import VisualShape, collision_shapes
from symbid_ros.report.link_meshes import mesh_vertices

KEYFRAME = "standing"
KNEE = 1.5  # rad, of a quadruped that crouches
# Largest height of a foot above the plane of the others, m, and tilt of a sole, rad.
UNEVEN, TILTED = 0.02, 0.02
# Corners of shapes within this height belong to a sole, m, and its smallest width.
SOLE_THICKNESS, SMALLEST_SOLE = 0.01, 0.02
_POINT = "give {}:point in `feet` if it touches the ground in a point"


def contact_names(robot: RobotModel, options: ExciteOptions) -> tuple[str, ...]:
    """Return the feet without a wrench sensor, as FRAME, FRAME:point or FRAME:RADIUS."""
    return _feet(robot, options.contact)


def _feet(robot: RobotModel, values: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names of feet; a ball is no sole, so it is a point where nothing else is said."""
    names = split_names(values)
    return tuple(
        f"{name}:point" if ":" not in name and robot.frame(name, "feet").radius else name
        for name in names
    )


def split_names(values: tuple[str, ...]) -> tuple[str, ...]:
    """Return the names in comma-separated lists."""
    return tuple(name for part in ",".join(values).split(",") if (name := part.strip()))


def find_stance(robot: RobotModel, options: ExciteOptions) -> Stance:
    """Return the stance of a robot on the feet and in the posture that options name.

    Raises
    ------
    SymbidError
        When a frame is unknown, or the feet are not on one plane.
    """
    feet = []
    for name in _feet(robot, options.feet):
        frame, _, kind = name.partition(":")
        if not is_contact_kind(kind):
            raise OptionError(
                f"`feet`: {name!r} is not a foot; give FRAME, FRAME:point or FRAME:RADIUS", "E920"
            )
        own = robot.frame(frame, "feet")
        radius = contact_radius(robot, name)
        bounds = sole_bounds(robot, frame) if radius is None else np.zeros(4)
        feet.append(Foot(own.name, bounds, radius or 0.0))
    position = _posture(robot, tuple(feet), options)
    nothing = np.zeros(3)
    stance = Stance(robot, tuple(feet), position, nothing, np.eye(3))
    place, rotation = (
        each[0] for each in stance.feet_poses(nothing[None], np.eye(3)[None], position[None])
    )
    soles = [index for index, foot in enumerate(feet) if not foot.is_point]
    level = np.eye(3)
    if soles:
        up = rotation[soles, :, 2]
        level = Rotation.align_vectors([[0.0, 0.0, 1.0]], [up.mean(axis=0)])[0].as_matrix()
        tilt = float(np.arccos(np.clip((up @ level.T)[:, 2], -1, 1)).max())
        if tilt > TILTED:
            why = f"its soles are {np.degrees(tilt):.1f} degrees from level"
            raise _no_stance(robot, f"{why}; {_POINT.format(feet[soles[0]].frame)}")
    heights = (place @ level.T)[:, 2] - [foot.radius for foot in feet]
    if np.ptp(heights) > UNEVEN:
        why = f"its feet differ by {1e3 * np.ptp(heights):.0f} mm in height"
        if soles:
            why += f"; {_POINT.format(feet[soles[0]].frame)}"
        raise _no_stance(robot, why)
    if len(feet) + 2 * len(soles) < 3:
        raise _no_stance(robot, "it needs a sole or three points to stand on")
    base = np.array([0.0, 0.0, -heights.mean()])
    return replace(stance, base_position=base, base_rotation=level)


def _no_stance(robot: RobotModel, why: str) -> ModelError:
    return ModelError(
        f"{robot.source}: the robot cannot stand on `feet`: {why}; give the joint positions of a "
        "standing robot as `posture`",
        "E921",
    )


def _posture(robot: RobotModel, feet: tuple[Foot, ...], options: ExciteOptions) -> FloatArray:
    """Return joint positions (J,): those named, of the keyframe, or of a crouched quadruped."""
    if options.posture:
        position = np.array([min(max(0.0, each.lower), each.upper) for each in robot.joints])
        for item in split_names(options.posture):
            name, _, value = item.partition("=")
            try:
                position[robot.joint_names.index(name.strip())] = _finite(value)
            except ValueError:
                raise OptionError(
                    f"`posture`: {item!r} is not JOINT=VALUE; joints are "
                    f"{', '.join(robot.joint_names)}",
                    "E922",
                ) from None
            return np.asarray(robot.apply_mimics(position[None])[0])
    keyframe = _keyframe(robot)
    if keyframe is not None:
        return keyframe
    position = np.zeros(len(robot.joints))
    for foot in feet:
        leg = np.flatnonzero(robot.ancestors[:, robot.frame(foot.frame).link])
        if len(leg) != 3:
            raise _no_stance(
                robot, f"its posture is not known, as leg {foot.frame} is not a leg of three joints"
            )
        knee = robot.joints[leg[2]]
        bent = KNEE if knee.lower + knee.upper > 0 else -KNEE
        position[leg[1:]] = -0.5 * bent, bent
    return position


def _finite(text: str) -> float:
    """Return a finite number; raise a ValueError for anything else."""
    number = float(text)
    if not np.isfinite(number):
        raise ValueError(text)
    return number


def _keyframe(robot: RobotModel) -> FloatArray | None:
    """Return the joint positions (J,) of the keyframe ``standing`` of an MJCF; None without."""
    if not is_mjcf(Path(robot.source)):
        return None
    model = mujoco.MjModel.from_xml_path(robot.source)
    if mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_KEY, KEYFRAME) < 0:
        return None
    pose: FloatArray = model.key(KEYFRAME).qpos
    places = [int(model.joint(name).qposadr[0]) for name in robot.joint_names]
    return np.asarray(pose[places])


def sole_bounds(robot: RobotModel, name: str) -> FloatArray:
    """Return smallest and largest x, then y, of the sole of a foot in its frame's axes, m.

    The sole is what lies lowest of the link's collision shapes along the frame's z axis.

    Raises
    ------
    ModelError
        When the shapes have no sole.
    """
    frame = robot.frame(name)
    shapes = [shape for shape in collision_shapes(robot).shapes if shape.link == frame.link]
    corners = [_corners(shape, frame) for shape in shapes]
    points = np.concatenate([np.zeros((0, 3)), *corners])
    lowest = points[points[:, 2] < points[:, 2].min(initial=np.inf) + SOLE_THICKNESS, :2]
    low, high = lowest.min(axis=0, initial=np.inf), lowest.max(axis=0, initial=-np.inf)
    if not np.all(high - low > SMALLEST_SOLE):
        raise ModelError(
            f"{robot.source}: the collision shapes of link {robot.link_names[frame.link]} have no "
            f"sole; give {name}:point in `feet` for a foot that touches the ground in a point, or "
            "add the shape",
            "E923",
        )
    return np.array([low[0], high[0], low[1], high[1]], dtype=np.float64)


def _corners(shape: VisualShape, frame: Frame) -> FloatArray:
    """Return the corners (V, 3) of a shape in a frame's axes; of round shapes their middle."""
    if shape.kind == "mesh":
        found = shape.vertices if shape.file is None else mesh_vertices(shape.file)
        corners = np.zeros((0, 3)) if found is None else found * shape.size
    elif shape.kind == "box":
        corners = np.array(list(product((-0.5, 0.5), repeat=3))) * shape.size
    else:
        corners = np.zeros((1, 3))
    in_link = corners @ shape.rotation.T + shape.translation
    return np.asarray((in_link - frame.translation) @ frame.rotation)
