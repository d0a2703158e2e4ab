"""Read a URDF."""

import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import ModelError
from symbid_ros.model.assembly import Body, BodyJoint, assemble
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.rotation import rotation_from_rpy
from symbid_ros.model.tree import STANDARD_GRAVITY, RobotModel

Base = Literal["auto", "floating", "fixed"]

_MOVING: dict[str, Literal["revolute", "prismatic"]] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}


def load_urdf(path: Path, base: Base = "auto") -> RobotModel:
    """Load a URDF.

    Parameters
    ----------
    path : Path
        The file.
    base : {"auto", "floating", "fixed"}
        A URDF does not say whether its root is bolted down. With "auto" it floats
        (REP-105's ``base_link``) unless the root is a massless link named
        ``world``, whose joint then decides.

    Raises
    ------
    ModelError
        When the file is missing, is not a URDF or describes no tree.
    """
    try:
        robot = ET.parse(path).getroot()
    except OSError as error:
        raise ModelError(
            f"{path}: cannot read the model ({error.strerror}); check the path"
        ) from None
    except ET.ParseError as error:
        raise ModelError(f"{path}: not well-formed XML ({error}); correct the file") from None
    if robot.tag != "robot":
        raise ModelError(f"{path}: the root element is <{robot.tag}>, a URDF has <robot>")
    reader = _Reader(str(path), robot)
    bodies, world_joint = reader.bodies()
    floating = base == "floating" or (base == "auto" and world_joint != "fixed")
    gravity = STANDARD_GRAVITY if floating else reader.root_rotation.T @ STANDARD_GRAVITY
    return assemble(
        robot.get("name", path.stem), bodies, floating=floating, gravity=gravity, source=str(path)
    )


class _Reader:
    """One URDF while it is read: links and joints by name."""

    def __init__(self, source: str, robot: ET.Element) -> None:
        self.source = source
        self.root_rotation = np.eye(3)
        self.links = {self._name(link): link for link in robot.findall("link")}
        self.joints = robot.findall("joint")
        self.children: dict[str, list[ET.Element]] = {name: [] for name in self.links}
        self.moved: set[str] = set()
        for joint in self.joints:
            parent, child = self._end(joint, "parent"), self._end(joint, "child")
            if child in self.moved:
                raise ModelError(
                    f"{source}: link {child!r} is the child of two joints; a URDF is a tree"
                )
            self.children[parent].append(joint)
            self.moved.add(child)

    def bodies(self) -> tuple[list[Body], str | None]:
        """Return the bodies, parents first, and the type of the joint below ``world``."""
        roots = [name for name in self.links if name not in self.moved]
        if len(roots) != 1:
            found = ", ".join(roots) or "none"
            raise ModelError(f"{self.source}: a URDF has one root link, found {found}; join them")
        root, world_joint = roots[0], None
        below = self.children[root]
        if root == "world" and self.links[root].find("inertial") is None and len(below) == 1:
            kind = below[0].get("type")
            if kind in ("fixed", "floating"):
                world_joint = kind
                self.root_rotation, _ = self._pose(below[0])
                root = self._end(below[0], "child")
        bodies: list[Body] = []
        self._descend(root, -1, None, bodies)
        return bodies, world_joint

    def _descend(self, name: str, parent: int, joint: ET.Element | None, out: list[Body]) -> None:
        rotation, translation = (np.eye(3), np.zeros(3)) if joint is None else self._pose(joint)
        moving = () if joint is None else self._body_joints(joint)
        out.append(Body(name, parent, rotation, translation, self._phi(name), moving))
        index = len(out) - 1
        for child in self.children[name]:
            self._descend(self._end(child, "child"), index, child, out)

    def _body_joints(self, joint: ET.Element) -> tuple[BodyJoint, ...]:
        name, kind = self._name(joint), joint.get("type", "")
        if kind == "fixed":
            return ()
        if kind not in _MOVING:
            raise ModelError(
                f"{self.source}: joint {name!r} is {kind!r}; revolute, continuous, prismatic and "
                "fixed joints are known (floating only below a massless root link 'world')"
            )
        axis = joint.find("axis")
        limit = joint.find("limit")
        limits = {} if limit is None else limit.attrib
        dynamics = joint.find("dynamics")
        friction = {} if dynamics is None else dynamics.attrib
        bounded = kind != "continuous" and "lower" in limits and "upper" in limits
        return (
            BodyJoint(
                name,
                _MOVING[kind],
                self._vector(axis, "xyz", np.array([1.0, 0.0, 0.0])),
                np.zeros(3),
                lower=self._number(limits["lower"]) if bounded else -np.inf,
                upper=self._number(limits["upper"]) if bounded else np.inf,
                effort=self._number(limits.get("effort", "inf")),
                damping=self._number(friction.get("damping", "0")),
                friction_loss=self._number(friction.get("friction", "0")),
            ),
        )

    def _phi(self, name: str) -> FloatArray:
        inertial = self.links[name].find("inertial")
        if inertial is None:
            return np.zeros(10)
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is None or inertia is None:
            raise ModelError(
                f"{self.source}: link {name!r} has an <inertial> without mass or inertia; add it"
            )
        value = {key: self._number(inertia.get(key, "0")) for key in _PRODUCTS}
        matrix = np.array([[value["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"])
        rotation, com = self._pose(inertial)
        return phi_from_com(
            self._number(mass.get("value", "nan")), com, rotation @ matrix @ rotation.T
        )

    def _pose(self, element: ET.Element) -> tuple[FloatArray, FloatArray]:
        origin = element.find("origin")
        rpy = self._vector(origin, "rpy", np.zeros(3))
        return rotation_from_rpy(rpy), self._vector(origin, "xyz", np.zeros(3))

    def _vector(self, element: ET.Element | None, key: str, default: FloatArray) -> FloatArray:
        if element is None or key not in element.attrib:
            return default
        words = element.attrib[key].split()
        if len(words) != 3:
            raise ModelError(f'{self.source}: {key}="{element.attrib[key]}" needs three numbers')
        return np.array([self._number(word) for word in words])

    def _number(self, text: str) -> float:
        try:
            return float(text)
        except ValueError:
            raise ModelError(f"{self.source}: {text!r} is not a number; correct it") from None

    def _name(self, element: ET.Element) -> str:
        name = element.get("name")
        if not name:
            raise ModelError(f"{self.source}: a <{element.tag}> has no name; name it")
        return name

    def _end(self, joint: ET.Element, end: str) -> str:
        element = joint.find(end)
        name = None if element is None else element.get("link")
        if name is None or name not in self.links:
            raise ModelError(
                f"{self.source}: joint {self._name(joint)!r} has an unknown {end} link {name!r}"
            )
        return name


_PRODUCTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
