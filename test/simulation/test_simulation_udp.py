"""The UDP loop over sockets: lockstep, lost datagrams and restarted controllers."""

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from lossy_relay import LossyRelay
from udp_packets import command, hello, measurement, sequence_and_stamp

from symbid_ros.errors import SimulationError
from symbid_ros.simulation.command import Drives
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.udp_server import UdpServer

PATIENCE = 300.0  # s until a hanging test fails
SUPPORT = Path(__file__).parents[1] / "support"


@contextmanager
def client(port: int, *options: object) -> Iterator[subprocess.Popen[str]]:
    """Run ``symbid udp-client`` and kill it at the end if it still runs."""
    words = [Path(sys.executable).parent / "symbid", "udp-client", "--port", port, *options]
    with subprocess.Popen(
        list(map(str, words)), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def commanded(**options: object) -> tuple[Simulator, Drives]:
    robot = Simulator(SimulateOptions(**options), is_commanded=True)
    return robot, Drives(robot.joint_names, robot.drive_names, robot.torque_limits)


@pytest.fixture
def stop() -> Iterator[threading.Event]:
    event = threading.Event()
    alarm = threading.Timer(PATIENCE, event.set)
    alarm.start()
    yield event
    alarm.cancel()


class Answering:
    """A controller in a thread that uses only ``socket`` and ``struct``."""

    def __init__(self, plant: tuple[str, int], answers: Callable[[bytes], list[bytes]]) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._plant, self._answers = plant, answers
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._socket.sendto(b"", self._socket.getsockname())
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        self._socket.sendto(hello(), self._plant)
        while datagram := self._socket.recv(65507):
            for answer in self._answers(datagram):
                self._socket.sendto(answer, self._plant)


def torques_for(datagram: bytes) -> list[float]:
    return [float(value) for value in measurement(datagram)["joint_position"][:8]]


def test_lockstep_with_an_independent_controller(stop):
    robot, drives = commanded(moves=1)
    with UdpServer("127.0.0.1", 0, drives, command_timeout=PATIENCE) as commands:

        def answers(datagram: bytes) -> list[bytes]:
            return [command(*sequence_and_stamp(datagram), torques_for(datagram))]

        with Answering(commands.address, answers):
            assert commands.await_controller(stop)
            for _ in range(50):
                instant = robot.step()
                answer = commands.exchange(instant, stop)
                assert not answer.is_safe
                np.testing.assert_array_equal(answer.torques, instant.joint_position[:8])
        assert commands.counts.accepted == 50


def test_invalid_datagrams_do_not_move_the_robot(stop):
    robot, drives = commanded(moves=1)

    def answers(datagram: bytes) -> list[bytes]:
        sequence, stamp = sequence_and_stamp(datagram)
        return [
            b"",
            command(sequence, stamp, [7.0] * 8)[:-1],
            command(sequence, stamp, [7.0] * 8, magic=1),
            command(sequence, stamp, [float("nan")] * 8),
            command(sequence, stamp, [1e6] * 8),
            command(sequence + 1, stamp, [7.0] * 8),
            command(sequence, stamp + 1, [7.0] * 8),
            command(sequence, stamp, torques_for(datagram)),
            command(sequence, stamp, [7.0] * 8),
        ]

    with UdpServer(
        "127.0.0.1", 0, drives, command_timeout=PATIENCE, retry_period=PATIENCE
    ) as commands:
        with Answering(commands.address, answers):
            assert commands.await_controller(stop)
            for _ in range(20):
                instant = robot.step()
                answer = commands.exchange(instant, stop)
                np.testing.assert_array_equal(answer.torques, instant.joint_position[:8])
        rejected = commands.counts.rejected
        every_time = ("magic", "not_finite", "beyond_limit", "future", "stamp")
        assert [rejected[reason] for reason in every_time] == [20] * 5
        assert rejected["length"] == 40
        assert commands.counts.accepted == 20


def test_timeout_gives_safe_torques_and_is_waited_for_once(stop):
    robot, drives = commanded(moves=1)
    instant = robot.step()
    with UdpServer("127.0.0.1", 0, drives, command_timeout=0.05) as commands:
        with Answering(commands.address, lambda datagram: []):
            assert commands.await_controller(stop)
            for _ in range(3):
                answer = commands.exchange(instant, stop)
                assert answer.is_safe
                np.testing.assert_array_equal(
                    answer.torques, drives.safe_torques(instant.joint_velocity)
                )
        assert commands.counts.timeouts == 1
        assert commands.controller is None


def test_stop_ends_the_wait():
    robot, drives = commanded(moves=1)
    stopped = threading.Event()
    stopped.set()
    with UdpServer("127.0.0.1", 0, drives, command_timeout=PATIENCE) as commands:
        assert not commands.await_controller(stopped)
        assert commands.exchange(robot.step(), stopped).is_safe


def test_measurements_go_to_the_reply_port(stop):
    robot, drives = commanded(moves=1)
    with (
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiving,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sending,
    ):
        receiving.bind(("127.0.0.1", 0))
        receiving.settimeout(PATIENCE)
        port = receiving.getsockname()[1]
        with UdpServer("127.0.0.1", 0, drives, command_timeout=0.05, reply_port=port) as commands:
            sending.sendto(hello(), commands.address)
            assert commands.await_controller(stop)
            instant = robot.step()
            commands.exchange(instant, stop)
            assert sequence_and_stamp(receiving.recv(65507)) == (1, instant.stamp)


def test_the_documented_program_controls_the_robot(stop):
    page = (Path(__file__).parents[2] / "docs" / "udp.md").read_text(encoding="utf-8")
    (program,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    robot, drives = commanded(moves=1, motion_seed=2)
    with UdpServer("127.0.0.1", 0, drives, command_timeout=PATIENCE) as commands:
        program = program.replace("5005", str(commands.address[1]))
        with subprocess.Popen([sys.executable, "-I", "-c", program]) as process:
            assert commands.await_controller(stop)
            instant = robot.step()
            for _ in range(2000):
                answer = commands.exchange(instant, stop)
                assert not answer.is_safe
                instant = robot.step(answer.torques)
            process.kill()
    assert instant.base_position[2] > 0.9
    assert np.abs(instant.true_velocity).max() < 0.1


def test_a_new_client_replaces_a_killed_one(stop):
    robot, drives = commanded(moves=1, motion_seed=3)
    instant = robot.step()
    with UdpServer("127.0.0.1", 0, drives, command_timeout=1.0) as commands:
        for _ in range(2):
            with client(commands.address[1], "--moves", 1, "--motion-seed", 3) as process:
                assert commands.await_controller(stop)
                accepted = commands.counts.accepted
                while commands.counts.accepted < accepted + 200:
                    assert not stop.is_set()
                    answer = commands.exchange(instant, stop)
                    instant = robot.step(answer.torques)
                process.send_signal(signal.SIGKILL)
                process.wait()
            timeouts = commands.counts.timeouts
            while commands.counts.timeouts == timeouts:  # a command may still be in transit
                answer = commands.exchange(instant, stop)
            assert answer.is_safe
            assert commands.controller is None
        assert instant.base_position[2] > 0.9


def test_a_suspended_client_continues(stop):
    robot, drives = commanded(moves=1)
    instant = robot.step()
    with (
        UdpServer("127.0.0.1", 0, drives, command_timeout=1.0) as commands,
        client(commands.address[1], "--moves", 1) as process,
    ):

        def until(is_safe: bool) -> None:
            while commands.exchange(instant, stop).is_safe is not is_safe:
                assert not stop.is_set()

        assert commands.await_controller(stop)
        until(is_safe=False)
        process.send_signal(signal.SIGSTOP)
        os.waitid(os.P_PID, process.pid, os.WSTOPPED | os.WNOWAIT)
        until(is_safe=True)
        process.send_signal(signal.SIGCONT)
        until(is_safe=False)


def test_robot_stands_over_a_lossy_network():
    options = {"moves": 20, "motion_seed": 4, "noise_seed": 4}
    with (
        subprocess.Popen(
            [sys.executable, SUPPORT / "lockstep_plant.py", "5000", json.dumps(options)],
            stdout=subprocess.PIPE,
            text=True,
        ) as plant,
        LossyRelay(("127.0.0.1", int(plant.stdout.readline())), seed=1) as relay,
        client(relay.port, "--moves", 20, "--motion-seed", 4) as controller,
    ):
        said = json.loads(plant.communicate(timeout=300)[0])
        controller.send_signal(signal.SIGINT)
        _, errors = controller.communicate(timeout=PATIENCE)
    assert controller.returncode == 0
    (said_first,) = errors.splitlines()
    assert said_first.startswith("waiting for measurements")
    assert (said["end"], said["safe"], said["accepted"]) == ("stands", 0, 5000)
    assert said["sunk"] < 0.1
    assert min(relay.faults.values()) > 250
    assert said["resent"] > 250
    assert said["rejected"]["duplicate"] + said["rejected"]["old"] > 1000


def test_a_port_in_use_is_named():
    _, drives = commanded(moves=1)
    with UdpServer("127.0.0.1", 0, drives) as commands:
        port = commands.address[1]
        with pytest.raises(SimulationError, match=rf"127\.0\.0\.1:{port}") as caught:
            UdpServer("127.0.0.1", port, drives)
        assert caught.value.code == "E616"
    for host, port in (("no.such.host.invalid", 5005), ("127.0.0.1", 70000), ("a..b", 5005)):
        with pytest.raises(SimulationError, match=f"{host}:{port}") as caught:
            UdpServer(host, port, drives)
        assert caught.value.code == "E616"


def test_empty_host_raises_an_error():
    with pytest.raises(SimulationError, match=r"give 127\.0\.0\.1"):
        UdpServer("", 0, commanded(moves=1)[1])
