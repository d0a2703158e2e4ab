"""The command validator accepts expected commands only; datagrams are built by ``struct``."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from udp_packets import MEASUREMENT, command, hello, measurement, sequence_and_stamp

from symbid_ros.simulation.command import Drives
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.packet import MAX_SEQUENCE, is_before, next_sequence
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.udp_server import CommandValidator

CLIENT, OTHER = ("127.0.0.1", 40001), ("127.0.0.1", 40002)
TORQUES = [float(value) for value in range(-4, 4)]


@functools.cache
def run() -> tuple[Drives, list[Instant]]:
    robot = Simulator(SimulateOptions(moves=1))
    drives = Drives(robot.joint_names, robot.drive_names, robot.torque_limits)
    return drives, [robot.step() for _ in range(3)]


def awaiting() -> CommandValidator:
    """Return a validator that has accepted a first command and expects the second."""
    drives, instants = run()
    validator = CommandValidator(drives)
    validator.process(hello(), CLIENT)
    sequence, stamp = sequence_and_stamp(validator.expect(instants[0]))
    assert validator.process(command(sequence, stamp, TORQUES), CLIENT) is not None
    validator.expect(instants[1])
    return validator


@pytest.fixture
def validator() -> CommandValidator:
    return awaiting()


@pytest.fixture
def instants() -> list[Instant]:
    return run()[1]


def rejected(validator: CommandValidator) -> dict[str, int]:
    return {str(reason): count for reason, count in validator.counts.rejected.items() if count}


def test_a_measurement_contains_all_readings(validator, instants):
    datagram = validator.expect(instants[2])
    assert sequence_and_stamp(datagram) == (3, instants[2].stamp)
    for name, values in measurement(datagram).items():
        np.testing.assert_array_equal(values, getattr(instants[2], name).ravel())


def test_the_expected_command_is_accepted(validator, instants):
    passed = validator.process(command(2, instants[1].stamp, TORQUES), CLIENT)
    assert passed.tolist() == TORQUES
    assert rejected(validator) == {}
    assert (validator.counts.accepted, validator.counts.hellos) == (2, 1)


STAMP = 2_000_000
ANSWER = command(2, STAMP, TORQUES)
REJECTIONS = [
    ("length", b""),
    ("length", ANSWER[:23]),
    ("length", ANSWER[:-1]),
    ("length", ANSWER + b"\0"),
    ("length", command(2, STAMP, TORQUES[:-1])),
    ("length", command(2, STAMP, [*TORQUES, 0.0])),
    ("length", command(2, STAMP, TORQUES, count=7)),
    ("length", command(2, STAMP, TORQUES, count=2**32 - 1)),
    ("magic", command(2, STAMP, TORQUES, magic=0x534D4244)),
    ("version", command(2, STAMP, TORQUES, version=2)),
    ("kind", command(2, STAMP, TORQUES, kind=MEASUREMENT)),
    ("duplicate", command(1, STAMP, TORQUES)),
    ("future", command(3, STAMP, TORQUES)),
    ("old", command(2**32 - 5, STAMP, TORQUES)),
    ("stamp", command(2, STAMP + 1, TORQUES)),
    ("stamp", command(2, 0, TORQUES)),
    ("not_finite", command(2, STAMP, [math.nan, *TORQUES[1:]])),
    ("not_finite", command(2, STAMP, [*TORQUES[:-1], -math.inf])),
    ("beyond_limit", command(2, STAMP, [*TORQUES[:-1], 100.0000001])),
    ("beyond_limit", command(2, STAMP, [-1e300, *TORQUES[1:]])),
]


@pytest.mark.parametrize(("reason", "datagram"), REJECTIONS)
def test_rejected_datagrams_are_counted_by_reason(validator, reason, datagram):
    assert validator.process(datagram, CLIENT) is None
    assert rejected(validator) == {reason: 1}
    assert validator.counts.accepted == 1
    # The state has not changed: the expected command is still accepted.
    assert validator.process(ANSWER, CLIENT) is not None


def test_a_command_is_accepted_once(validator):
    assert validator.process(ANSWER, CLIENT) is not None
    assert validator.process(ANSWER, CLIENT) is None
    assert rejected(validator) == {"duplicate": 1}


def test_other_senders_are_rejected_while_a_controller_is_in_control(validator, instants):
    for datagram in (hello(), ANSWER, b"nonsense"):
        assert validator.process(datagram, OTHER) is None
    assert rejected(validator) == {"stranger": 3}
    assert validator.controller == CLIENT


def test_the_first_hello_after_release_takes_control(validator, instants):
    validator.release()
    validator.process(hello(), OTHER)
    assert (validator.controller, validator.is_controlled) == (OTHER, True)
    assert validator.process(ANSWER, CLIENT) is None
    assert validator.process(ANSWER, OTHER).tolist() == TORQUES
    assert rejected(validator) == {"stranger": 1}


def test_a_late_command_is_rejected_but_keeps_control(validator, instants):
    validator.release()
    validator.expect(instants[2])
    assert validator.process(ANSWER, OTHER) is None
    assert not validator.is_controlled
    assert validator.process(ANSWER, CLIENT) is None
    assert validator.is_controlled
    assert rejected(validator) == {"old": 2}


def test_hello_gives_no_torques(validator):
    assert validator.process(command(0, STAMP, TORQUES), CLIENT) is None
    assert (validator.counts.hellos, validator.counts.accepted) == (2, 1)


def test_sequence_numbers_wrap_around():
    assert next_sequence(MAX_SEQUENCE) == 1
    assert is_before(MAX_SEQUENCE, 1)
    assert is_before(MAX_SEQUENCE - 1, MAX_SEQUENCE)
    assert not is_before(1, MAX_SEQUENCE)
    assert not is_before(5, 5)


MUTATIONS = st.lists(st.tuples(st.integers(0, len(ANSWER) - 1), st.integers(1, 255)), max_size=4)


def mutated(changes: list[tuple[int, int]]) -> bytes:
    datagram = bytearray(ANSWER)
    for place, change in changes:
        datagram[place] ^= change
    return bytes(datagram)


@settings(deadline=None)
@given(st.lists(st.binary(max_size=200) | MUTATIONS.map(mutated), max_size=5))
def test_no_datagram_raises_an_error_or_exceeds_the_torque_limits(datagrams):
    validator = awaiting()
    for datagram in datagrams:
        passed = validator.process(datagram, CLIENT)
        if passed is not None:
            # Only bits of the torques can have changed.
            assert datagram[:24] == ANSWER[:24]
            assert len(datagram) == len(ANSWER)
            assert np.all(np.abs(passed) <= 100.0)
    counts = validator.counts
    before = 2  # hello and first command
    assert (
        counts.accepted + counts.hellos + sum(counts.rejected.values()) == len(datagrams) + before
    )
