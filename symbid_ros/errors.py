"""Errors that a user can cause: what went wrong, where, and how to fix it, in one line."""

import copyreg
from typing import Any


class SymbidError(Exception):
    """An error that the user can fix.

    Parameters
    ----------
    message : str
        One line: what happened, where (file, topic, joint, link) and the option or parameter that
        fixes it.
    code : str
        Such as ``"E104"``. ``docs/errors.md`` gives the cause and fix of each code, which never
        changes its meaning.
    """

    def __init__(self, message: str, code: str) -> None:
        super().__init__(message)
        self.code = code

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle without calling ``__init__``, whose arguments differ from ``args``.

        Processes send their errors to their parent in this way.
        """
        return copyreg.__newobj__, (type(self), *self.args), vars(self)  # type: ignore[attr-defined]

    @property
    def labelled(self) -> str:
        """The message with its code, as commands and nodes print it."""
        return f"{self} (SYMBID-{self.code})"


class ModelError(SymbidError):
    """A robot description that cannot be read or does not match the data."""


class BagError(SymbidError):
    """A bag that is missing, unreadable or incomplete."""


class DataError(SymbidError):
    """Measurements that cannot be used: NaN, too short, misaligned."""


class PriorError(SymbidError):
    """A prior that does not match the model or is not a distribution."""


class EstimateError(SymbidError):
    """An estimate that cannot be computed, written or read."""


class OptionError(EstimateError):
    """An option with an invalid value, or options that contradict each other.

    The message names options in backquotes, as fields; each front end spells them its own way.
    """


class SimulationError(SymbidError):
    """A simulation that cannot start or has failed, for example by a fall."""


class StudyError(SymbidError):
    """A study with an invalid file, or with a folder that holds results of another study."""
