"""Signals as an event."""

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from threading import Event

import pytest

from symbid_ros.shutdown import SIGNALS, interruptible

# Spends nearly all its time in the wait, where a handler that sets the event would deadlock.
WORK = """
from symbid_ros.shutdown import stop_on_signals
stop = stop_on_signals()
print("at work", flush=True)
while not stop.wait(0):
    pass
"""

CHILD = """
import os, signal
from symbid_ros.shutdown import end_with_parent
end_with_parent(int(os.environ.get("PARENT", os.getppid())))
print("at work", flush=True)
signal.pause()
"""
PARENT = f"import subprocess, sys; subprocess.run([sys.executable, '-c', {CHILD!r}])"


@pytest.fixture(autouse=True)
def restored_handlers() -> Iterator[None]:
    """Processes that later tests start would inherit an ignored signal."""
    before = {number: signal.getsignal(number) for number in SIGNALS}
    yield
    for number, handler in before.items():
        signal.signal(number, handler)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_work_that_waits_for_the_event(number: signal.Signals) -> None:
    for _ in range(5):
        with subprocess.Popen([sys.executable, "-c", WORK], stdout=subprocess.PIPE) as process:
            assert process.stdout is not None
            assert process.stdout.readline() == b"at work\n"
            process.send_signal(number)
            try:
                assert process.wait(timeout=300) == 0
            finally:
                process.kill()


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_interruptible_work_and_restores_handlers(number: signal.Signals) -> None:
    before = signal.getsignal(number)

    def work() -> None:
        with interruptible(Event()):
            signal.raise_signal(number)

    with pytest.raises(SystemExit) as ended:
        work()
    assert ended.value.code == 128 + number
    assert signal.getsignal(number) is before


def test_interruptible_work_does_not_start_after_shutdown_was_requested() -> None:
    stop, begun = Event(), []
    stop.set()

    def work() -> None:
        with interruptible(stop):
            begun.append(True)

    with pytest.raises(SystemExit):
        work()
    assert not begun


@pytest.mark.skipif(sys.platform != "linux", reason="only Linux tells children of their parent")
def test_a_child_ends_when_its_parent_is_killed() -> None:
    command = [sys.executable, "-c", PARENT]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as parent:
        assert parent.stdout is not None
        assert parent.stdout.readline() == b"at work\n"
        parent.kill()
        # Its output ends with the last process that has it, which is the child.
        assert parent.communicate(timeout=300) == (b"", None)


def test_a_child_whose_parent_has_gone_already_ends() -> None:
    gone = subprocess.Popen(["true"])
    gone.wait()
    command, env = [sys.executable, "-c", CHILD], os.environ | {"PARENT": str(gone.pid)}
    ended = subprocess.run(command, check=False, env=env, capture_output=True, timeout=300)
    assert ended.returncode == -signal.SIGINT
    assert ended.stdout == b""
