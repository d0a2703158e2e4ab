"""Truncated requests and requests with invalid values end no node."""

import struct
from collections.abc import Callable
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest
from graph_probes import call
from raw_requests import raw_requests
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import SetParameters
from rclpy.serialization import serialize_message

from symbid_ros.package_paths import config_file

ENCAPSULATION = 4  # bytes that the middleware itself adds
QUEUE = 10  # requests that a service keeps
OWN_SERVICES = {
    "identifier": {"reset", "solve", "save", "enable"},
    "recorder": set(),
    "player": {"pause", "restart"},
    "mujoco_bridge": {"pause", "reset"},
    "balance_controller": set(),
    "monitor": set(),
}


def malformed() -> list[bytes]:
    """Return truncated requests, and requests with values outside the range of their type.

    Larger words would be lengths of sequences, for which the middleware allocates the memory. In
    shorter requests it reads such lengths from arbitrary bytes, because its buffer has at least
    200 bytes (rmw_fastrtps, Fast CDR).
    """
    return [
        struct.pack("<64I", *64 * [word])[:size]
        for word in (0, 1, 2, 7)
        for size in (200, 228, 256)
    ]


def flood(graph, kind: type[Any], service: str) -> None:
    """Send malformed requests, some at a time, each time with a valid one that is answered."""
    valid = serialize_message(kind.Request())[ENCAPSULATION:]
    with raw_requests(kind) as payload:
        client = graph.node.create_client(kind, service)
        graph.wait_until(client.service_is_ready)
        requests = malformed()
        for start in range(0, len(requests), QUEUE - 1):
            for request in (*requests[start : start + QUEUE - 1], valid):
                payload[:] = request
                answer = client.call_async(kind.Request())
            graph.wait_until(answer.done)
        graph.node.destroy_client(client)


@pytest.mark.parametrize("node", OWN_SERVICES)
def test_malformed_requests_end_no_node(
    graph, simulated: Callable[..., Path], tmp_path: Path, node: str
) -> None:
    parameters: dict[str, object] = {
        "identifier": {"model": config_file("symbitron.xml")},
        "recorder": {"bag": tmp_path / "bag"},
        "mujoco_bridge": {"moves": 100},
    }.get(node, {})
    if node == "player":
        bag = simulated("smooth", moves=2, motion_seed=7, noise_seed=3)
        parameters = {"bag": f"['{bag}']", "loop": True}
    graph.start(node, **parameters)
    graph.wait_for_node(node)

    def services() -> dict[str, str]:
        found = graph.node.get_service_names_and_types_by_node(node, "/")
        return {name.removeprefix(f"/{node}/"): kinds[0] for name, kinds in found}

    graph.wait_until(lambda: {"set_parameters", *OWN_SERVICES[node]} <= services().keys())
    for name, kind in services().items():
        package, space, word = kind.split("/")
        flood(graph, getattr(import_module(f"{package}.{space}"), word), f"/{node}/{name}")
    client = graph.node.create_client(SetParameters, f"/{node}/set_parameters")
    graph.wait_until(client.service_is_ready)
    unknown = Parameter(name="use_sim_time", value=ParameterValue(type=99))
    client.call_async(SetParameters.Request(parameters=[unknown]))
    valid = Parameter(name="use_sim_time", value=ParameterValue(type=1))
    answer = client.call_async(SetParameters.Request(parameters=[valid]))
    graph.wait_until(answer.done)
    assert answer.result().results[0].successful
    assert call(graph, SetParameters, f"/{node}/set_parameters").results == []
