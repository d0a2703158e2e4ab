"""How far below the centre of a foot's ball the ground pushes, if nothing measures the force.

Soft ground and soft soles bring the ground nearer to the centre than the radius of the model file.
Many files put a frame at the centre of a foot but describe its shape by a mesh alone, so that the
radius is not known.
"""

from collections.abc import Iterable, Sequence
from itertools import islice

import numpy as np

from symbid_ros.dynamics.unmeasured_contacts import contact_radius, with_contacts
from symbid_ros.identification.conventions.loose_fit import LooseFit, loose_rows, some_blocks
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.segments import Segment

# Another radius has to be likelier by this many nats. Quadrupeds that trot in MuJoCo, whose feet
# sink in by 5 mm, give 100 to 850 nats within 32 s.
EVIDENCE = 50.0
# Where no radius explains the forces (RMS) as well as this, something else is wrong, such as units.
MOST_LEFT = 0.1
LARGEST = 1.5  # times the radius of the model file
# Largest radius about a frame for which the file gives no ball, as a share of the leg's length.
LARGEST_OF_POINTS = 0.1
TOLERANCE = 0.02  # of the largest share
BLOCKS = 8  # of the log that are compared


def with_fitted_radii(
    robot: RobotModel, contacts: tuple[str, ...], segments: Iterable[Segment]
) -> tuple[str, ...]:
    """Return contacts with the radii that a log shows.

    These are a common share of those of the model, or of the legs' lengths if the model has no
    balls. Contacts are returned as they are if all are surfaces, or the log does not show it. A
    ball is ``FRAME:RADIUS``, as in :func:`with_contacts`.
    """
    sizes, stated, largest = [contact_radius(robot, one) for one in contacts], 1.0, LARGEST
    if not any(sizes):
        sizes = [
            size if size is None else leg_length(robot, one)
            for size, one in zip(sizes, contacts, strict=True)
        ]
        stated, largest = 0.0, LARGEST_OF_POINTS
    if not any(sizes):
        return contacts
    blocks = list(islice(some_blocks(segments), BLOCKS))

    def fit(share: float) -> LooseFit | None:
        rows = loose_rows(blocks, with_contacts(robot, _scaled(contacts, sizes, share)))
        return None if rows is None else rows.fit()

    def cost(share: float) -> float:
        found = fit(share)
        return np.inf if found is None else found.cost

    of_file = fit(stated)
    if of_file is None or of_file.unexplained > MOST_LEFT:
        return contacts
    from scipy.optimize import minimize_scalar  # noqa: PLC0415 - loads slowly

    best = minimize_scalar(
        cost, bounds=(0.0, largest), method="bounded", options={"xatol": TOLERANCE * largest}
    )
    return contacts if of_file.cost - best.fun < EVIDENCE else _scaled(contacts, sizes, best.x)


def leg_length(robot: RobotModel, contact: str) -> float:
    """Return the length (m) of the links from a leg's first joint to a contact."""
    frame = robot.frame(contact.partition(":")[0])
    chain = np.flatnonzero(robot.ancestors[:, frame.link])[1:]
    parts = [*(robot.joints[joint].translation for joint in chain), frame.translation]
    return float(np.linalg.norm(parts, axis=1).sum())


def _scaled(
    contacts: tuple[str, ...], sizes: Sequence[float | None], share: float
) -> tuple[str, ...]:
    return tuple(
        f"{contact.partition(':')[0]}:{share * size:.4g}" if size else contact
        for contact, size in zip(contacts, sizes, strict=True)
    )
