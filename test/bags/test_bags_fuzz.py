"""Some of the thousands of damaged bags that ``make fuzz`` tries."""

import subprocess
import sys

import bag_fuzz
import numpy as np
import pytest


def test_no_damaged_bag_passes_as_intact() -> None:
    """Runs in a separate process, because its peak memory is measured."""
    command = [sys.executable, bag_fuzz.__file__, "--cases", "160", "--processes", "1"]
    ended = subprocess.run(command, capture_output=True, text=True, check=False, timeout=300)
    assert ended.returncode == 0, ended.stdout + ended.stderr


@pytest.mark.parametrize("kind", bag_fuzz.KINDS, ids=lambda kind: kind.name)
def test_bags_are_intact_before_they_are_damaged(kind: bag_fuzz.Kind) -> None:
    _, arrays = bag_fuzz.original(kind)
    assert bag_fuzz.count(arrays) == 4 * bag_fuzz.STEPS


def test_wrong_number_is_detected() -> None:
    _, truth = bag_fuzz.original(bag_fuzz.KINDS[0])
    stamp, values = truth["/imu/data"]
    wrong = values.copy()
    wrong[7, 1] = np.nextafter(wrong[7, 1], np.inf)
    assert [*bag_fuzz.differences({"/imu/data": (stamp, wrong)}, truth)] == [
        "/imu/data: values that are not in the original"
    ]
    assert [*bag_fuzz.differences({"/imu/data": (stamp + 1, values)}, truth)] == [
        "/imu/data: stamps that are not in the original"
    ]
