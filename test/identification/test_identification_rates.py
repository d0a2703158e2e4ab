"""Logs of any length and rate, with any gaps, are identified or refused in one line."""

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from log_fuzz import run
from random_logs import LogPlan, random_streams, small_robot

from symbid_ros.diagnosis.model_checks import check_model
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.sensor_faults import mask_faulty_messages
from symbid_ros.errors import DataError, SymbidError
from symbid_ros.estimation.prior import model_prior
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.dataset import Dataset, Processing, fold_dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.alignment import align_checked
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.weak_form import BLOCKS, block_length

START = 1_723_456_789_012_345_678
SPAN = 60 * 10**9
ARM, LEGGED = (ParameterSet(small_robot(3, floating=floating)) for floating in (False, True))


def record_of(parameters: ParameterSet, plan: LogPlan, windows: tuple[float, ...] = ()) -> Dataset:
    """Fold the rows of a random log, cut into minutes like that of a bag."""
    streams, _ = mask_faulty_messages(random_streams(parameters.model, plan, 1))
    whole = align_checked(streams, parameters.model)
    first, last = int(whole[0].stamp[0]) // SPAN, int(whole[-1].stamp[-1]) // SPAN
    segments = [
        part
        for minute in range(first, last + 1)
        for part in cut_to(whole, minute * SPAN, (minute + 1) * SPAN)
    ]
    processing = Processing(windows=windows) if windows else Processing()
    return fold_dataset(segments, "log", parameters, processing)


def identified(parameters: ParameterSet, plan: LogPlan) -> Identification:
    """Identify from a log as offline, without reading a bag."""
    record = record_of(parameters, plan)
    first = next(iter(record.segments))
    watch = ModelStatistics(parameters.model, first.wrench_frames, first.imu_frames)
    for segment in record.segments:
        watch.add(segment)
    topics = {frame: frame for frame in first.wrench_frames}
    check_model(watch, "/joint_states", list(first.imu_frames), topics)
    prior = model_prior(parameters)
    return SolvedProblem.of(
        Problem(record.observations, parameters, prior, is_empirical=True)
    ).map()


plans = st.builds(
    LogPlan,
    rate=st.floats(20, 4000),
    count=st.integers(50, 1500),
    start=st.integers(-5 * 10**9, 2 * 10**18),
    gaps=st.lists(st.tuples(st.floats(0, 1), st.floats(1, 200)), max_size=4).map(tuple),
    ratios=st.sampled_from([(1.0, 1.0), (0.5, 2.0), (2.0, 0.3)]),
    jitter=st.sampled_from([0.0, 0.3]),
    noise=st.sampled_from([0.0, 1.0]),
)


@settings(max_examples=30)
@given(parameters=st.sampled_from([ARM, LEGGED]), plan=plans)
@example(ARM, LogPlan(100.0, 801, START))
@example(LEGGED, LogPlan(1000.0, 1001, START))
@example(ARM, LogPlan(500.0, 1500, SPAN - 1498 * 2_000_000))  # two samples of the last minute
@example(LEGGED, LogPlan(500.0, 1500, SPAN - 1499 * 2_000_000))
def test_any_log_is_identified_or_refused_in_one_line(
    parameters: ParameterSet, plan: LogPlan
) -> None:
    try:
        refusal, value = "", identified(parameters, plan).estimate.value
    except SymbidError as error:
        refusal, value = str(error), np.zeros(0)
    assert "\n" not in refusal
    assert np.isfinite(value).all()
    # Four seconds without a gap suffice at any of these rates.
    assert not refusal or plan.gaps or plan.count < 4 * plan.rate


@pytest.mark.parametrize("rate", [20.0, 30.0, 57.0, 100.0])
@pytest.mark.parametrize("parameters", [ARM, LEGGED], ids=["arm", "legged"])
def test_most_of_a_minute_is_used_at_any_rate(parameters: ParameterSet, rate: float) -> None:
    plan = LogPlan(rate, round(60 * rate), START)
    for one in record_of(parameters, plan).observations:
        # Windows overlap by half.
        kept = one.window / 2 * one.rows.samples / 60
        assert 0.8 < kept < 1.0


@pytest.mark.parametrize("more", [-1, 0, 1, 2, 3, 49, 50, 51])
@pytest.mark.parametrize("rate", [20.0, 100.0, 125.0])
def test_a_log_of_about_one_block(rate: float, more: int) -> None:
    length = block_length(rate)
    count = round(length * 1e-9 * rate) + more
    record = record_of(ARM, LogPlan(rate, count, 430_000_000 * length))
    for one in record.observations:
        assert one.rows.samples > 0
    assert len(record.samples) > 0
    assert record.samples.stamp.max() < 430_000_000 * length + count / rate * 1e9


@pytest.mark.parametrize("rate", [20.0])
def test_errors_from_slow_logs_agree_with_their_standard_deviations(rate: float) -> None:
    plan = LogPlan(rate, round(120 * rate), START)
    record = record_of(LEGGED, plan)
    prior = model_prior(LEGGED)
    found = SolvedProblem.of(Problem(record.observations, LEGGED, prior)).map()
    mass = LEGGED.names.index("link_0/m")
    error = np.abs(found.estimate.value - LEGGED.values)
    assert error[mass] < 0.02 * LEGGED.values[mass]
    # The remaining error at 20 Hz comes from differences between samples.
    assert np.sqrt(np.mean((error / found.estimate.std) ** 2)) < 4


def test_blocks_divide_a_slice() -> None:
    assert all(SPAN % length == 0 for length in BLOCKS)


def test_a_window_of_too_few_samples_is_refused() -> None:
    with pytest.raises(DataError, match=r"hold fewer than 6 samples at 20 Hz.*at least 0\.3 s"):
        record_of(ARM, LogPlan(20.0, 400, START), (0.081,))


def test_random_bags_end_without_a_traceback() -> None:
    """Twenty of the hundreds that ``make fuzz`` tries."""
    assert run(range(20)) == []
