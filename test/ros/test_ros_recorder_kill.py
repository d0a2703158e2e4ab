"""Contents of the unfinished bag of a recorder that was killed at a random time."""

import random
from pathlib import Path

import pytest
from paced_feed import kill_recorder

KILLS = 3
ATTEMPTS = 5
BOUND = 0.1  # s during which the recorder could run
STANDSTILL = (
    0.02  # s; a machine that delays the publisher for this long may delay the recorder as well
)


@pytest.mark.parametrize("seed", range(KILLS))
def test_killed_recorder_loses_a_tenth_of_a_second_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    draw = random.Random(seed)
    for attempt in range(ATTEMPTS):
        folder = tmp_path / str(attempt)
        folder.mkdir()
        cost = kill_recorder(draw.uniform(0.3, 1.5), folder)
        if cost.standstill <= STANDSTILL:
            assert max(cost.lost.values()) <= BOUND + cost.waited, cost
            return
    pytest.skip(f"the machine stands still for {cost.standstill * 1e3:.0f} ms at a time")
