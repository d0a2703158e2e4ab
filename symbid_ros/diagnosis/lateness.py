"""The fewest streams that are late, of delays that are known together only."""

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.diagnosis.gains import Gains

# Squared deviations that a delay must explain, and what share of all that there is to explain.
EVIDENCE = 25.0
SHARE = 0.1


def late_streams(delays: Gains) -> dict[int, tuple[float, float]]:
    """Return places of the delays that are not zero, and each with its standard deviation, s.

    Delays are known against each other better than by themselves, so that one late stream may
    look like all others early. One after the other those are taken that explain most of the
    estimate, until little of it is left.
    """
    free = np.flatnonzero(delays.sensors.is_delay)
    mean = delays.mean[free]
    precision = np.linalg.inv(delays.covariance[np.ix_(free, free)]).astype(np.float64)
    moment = precision @ mean
    total = left = float(mean @ moment)
    chosen: list[int] = []
    found: dict[int, tuple[float, float]] = {}
    while len(chosen) < len(free):
        costs = {
            place: total - _explained(precision, moment, [*chosen, place])
            for place in range(len(free))
            if place not in chosen
        }
        best = min(costs, key=lambda place: costs[place])
        if left - costs[best] < max(EVIDENCE, SHARE * total):
            break
        chosen.append(best)
        left = costs[best]
        own = np.ix_(chosen, chosen)
        size = np.linalg.solve(precision[own], moment[chosen])
        std = np.sqrt(np.diag(np.linalg.inv(precision[own])))
        found = {
            int(free[place]): (float(one), float(doubt))
            for place, one, doubt in zip(chosen, size, std, strict=True)
        }
    return found


def _explained(precision: FloatArray, moment: FloatArray, places: list[int]) -> float:
    own = np.ix_(places, places)
    return float(moment[places] @ np.linalg.solve(precision[own], moment[places]))
