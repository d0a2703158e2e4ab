"""Known payloads: bodies that a robot carries in all or part of its logs."""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.errors import ModelError
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.tree import RobotModel

# Stamps beyond those of any log, ns.
FIRST, LAST = -(2**62), 2**62


@dataclass(frozen=True)
class Payload:
    """A point mass fixed to a link, of which mass and place are known.

    Attributes
    ----------
    link : int
        Index of the link.
    phi : (10,) float64
        Inertial parameters in the link's axes about its origin.
    start, stop : int
        Stamps between which the robot carries it, ns.
    """

    link: int
    phi: FloatArray
    start: int = FIRST
    stop: int = LAST

    def is_carried(self, stamp: IntArray) -> BoolArray:
        """Return whether the robot carries it at stamps (N,)."""
        carried: BoolArray = (stamp >= self.start) & (stamp < self.stop)
        return carried

    @classmethod
    def parse(cls, text: str, model: RobotModel) -> "Payload":
        """Return the payload ``LINK,MASS,X,Y,Z``, at all times.

        LINK is a link or a frame of the model, and X, Y, Z (m) the mass's place in its axes.

        Raises
        ------
        ModelError
            When the text, the link or the mass is invalid.
        """
        name, *rest = (part.strip() for part in text.split(","))
        try:
            mass, *place = (float(part) for part in rest)
        except ValueError:
            mass, place = np.nan, []
        if len(place) != 3 or not (0 < mass < np.inf and np.all(np.isfinite(place))):
            raise ModelError(
                f"`payload`: {text!r} is not valid; give a link, a mass (kg) and its place in the "
                "link's axes (m), such as tool0,2.5,0,0,0.06",
                "E122",
            )
        frame = model.frame(name)
        com = frame.rotation @ np.array(place) + frame.translation
        if model.links[frame.link].virtual:
            raise ModelError(
                f"`payload`: {model.source} has no inertia at {name!r}; name another link", "E122"
            )
        return cls(frame.link, phi_from_com(mass, com, np.zeros((3, 3))))


def with_payloads(model: RobotModel, payloads: tuple[Payload, ...]) -> RobotModel:
    """Return the robot with the payloads that it carries at all times."""
    phi = model.phi.copy()
    for one in payloads:
        if (one.start, one.stop) == (FIRST, LAST):
            phi[one.link] += one.phi
    return model.with_phi(phi) if payloads else model
