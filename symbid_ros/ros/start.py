"""The executables: one that is interrupted while its libraries still load ends quietly, too."""

import os
import signal
import sys
from importlib import import_module

from symbid_ros.package_paths import missing_extra


def mujoco_bridge() -> None:
    """Run the node ``mujoco_bridge``."""
    _run("mujoco_bridge")


def balance_controller() -> None:
    """Run the node ``balance_controller``."""
    _run("balance_controller")


def recorder() -> None:
    """Run the node ``recorder``."""
    _run("recorder")


def player() -> None:
    """Run the node ``player``."""
    _run("player")


def identifier() -> None:
    """Run the node ``identifier``."""
    _run("identifier")


def monitor() -> None:
    """Run the node ``monitor``."""
    _run("monitor")


def _run(node: str) -> None:
    for number in (signal.SIGINT, signal.SIGTERM):
        # At once: a library may turn an exception raised while it loads into one of its own. So
        # far there is nothing to clean up.
        signal.signal(number, lambda number, _: os._exit(128 + number))
    # Loading takes seconds; the node then has handlers of its own.
    try:
        run = import_module(f"{__package__}.{node}").main
    except ModuleNotFoundError as error:
        advice = missing_extra(error)
        if advice is None:
            raise
        print(f"{node}: {advice}; or source ROS 2's setup.bash", file=sys.stderr)
        sys.exit(2)
    run()
