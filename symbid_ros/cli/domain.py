"""A ROS domain that nobody else on this machine uses."""

import random
import socket
from collections.abc import Iterator, Sequence
from contextlib import closing, contextmanager

from symbid_ros.errors import SymbidError

DOMAINS = range(1, 102)  # above lie the ephemeral ports of Linux
# Ports of RTPS 2.5, 9.6.2.3: a participant listens at FIRST + DOMAIN · domain + 10 + 2 · number.
FIRST, DOMAIN = 7400, 250
PARTICIPANT, PARTICIPANTS = 10, 20
MARK = 2  # no participant uses this one


@contextmanager
def unused_domain(domains: Sequence[int] = DOMAINS) -> Iterator[int]:
    """Yield one of ``domains`` in which no participant listens, for as long as the block lasts.

    Whoever else asks this function meanwhile gets another one.

    Raises
    ------
    SymbidError
        When all of them are in use.
    """
    for domain in random.sample(domains, len(domains)):
        mark = _marked(domain)
        if mark is not None:
            with closing(mark):
                yield domain
            return
    raise SymbidError(
        f"each of {len(domains)} ROS domains is in use on this machine; end some of its nodes"
    )


def _marked(domain: int) -> socket.socket | None:
    """Return a socket that marks a domain as taken, or None if it already is."""
    base = FIRST + DOMAIN * domain
    mark = _bound(base + MARK)
    if mark is None:
        return None
    for number in range(PARTICIPANTS):
        probe = _bound(base + PARTICIPANT + 2 * number)
        if probe is None:
            mark.close()
            return None
        probe.close()
    return mark


def _bound(port: int) -> socket.socket | None:
    """Return a socket that owns a port of loopback, or None if another does."""
    owner = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        owner.bind(("127.0.0.1", port))
    except OSError:
        owner.close()
        return None
    return owner
