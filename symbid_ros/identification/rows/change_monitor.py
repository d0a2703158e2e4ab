"""Detection of changes of a robot's inertias and sensor errors from live rows."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.estimation.change import (
    Innovation,
    LinkChange,
    SensorChange,
    SensorHypothesis,
    innovation,
)
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.identification.rows.accumulator import BlockRows
from symbid_ros.model.parameters import ParameterSet

# Alarm threshold of the evidence for a change, nat, relative to the usual misfit. Chance alone
# never reaches it.
ALARMING = 30.0
# Number of updates from which the usual misfit is taken, and the fewest before an alarm.
USUAL, FEWEST_USUAL = 30, 8
# Updates whose rows are tested together. The change may lie within these rows, so later rows decide
# which link changed.
RECENT = 2
# Pieces kept to attribute a change; bounds memory while the robot runs on.
LONGEST_AFTER = 30
# Updates below the threshold after which a change is over: the estimate has followed it.
QUIET = 10
# Updates after which a change is attributed surely enough for an estimate to start anew from it.
SETTLED = 2


@dataclass(frozen=True)
class Change:
    """A detected change.

    Attributes
    ----------
    since : int
        Stamp of the first rows that showed it, ns.
    suspects : tuple of LinkChange or SensorChange
        The link or sensor error that best explains the rows since then and those that explain them
        about as well, each with the change it would need.
    """

    since: int
    suspects: tuple[LinkChange | SensorChange, ...]

    @property
    def suspect(self) -> LinkChange | SensorChange:
        """The link or sensor error that best explains the rows since the change."""
        return self.suspects[0]

    @property
    def links(self) -> tuple[LinkChange, ...]:
        """The links among the suspects."""
        return tuple(one for one in self.suspects if isinstance(one, LinkChange))

    def __str__(self) -> str:
        """Return the text of the alarm."""
        names = [suspect.subject for suspect in self.suspects]
        since = f"changed since {self.since * 1e-9:.1f} s"
        if len(names) == 1:
            return f"{names[0]} has {since}: {_describe(self.suspect)}"
        amounts = ", ".join(f"{_describe(one)} on {one.subject}" for one in self.suspects)
        return (
            f"{', '.join(names[:-1])} or {names[-1]} has {since}, the motion does not show which: "
            f"{amounts}"
        )


def _describe(change: LinkChange | SensorChange) -> str:
    """Return the change of a sensor's error, or the added mass and, if known, its position."""
    if isinstance(change, SensorChange):
        return _describe_error(change)
    mass, std = change.phi[0], change.std[0]
    place = ""
    if abs(mass) > 3 * std:
        # Adding zero removes the sign of a rounded -0.00.
        x, y, z = np.round(change.phi[1:4] / mass, 2) + 0.0
        place = f" at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    decimals = 2 if std >= 0.005 else 4  # rather than ± 0.00
    return f"{mass:+.{decimals}f} ± {std:.{decimals}f} kg{place}"


def _describe_error(change: SensorChange) -> str:
    """Return the components that have changed clearly, or else the one that has most clearly."""
    clarity = np.abs(change.error) / change.std
    shown = np.flatnonzero(clarity >= min(3.0, clarity.max())).tolist()
    sensor = change.sensor
    parts = []
    for index in shown:
        channel = sensor.names[index].removeprefix(sensor.subject).strip("_")
        unit = "" if sensor.units[index] == "1" else f" {sensor.units[index]}"
        amount = f"{change.error[index]:+.3g} ± {change.std[index]:.1g}{unit}"
        parts.append(f"{channel} {amount}".strip())
    return ", ".join(parts)


class ChangeMonitor:
    """Tests whether new rows agree with the posterior from before them.

    Parameters
    ----------
    parameters : ParameterSet
        The robot's columns.
    sensors : sequence of SensorHypothesis
        Sensor errors, whose columns follow.

    Attributes
    ----------
    change : Change or None
        The change that has been detected and is not over.
    followed : Change or None
        The last change from which the estimate started anew, for :data:`QUIET` updates.
    evidence : float
        Of the last update, relative to the usual misfit; NaN before the first test.
    """

    def __init__(self, parameters: ParameterSet, sensors: Sequence[SensorHypothesis] = ()) -> None:
        self._parameters, self._sensors = parameters, sensors
        self._usual: deque[float] = deque(maxlen=USUAL)
        self.evidence = float("nan")
        self.change: Change | None = None
        self.followed: Change | None = None
        self.restart()

    @property
    def settled(self) -> tuple[Change, Posterior] | None:
        """A change that is attributed surely, and the posterior before it; None otherwise."""
        if self.change is None or self._before is None or self._updates < SETTLED:
            return None
        return self.change, self._before

    def follow(self) -> None:
        """Regard the change as over, because later posteriors start anew from it."""
        self.restart()
        self.followed, self.change = self.change, None

    @property
    def is_ready(self) -> bool:
        """Whether the usual misfit is known well enough to detect a change."""
        return len(self._usual) >= FEWEST_USUAL

    def restart(self) -> None:
        """Discard rows and posteriors, because later rows have another window length.

        A detected change remains.
        """
        self._past: deque[Posterior] = deque(maxlen=RECENT)
        self._rows: deque[tuple[BlockRows, ...]] = deque(maxlen=RECENT)
        self._before: Posterior | None = None
        self._since = self._quiet = self._updates = 0
        self._after: list[BlockRows] = []

    def update(self, rows: Sequence[BlockRows], posterior: Posterior) -> None:
        """Test the rows since the last update.

        Parameters
        ----------
        rows : sequence of BlockRows
            All with the same window length.
        posterior : Posterior
            From all rows up to now.
        """
        self._rows.append(tuple(rows))
        if len(self._past) == RECENT:
            recent = [block for some in self._rows for block in some]
            found = self._innovation(self._past[0], recent)
            if found is not None:
                self._assess(found, recent, rows)
        self._past.append(posterior)

    def _assess(
        self, found: Innovation, recent: Sequence[BlockRows], rows: Sequence[BlockRows]
    ) -> None:
        usual = max([1.0, *self._usual])
        self.evidence = found.changes[0].evidence / usual
        is_loud = self.evidence > ALARMING and self.is_ready
        if self._before is None and self.change is None:
            if is_loud:
                self._before, self._since = self._past[0], recent[0].start
                self._after, self._quiet, self._updates = [], 0, 0
                self.followed = None
            else:
                self._usual.append(found.misfit)
                self._quiet = 0 if self.followed is None else self._quiet + 1
                if self._quiet >= QUIET:
                    self.followed = None
            return
        self._quiet = 0 if is_loud else self._quiet + 1
        if self._quiet >= QUIET:
            self._before = self.change = None
            return
        if self._before is None:
            return  # detected with another window length, and its earlier posterior is discarded
        self._updates += 1
        if len(self._after) < LONGEST_AFTER:
            self._after += rows
        after = self._innovation(self._before, self._after)
        if after is not None:
            self.change = Change(self._since, after.suspects(usual))

    def _innovation(self, before: Posterior, blocks: Sequence[BlockRows]) -> Innovation | None:
        rows = [part for block in blocks for part in block.parts if len(part.valid)]
        return innovation(before, rows, self._parameters, self._sensors) if rows else None
