"""The frame of every node's process: start, stop on signals, one line for an error."""

import argparse
import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

import rclpy
from rclpy.exceptions import InvalidParameterTypeException, NameValidationException
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from symbid_ros.errors import SymbidError
from symbid_ros.ros.log_bridge import python_logs_of
from symbid_ros.ros.message_executor import MessageExecutor
from symbid_ros.ros.parameters import Parameter, declare
from symbid_ros.ros.transport import use_udp
from symbid_ros.shutdown import interruptible, stop_on_signals

FAILURE = 2

Built = TypeVar("Built")
Work = Callable[[Node, dict[str, Any], threading.Event], None]


def run_node(
    name: str,
    work: Work,
    args: Sequence[str] | None = None,
    *,
    purpose: str = "",
    parameters: Sequence[Parameter] = (),
) -> int:
    """Run a node until its work is done and return the exit status.

    Services and parameters are answered by an executor in a thread of its own, once
    all parameters are declared; the work has the main thread. rclpy's own signal
    handlers are not used: they would invalidate the context first, and what still
    lies in the queues could not be read any more.

    Parameters
    ----------
    name : str
        Of the node and its executable.
    work : callable
        ``work(node, values, stop)``, with the parameters' values by name, returns soon
        after SIGINT or SIGTERM has set ``stop``.
    args : sequence of str, optional
        Arguments without the executable's name; the process's own if left out.
    purpose : str
        What ``--help`` says that the node does.
    parameters : sequence of Parameter
        What the node declares and ``--help`` lists.
    """
    arguments = list(sys.argv if args is None else [name, *args])
    stop = stop_on_signals()
    try:
        _refuse_foreign_arguments(name, purpose, parameters, remove_ros_args(arguments)[1:])
        use_udp(os.environ, rclpy.get_rmw_implementation_identifier())
        rclpy.init(args=arguments, signal_handler_options=SignalHandlerOptions.NO)
        node = Node(name)
        try:
            with python_logs_of(node):
                values = declare(node, parameters)
                _work_beside_executor(node, lambda: work(node, values, stop), stop)
        finally:
            node.destroy_node()
    except SymbidError as error:
        print(f"{name}: {error}", file=sys.stderr)
        return FAILURE
    except OSError as error:
        # The operating system refuses a path, such as a name that is too long for it.
        if error.filename is None:
            raise
        place = os.fsdecode(error.filename)
        print(f"{name}: {place}: {error.strerror}; check the path", file=sys.stderr)
        return FAILURE
    except (RuntimeError, NameValidationException, InvalidParameterTypeException) as error:
        # rcl reports malformed --ros-args and parameter files as RuntimeError.
        if not _is_argument_error(error):
            raise
        print(f"{name}: {' '.join(str(error).split())}; check --ros-args", file=sys.stderr)
        return FAILURE
    finally:
        rclpy.try_shutdown()
    return 0


def built(
    make: Callable[[Node, dict[str, Any]], Built],
    node: Node,
    values: dict[str, Any],
    stop: threading.Event,
) -> Built:
    """Return what a node works with; a signal ends the process while that is made."""
    with interruptible(stop):
        return make(node, values)


def _refuse_foreign_arguments(
    name: str, purpose: str, parameters: Sequence[Parameter], arguments: Sequence[str]
) -> None:
    """Answer ``--help``, and exit on what rcl would silently ignore."""
    lines = [f"  {each.name} ({each.default!r}): {each.description}" for each in parameters]
    argparse.ArgumentParser(
        prog=name,
        usage=f"{name} [--ros-args -p PARAMETER:=VALUE ...]",
        description="\n".join([purpose, "", "parameters and defaults:", *lines]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).parse_args(arguments)


def _work_beside_executor(node: Node, work: Callable[[], None], stop: threading.Event) -> None:
    executor = MessageExecutor()
    executor.add_node(node)
    end: Future = Future()
    failures: list[Exception] = []

    def spin() -> None:
        try:
            executor.spin_until_future_complete(end)
        except Exception as failure:
            # A node whose services have died must not go on as if it were well.
            failures.append(failure)
            stop.set()

    spinner = threading.Thread(target=spin, name="executor", daemon=True)
    spinner.start()
    try:
        work()
    finally:
        # Shut down while it executes a callback, rclpy's executor trips over itself.
        end.set_result(None)
        spinner.join()
        executor.shutdown()
    for failure in failures:
        raise failure


def _is_argument_error(error: Exception) -> bool:
    if isinstance(error, NameValidationException | InvalidParameterTypeException):
        return True
    return type(error).__name__ in {
        "RCLError",
        "RCLInvalidROSArgsError",
        "UnknownROSArgsError",
    }
