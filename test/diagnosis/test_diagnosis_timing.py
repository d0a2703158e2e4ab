"""Statistics of stamps, and findings on either side of their limits."""

import numpy as np
import pytest

from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.timing import TimingCheck

MILLISECOND = 1_000_000
START = 1_700_000_000_000_000_000


def ticks(count, period_ms=10.0, first_ms=0.0):
    return START + np.rint((first_ms + period_ms * np.arange(count)) * MILLISECOND).astype(np.int64)


def checked(*parts):
    check = TimingCheck("/imu")
    for part in parts:
        check.add(part)
    return check


def findings(check, late_ms=0.0, early_ms=0.0):
    first = check.first - round(late_ms * MILLISECOND)
    return check.findings(first, check.last + round(early_ms * MILLISECOND))


@pytest.mark.parametrize("cuts", [[], [40], [1, 2, 99]])
def test_regular_stamps_have_figures_but_no_finding(cuts):
    stamps = ticks(100)
    order = np.random.default_rng(0).permutation(100)
    parts = [stamps[order[order < 50]], stamps[order[order >= 50]]] if not cuts else None
    check = checked(*(parts or np.split(stamps, cuts)))
    figures = check.figures
    assert (figures.topic, figures.messages) == ("/imu", 100)
    assert figures.duration_s == pytest.approx(0.99)
    assert figures.rate_hz == pytest.approx(100)
    assert figures.jitter == pytest.approx(0, abs=1e-12)
    assert (figures.gaps, figures.missing) == (0, 0)
    assert figures.longest_gap_s == pytest.approx(0.01)
    assert findings(check) == []


def test_a_topic_without_two_messages_has_no_rate():
    for stamps in (ticks(0), ticks(1)):
        check = checked(stamps)
        assert (check.period, check.figures.rate_hz, check.figures.jitter) == (0, 0, 0)
        assert check.figures.duration_s == 0
        assert check.figures.messages == len(stamps)
        assert check.findings(START, START) == []


def test_messages_that_repeat_in_the_next_slice_count_once_as_intervals():
    check = checked(ticks(10), ticks(12), ticks(10, first_ms=120))
    assert check.messages == 32
    assert (check.gaps, check.missing) == (0, 0)
    assert check.last == ticks(22)[-1]
    assert check.first == START
    # Nor do gaps count twice.
    lost = np.delete(ticks(20), [4, 5, 15])
    check = checked(lost[:10], lost, lost)
    assert (check.gaps, check.missing) == (2, 3)


@pytest.mark.parametrize("cut", [None, 30])
def test_lost_messages_are_counted_within_and_between_slices(cut):
    stamps = np.delete(ticks(100), [30, 31, 32, 60])
    check = checked(*([stamps] if cut is None else np.split(stamps, [cut])))
    (finding,) = findings(check)
    assert (finding.kind, finding.stream, finding.severity) == (Kind.GAP, "/imu", Severity.WARNING)
    assert finding.figures == {"gaps": 2, "missing": 4, "longest_gap_s": pytest.approx(0.04)}
    assert check.figures.jitter == pytest.approx(0, abs=1e-12)
    assert "4 messages (4 %) are missing in 2 gaps, the longest lasts 0.04 s" in finding.message


@pytest.mark.parametrize("offset_ms", [0.0, 0.001, 0.5, 2.0, 5.0])
def test_parts_of_a_topic_have_periods_of_their_own(offset_ms):
    """Two drivers publish half of the joints each."""
    check = TimingCheck("/joint_states")
    for cut in (slice(0, 50), slice(50, 100)):
        check.add(ticks(100)[cut], part=0)
        check.add(np.delete(ticks(100, first_ms=offset_ms)[cut], [20, 21]), part=1)
    figures = check.figures
    assert figures.rate_hz == pytest.approx(100)
    assert (figures.messages, figures.gaps, figures.missing) == (196, 2, 4)
    assert figures.jitter == pytest.approx(0, abs=1e-12)
    assert figures.duration_s == pytest.approx(0.99 + offset_ms * 1e-3)
    assert [one.kind for one in findings(check)] == [Kind.GAP]


@pytest.mark.parametrize(
    ("lost", "severity", "percent"),
    [
        (4000, Severity.UNUSABLE, "over 99"),
        (19, Severity.WARNING, 49),
        (21, Severity.UNUSABLE, 51),
        (480, Severity.UNUSABLE, 96),
    ],
)
def test_a_topic_that_lacks_more_than_half_of_its_messages_is_unusable(lost, severity, percent):
    """Twenty messages are left."""
    check = checked(np.append(ticks(10), ticks(10, first_ms=(10 + lost) * 10)))
    (finding,) = findings(check)
    assert finding.figures["missing"] == lost
    assert finding.severity is severity
    assert f"({percent} %)" in finding.message


@pytest.mark.parametrize(
    ("period_ms", "offset_ms", "is_found"),
    [(10, 990, False), (10, 1010, True), (400, 1990, False), (400, 2010, True)],
)
@pytest.mark.parametrize("side", ["late_ms", "early_ms"])
def test_a_topic_begins_and_ends_with_the_others(period_ms, offset_ms, is_found, side):
    """Within a second, or five periods of a slow topic."""
    found = findings(checked(ticks(20, period_ms)), **{side: offset_ms})
    found = [one for one in found if one.kind is Kind.GAP]
    assert len(found) == is_found
    for one in found:
        expected = {"late_s": 0.0, "early_s": 0.0, side.replace("_ms", "_s"): offset_ms / 1e3}
        assert one.figures == pytest.approx(expected)
        assert one.severity is Severity.WARNING


@pytest.mark.parametrize(("rate", "is_found"), [(49.5, False), (48.5, True), (0.5, True)])
def test_a_slow_topic_is_reported(rate, is_found):
    found = findings(checked(ticks(60, 1e3 / rate)))
    assert [one.kind for one in found] == [Kind.RATE] * is_found
    for one in found:
        assert one.figures["rate_hz"] == pytest.approx(rate, rel=1e-6)
        assert "below 50 Hz" in one.message


@pytest.mark.parametrize(("share", "is_found"), [(0.24, False), (0.26, True)])
@pytest.mark.parametrize("cuts", [[], [101]])
def test_unsteady_periods_are_reported(share, is_found, cuts):
    """Every second period is longer and every other is shorter by the same share."""
    steps = 10 * (1 + share * np.tile([1.0, -1.0, 0.0, 0.0], 75))
    # The median is the nominal period; half of the periods deviate.
    steps = 10 + (steps - 10) * np.sqrt(2)
    stamps = START + np.rint(np.append(0, np.cumsum(steps)) * MILLISECOND).astype(np.int64)
    check = checked(*np.split(stamps, cuts))
    assert check.figures.jitter == pytest.approx(share, rel=1e-2)
    found = findings(check)
    assert [one.kind for one in found] == [Kind.RATE] * is_found
    for one in found:
        assert "vary by 26 %" in one.message
        assert one.figures["jitter"] == pytest.approx(share, rel=1e-2)
