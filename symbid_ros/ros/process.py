"""The process of every node: start, executor, stop on signals, one-line errors."""

import argparse
import os
import shutil
import sys
import textwrap
import threading
from collections import Counter
from collections.abc import Callable, Coroutine, MutableMapping, Sequence
from typing import Any, TypeVar

import rclpy
from rclpy.context import Context
from rclpy.exceptions import InvalidParameterTypeException, NameValidationException
from rclpy.executors import SingleThreadedExecutor, await_or_execute
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.serialization import deserialize_message
from rclpy.service import Service
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.task import Future
from rclpy.utilities import remove_ros_args

from symbid_ros.errors import DataError, SymbidError
from symbid_ros.package_paths import config_file
from symbid_ros.ros.parameters import Parameter, declare
from symbid_ros.ros.reporting import forward_python_logs
from symbid_ros.ros.unknown_parameters import require_known_parameters
from symbid_ros.shutdown import interruptible, stop_on_signals

FAILURE = 2  # exit status
# What rcl cannot parse: a value after -p, and a line of a parameter file.
UNPARSED = "parameter override rule", "parsing a event"
WARNING_PERIOD = 5.0  # s between two warnings
NARROWEST = 40  # columns of the text of --help
PROFILE, TRANSPORTS = "FASTRTPS_DEFAULT_PROFILES_FILE", "FASTDDS_BUILTIN_TRANSPORTS"
RANGE, LOCALHOST = "ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST"
OLD_RANGE = "ROS_LOCALHOST_ONLY"  # deprecated; "1" overrides the others
PEERS = "ROS_STATIC_PEERS"
Constructed = TypeVar("Constructed")
Work = Callable[[Node, dict[str, Any], threading.Event], None]
Callback = Callable[[], Coroutine[Any, Any, None]]


def use_udp(environment: MutableMapping[str, str], middleware: str) -> None:
    """Make Fast DDS send by UDP only, without shared memory.

    A publisher that shares memory with a subscriber blocks for seconds when that subscriber is
    killed, and sometimes hangs forever (Fast DDS 2.14,
    https://github.com/eProsima/Fast-DDS/issues/6485). A robot's driver must survive the end of
    an identifier or a recorder.

    The user's own choices are kept: a profile, transports, another middleware, and static peers
    combined with the range ``LOCALHOST``, which a loopback profile would cut off.

    Parameters
    ----------
    environment : mutable mapping of str to str
        Environment of the process, before its first node. The discovery range ``LOCALHOST`` is
        removed from it, because the middleware would then add shared memory to any profile. The
        profile that replaces it is stricter: its sockets are bound to 127.0.0.1.
    middleware : str
        Name of the RMW implementation.
    """
    is_chosen = environment.get(PROFILE) or environment.get(TRANSPORTS)
    if is_chosen or not middleware.startswith("rmw_fastrtps"):
        return
    if _is_local(environment):
        if environment.get(PEERS):
            return
        environment.pop(RANGE, None)
        environment.pop(OLD_RANGE, None)
        environment[PROFILE] = str(config_file("fastdds_localhost.xml"))
    else:
        environment[PROFILE] = str(config_file("fastdds_udp.xml"))


def _is_local(environment: MutableMapping[str, str]) -> bool:
    return environment.get(OLD_RANGE) == "1" or environment.get(RANGE) == LOCALHOST


def run_node(name: str, work: Work, *, purpose: str, parameters: Sequence[Parameter]) -> int:
    """Run a node with the arguments of the process and return the exit status.

    The work runs in the main thread. An executor in a second thread serves services and
    parameters once all parameters are declared. rclpy's signal handlers are disabled: they
    invalidate the context, after which queued messages can no longer be read.

    Parameters
    ----------
    name : str
        Name of the node and of its executable.
    work : callable
        ``work(node, values, stop)`` gets the parameters' values by name. It returns soon after
        SIGINT or SIGTERM sets ``stop``.
    purpose : str
        Description of the node for ``--help``.
    parameters : sequence of Parameter
        Parameters that the node declares and ``--help`` lists.
    """
    stop = stop_on_signals()
    try:
        _parse_arguments(name, purpose, parameters, remove_ros_args(sys.argv)[1:])
        use_udp(os.environ, rclpy.get_rmw_implementation_identifier())
        rclpy.init(args=sys.argv, signal_handler_options=SignalHandlerOptions.NO)
        node = Node(name)
        try:
            with forward_python_logs(node):
                values = declare(node, parameters)
                require_known_parameters(node, sys.argv)
                _run_with_executor(node, lambda: work(node, values, stop), stop)
        finally:
            node.destroy_node()
    except SymbidError as error:
        print(f"{name}: {error.labelled}", file=sys.stderr)
        return FAILURE
    except OSError as error:
        # The operating system rejects a path, for example because its name is too long.
        if error.filename is None:
            raise
        place = os.fsdecode(error.filename)
        print(f"{name}: {place}: {error.strerror}; check the path", file=sys.stderr)
        return FAILURE
    except (RuntimeError, NameValidationException, InvalidParameterTypeException) as error:
        # rcl reports malformed --ros-args and parameter files as RuntimeError.
        if not _is_argument_error(error):
            raise
        text = " ".join(str(error).split())
        advice = "check --ros-args"
        if any(each in text for each in UNPARSED):
            advice = f"quote list entries with colons, and {advice}"
        elif "ROS_DOMAIN_ID" in text:
            advice = "correct that environment variable"
        print(f"{name}: {text}; {advice}", file=sys.stderr)
        return FAILURE
    finally:
        rclpy.try_shutdown()
    return 0


