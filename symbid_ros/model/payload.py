"""Known payloads: bodies that a robot carries in all or part of its logs."""

from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.errors import ModelError
from symbid_ros.model.frames import Frame
from symbid_ros.model.inertia import phi_from_com
from symbid_ros.model.tree import RobotModel

# Stamps beyond those of any log, ns.
FIRST, LAST = -(2**62), 2**62


@dataclass(frozen=True)
class Payload:
    """A point mass fixed to a link, of which the mass and, if given, the place are known.

    Attributes
    ----------
    link : int
        Index of the link.
    phi : (10,) float64
        Inertial parameters in the link's axes about its origin.
    start, stop : int
        Stamps between which the robot carries it, ns.
    frame : Frame or None
        Frame in whose axes its place is unknown; None if the place is known.
    """

    link: int
    phi: FloatArray
    start: int = FIRST
    stop: int = LAST
    frame: Frame | None = None

    @property
    def name(self) -> str:
        """Name of a payload whose place is unknown, the same in all logs in which it is carried."""
        return "" if self.frame is None else f"{self.phi[0]:g}kg_on_{self.frame.name}"

    def moved(self, place: FloatArray) -> "Payload":
        """Return the payload at a place (3,) in the axes of its frame, m."""
        assert self.frame is not None
        com = self.frame.rotation @ place + self.frame.translation
        return replace(self, phi=phi_from_com(float(self.phi[0]), com, np.zeros((3, 3))))

    def place_slope(self) -> FloatArray:
        """Return ∂φ/∂place (10, 3); φ is quadratic in the place, so differences are exact."""
        assert self.frame is not None
        place = self.frame.rotation.T @ (self.phi[1:4] / self.phi[0] - self.frame.translation)
        steps = np.eye(3)
        slopes = [(self.moved(place + e).phi - self.moved(place - e).phi) / 2 for e in steps]
        return np.stack(slopes, axis=1)

    def is_carried(self, stamp: IntArray) -> BoolArray:
        """Return whether the robot carries it at stamps (N,)."""
        carried: BoolArray = (stamp >= self.start) & (stamp < self.stop)
        return carried

    @classmethod
    def parse(cls, text: str, model: RobotModel) -> "Payload":
        """Return the payload ``LINK,MASS,X,Y,Z`` or ``LINK,MASS``, at all times.

        LINK is a link or a frame of the model, and X, Y, Z (m) the mass's place in its axes. A
        place that is not given is unknown; until it is known the mass is at the frame's origin.

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
        if len(place) not in (0, 3) or not (0 < mass < np.inf and np.all(np.isfinite(place))):
            raise ModelError(
                f"`payload`: {text!r} is not valid; give a link, a mass (kg) and, if it is known, "
                "its place in the link's axes (m), such as tool0,2.5,0,0,0.06",
                "E122",
            )
        frame = model.frame(name, "payload")
        if model.links[frame.link].virtual:
            raise ModelError(
                f"`payload`: {model.source} has no inertia at {name!r}; name another link", "E122"
            )
        alone = cls(frame.link, np.array([mass, *np.zeros(9)]), frame=frame)
        payload = alone.moved(np.array(place or np.zeros(3)))
        return replace(payload, frame=None) if place else payload


def with_payloads(model: RobotModel, payloads: tuple[Payload, ...]) -> RobotModel:
    """Return the robot with the payloads that it carries at all times."""
    phi = model.phi.copy()
    for one in payloads:
        if (one.start, one.stop) == (FIRST, LAST):
            phi[one.link] += one.phi
    return model.with_phi(phi) if payloads else model
