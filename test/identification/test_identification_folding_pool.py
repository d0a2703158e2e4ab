"""Rows folded by several threads against those folded by one."""

import threading

import numpy as np
import pytest
from analytic_log import analytic_segment, noisy
from random_robots import random_robot

from symbid_ros.diagnosis.findings import Kind
from symbid_ros.errors import DataError
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.dataset import observe
from symbid_ros.identification.rows.folding_pool import available_cores, read_ahead
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.log import Log
from symbid_ros.signals.weak_form import WINDOWS, equation_rows

PARAMETERS = ParameterSet(random_robot(1, links=3), ("viscous", "coulomb"))
LAYOUT = RowLayout.of(PARAMETERS)


@pytest.fixture(scope="module")
def segment():
    exact = analytic_segment(PARAMETERS, 22.0, 3, rate=250.0)
    return noisy(exact, np.random.default_rng(0), position=1e-5, rate=5e-3, effort=0.1)


@pytest.mark.parametrize("jobs", [2, 3, 8])
def test_the_number_of_threads_changes_no_digit(segment, jobs):
    build = equation_rows(PARAMETERS)
    one = observe([segment], build, LAYOUT, WINDOWS)
    several = observe([segment], build, LAYOUT, WINDOWS, jobs=jobs)
    for expected, found in zip(one, several, strict=True):
        assert found.rows.samples == expected.rows.samples > 0
        assert found.seconds == expected.seconds
        np.testing.assert_array_equal(found.rows.factor, expected.rows.factor)
        np.testing.assert_array_equal(found.noise.factor, expected.noise.factor)
        np.testing.assert_array_equal(found.counts, expected.counts)


@pytest.mark.parametrize("failure", [DataError("no wrench", "E520"), KeyboardInterrupt()])
@pytest.mark.parametrize("jobs", [1, 3])
def test_what_stops_a_thread_stops_the_caller(segment, failure, jobs):
    built = 0

    def build(readings):
        nonlocal built
        built += 1
        if built > 3:
            raise failure
        yield from equation_rows(PARAMETERS)(readings)

    before = threading.active_count()
    with pytest.raises(type(failure)):
        observe([segment], build, LAYOUT, WINDOWS, jobs=jobs)
    assert threading.active_count() == before


def test_an_interrupted_reading_ends_all_threads(segment):
    def interrupted():
        yield segment
        raise KeyboardInterrupt

    before = threading.active_count()
    with pytest.raises(KeyboardInterrupt):
        observe(interrupted(), equation_rows(PARAMETERS), LAYOUT, WINDOWS, jobs=3)
    assert threading.active_count() == before


def test_a_log_that_is_checked_while_it_is_read_says_the_same():
    arm = random_robot(3, links=4, floating=False, wrench_frames=0)
    exact = analytic_segment(ParameterSet(arm), 130.0, 3, rate=50.0)  # three slices
    late = np.roll(exact.effort, 2, axis=0)
    log = Log.from_arrays(arm, time=exact.stamp, position=exact.position, effort=late)
    before = threading.active_count()
    one, several = (load_problem(arm, log, IdentifyOptions(jobs=jobs)) for jobs in (1, 3))
    assert [one.kind for one in one.checks.findings] == [Kind.DELAY]
    assert several.checks == one.checks
    for expected, found in zip(one.dataset.observations, several.dataset.observations, strict=True):
        np.testing.assert_array_equal(found.rows.factor, expected.rows.factor)
    assert threading.active_count() == before


def test_an_error_of_reading_ahead_comes_after_what_was_read():
    def failing():
        yield 1
        raise DataError("no wrench", "E520")

    items = read_ahead(failing())
    assert next(items) == 1
    with pytest.raises(DataError, match="no wrench"):
        next(items)


def test_at_least_one_core_is_available():
    assert available_cores() >= 1
