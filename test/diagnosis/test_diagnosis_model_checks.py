"""Delays on either side of their limits, which stream they are attributed to, and excitation."""

from types import SimpleNamespace

import pytest

from symbid_ros.diagnosis import model_checks
from symbid_ros.diagnosis.delay_checks import _attribute_to_joints, delay_finding
from symbid_ros.diagnosis.findings import Finding, Kind, ModelChecks, Severity
from symbid_ros.diagnosis.model_checks import Excitation


@pytest.mark.parametrize(
    ("delay", "std", "is_found"),
    [
        (3.1e-3, 1e-4, True),
        (2.9e-3, 1e-4, False),
        (-3.1e-3, 1e-4, True),
        (-2.9e-3, 1e-4, False),
        (10e-3, 1.9e-3, True),
        (10e-3, 2.1e-3, False),
        (-10e-3, 2.1e-3, False),
    ],
)
@pytest.mark.parametrize("what", ["", "the efforts"])
def test_a_delay_exceeds_three_milliseconds_and_five_deviations(delay, std, is_found, what):
    found = list(delay_finding("/imu", delay, std, "the others", what))
    assert len(found) == is_found
    for one in found:
        assert (one.kind, one.stream, one.severity) == (Kind.DELAY, "/imu", Severity.WARNING)
        expected = {"delay_ms": 1e3 * delay, "delay_std_ms": 1e3 * std}
        assert one.figures == pytest.approx(expected)
        which = "late" if delay > 0 else "early"
        subject = "the efforts are" if what else "is"
        text = f"/imu: {subject} {abs(1e3 * delay):.1f} ± {1e3 * std:.1g} ms {which} relative to"
        assert text in one.message
        assert ("computed from commands" in one.message) == (bool(what) and delay < 0)
        assert "add sensor_delay to `sensor_errors`" in one.message


def attributed(delays, others=("/imu", "/wrench"), more=()):
    """Return the delays of the findings that are left, ms; ``/joints`` may be among them."""
    checks = ModelChecks(findings=list(more))
    for topic, delay in delays.items():
        checks.findings += delay_finding(topic, 1e-3 * delay, 1e-5, "the others")
    _attribute_to_joints(checks, "/joints", set(others))
    return {
        one.stream: one.figures["delay_ms"] for one in checks.findings if one.kind is Kind.DELAY
    }


@pytest.mark.parametrize(
    ("delays", "joints"),
    [
        ({"/imu": -20, "/wrench": -20}, 20),
        ({"/imu": 20, "/wrench": 29}, -24.5),  # five deviations are 22.5
        ({"/imu": 20, "/wrench": 31}, None),  # five deviations are 27.5, the mean is 25.5
        ({"/imu": 20, "/wrench": 34}, None),  # differ by 14, half of the mean is 13.5
        ({"/imu": 20, "/wrench": -20}, None),
        ({"/imu": 20}, None),
        ({"/joints": 20, "/imu": -20}, 20),
        ({"/joints": 20, "/imu": 20}, None),
        ({"/joints": 20, "/imu": -20, "/wrench": -20}, 20),
        ({"/joints": 20}, None),
    ],
)
def test_equal_delays_of_all_others_are_the_joint_states(delays, joints):
    found = attributed(delays)
    if joints is None:
        assert found == pytest.approx(delays)
    else:
        assert found == pytest.approx({"/joints": joints})


def test_streams_that_are_in_time_speak_against_late_joint_states():
    delays = {"/imu": -20, "/wrench": -20}
    assert attributed(delays, ("/imu", "/wrench", "/other")) == pytest.approx(delays)


def test_other_findings_stay():
    other = Finding(Kind.RATE, "/imu", Severity.WARNING, "slow", {})
    checks = ModelChecks(findings=[other])
    for topic in ("/imu", "/wrench"):
        checks.findings += delay_finding(topic, 0.02, 1e-5, "the others")
    _attribute_to_joints(checks, "/joints", {"/imu", "/wrench"})
    assert checks.findings[0] is other
    assert [one.stream for one in checks.findings] == ["/imu", "/joints"]
    assert checks.findings[1].figures["delay_std_ms"] == pytest.approx(0)


@pytest.mark.parametrize(
    ("floating", "determined", "is_found"),
    [(True, 4, True), (False, 4, False), (True, 6, False), (False, 3, True)],
)
def test_a_log_that_tells_no_more_than_rest_is_a_warning(
    monkeypatch, floating, determined, is_found
):
    """Most of what an arm's motion shows is friction."""
    monkeypatch.setattr(model_checks, "excitation", lambda *_: Excitation(determined, 3, 20.0))
    checks, statistics = ModelChecks(), SimpleNamespace(model=SimpleNamespace(floating=floating))
    model_checks._check_excitation(checks, statistics, SimpleNamespace(left=None))
    assert [one.kind for one in checks.findings] == [Kind.EXCITATION] * is_found
    for one in checks.findings:
        assert "a log at rest would determine 3" in one.message
        assert ("turn the base" in one.message) == floating
