"""Malformed messages and requests, and values that a callback rejects, end no executor."""

from collections.abc import Iterator

import pytest
import rclpy
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from junk_messages import some_malformed
from rcl_interfaces.msg import Parameter as ParameterMessage
from rcl_interfaces.msg import ParameterValue
from rcl_interfaces.srv import SetParameters, SetParametersAtomically
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.serialization import serialize_message
from rosgraph_msgs.msg import Clock

from symbid_ros.ros.endpoints import reliable_qos
from symbid_ros.ros.process import MessageExecutor


@pytest.fixture
def spun(domain: int) -> Iterator[tuple[Node, MessageExecutor]]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("reader", context=context)
    executor = MessageExecutor(context=context)
    executor.add_node(node)
    yield node, executor
    executor.shutdown()
    node.destroy_node()
    context.try_shutdown()


def test_a_time_out_of_range_is_dropped(spun) -> None:
    node, executor = spun
    node.set_parameters([Parameter("use_sim_time", value=True)])
    publisher = node.create_publisher(Clock, "/clock", reliable_qos(10))

    def send(seconds: int) -> None:
        message = Clock()
        message.clock.sec = seconds
        publisher.publish(message)

    # One at a time, because the queue holds only the newest.
    while publisher.get_subscription_count() == 0:
        executor.spin_once(timeout_sec=0.1)
    send(-5)
    while not executor.dropped:
        executor.spin_once(timeout_sec=1.0)
    assert executor.dropped == {"/clock": 1}
    send(7)
    while node.get_clock().now().nanoseconds != 7 * 10**9:
        executor.spin_once(timeout_sec=1.0)


def test_malformed_messages_are_counted_and_the_others_arrive(spun) -> None:
    node, executor = spun
    received: list[str] = []
    node.create_subscription(
        DiagnosticArray,
        "status",
        lambda message: received.append(message.status[0].name),
        reliable_qos(1000),
    )
    publisher = node.create_publisher(DiagnosticArray, "status", reliable_qos(1000))
    valid = serialize_message(DiagnosticArray(status=[DiagnosticStatus(name="first")]))
    publisher.publish(valid)
    invalid = some_malformed(valid, 50)
    for payload in invalid:
        publisher.publish(payload)
    publisher.publish(DiagnosticArray())  # valid, but rejected by the callback
    publisher.publish(DiagnosticArray(status=[DiagnosticStatus(name="last")]))
    while "last" not in received:
        executor.spin_once(timeout_sec=1.0)
    assert received[0] == "first"
    # The decoder of the middleware accepts extra bytes after a message.
    assert executor.dropped["/status"] + len(received) == len(invalid) + 3
    assert executor.dropped["/status"] > len(invalid) // 2


@pytest.mark.parametrize("kind", [SetParameters, SetParametersAtomically])
def test_a_request_with_an_unknown_value_type_is_dropped(spun, kind) -> None:
    node, executor = spun
    service = {
        SetParameters: "set_parameters",
        SetParametersAtomically: "set_parameters_atomically",
    }
    client = node.create_client(kind, f"/reader/{service[kind]}")

    def request(value: ParameterValue):
        return client.call_async(kind.Request(parameters=[ParameterMessage(name="a", value=value)]))

    executor.spin_until_future_complete(executor.create_task(client.wait_for_service))
    unanswered, answered = request(ParameterValue(type=99)), request(ParameterValue(type=1))
    executor.spin_until_future_complete(answered)
    assert "undeclared" in str(answered.result())
    assert not unanswered.done()
    assert executor.dropped == {f"/reader/{service[kind]}": 1}


def test_a_request_that_asks_for_too_much_memory_is_dropped(
    spun, monkeypatch: pytest.MonkeyPatch
) -> None:
    node, executor = spun
    service = node.create_service(SetParameters, "large", lambda _, response: response)

    def take(*_: object) -> None:
        raise MemoryError

    monkeypatch.setattr(SingleThreadedExecutor, "_take_service", take)
    assert executor._take_service(service) is None
    assert executor.dropped == {"/large": 1}
