"""The entry point of ``symbid``, which handles Ctrl-C while libraries are still loading."""

import signal
import sys
from io import TextIOWrapper
from types import FrameType
from typing import NoReturn

from symbid_ros.shutdown import exit_on_signals

INTERRUPTED = 130  # as in shells: 128 plus the signal's number


def main() -> None:
    """Run the command line and exit with its status; after Ctrl-C that is 130."""
    exit_on_signals()
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, TextIOWrapper):  # a terminal of another encoding shows ? for ┏
            stream.reconfigure(errors="replace")
    was_interrupted = False

    def interrupt(_: int, __: FrameType | None) -> NoReturn:
        nonlocal was_interrupted
        was_interrupted = True
        raise KeyboardInterrupt

    before = signal.getsignal(signal.SIGINT)
    if before is signal.default_int_handler:  # unless the caller ignores or handles it
        signal.signal(signal.SIGINT, interrupt)
    try:
        # Loading takes up to a second.
        from symbid_ros.cli.app import run

        status = run()
    except BaseException as error:
        # A library that is interrupted while it loads may raise ImportError or SystemError
        # instead of KeyboardInterrupt.
        if was_interrupted:
            status = INTERRUPTED
        elif isinstance(error, ModuleNotFoundError):
            status = _report_missing(error)
        else:
            raise
    finally:
        if before is signal.default_int_handler:
            signal.signal(signal.SIGINT, before)
    if status == INTERRUPTED:
        print("symbid: interrupted", file=sys.stderr)
    sys.exit(status)


def _report_missing(error: ModuleNotFoundError) -> int:
    """Print how to install the missing module and return the exit status, or raise the error."""
    from symbid_ros.package_paths import missing_extra

    advice = missing_extra(error)
    if advice is None:
        raise error
    print(f"symbid: {advice}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    main()
