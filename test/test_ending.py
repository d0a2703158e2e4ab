"""Signals as an event."""

import signal
import subprocess
import sys

import pytest

# Nearly all the time within the wait, where a handler that set the event itself would hang.
WORK = """
from symbid_ros.ending import stop_on_signals
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
