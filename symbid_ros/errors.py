"""The one error root: what went wrong, where, and what to do, in one line."""


class SymbidError(Exception):
    """Something the user can mend; the message names the place and the remedy."""


class ModelError(SymbidError):
    """A robot description that cannot be read or does not fit the data."""


class BagError(SymbidError):
    """A bag that is missing, unreadable or lacks what the job needs."""


class DataError(SymbidError):
    """Measurements that cannot be used: NaN, too short, misaligned."""


class PriorError(SymbidError):
    """A prior that does not belong to the model or is not a distribution."""


class EstimateError(SymbidError):
    """An estimate that cannot be computed, written or read."""


class SimulationError(SymbidError):
    """A simulation that cannot start or has come to grief, such as a fall."""


class StudyError(SymbidError):
    """A study whose file is wrong, or whose folder holds another one's results."""
