"""Variants of the robot with joint friction and modified lengths."""

import xml.etree.ElementTree as ET
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.simulation.plant import Plant, resting_data, site_ids
from symbid_ros.simulation.settings import JointFriction

# The shortest time constant that MuJoCo allows at a period of 1 ms. Coulomb friction then has its
# full value or stops the joint within one period; by default joints creep at up to 0.1 rad/s.
FRICTION_TIME_CONSTANT = 2e-3  # s
ITERATIONS = 6  # Gauss-Newton converges quadratically from millimetres to rounding errors
FLAT = [2, 3, 4]  # height, roll and pitch among displacement and rotation vector


def modified_plant(
    original: Plant,
    soles: tuple[str, ...],
    friction: Mapping[str, JointFriction],
    lengths: Mapping[str, float],
) -> Plant:
    """Return the plant with joint friction and modified lengths, standing like the original.

    Parameters
    ----------
    original : Plant
        Its MJCF must contain the bodies and joints itself, without includes.
    soles : tuple of str
        Sites of the F soles.
    friction : mapping of str to JointFriction
        By joint name.
    lengths : mapping of str to float
        By joint name: additional distance of the joint's body from its parent's origin, m. A
        body at its parent's origin stays there.

    Raises
    ------
    SimulationError
        When a joint is not in the file.
    """
    plant = Plant(original.path, soles, _modified_mjcf(original.path, friction, lengths))
    plant.data.qpos[:] = _level_soles(plant.model, original, soles)
    return plant


def _modified_mjcf(
    path: Path, friction: Mapping[str, JointFriction], lengths: Mapping[str, float]
) -> str:
    root = ET.parse(path, ET.XMLParser(target=ET.TreeBuilder(insert_comments=True))).getroot()
    joints = {element.get("name"): element for element in root.iterfind("worldbody//joint")}
    missing = [name for name in (*friction, *lengths) if name not in joints]
    if missing:
        raise SimulationError(
            f"{path}: no joint {missing[0]}; name joints in the worldbody of this file", "E602"
        )
    for name, values in friction.items():
        for attribute, value in asdict(values).items():
            joints[name].set(attribute, repr(value))
        joints[name].set("solreffriction", f"{FRICTION_TIME_CONSTANT} 1")
    if friction:
        _integrate_explicitly(root)
    for body in root.iterfind("worldbody//body"):
        names = [joint.get("name") for joint in body.findall("joint")]
        _lengthen_body(body, sum(lengths.get(str(name), 0.0) for name in names))
    return ET.tostring(root, encoding="unicode") + "\n"


def _integrate_explicitly(root: ET.Element) -> None:
    # With implicit damping, the change of velocity would differ from the acceleration in the
    # equation of motion, by one per cent in light joints: the log would be inconsistent.
    option = root.find("option")
    if option is None:
        option = ET.SubElement(root, "option")
    option.set("integrator", "Euler")
    flag = option.find("flag")
    if flag is None:
        flag = ET.SubElement(option, "flag")
    flag.set("eulerdamp", "disable")


def _lengthen_body(body: ET.Element, amount: float) -> None:
    offset = np.array(body.get("pos", "0 0 0").split(), dtype=np.float64)
    length = float(np.linalg.norm(offset))
    if amount and length > 0.0:
        longer = offset * (1.0 + amount / length)
        body.set("pos", " ".join(repr(float(value)) for value in longer))


def _level_soles(model: mujoco.MjModel, original: Plant, soles: tuple[str, ...]) -> FloatArray:
    """Return the pose (nq,) closest to the original's with soles at the same height and tilt.

    Otherwise a robot with legs of unequal length would start with one sole below the floor and
    the other above it.
    """
    pose: FloatArray = original.data.qpos.copy()
    goal, sites = resting_data(original.model, pose), site_ids(original.model, soles)
    for _ in range(ITERATIONS):
        current = resting_data(model, pose)
        jacobian = np.zeros((len(soles), 6, model.nv))
        error = np.zeros((len(soles), 6))
        for index, (site, target) in enumerate(zip(site_ids(model, soles), sites, strict=True)):
            mujoco.mj_jacSite(model, current, jacobian[index, :3], jacobian[index, 3:], site)
            error[index, :3] = goal.site_xpos[target] - current.site_xpos[site]
            error[index, 3:] = _rotation_vector(current.site_xmat[site], goal.site_xmat[target])
        step = np.linalg.lstsq(
            jacobian[:, FLAT].reshape(-1, model.nv), error[:, FLAT].ravel(), rcond=None
        )[0]
        mujoco.mj_integratePos(model, pose, step, 1.0)
    return pose


def _rotation_vector(start: FloatArray, end: FloatArray) -> FloatArray:
    """Return the rotation vector (3,) in world axes between two rotation matrices (9,), rad."""
    quaternion, vector = np.zeros(4), np.zeros(3)
    mujoco.mju_mat2Quat(quaternion, (end.reshape(3, 3) @ start.reshape(3, 3).T).ravel())
    mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vector
