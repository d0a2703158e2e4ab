"""Plant and controller as two processes that communicate only over topics."""

import itertools
import json
import signal

import numpy as np
import pytest
from graph_probes import RELIABLE, StatusProbe, call, descriptors
from nav_msgs.msg import Odometry
from rosgraph_msgs.msg import Clock
from sensor_msgs.msg import JointState
from std_srvs.srv import SetBool, Trigger

from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.simulator import Simulator

COMMANDS, SIMULATION = "/mujoco_bridge: commands", "/mujoco_bridge: simulation"
CONTROL = "/balance_controller: control"
MODEL = "/balance_controller: model"
# On a busy machine a process may wait longer than the default timeout.
PATIENT = {
    "command_source": "topic",
    "command_timeout": 60.0,
    "real_time_factor": 100.0,
    "clock_rate": 100.0,  # for the observer, which would be busy with a message per step
}

# A robot that is only waited for takes no more steps than a real one.
PACED = PATIENT | {"real_time_factor": 1.0}


def nanoseconds(stamp) -> int:
    return stamp.sec * 10**9 + stamp.nanosec


class Clocked:
    """The received stamps of /clock."""

    def __init__(self, graph) -> None:
        self.stamps: list[int] = []
        graph.node.create_subscription(Clock, "/clock", self._keep, RELIABLE)

    def _keep(self, message: Clock) -> None:
        self.stamps.append(nanoseconds(message.clock))

    @property
    def now(self) -> float:
        return self.stamps[-1] / 1e9 if self.stamps else 0.0

    @property
    def jumps(self) -> int:
        return int(np.count_nonzero(np.diff(self.stamps) < 0))


