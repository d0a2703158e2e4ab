"""What may move the robot: datagrams made by ``struct`` alone, offered one by one."""

import functools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from udp_packets import MEASUREMENT, command, hello, measurement, sequence_and_stamp

from symbid_ros.simulation.command import Drives
from symbid_ros.simulation.packet import MAX_SEQUENCE, is_before, next_sequence
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.udp_server import CommandValidator

CLIENT, OTHER = ("127.0.0.1", 40001), ("127.0.0.1", 40002)
TORQUES = [float(value) for value in range(-4, 4)]


@functools.cache
def run() -> tuple[Drives, list[Instant]]:
    robot = Simulator(moves=1)
    drives = Drives(robot.joint_names, robot.drive_names, robot.torque_limits)
    return drives, [robot.step() for _ in range(3)]


def awaiting() -> CommandValidator:
    """Return a gate that has had its first answer and awaits the second."""
    drives, instants = run()
    gate = CommandValidator(drives)
    gate.process(hello(), CLIENT)
    sequence, stamp = sequence_and_stamp(gate.expect(instants[0]))
    assert gate.process(command(sequence, stamp, TORQUES), CLIENT) is not None
    gate.expect(instants[1])
    return gate


@pytest.fixture
def gate() -> CommandValidator:
    return awaiting()


@pytest.fixture
def instants() -> list[Instant]:
    return run()[1]


def rejected(gate: CommandValidator) -> dict[str, int]:
    return {str(reason): count for reason, count in gate.counts.rejected.items() if count}


def test_a_measurement_says_all_that_the_sensors_say(gate, instants):
    datagram = gate.expect(instants[2])
    assert sequence_and_stamp(datagram) == (3, instants[2].stamp)
    for name, values in measurement(datagram).items():
        np.testing.assert_array_equal(values, getattr(instants[2], name).ravel())


def test_the_answer_passes_and_its_torques_are_in_order(gate, instants):
    passed = gate.process(command(2, instants[1].stamp, TORQUES), CLIENT)
    assert passed.tolist() == TORQUES
    assert rejected(gate) == {}
    assert (gate.counts.accepted, gate.counts.hellos) == (2, 1)


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
def test_what_is_no_answer_is_counted_by_its_reason(gate, reason, datagram):
    assert gate.process(datagram, CLIENT) is None
    assert rejected(gate) == {reason: 1}
    assert gate.counts.accepted == 1
    # It has changed nothing: the answer still passes.
    assert gate.process(ANSWER, CLIENT) is not None


def test_an_answer_is_obeyed_once(gate):
    assert gate.process(ANSWER, CLIENT) is not None
    assert gate.process(ANSWER, CLIENT) is None
    assert rejected(gate) == {"duplicate": 1}


def test_strangers_are_not_heard_while_somebody_is_in_control(gate, instants):
    for datagram in (hello(), ANSWER, b"nonsense"):
        assert gate.process(datagram, OTHER) is None
    assert rejected(gate) == {"stranger": 3}
    assert gate.controller == CLIENT


def test_whoever_says_hello_first_follows(gate, instants):
    gate.release()
    gate.process(hello(), OTHER)
    assert (gate.controller, gate.is_controlled) == (OTHER, True)
    assert gate.process(ANSWER, CLIENT) is None
    assert gate.process(ANSWER, OTHER).tolist() == TORQUES
    assert rejected(gate) == {"stranger": 1}


def test_a_late_answer_does_not_move_the_robot_but_is_a_sign_of_life(gate, instants):
    gate.release()
    gate.expect(instants[2])
    assert gate.process(ANSWER, OTHER) is None
    assert not gate.is_controlled
    assert gate.process(ANSWER, CLIENT) is None
    assert gate.is_controlled
    assert rejected(gate) == {"old": 2}


def test_hello_moves_nothing(gate):
    assert gate.process(command(0, STAMP, TORQUES), CLIENT) is None
    assert (gate.counts.hellos, gate.counts.accepted) == (2, 1)


def test_numbers_go_round():
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
def test_whatever_comes_nothing_is_raised_and_no_torque_exceeds_its_limit(datagrams):
    gate = awaiting()
    for datagram in datagrams:
        passed = gate.process(datagram, CLIENT)
        if passed is not None:
            # Only bits of the torques themselves can have been changed.
            assert datagram[:24] == ANSWER[:24]
            assert len(datagram) == len(ANSWER)
            assert np.all(np.abs(passed) <= 100.0)
    counts = gate.counts
    before = 2  # hello and first answer
    assert (
        counts.accepted + counts.hellos + sum(counts.rejected.values()) == len(datagrams) + before
    )
