"""Read a URDF."""

import sys
import xml.etree.ElementTree as ET
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Base
from symbid_ros.errors import ModelError
from symbid_ros.model.bodies import Body, BodyJoint, assemble
from symbid_ros.model.frames import AT_CENTER
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.rotation import rotation_from_rpy
from symbid_ros.model.tree import STANDARD_GRAVITY, RobotModel
from symbid_ros.model.xml_file import LARGEST, MAX_DEPTH, place, read_xml

_MOVING: dict[str, Literal["revolute", "prismatic"]] = {
    "revolute": "revolute",
    "continuous": "revolute",
    "prismatic": "prismatic",
}
# Stands for no limit: urdfdom requires finite numbers.
UNLIMITED = 1e9
_SHORTEST_AXIS = 1e-9
_PRODUCTS = ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")


def load_urdf(path: Path, base: Base = "auto", *, is_identified: bool = False) -> RobotModel:
    """Load a URDF.

    Parameters
    ----------
    path : Path
        The file.
    base : {"auto", "floating", "fixed"}
        A URDF does not say whether its root is fixed. With "auto" the root floats (REP-105's
        ``base_link``) unless it is named ``world``. A floating joint below a massless ``world``
        carries a base that floats.
    is_identified : bool
        Whether an identification wrote it, which may have found negative masses.

    Raises
    ------
    ModelError
        When the file cannot be read, is not a URDF (for example xacro), is not a tree, or has a
        number outside a robot's range.
    """
    robot = read_xml(path)
    if robot.tag != "robot":
        raise ModelError(f"{path}: the root element is <{robot.tag}>, a URDF has <robot>", "E104")
    for element in robot:
        if element.tag.startswith("xacro:"):
            raise ModelError(
                f"{place(element)}: <{element.tag}> is xacro; run `xacro {path.name} > "
                f"{expanded_name(path)}` and give that file",
                "E104",
            )
    reader = UrdfReader(str(path), robot, is_identified=is_identified)
    bodies, floats = reader.bodies()
    floating = base == "floating" or (base == "auto" and floats)
    gravity = STANDARD_GRAVITY if floating else reader.root_rotation.T @ STANDARD_GRAVITY
    return assemble(
        robot.get("name", path.stem), bodies, floating=floating, gravity=gravity, source=str(path)
    )


def expanded_name(path: Path) -> str:
    """Return a name for the output of xacro: without .xacro, and never the input itself."""
    stem = path.name.removesuffix(".xacro").removesuffix(".urdf")
    return f"{stem}.urdf" if path.name != f"{stem}.urdf" else f"{stem}_expanded.urdf"


WORLD = "world"