def test_the_robot_moves_as_with_the_internal_controller(graph) -> None:
    clock, places = Clocked(graph), {}
    graph.node.create_subscription(
        Odometry,
        "ground_truth/odom",
        lambda message: places.setdefault(
            nanoseconds(message.header.stamp), message.pose.pose.position
        ),
        RELIABLE,
    )
    robot = Simulator(SimulateOptions("smooth", moves=1, motion_seed=3))
    end = 3 * 10**9  # ns, half of the motion
    # The controller starts first and waits for a robot, which waits for the controller.
    controller = graph.start("balance_controller", moves=1, motion_seed=3)
    graph.wait_for_node("balance_controller")
    bridge = graph.start("mujoco_bridge", moves=1, motion_seed=3, **PATIENT)
    for second in range(1 + end // 10**9):  # on a slow machine each second has its own deadline
        graph.wait_until(lambda s=second: clock.now > s)
    graph.wait_until(lambda: clock.stamps[-1] >= end)
    graph.wait_until(lambda: places and max(places) > end - 10 * robot.period_ns)
    for process in (controller, bridge):
        process.send(signal.SIGINT)
    answers, bridge_end = controller.ended(), bridge.ended()
    assert (answers.status, bridge_end.status) == (0, 0)
    assert "WARN" not in answers.err
    commands = json.loads(bridge_end.out)["commands"]
    assert (commands["starts"], commands["falls"], commands["timeouts"]) == (1, 0, 0)
    assert not any(n for key, n in commands.items() if key.startswith("rejected/"))
    assert json.loads(answers.out)["restarts"] == 0

    instants = itertools.islice(robot, end // robot.period_ns)
    alone = {instant.stamp: instant.base_position for instant in instants}
    assert np.linalg.norm(alone[end] - alone[robot.period_ns]) > 0.03
    away = [
        np.linalg.norm([place.x, place.y, place.z] - alone[stamp])
        for stamp, place in places.items()
        if stamp <= end
    ]
    # The robot does not wait for this subscriber, which gets every message after its first.
    stamps = np.array(sorted(stamp for stamp in places if stamp <= end))
    assert set(np.diff(stamps)) == {10 * robot.period_ns}
    assert stamps[0] < end / 2
    # It went several centimetres; sensor noise and a delay of one period cost millimetres.
    assert max(away) < 0.01


def test_each_node_resumes_after_the_other_is_killed(graph) -> None:
    clock, statuses = Clocked(graph), StatusProbe(graph)
    bridge = graph.start("mujoco_bridge", **PACED | {"command_timeout": 1.0})
    graph.wait_until(lambda: statuses.message(COMMANDS) == "waiting for a controller")
    assert not clock.stamps, "simulated time waits for a controller"

    controller = graph.start("balance_controller")
    graph.wait_until(lambda: clock.now > 0.3)
    jumps = clock.jumps
    controller.kill()
    # Drives that only brake do not keep it upright: it falls, restarts and waits.
    graph.wait_until(lambda: statuses.count(SIMULATION, "falls") == 1)
    graph.wait_until(lambda: statuses.message(COMMANDS) == "waiting for a controller")
    assert statuses.count(COMMANDS, "timeouts") >= 1
    assert statuses.count(COMMANDS, "safe_steps") >= 10
    assert "restarted after" in statuses.message(SIMULATION)

    controller = graph.start("balance_controller")
    graph.wait_until(lambda: clock.jumps == jumps + 1 and clock.now > 0.3)
    # The middleware counts the killed controller for many seconds more; nothing moves meanwhile.
    assert call(graph, SetBool, "/mujoco_bridge/pause", data=True).success
    graph.wait_until(lambda: statuses.message(COMMANDS) == "commands are obeyed")
    assert call(graph, SetBool, "/mujoco_bridge/pause", data=False).success

    bridge.kill()
    graph.wait_until(lambda: statuses.message(CONTROL).startswith("no measurements"))
    # A new subscription gets nothing that the killed bridge sent, which may still lie in a queue.
    clock = Clocked(graph)
    bridge = graph.start("mujoco_bridge", **PACED)
    graph.wait_until(lambda: clock.now > 0.3)
    for process in (controller, bridge):
        process.send(signal.SIGTERM)
    answers, bridge_end = controller.ended(), bridge.ended()
    assert (answers.status, bridge_end.status) == (0, 0)
    assert "Traceback" not in answers.err + bridge_end.err
    assert answers.err.count("the clock jumped back") == 1
    assert json.loads(answers.out)["restarts"] == 1


def test_reset_and_pause(graph) -> None:
    clock, statuses = Clocked(graph), StatusProbe(graph)
    bridge = graph.start("mujoco_bridge", **PACED)
    controller = graph.start("balance_controller")
    graph.wait_until(lambda: clock.now > 0.3)
    assert call(graph, Trigger, "/mujoco_bridge/reset").success
    graph.wait_until(lambda: clock.jumps == 1 and clock.now > 0.2)
    assert call(graph, SetBool, "/mujoco_bridge/pause", data=True).success
    graph.wait_until(lambda: statuses.message(SIMULATION) == "paused")
    received, paused = statuses.received, len(clock.stamps)
    graph.wait_until(lambda: statuses.received >= received + 2)
    assert len(clock.stamps) == paused
    assert call(graph, SetBool, "/mujoco_bridge/pause", data=False).success
    graph.wait_until(lambda: len(clock.stamps) > paused + 10)
    # Unless it is asked to, the controller listens to no identifier and says nothing of models.
    assert statuses.message(CONTROL)
    assert statuses.message(MODEL) == ""
    for process in (controller, bridge):
        process.send(signal.SIGINT)
    assert (controller.ended().status, bridge.ended().status) == (0, 0)
    assert clock.jumps == 1


def test_bad_commands_are_reported_and_ignored(graph) -> None:
    states, statuses = [], StatusProbe(graph)
    graph.node.create_subscription(JointState, "joint_states", states.append, RELIABLE)
    commands = graph.node.create_publisher(JointState, "joint_command", RELIABLE)
    bridge = graph.start("mujoco_bridge", **PACED)
    graph.wait_until(lambda: states)
    drives = Simulator(SimulateOptions("tare")).drive_names
    first = states[0]

    def send(stamp, efforts: dict[str, float]) -> None:
        message = JointState(name=list(efforts), effort=list(efforts.values()))
        message.header.stamp = stamp
        commands.publish(message)

    still = dict.fromkeys(drives, 0.0)
    later = Clock().clock
    later.sec = 1000
    send(first.header.stamp, still | {drives[0]: float("nan")})
    send(first.header.stamp, still | {drives[0]: 1e6})
    send(first.header.stamp, dict.fromkeys(drives[1:], 0.0))
    send(first.header.stamp, still | {"tail": 0.0})
    send(later, still)
    expected = {"not_finite": 1, "beyond_limit": 1, "joints": 2, "future": 1}
    graph.wait_until(
        lambda: all(statuses.count(COMMANDS, f"rejected/{key}") == n for key, n in expected.items())
    )
    assert statuses.count(COMMANDS, "accepted") == 0
    assert {nanoseconds(state.header.stamp) for state in states} == {1_000_000}
    send(first.header.stamp, still)
    graph.wait_until(lambda: nanoseconds(states[-1].header.stamp) == 2_000_000)
    effort = dict(zip(states[-1].name, states[-1].effort, strict=True))
    assert all(abs(effort[name]) < 1.0 for name in drives), "zero but for the sensors' noise"
    bridge.send(signal.SIGINT)
    assert bridge.ended().status == 0


@pytest.mark.parametrize(("source", "number"), [("topic", signal.SIGINT), ("udp", signal.SIGTERM)])
def test_signals_end_a_bridge_that_waits(graph, source: str, number: signal.Signals) -> None:
    statuses = StatusProbe(graph)
    bridge = graph.execute("mujoco_bridge", command_source=source, udp_port=0)
    graph.wait_until(lambda: statuses.message(COMMANDS) == "waiting for a controller")
    bridge.send(number)
    ended = bridge.ended()
    assert ended.status == 0
    assert "Traceback" not in ended.err
    assert json.loads(ended.out)["steps"] == 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_end_a_controller_without_measurements(graph, number: signal.Signals) -> None:
    statuses = StatusProbe(graph)
    controller = graph.execute("balance_controller")
    graph.wait_until(lambda: statuses.message(CONTROL).startswith("no measurements"))
    described = descriptors(graph, "/balance_controller", ["scenario", "moves", "use_sim_time"])
    assert all(each.description for each in described)
    controller.send(number)
    ended = controller.ended()
    assert (ended.status, ended.err) == (0, "")
    assert json.loads(ended.out)["answered"] == 0


@pytest.mark.parametrize(
    ("executable", "parameters", "line"),
    [
        ("balance_controller", {"scenario": "dance"}, "parameter scenario: 'dance' is not valid"),
        ("balance_controller", {"model": "/nowhere.xml"}, "/nowhere.xml"),
        (
            "mujoco_bridge",
            {"command_source": "topic", "errors": "sample_rates"},
            "parameter errors: sample_rates leaves instants without IMU",
        ),
    ],
)
def test_bad_parameters_end_with_one_line(graph, executable, parameters, line) -> None:
    ended = graph.start(executable, **parameters).ended()
    assert ended.status == 2
    assert ended.err.startswith(f"{executable}: {line}")
    assert ended.err.count("\n") == 1
