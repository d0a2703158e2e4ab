"""Signals as an event."""

import signal
import subprocess
import sys
from threading import Event

import pytest

from symbid_ros.shutdown import interruptible

# Nearly all the time within the wait, where a handler that set the event itself would hang.
WORK = """
from symbid_ros.shutdown import stop_on_signals
stop = stop_on_signals()
print("at work", flush=True)
while not stop.wait(0):
    pass
"""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_work_that_waits_for_the_end_is_ended_by_a_signal(number: signal.Signals) -> None:
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
def test_a_signal_leaves_interruptible_work_and_nothing_else(number: signal.Signals) -> None:
    before = signal.getsignal(number)

    def work() -> None:
        with interruptible(Event()):
            signal.raise_signal(number)

    with pytest.raises(SystemExit) as ended:
        work()
    assert ended.value.code == 128 + number
    assert signal.getsignal(number) is before


def test_work_is_not_begun_once_the_end_is_asked_for() -> None:
    stop, begun = Event(), []
    stop.set()

    def work() -> None:
        with interruptible(stop):
            begun.append(True)

    with pytest.raises(SystemExit):
        work()
    assert not begun
