"""A recorder killed at random times: what its unfinished bag still holds."""

import random
from pathlib import Path

import pytest
from paced_feed import kill_recorder

KILLS = 5
ATTEMPTS = 2
BOUND = 0.1  # s
STANDSTILL = 0.02  # s; a machine that halts the publisher for so long may halt the recorder, too
FIRST_DOMAIN = 90  # behind those of the other tests


@pytest.mark.parametrize("seed", range(KILLS))
def test_killed_recorder_loses_a_tenth_of_a_second_at_most(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, seed: int
) -> None:
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
    draw = random.Random(seed)
    for attempt in range(ATTEMPTS):
        domain = FIRST_DOMAIN + attempt * KILLS + seed
        cost = kill_recorder(domain, draw.uniform(0.3, 1.5), tmp_path)
        if cost.standstill <= STANDSTILL:
            break
    assert max(cost.lost.values()) <= BOUND, cost
    assert all(cost.kept.values())
