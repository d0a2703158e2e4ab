"""Network of the nodes: which sockets they bind, and that they share no memory."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from symbid_ros.package_paths import config_file
from symbid_ros.ros.process import use_udp

ANY = "00000000"
LOOPBACK = "0100007F"  # 127.0.0.1 in the notation of /proc/net/udp

# Prints a line when it has received a message, and runs until its input ends.
OBSERVER = """
import sys
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("observer")
received = []
node.create_subscription(JointState, "joint_states", received.append, qos_profile_sensor_data)
while not received:
    rclpy.spin_once(node)
print("received", len(received[0].name), flush=True)
sys.stdin.read()
"""


def udp_addresses(process: int) -> set[str]:
    """Return the local addresses of a process's UDP sockets, IPv4 and IPv6, in hexadecimal."""
    proc = Path("/proc") / str(process)
    links = []
    for entry in (proc / "fd").iterdir():
        with suppress(FileNotFoundError):  # just closed
            links.append(os.readlink(entry))
    inodes = {link[8:-1] for link in links if link.startswith("socket:[")}
    rows = [
        line.split()
        for table in ("udp", "udp6")
        for line in (proc / "net" / table).read_text().splitlines()[1:]
    ]
    return {row[1].split(":")[0] for row in rows if row[9] in inodes}


def shares_memory(process: int) -> bool:
    """Return whether a process has mapped shared memory of Fast DDS."""
    return "/dev/shm/fastrtps" in (Path("/proc") / str(process) / "maps").read_text()


@pytest.fixture
def connected(domain: int) -> Iterator[Callable[..., tuple[int, int]]]:
    """Start a bridge and a plain rclpy observer; return their process ids once connected."""
    processes: list[subprocess.Popen[str]] = []

    def start(arguments: list[str], environment: dict[str, str]) -> subprocess.Popen[str]:
        processes.append(
            subprocess.Popen(
                arguments,
                env=environment,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=subprocess.DEVNULL,
                text=True,
            )
        )
        return processes[-1]

    def connect(**variables: str) -> tuple[int, int]:
        environment = {
            key: value for key, value in os.environ.items() if "DISCOVERY_RANGE" not in key
        } | variables
        bridge = start([str(Path(sys.executable).parent / "mujoco_bridge")], environment)
        observer = start([sys.executable, "-c", OBSERVER], environment)
        assert observer.stdout is not None
        assert observer.stdout.readline() == "received 10\n"
        return bridge.pid, observer.pid

    try:
        yield connect
    finally:
        for process in processes:
            process.terminate()
            process.communicate()


PROFILE = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(config_file("fastdds_localhost.xml"))}
LOCAL = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"}
DEFAULT_TRANSPORTS = {"FASTDDS_BUILTIN_TRANSPORTS": "DEFAULT"}


def test_with_the_profile_nodes_communicate_only_over_the_loopback(connected):
    for process in connected(**PROFILE):
        assert udp_addresses(process) == {LOOPBACK}
        assert not shares_memory(process)


def test_with_range_localhost_nodes_bind_only_the_loopback(connected):
    bridge, observer = connected(**LOCAL)
    assert udp_addresses(bridge) == {LOOPBACK}
    assert not shares_memory(bridge)
    assert ANY in udp_addresses(observer)  # the reason why other programs need the profile


def test_by_default_nodes_use_the_network_and_no_shared_memory(connected):
    bridge, _ = connected()
    assert ANY in udp_addresses(bridge)
    assert not shares_memory(bridge)


@pytest.mark.parametrize(
    "variables",
    [
        DEFAULT_TRANSPORTS,
        DEFAULT_TRANSPORTS | LOCAL,
        # The middleware adds transports of its own to those of the profile.
        PROFILE | LOCAL,
    ],
    ids=["transports", "transports and range", "profile and range"],
)
def test_the_users_choices_are_kept(variables, connected):
    bridge, _ = connected(**variables)
    assert ANY in udp_addresses(bridge)
    assert shares_memory(bridge)


@pytest.mark.parametrize(
    ("middleware", "variables"),
    [
        ("rmw_cyclonedds_cpp", LOCAL),
        ("rmw_zenoh_cpp", {}),
        ("rmw_fastrtps_cpp", DEFAULT_TRANSPORTS),
        ("rmw_fastrtps_cpp", LOCAL | {"ROS_STATIC_PEERS": "192.0.2.7"}),
        ("rmw_fastrtps_cpp", {"FASTRTPS_DEFAULT_PROFILES_FILE": "mine.xml"}),
    ],
)
def test_other_middleware_and_explicit_choices_are_left_alone(middleware, variables):
    environment = dict(variables)
    use_udp(environment, middleware)
    assert environment == variables


@pytest.mark.parametrize(
    ("variables", "profile"),
    [
        ({}, "fastdds_udp.xml"),
        (
            {"FASTRTPS_DEFAULT_PROFILES_FILE": "", "FASTDDS_BUILTIN_TRANSPORTS": ""},
            "fastdds_udp.xml",
        ),
        ({"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}, "fastdds_udp.xml"),
        ({"ROS_STATIC_PEERS": "192.0.2.7"}, "fastdds_udp.xml"),
        (LOCAL, "fastdds_localhost.xml"),
        ({"ROS_LOCALHOST_ONLY": "1", "ROS_STATIC_PEERS": ""}, "fastdds_localhost.xml"),
    ],
)
def test_the_range_chooses_the_profile(variables, profile):
    environment = dict(variables)
    use_udp(environment, "rmw_fastrtps_cpp")
    assert environment.pop("FASTRTPS_DEFAULT_PROFILES_FILE") == str(config_file(profile))
    # The range LOCALHOST would add shared memory to the profile.
    assert "LOCALHOST" not in environment.values()
    assert "ROS_LOCALHOST_ONLY" not in environment
