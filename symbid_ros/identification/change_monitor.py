"""A robot that is not any more what it was: noticed as its rows come in."""

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.estimation.change import Innovation, LinkChange, innovation
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.identification.accumulator import BlockRows
from symbid_ros.model.parameters import ParameterSet

# Evidence for a change, nat, over the misfit that has been usual: by chance it is never that large.
ALARMING = 30.0
# Looks that tell what is usual, and how many there must be before an alarm.
USUAL, FEWEST_USUAL = 30, 8
# New rows are those of so many looks. The change may lie within them, so that who has changed is
# asked of those that come after.
RECENT = 2
# Pieces that are asked who has changed: a robot that goes on must not fill the memory.
LONGEST_AFTER = 30
# Quiet looks after which a change is over: the estimate has followed it.
QUIET = 10


@dataclass(frozen=True)
class Change:
    """A change that has been noticed.

    Attributes
    ----------
    since : int
        Stamp of the first rows that showed it, ns.
    suspects : tuple of LinkChange
        The link that best explains the rows since then, and any others that explain them about as
        well, each with the change that it would need.
    """

    since: int
    suspects: tuple[LinkChange, ...]

    @property
    def suspect(self) -> LinkChange:
        """The link that best explains what has come since."""
        return self.suspects[0]

    def __str__(self) -> str:
        """Return what an alarm says of it."""
        names = [suspect.link for suspect in self.suspects]
        since = f"changed since {self.since * 1e-9:.1f} s"
        if len(names) == 1:
            return f"{names[0]} has {since}: {_amount(self.suspect)}"
        amounts = ", ".join(f"{_amount(one)} on {one.link}" for one in self.suspects)
        return (
            f"{', '.join(names[:-1])} or {names[-1]} has {since}, the motion does not tell which: "
            f"{amounts}"
        )


def _amount(change: LinkChange) -> str:
    """Return the mass that was added and, where it is known, its place in the link's frame."""
    mass, std = change.phi[0], change.std[0]
    place = ""
    if abs(mass) > 3 * std:
        # Adding zero removes the sign of a rounded -0.00.
        x, y, z = np.round(change.phi[1:4] / mass, 2) + 0.0
        place = f" at ({x:.2f}, {y:.2f}, {z:.2f}) m"
    return f"{mass:+.2f} ± {std:.2f} kg{place}"


class ChangeWatch:
    """Compares the rows of each look with what was known some looks ago.

    Parameters
    ----------
    parameters : ParameterSet
        The robot's columns.

    Attributes
    ----------
    change : Change or None
        What stands.
    evidence : float
        Of the last look, over what has been usual; nan before the first.
    """

    def __init__(self, parameters: ParameterSet) -> None:
        self._parameters = parameters
        self._usual: deque[float] = deque(maxlen=USUAL)
        self.evidence = float("nan")
        self.change: Change | None = None
        self.begin_again()

    @property
    def is_ready(self) -> bool:
        """Whether enough looks have told what is usual for a change to be told from it."""
        return len(self._usual) >= FEWEST_USUAL

    def begin_again(self) -> None:
        """Let go of rows and knowledge: those to come are over another length of windows.

        A change that stands goes on to stand.
        """
        self._past: deque[Posterior] = deque(maxlen=RECENT)
        self._rows: deque[tuple[BlockRows, ...]] = deque(maxlen=RECENT)
        self._before: Posterior | None = None
        self._since = self._quiet = 0
        self._after: list[BlockRows] = []

    def look(self, rows: Sequence[BlockRows], posterior: Posterior) -> None:
        """Take the rows that are new at this look, and what is known with them.

        Parameters
        ----------
        rows : sequence of BlockRows
            Since the last look, all over the same length of windows.
        posterior : Posterior
            By all rows up to now.
        """
        self._rows.append(tuple(rows))
        if len(self._past) == RECENT:
            recent = [block for some in self._rows for block in some]
            found = self._innovation(self._past[0], recent)
            if found is not None:
                self._judge(found, recent, rows)
        self._past.append(posterior)

    def _judge(
        self, found: Innovation, recent: Sequence[BlockRows], rows: Sequence[BlockRows]
    ) -> None:
        usual = max([1.0, *self._usual])
        self.evidence = found.links[0].evidence / usual
        is_loud = self.evidence > ALARMING and self.is_ready
        if self._before is None and self.change is None:
            if is_loud:
                self._before, self._since = self._past[0], recent[0].start
                self._after, self._quiet = [], 0
            else:
                self._usual.append(found.misfit)
            return
        self._quiet = 0 if is_loud else self._quiet + 1
        if self._quiet >= QUIET:
            self._before = self.change = None
            return
        if self._before is None:
            return  # what stands was told over other windows, by who did not know of it yet
        if len(self._after) < LONGEST_AFTER:
            self._after += rows
        after = self._innovation(self._before, self._after)
        if after is not None:
            self.change = Change(self._since, after.suspects(usual))

    def _innovation(self, known: Posterior, blocks: Sequence[BlockRows]) -> Innovation | None:
        rows = [part for block in blocks for part in block.parts if len(part.valid)]
        return innovation(known, rows, self._parameters) if rows else None
