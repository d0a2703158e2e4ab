"""Alarms about single quantities."""

import numpy as np
import pytest

from symbid_ros.estimation.alarms import Alarm, heavy_link_alarms

LINKS = "upper_arm", "forearm", "wrist"
BEFORE = np.array([4.0, 2.0, 0.2])


@pytest.mark.parametrize(
    ("after", "std", "is_heavy"),
    [
        ([4.1, 2.2, 1.7], 0.1, True),
        ([4.1, 2.2, 1.7], 2.0, False),  # the data widened the prior enough
        ([5.9, 2.9, 0.3], 0.01, False),  # a file with wrong masses
        ([40.0, 20.0, 2.0], 0.1, False),  # wrong units
    ],
)
def test_a_link_that_weighs_several_times_the_models_mass_raises_an_alarm(after, std, is_heavy):
    found = heavy_link_alarms(LINKS, BEFORE, np.array(after), np.full(3, std))
    assert len(found) == is_heavy
    for one in found:
        assert one.startswith(f"wrist is 8.5 {Alarm.HEAVY_LINK} (0.2 kg)")
