"""Couplings: drives that turn with the weighted sum of several joints.

The motors of a wrist often sit further up the arm, so that one of them moves with two joints
(Khalil and Dombre 2002, Modeling, Identification and Control of Robots, sec. 9.2.3). By virtual
work a force at a drive of speed Σ r_j q̇_j acts with the factor r_j on joint j.
"""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import Term
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import RobotModel

# Terms of a coupled drive. A constant offset cannot be told from those of its joints.
COUPLED_TERMS: tuple[Term, ...] = ("viscous", "coulomb", "armature", "stribeck")


@dataclass(frozen=True)
class Coupling:
    """A drive that turns with several joints.

    Attributes
    ----------
    label : str
        Such as ``joint_5+joint_6`` or ``joint_2-0.5*joint_3``.
    joints : tuple of int
        Indices of the joints.
    ratios : tuple of float
        Speed of the drive per speed of each joint; that of the first joint is 1.
    """

    label: str
    joints: tuple[int, ...]
    ratios: tuple[float, ...]

    @classmethod
    def of(cls, model: RobotModel, joints: Iterable[int], ratios: Iterable[float]) -> "Coupling":
        """Return a coupling of joints given by their indices."""
        joints, ratios = tuple(joints), tuple(ratios)
        ratios = tuple(ratio / ratios[0] for ratio in ratios)
        parts = [model.joint_names[joints[0]]]
        for joint, ratio in zip(joints[1:], ratios[1:], strict=True):
            factor = "" if abs(ratio) == 1 else f"{abs(ratio):.12g}*"
            parts.append(f"{'-' if ratio < 0 else '+'}{factor}{model.joint_names[joint]}")
        return cls("".join(parts), joints, ratios)

    @classmethod
    def parse(cls, text: str, model: RobotModel) -> "Coupling":
        """Return the coupling that a label such as ``joint_5+joint_6`` means.

        Raises
        ------
        ModelError
            When it is not a sum of two or more different joints of the model.
        """
        # Names may contain + and -, so the longest name that fits is taken.
        names = sorted(model.measured_joint_names, key=len, reverse=True)
        one = rf"([+-]?)(?:(\d+\.?\d*)\*)?({'|'.join(map(re.escape, names))})"
        left = text.replace(" ", "")
        found: list[tuple[str, float]] = []
        while (match := re.match(one, left)) and (match[1] or not found):
            found.append((match[3], float(f"{match[1]}{match[2] or 1}")))
            left = left[match.end() :]
        joints = [model.joint_names.index(name) for name, _ in found]
        ratios = [ratio for _, ratio in found]
        if left or len(set(joints)) != len(joints) or len(joints) < 2 or not all(ratios):
            raise ModelError(
                f"{model.source}: {text!r} is not a coupling of joints; give a sum of two or more "
                f"of {', '.join(model.measured_joint_names)} to `coupling`, such as "
                "joint_5+joint_6 or joint_2-0.5*joint_3",
                "E118",
            )
        return cls.of(model, joints, ratios)

    def speed(self, rates: FloatArray) -> FloatArray:
        """Return the drive's rate (N,) for joint rates (N, J); also of accelerations."""
        speed: FloatArray = rates[:, self.joints] @ np.array(self.ratios)
        return speed


def couplings_in(names: Collection[str], model: RobotModel) -> tuple[Coupling, ...]:
    """Return the couplings whose terms occur in parameter names.

    Raises
    ------
    ModelError
        When one is not of this robot.
    """
    own = {*model.link_names, *model.joint_names}
    parts = [name.rpartition("/") for name in names]
    labels = [owner for owner, _, kind in parts if owner not in own and kind in COUPLED_TERMS]
    return tuple(Coupling.parse(label, model) for label in dict.fromkeys(labels))


def coupled_terms(terms: Collection[Term]) -> tuple[Term, ...]:
    """Return the terms that couplings have if joints have ``terms``."""
    return tuple(term for term in COUPLED_TERMS if term in terms)
