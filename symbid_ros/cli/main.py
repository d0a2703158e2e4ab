"""The entry point of ``symbid``: light, so that Ctrl-C is answered while libraries still load."""

import signal
import sys
from types import FrameType
from typing import NoReturn

from symbid_ros.ending import exit_on_signals

INTERRUPTED = 130  # as shells have it: 128 and the signal's number


def main() -> None:
    """Run the command line and exit with its status; after Ctrl-C that is 130."""
    exit_on_signals()
    was_interrupted = False

    def interrupt(_: int, __: FrameType | None) -> NoReturn:
        nonlocal was_interrupted
        was_interrupted = True
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # not where the caller ignores or handles it
        signal.signal(signal.SIGINT, interrupt)
    try:
        # Loading takes up to a second.
        from symbid_ros.cli.app import run

        status = run()
    except BaseException:
        # What arrives here need not be KeyboardInterrupt: a library that is interrupted while
        # it loads may raise ImportError or SystemError instead.
        if not was_interrupted:
            raise
        status = INTERRUPTED
    finally:
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, before)
    if status == INTERRUPTED:
        print("symbid: interrupted", file=sys.stderr)
    sys.exit(status)


if __name__ == "__main__":
    main()
