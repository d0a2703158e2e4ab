"""How far below the centre of a foot's ball the ground pushes, if nothing measures the force.

Soft ground and soft soles bring the ground nearer to the centre than the radius of the model file.
"""

from collections.abc import Iterable, Sequence
from itertools import islice

import numpy as np
from scipy.optimize import minimize_scalar

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
TOLERANCE = 0.02  # of that share
BLOCKS = 8  # of the log that are compared


def with_fitted_radii(
    robot: RobotModel, contacts: tuple[str, ...], segments: Iterable[Segment]
) -> tuple[str, ...]:
    """Return contacts with the radii that a log shows, a common share of those of the model.

    They are returned as they are if none is a ball, or the log does not show it.

    Parameters
    ----------
    robot : RobotModel
    contacts : tuple of str
        ``FRAME:RADIUS`` of each ball, as in :func:`with_contacts`.
    segments : iterable of Segment
    """
    radii = [contact_radius(robot, one) for one in contacts]
    if not any(radii):
        return contacts
    blocks = list(islice(some_blocks(segments), BLOCKS))

    def fit(share: float) -> LooseFit | None:
        rows = loose_rows(blocks, with_contacts(robot, _scaled(contacts, radii, share)))
        return None if rows is None else rows.fit()

    def cost(share: float) -> float:
        found = fit(share)
        return np.inf if found is None else found.cost

    of_file = fit(1.0)
    if of_file is None or of_file.unexplained > MOST_LEFT:
        return contacts
    best = minimize_scalar(
        cost, bounds=(0.0, LARGEST), method="bounded", options={"xatol": TOLERANCE}
    )
    return contacts if of_file.cost - best.fun < EVIDENCE else _scaled(contacts, radii, best.x)


def _scaled(
    contacts: tuple[str, ...], radii: Sequence[float | None], share: float
) -> tuple[str, ...]:
    return tuple(
        f"{contact.partition(':')[0]}:{share * radius:.4g}" if radius else contact
        for contact, radius in zip(contacts, radii, strict=True)
    )
