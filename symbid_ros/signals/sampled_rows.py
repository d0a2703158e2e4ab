"""Rows of the equation of motion at single samples, and where they hold.

A joint with dry friction obeys the equation of motion only while it slips. A row without unmeasured
contacts is a combination of coordinates, and is used where most joints slip.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.choices import SLIDING_TERMS
from symbid_ros.dynamics.friction import slipping
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.unmeasured_contacts import contact_states, contacts_of_state
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sensor_samples import SensorSamples

# A joint's row is used if the joint slipped for this share of the window, and did not for this time
# at most, s. The rest is enough for a reversal, about which friction says most; in a longer one a
# loaded joint sticks, and its friction may be off by twice the Coulomb friction.
SLIPPING, LONGEST_REVERSAL = 0.8, 0.03
# The share in combinations of coordinates, in which some joint nearly always sticks. Windows in
# which a contact is open and closed for more than the rest are left out.
COMBINED = 0.8
# Share of the joints in a combination that must slip. One of a dozen leg joints sticks nearly
# always, and hardly any row would be left if all had to slip. The friction of a sticking joint,
# which no column describes, is less than that of all joints without the column of Coulomb friction.
MOST = 0.5
# Samples whose rows are built at once, and numbers in these, 32 MB: the allocator returns larger
# arrays to the system, and clearing them anew takes as long as filling them.
MOST_AT_ONCE, NUMBERS_AT_ONCE = 512, 4_000_000


def samples_at_once(parameters: ParameterSet) -> int:
    """Return the number of samples whose rows are built at once."""
    size = parameters.model.dof * len(parameters)
    return max(min(MOST_AT_ONCE, NUMBERS_AT_ONCE // size), 1)


def least_slipping(window: float) -> float:
    """Return the share of a window (s) for which a joint must slip."""
    return max(SLIPPING, 1 - LONGEST_REVERSAL / window)


@dataclass(frozen=True)
class CombinedCoordinates:
    """Where the coordinates obey the equation of motion of which rows are combinations.

    A row without unmeasured contacts contains all coordinates on which they act.

    Attributes
    ----------
    model : RobotModel
    measured : (N, n) bool, or shares of windows
        Rows that are known.
    obeys : (N, n) bool, or shares of windows
        Single coordinates; false where a joint with friction may stick.
    slips : (N, n) bool or None, or shares of windows
        The same of candidate terms.
    touching : (N, C) bool, or shares of windows
        Which contacts without a sensor touch something.
    """

    model: RobotModel
    measured: FloatArray | BoolArray
    obeys: FloatArray | BoolArray
    slips: FloatArray | BoolArray | None
    touching: FloatArray | BoolArray

    def averaged(self, weights: csr_array) -> "CombinedCoordinates":
        """Return the shares of windows with ``weights`` (W, N)."""
        slips = None if self.slips is None else weights @ self.slips
        return CombinedCoordinates(
            self.model,
            weights @ self.measured,
            weights @ self.obeys,
            slips,
            weights @ self.touching,
        )

    def __add__(self, other: "CombinedCoordinates") -> "CombinedCoordinates":
        """Return the sum of shares that two parts of the samples have in windows."""
        slips = None
        if self.slips is not None and other.slips is not None:
            slips = self.slips + other.slips
        return CombinedCoordinates(
            self.model,
            self.measured + other.measured,
            self.obeys + other.obeys,
            slips,
            self.touching + other.touching,
        )

    def valid(self) -> tuple[BoolArray, BoolArray | None]:
        """Return which rows of windows (W, n) are valid, and in which of them the joints slip.

        A joint slips if it does so for most of the window. Of the joints in a combination, half
        must slip. The second part is None if the joints' terms are given.
        """
        contacts = self.model.contacts
        assert contacts is not None
        # A coordinate's row has another meaning when a contact that acts on it opens or closes.
        changes = (self.touching < COMBINED) & (self.touching > 1 - COMBINED)
        known = (self.measured > COMBINED) & ~(changes.astype(float) @ contacts.loads > 0)
        touching = np.asarray(self.touching > 1 - COMBINED)
        valid, slips = (
            None if each is None else _valid_combinations(self.model, each > COMBINED, touching)
            for each in (self.obeys, self.slips)
        )
        assert valid is not None
        valid &= known
        return valid, None if slips is None else slips & valid


@dataclass(frozen=True)
class SampledRows:
    """Rows at single samples.

    Attributes
    ----------
    stamp : (N,) int64
        Nanoseconds.
    rows : Rows
        N rows of n coordinates.
    valid : (N, n) bool
        Coordinates at which the equation holds; false where a joint with friction may stick.
    slips : (N, n) bool or None
        Of candidate terms: valid coordinates except joints that may stick.
    combined : CombinedCoordinates or None
        What the rows are combinations of, on a robot with contacts that have no sensor.
    """

    stamp: IntArray
    rows: Rows
    valid: BoolArray
    slips: BoolArray | None = None
    combined: CombinedCoordinates | None = None


RowBuilder = Callable[[SensorSamples], Iterator[SampledRows]]


def sampled_rows(parameters: ParameterSet, samples: Samples) -> SampledRows:
    """Return the equation of motion at single samples, and where it holds."""
    return rows_that_hold(parameters, samples, equation_of_motion(parameters, samples))


def rows_that_hold(parameters: ParameterSet, samples: Samples, rows: Rows) -> SampledRows:
    """Return rows of samples together with where they hold."""
    model, touching = parameters.model, samples.touching
    obeys, slips = _single_coordinates(parameters, samples.velocity)
    if model.contacts is None:
        return valid_rows(samples.stamp, rows, obeys, slips)
    if touching is None:
        touching = np.ones((len(samples), len(model.contacts.frames)), dtype=bool)
    combined = CombinedCoordinates(model, np.isfinite(rows.y), obeys, slips, touching)
    sampled = valid_rows(
        samples.stamp,
        rows,
        _valid_combinations(model, obeys, touching),
        None if slips is None else _valid_combinations(model, slips, touching),
    )
    return replace(sampled, combined=combined)


def valid_rows(
    stamp: IntArray, rows: Rows, valid: BoolArray, slips: BoolArray | None = None
) -> SampledRows:
    """Return rows valid at some coordinates (N, n), except where the force was not measured.

    ``slips`` (N, n) tells at which coordinates joints slip, which some terms need.
    """
    measured = np.isfinite(rows.y)
    if not measured.all():
        valid = valid & measured
        rows = Rows(rows.K, np.where(measured, rows.y, 0.0))
    if slips is None:
        return SampledRows(stamp, rows, valid)
    return SampledRows(stamp, rows, valid, valid & slips)


def valid_coordinates(parameters: ParameterSet, velocity: FloatArray) -> BoolArray:
    """Return which coordinates (N, n) obey the equation of motion at joint rates (N, J).

    Joints with Coulomb friction, identified or known, do so only while they slip. A joint that
    mimics another has no row of its own. Contacts without a sensor may all touch something.
    """
    obeys, _ = _single_coordinates(parameters, velocity)
    contacts = parameters.model.contacts
    return obeys if contacts is None else _valid_combinations(parameters.model, obeys, None)


def slipping_coordinates(parameters: ParameterSet, velocity: FloatArray) -> BoolArray | None:
    """Return at which coordinates (N, n) joints slip, if it is open which have friction.

    None if the joints' terms are given.
    """
    _, slips = _single_coordinates(parameters, velocity)
    contacts = parameters.model.contacts
    if slips is None or contacts is None:
        return slips
    return _valid_combinations(parameters.model, slips, None)


def _single_coordinates(
    parameters: ParameterSet, velocity: FloatArray
) -> tuple[BoolArray, BoolArray | None]:
    """Return :func:`valid_coordinates` and :func:`slipping_coordinates`, not yet combined."""
    model = parameters.model
    obeys = np.ones((len(velocity), model.dof), dtype=bool)
    slips, joints = None, slice(6 * model.floating, None)
    if parameters.candidates:
        slips = obeys.copy()
        slips[:, joints] = slipping(parameters, velocity)
    else:
        has_friction = np.full(len(model.joints), not SLIDING_TERMS.isdisjoint(parameters.terms))
        if "coulomb" in parameters.known_terms:
            has_friction |= parameters.known_terms["coulomb"] != 0
        obeys[:, joints] = slipping(parameters, velocity) | ~has_friction
    obeys[:, [6 * model.floating + joint for joint in model.followers]] = False
    return obeys, slips


def _valid_combinations(
    model: RobotModel, valid: BoolArray, touching: BoolArray | None
) -> BoolArray:
    """Return which rows without unmeasured contacts are valid if single coordinates are (N, n)."""
    contacts = model.contacts
    assert contacts is not None
    if touching is None:
        touching = np.ones((len(valid), len(contacts.frames)), dtype=bool)
    combined = np.zeros_like(valid)
    is_joint = np.arange(model.dof) >= 6 * model.floating
    for state, index in contact_states(touching):
        active = contacts_of_state(model, state)
        kept, loaded = active.coordinates, np.asarray(active.loads.any(axis=0))
        some = combined[index]
        # Combinations contain all coordinates that feel a contact; other rows stay as they are.
        some[:, kept] = valid[np.ix_(index, kept)]
        slipping_joints = valid[index][:, loaded & is_joint]
        together: BoolArray = slipping_joints.sum(axis=1) >= MOST * slipping_joints.shape[1]
        some[:, kept[loaded[kept]]] = together[:, None]
        combined[index] = some
    return combined
