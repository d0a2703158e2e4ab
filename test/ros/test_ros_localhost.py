"""config/fastdds_localhost.xml keeps a graph on this machine, and nothing else we offer does."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import pytest

from symbid_ros.share import config_file

ANY = "00000000"
LOOPBACK = "0100007F"  # 127.0.0.1, as /proc/net/udp writes it

# Says that it has heard the bridge, and stays until its input ends.
OBSERVER = """
import sys
import rclpy
from rclpy.qos import qos_profile_sensor_data
from sensor_msgs.msg import JointState
rclpy.init()
node = rclpy.create_node("observer")
heard = []
node.create_subscription(JointState, "joint_states", heard.append, qos_profile_sensor_data)
while not heard:
    rclpy.spin_once(node)
print("heard", len(heard[0].name), flush=True)
sys.stdin.read()
"""


def udp_addresses(process: int) -> set[str]:
    """The local addresses of a process's UDP sockets, of IPv4 and IPv6, in hexadecimal."""
    proc = Path("/proc") / str(process)
    links = []
    for entry in (proc / "fd").iterdir():
        with suppress(FileNotFoundError):  # closed meanwhile
            links.append(os.readlink(entry))
    inodes = {link[8:-1] for link in links if link.startswith("socket:[")}
    rows = [
        line.split()
        for table in ("udp", "udp6")
        for line in (proc / "net" / table).read_text().splitlines()[1:]
    ]
    return {row[1].split(":")[0] for row in rows if row[9] in inodes}


@pytest.fixture
def addresses(domain: int) -> Iterator[Callable[..., set[str]]]:
    """Start a bridge and an observer, wait until they have met, and return their addresses."""
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

    def measured(**variables: str) -> set[str]:
        environment = {
            key: value for key, value in os.environ.items() if "DISCOVERY_RANGE" not in key
        } | variables
        bridge = start([str(Path(sys.executable).parent / "mujoco_bridge")], environment)
        observer = start([sys.executable, "-c", OBSERVER], environment)
        assert observer.stdout is not None
        assert observer.stdout.readline() == "heard 10\n"
        return udp_addresses(bridge.pid) | udp_addresses(observer.pid)

    try:
        yield measured
    finally:
        for process in processes:
            process.terminate()
            process.communicate()


PROFILE = {"FASTRTPS_DEFAULT_PROFILES_FILE": str(config_file("fastdds_localhost.xml"))}


def test_with_the_profile_nodes_meet_on_the_loopback_alone(addresses):
    assert addresses(**PROFILE) == {LOOPBACK}


@pytest.mark.parametrize(
    "variables",
    [
        {},
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST"},
        # The middleware then adds transports of its own to those of the profile.
        {"ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST", **PROFILE},
    ],
    ids=["nothing", "discovery range", "both"],
)
def test_anything_else_opens_sockets_for_everybody(variables, addresses):
    assert ANY in addresses(**variables)
