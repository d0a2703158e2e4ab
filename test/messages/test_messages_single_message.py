"""Gaps counted in blocks equal those of all stamps."""

import numpy as np
import pytest

from symbid_ros.messages.single_message import BLOCK, GapCounter
from symbid_ros.signals.defects import Gaps, find_gaps


@pytest.mark.parametrize("count", [0, 1, 2, BLOCK, BLOCK + 1, 3 * BLOCK + 17])
def test_gaps_in_blocks_equal_gaps_of_all_stamps(count: int) -> None:
    draw = np.random.default_rng(count)
    stamps = np.arange(count) * 1_000_000 + draw.integers(-50_000, 50_000, count)
    stamps = stamps[draw.random(count) > 0.01]
    gap_count = GapCounter()
    for stamp in stamps:
        gap_count.add(int(stamp))
    found, whole = gap_count.gaps, find_gaps(stamps)
    assert found.period == pytest.approx(whole.period, rel=0.001)
    assert (found.gaps, found.missing, found.longest, found.disordered) == (
        whole.gaps,
        whole.missing,
        whole.longest,
        whole.disordered,
    )


def test_gap_between_blocks_is_counted_once() -> None:
    gap_count = GapCounter()
    for stamp in [*range(BLOCK + 1), *range(BLOCK + 5, BLOCK + 100)]:
        gap_count.add(stamp)
    assert gap_count.gaps == Gaps(period=1, gaps=1, missing=4, longest=5, disordered=0)
