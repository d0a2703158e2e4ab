"""Friction that changes during a log: its columns against closed forms."""

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.errors import ModelError
from symbid_ros.model.warming import NODES, PAUSE, Warming, courses_of, warming_in

SECOND = 1_000_000_000
LOG = ((1_700_000_000 * SECOND, 1_700_000_300 * SECOND),)


def share(courses, stamps):
    start, stop = courses[-1]
    return (stamps - start) / (stop - start)


def test_the_unknowns_are_the_changes_at_percentages_of_the_log() -> None:
    start, stop = LOG[0]
    stamps = start + (stop - start) // 100 * np.array(NODES)
    columns = Warming(0, "viscous", LOG).columns(stamps)
    np.testing.assert_allclose(columns, np.eye(len(NODES))[:, :-1], atol=1e-12)


def test_friction_is_constant_outside_the_log() -> None:
    start, stop = LOG[0]
    outside = np.array([0, start - 1, stop, stop + 1, stop + 1000 * SECOND])
    assert not Warming(0, "coulomb", LOG).columns(outside).any()


@pytest.mark.parametrize(("rate", "error"), [(0.1, 1e-4), (1, 1e-3), (3, 1e-3), (10, 4e-3)])
def test_an_exponential_decay_is_followed(rate, error) -> None:
    stamps = np.linspace(*LOG[0], 1000).astype(np.int64)
    change = np.exp(-rate * share(LOG, stamps)) - np.exp(-rate)
    columns = Warming(0, "viscous", LOG).columns(stamps)
    found = columns @ np.linalg.lstsq(columns, change, rcond=None)[0]
    assert np.sqrt(np.mean((found - change) ** 2)) < error * change[0]


def test_each_part_has_a_change_of_its_own() -> None:
    """Until the end of the last part, also if friction jumps between two."""
    courses = ((0, 100 * SECOND), (300 * SECOND, 400 * SECOND))
    one = Warming(2, "viscous", courses)
    assert one.terms[:5] == tuple(f"viscous_excess_part1_{node}" for node in NODES)
    assert one.terms[5:] == tuple(f"viscous_excess_{node}" for node in NODES[:-1])
    stamps = np.array([0, 100, 200, 300, 400]) * SECOND
    change = np.array([5.0, 2.0, 0.0, 3.0, 0.0])
    unknowns = np.array([5.0, 4.0, 3.0, 2.5, 2.0, 3.0, 2.0, 1.0, 0.5])
    np.testing.assert_allclose(one.columns(stamps) @ unknowns, change, atol=1e-12)


def test_long_pauses_divide_a_log() -> None:
    spans = [(400, 500), (0, 100), (500 + PAUSE, 600 + PAUSE), (120, 150)]
    assert courses_of(spans) == ((0, 500), (500 + PAUSE, 600 + PAUSE))


@pytest.mark.parametrize("name", ["wrist/viscous_excess_0", "{}/viscous_excess_part99999_0"])
def test_changes_of_other_robots_are_refused(name) -> None:
    robot = random_robot(2, links=3, floating=False, wrench_frames=0)
    with pytest.raises(ModelError, match="friction that changes") as refusal:
        warming_in([name.format(robot.joint_names[0])], robot)
    assert refusal.value.code == "E117"
