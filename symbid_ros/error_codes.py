"""Codes of errors, stable over releases, each with its cause and its fix.

The documentation lists them; tests bind to them rather than to the wording of a message.
"""

from typing import NamedTuple


class Entry(NamedTuple):
    """What a code means.

    Attributes
    ----------
    cause, fix : str
        One sentence each, for the documentation.
    """

    cause: str
    fix: str


CODES: dict[str, Entry] = {
    # E1xx: robot models
    # E2xx: bags and messages
    # E3xx: measurements
    # E4xx: priors and estimates
    # E5xx: options and their combinations
    # E6xx: simulation
    # E7xx: studies and reports
    # E8xx: ROS nodes
}
