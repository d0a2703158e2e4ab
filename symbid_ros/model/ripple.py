"""Ripples: torques that repeat several times in a turn of a joint.

Teeth of gears, poles of motors and spokes of torque sensors add a torque that depends on the angle
of the joint alone (Taghirad and Bélanger 1998, Torque ripple and misalignment torque compensation
for the built-in torque sensor of harmonic drive systems, IEEE Trans. Instrum. Meas. 47(1)). With k
periods a turn it is a sin(kq) + b cos(kq), linear in a and b. One period a turn is left out: it is
like gravity's.
"""

import re
from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import ModelError
from symbid_ros.model.tree import RobotModel

# Names of the two columns of a ripple with {} periods a turn.
RIPPLE_TERMS = "ripple{}_sin", "ripple{}_cos"
RIPPLE_TERM = re.compile(r"ripple(\d+)_(?:sin|cos)")


@dataclass(frozen=True)
class Ripple:
    """A torque with a number of periods in a turn of a joint.

    Attributes
    ----------
    joint : int
        Index of a revolute joint.
    periods : int
        Per turn, 2 or more.
    """

    joint: int
    periods: int

    @classmethod
    def parse(cls, text: str, model: RobotModel) -> "Ripple":
        """Return the ripple that a text such as ``joint_6:4`` means.

        Raises
        ------
        ModelError
            When it is not a revolute joint of the model and a whole number above one.
        """
        name, _, periods = text.rpartition(":")
        names = [
            model.joint_names[joint]
            for joint in model.moving_joints
            if model.joints[joint].kind == "revolute"
        ]
        if name.strip() not in names or not periods.strip().isdecimal() or int(periods) < 2:
            raise ModelError(
                f"{model.source}: {text!r} is not a ripple of a joint; give one of "
                f"{', '.join(names)} and the periods in a turn, 2 or more, to `ripple`, such as "
                "joint_6:4",
                "E900",
            )
        return cls(model.joint_names.index(name.strip()), int(periods))

    @property
    def terms(self) -> tuple[str, ...]:
        """Names of its two columns."""
        return tuple(name.format(self.periods) for name in RIPPLE_TERMS)

    def label(self, model: RobotModel) -> str:
        """Return the text that :meth:`parse` reads."""
        return f"{model.joint_names[self.joint]}:{self.periods}"

    def columns(self, position: FloatArray) -> FloatArray:
        """Return sin(kq) and cos(kq) (N, 2) for joint positions (N, J)."""
        angle = self.periods * position[:, self.joint]
        return np.stack([np.sin(angle), np.cos(angle)], axis=1)


def ripples_in(names: Collection[str], model: RobotModel) -> tuple[Ripple, ...]:
    """Return the ripples whose columns occur in parameter names."""
    parts = [name.rpartition("/") for name in names]
    labels = dict.fromkeys(
        f"{joint}:{match[1]}" for joint, _, term in parts if (match := RIPPLE_TERM.fullmatch(term))
    )
    return tuple(Ripple.parse(label, model) for label in labels)
