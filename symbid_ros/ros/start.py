"""Entry points of the executables; Ctrl-C ends each one quietly even while its libraries load."""

import gc
import os
import signal
import sys
from functools import partial
from importlib import import_module

from symbid_ros.package_paths import missing_extra


def _run(node: str) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        # Exit at once: a library that is still loading may replace an exception by its own. There
        # is nothing to clean up yet.
        signal.signal(number, lambda number, _: os._exit(128 + number))
    # Loading takes seconds; the node then installs its own handlers.
    try:
        run = import_module(f"{__package__}.{node}").main
    except ModuleNotFoundError as error:
        advice = missing_extra(error)
        if advice is None:
            raise
        print(f"{node}: {advice}; or source ROS 2's setup.bash", file=sys.stderr)
        sys.exit(2)
    # Libraries live as long as the node: a search for garbage among them would pause it for 0.06 s.
    gc.freeze()
    sys.exit(run())


mujoco_bridge = partial(_run, "mujoco_bridge")
balance_controller = partial(_run, "balance_controller")
recorder = partial(_run, "recorder")
player = partial(_run, "player")
identifier = partial(_run, "identifier")
monitor = partial(_run, "monitor")
web_monitor = partial(_run, "web_monitor")