def construct(
    make: Callable[[Node, dict[str, Any]], Constructed],
    node: Node,
    values: dict[str, Any],
    stop: threading.Event,
) -> Constructed:
    """Return ``make(node, values)``; a signal during construction ends the process."""
    with interruptible(stop):
        return make(node, values)


def _parse_arguments(
    name: str, purpose: str, parameters: Sequence[Parameter], arguments: Sequence[str]
) -> None:
    """Answer ``--help`` and exit on unknown arguments, which rcl would silently ignore."""
    width = max(shutil.get_terminal_size().columns, NARROWEST)
    lines = [
        textwrap.fill(
            f"{each.name} ({each.default!r}): {each.description}",
            width,
            initial_indent=" " * 2,
            subsequent_indent=" " * 6,
            break_long_words=False,
            break_on_hyphens=False,
        )
        for each in parameters
    ]
    purpose = textwrap.fill(purpose, width)
    argparse.ArgumentParser(
        prog=name,
        usage=f"{name} [--ros-args -p PARAMETER:=VALUE ...]",
        description="\n".join([purpose, "", "parameters and defaults:", *lines]),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    ).parse_args(arguments)


def _run_with_executor(node: Node, work: Callable[[], None], stop: threading.Event) -> None:
    executor = MessageExecutor()
    executor.add_node(node)
    end: Future = Future()
    failures: list[Exception] = []

    def spin() -> None:
        try:
            executor.spin_until_future_complete(end)
        except Exception as failure:
            # A node whose executor has failed must stop: its services no longer answer.
            failures.append(failure)
            stop.set()

    spinner = threading.Thread(target=spin, name="executor", daemon=True)
    spinner.start()
    try:
        work()
    finally:
        # rclpy's executor fails when it is shut down while it executes a callback.
        end.set_result(None)
        spinner.join()
        executor.shutdown()
        if failures:  # it stopped the work, whose own error would hide the reason
            raise failures[0]


def _is_argument_error(error: Exception) -> bool:
    if isinstance(error, NameValidationException | InvalidParameterTypeException):
        return True
    return type(error).__name__ in {
        "RCLError",
        "RCLInvalidROSArgsError",
        "UnknownROSArgsError",
    }


class MessageExecutor(SingleThreadedExecutor):  # type: ignore[misc]
    """Drops and counts messages and requests that cannot be decoded or make their callback fail.

    In rclpy's own executors such an exception ends the node: a negative time on ``/clock`` ends
    every node that uses simulated time. A request to ``~/set_parameters`` with an unknown value
    type ends any node (https://github.com/ros2/rclcpp/issues/3257 for C++). A dropped request gets
    no answer. Exceptions of timers still end the node.

    Attributes
    ----------
    dropped : Counter of str
        Number of dropped messages by topic, and of dropped requests by service.
    """

    def __init__(self, *, context: Context | None = None) -> None:
        super().__init__(context=context)
        self.dropped: Counter[str] = Counter()

    def _take_subscription(self, subscription: Subscription) -> Callback | None:
        # The middleware drops malformed bytes silently, so they are decoded here.
        try:
            with subscription.handle:
                taken = subscription.handle.take_message(subscription.msg_type, True)
        except rclpy_implementation.InvalidHandle:  # the subscription has just been destroyed
            return None
        if taken is None:
            return None
        payload, details = taken

        async def work() -> None:
            message = payload if subscription.raw else _decode(payload, subscription.msg_type)
            wants_details = subscription._callback_type is not Subscription.CallbackType.MessageOnly
            arguments = (message, details) if wants_details else (message,)
            await await_or_execute(subscription.callback, *arguments)

        return self._guarded(work, "message", "publisher", str(subscription.topic_name))

    def _take_service(self, service: Service) -> Callback | None:
        try:
            work = super()._take_service(service)
        except Exception as error:  # a length in the bytes can ask for more memory than there is
            self._drop("request", "client", str(service.service_name), error)
            return None
        if work is None:
            return None
        return self._guarded(work, "request", "client", str(service.service_name))

    def _guarded(self, work: Callback, kind: str, sender: str, name: str) -> Callback:
        """Return a callback that drops a message or request instead of raising an exception."""

        async def guarded() -> None:
            try:
                await work()
            except Exception as error:
                self._drop(kind, sender, name, error)

        return guarded

    def _drop(self, kind: str, sender: str, name: str, error: Exception) -> None:
        self.dropped[name] += 1
        for node in self.get_nodes():
            node.get_logger().warning(
                f"{name}: {kind} dropped ({self.dropped[name]} so far): "
                f"{str(error) or type(error).__name__}; check the {sender}",
                throttle_duration_sec=WARNING_PERIOD,
            )


def _decode(payload: bytes, kind: type[Any]) -> Any:
    try:
        return deserialize_message(payload, kind)
    except Exception as error:  # rmw's and Unicode's exceptions have no common base
        raise DataError(f"the bytes are not a valid {kind.__name__}", "E817") from error
