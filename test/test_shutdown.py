"""Signals as an event."""

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