class UrdfReader:
    """Reads the links and joints of one URDF by name."""

    def __init__(self, source: str, robot: ET.Element, *, is_identified: bool = False) -> None:
        self.source = source
        self.is_identified = is_identified
        self.root_rotation = np.eye(3)
        self.links: dict[str, ET.Element] = {}
        for link in robot.findall("link"):
            if self._name(link) in self.links:
                raise ModelError(
                    f"{place(link)}: link name {self._name(link)!r} is used twice; rename one",
                    "E105",
                )
            self.links[self._name(link)] = link
        self.joints = robot.findall("joint")
        parents = [joint.find("parent") for joint in self.joints]
        if WORLD not in self.links and any(
            one is not None and one.get("link") == WORLD for one in parents
        ):
            self.links[WORLD] = ET.Element("link", name=WORLD)  # Drake's files do not define it
        self.children: dict[str, list[ET.Element]] = {name: [] for name in self.links}
        self.moved: set[str] = set()
        for joint in self.joints:
            parent, child = self._end(joint, "parent"), self._end(joint, "child")
            if child in self.moved:
                raise ModelError(
                    f"{place(joint)}: link {child!r} is the child of two joints; a URDF is a tree",
                    "E106",
                )
            self.children[parent].append(joint)
            self.moved.add(child)

    def bodies(self) -> tuple[list[Body], bool]:
        """Return the bodies, parents first, and whether the file lets the first one float."""
        roots = [name for name in self.links if name not in self.moved]
        if len(roots) != 1:
            found = ", ".join(roots) or "none"
            raise ModelError(
                f"{self.source}: a URDF has one root link, found {found}; join them", "E106"
            )
        root, floats = roots[0], roots[0] != WORLD
        below = self.children[root]
        if root == WORLD and self.links[root].find("inertial") is None and len(below) == 1:
            kind = below[0].get("type")
            if kind in ("fixed", "floating"):
                floats = kind == "floating"
                self.root_rotation, _ = self.pose(below[0])
                root = self._end(below[0], "child")
        bodies: list[Body] = []
        self._descend([root], -1, None, bodies)
        below_root = len(self.links) - (root != roots[0])
        if len(bodies) != below_root:
            raise ModelError(
                f"{self.source}: {below_root - len(bodies)} links are in a loop of joints that is "
                f"not connected to {root!r}; a URDF is a tree",
                "E106",
            )
        return bodies, floats

    def _descend(
        self, chain: list[str], parent: int, joint: ET.Element | None, out: list[Body]
    ) -> None:
        name = chain[-1]
        if len(chain) > MAX_DEPTH:
            raise ModelError(
                f"{place(self.links[name])}: link {name!r} is the end of a chain of more than "
                f"{MAX_DEPTH} links; shorten it",
                "E102",
            )
        rotation, translation = (np.eye(3), np.zeros(3)) if joint is None else self.pose(joint)
        moving = () if joint is None else self._body_joints(joint)
        out.append(Body(name, parent, rotation, translation, self.phi(name), moving))
        index = len(out) - 1
        for child in self.children[name]:
            self._descend([*chain, self._end(child, "child")], index, child, out)
        if parent >= 0 and not any(body.joints for body in out[index + 1 :]):
            out[index] = self._with_ball(out[index])

    def _with_ball(self, body: Body) -> Body:
        """Return a body beyond which nothing moves with the only ball that can touch things.

        A ball about the origin of a welded body belongs to that body's frame. Another one has a
        frame of its own, ``LINK_end``.
        """
        balls = []
        for collision in self.links[body.name].findall("collision"):
            sphere = collision.find("geometry/sphere")
            with suppress(ModelError):  # shapes may be wrong where they are not needed
                radius = self._number(sphere, "radius", LARGEST)
                if radius:
                    balls.append((self.pose(collision)[1], radius))
        if len(balls) != 1 or balls[0][1] < 0:
            return body
        ((center, radius),) = balls
        if not body.joints and np.linalg.norm(center) < AT_CENTER:
            return replace(body, balls={body.name: radius})
        end = f"{body.name}_end"
        if end in self.links:
            return body
        return replace(body, frames={end: (np.eye(3), center)}, balls={end: radius})

    def _body_joints(self, joint: ET.Element) -> tuple[BodyJoint, ...]:
        name, kind = self._name(joint), joint.get("type", "")
        if kind == "fixed":
            return ()
        if kind not in _MOVING:
            raise ModelError(
                f"{place(joint)}: joint {name!r} is {kind!r}; use revolute, continuous, prismatic "
                "or fixed (floating only below a massless root link 'world')",
                "E107",
            )
        limit, dynamics = joint.find("limit"), joint.find("dynamics")
        lower, upper = (self._number(limit, key) for key in ("lower", "upper"))
        if kind == "continuous" or lower is None or upper is None or upper - lower >= UNLIMITED:
            lower, upper = -np.inf, np.inf
        effort, speed = (self._number(limit, key) for key in ("effort", "velocity"))
        # URDF requires both numbers, and CAD exporters write zeros for unknown ones. A joint that
        # is passive but moves has a speed.
        if effort == 0.0 and speed == 0.0:
            effort = speed = None
            if lower == upper == 0.0:
                lower, upper = -np.inf, np.inf
        return (
            BodyJoint(
                name,
                _MOVING[kind],
                self._axis(joint),
                np.zeros(3),
                lower=lower,
                upper=upper,
                effort=np.inf if effort is None else effort,
                damping=self._number(dynamics, "damping", LARGEST) or 0.0,
                friction_loss=self._number(dynamics, "friction", LARGEST) or 0.0,
                mimic=self._mimic(joint),
                speed=np.inf if speed is None else speed,
            ),
        )

    def _mimic(self, joint: ET.Element) -> tuple[str, float, float] | None:
        mimic = joint.find("mimic")
        if mimic is None:
            return None
        multiplier = self._number(mimic, "multiplier", LARGEST)
        offset = self._number(mimic, "offset", LARGEST)
        return mimic.get("joint", ""), 1.0 if multiplier is None else multiplier, offset or 0.0

    def _axis(self, joint: ET.Element) -> FloatArray:
        axis = self._vector(joint.find("axis"), "xyz", np.array([1.0, 0.0, 0.0]))
        if np.linalg.norm(axis) < _SHORTEST_AXIS:
            raise ModelError(
                f"{place(joint)}: joint {self._name(joint)!r} has a zero axis; give it a direction",
                "E108",
            )
        return axis

    def phi(self, name: str) -> FloatArray:
        """Return φ (10,) of a link in the file, about the link's origin."""
        inertial = self.links[name].find("inertial")
        if inertial is None:
            return np.zeros(10)
        mass, inertia = inertial.find("mass"), inertial.find("inertia")
        if mass is None or inertia is None:
            raise ModelError(
                f"{place(inertial)}: <inertial> of link {name!r} lacks mass or inertia; add it",
                "E108",
            )
        kilograms = self._number(mass, "value", LARGEST)
        if kilograms is None or (kilograms < 0 and not self.is_identified):
            raise ModelError(
                f"{place(mass)}: link {name!r} needs a mass of 0 kg or more; correct it", "E108"
            )
        value = {key: self._number(inertia, key, LARGEST) or 0.0 for key in _PRODUCTS}
        matrix = np.array([[value["i" + "".join(sorted(a + b))] for b in "xyz"] for a in "xyz"])
        rotation, com = self.pose(inertial)
        return phi_from_com(kilograms, com, rotation @ matrix @ rotation.T)

    def pose(self, element: ET.Element) -> tuple[FloatArray, FloatArray]:
        """Return rotation and translation of an element's <origin>."""
        origin = element.find("origin")
        rpy = self._vector(origin, "rpy", np.zeros(3))
        return rotation_from_rpy(rpy), self._vector(origin, "xyz", np.zeros(3))

    def _vector(self, element: ET.Element | None, key: str, default: FloatArray) -> FloatArray:
        if element is None or key not in element.attrib:
            return default
        words = element.attrib[key].split()
        if len(words) != 3:
            raise ModelError(
                f'{place(element)}: {key}="{element.attrib[key]}" needs three numbers', "E108"
            )
        return np.array([self._finite(element, key, word, LARGEST) for word in words])

    def _number(
        self, element: ET.Element | None, key: str, largest: float = sys.float_info.max
    ) -> float | None:
        if element is None or key not in element.attrib:
            return None
        return self._finite(element, key, element.attrib[key], largest)

    @staticmethod
    def _finite(element: ET.Element, key: str, word: str, largest: float) -> float:
        try:
            number = float(word)
        except ValueError:
            remedy = "run xacro first" if "${" in word else "correct it"
            raise ModelError(
                f"{place(element)}: {key}={word!r} is not a number; {remedy}", "E108"
            ) from None
        if not abs(number) <= largest:
            raise ModelError(
                f"{place(element)}: {key}={word!r} is not finite or outside a robot's range; "
                "correct it, or remove the limit",
                "E108",
            )
        return number

    def _name(self, element: ET.Element) -> str:
        name = element.get("name")
        if not name:
            raise ModelError(f"{place(element)}: a <{element.tag}> has no name; name it", "E105")
        return name

    def _end(self, joint: ET.Element, end: str) -> str:
        element = joint.find(end)
        name = None if element is None else element.get("link")
        if name is None or name not in self.links:
            raise ModelError(
                f"{place(joint)}: joint {self._name(joint)!r} has an unknown {end} link {name!r}; "
                "define that link or correct the name",
                "E106",
            )
        return name
