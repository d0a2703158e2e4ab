"""The online identifier as a process: its topics, services and errors."""

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import InertiaStamped
from json_schemas import require_valid
from preloaded import run_symbid
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from symbid_ros.estimation.archive import load_archive
from symbid_ros.package_paths import config_file

MODEL = config_file("symbitron.xml")
SENSORS = "[joint_states, imu/data, left_foot/wrench, right_foot/wrench]"
LINKS = {"joint_terms": "none"}  # half the work where joint terms do not matter
LATCHED = QoSProfile(depth=10, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)


class EstimateProbe:
    """The identifier's newest estimate, and its statuses by part."""

    def __init__(self, graph: Any) -> None:
        self.estimates: list[DiagnosticArray] = []
        self.statuses: dict[str, Any] = {}
        graph.node.create_subscription(
            DiagnosticArray, "/identifier/estimate", self.estimates.append, LATCHED
        )
        graph.node.create_subscription(DiagnosticArray, "/diagnostics", self._keep, 10)
        graph.details = lambda: (len(self.estimates), self.statuses)

    def _keep(self, message: DiagnosticArray) -> None:
        for status in message.status:
            node, _, part = status.name.partition(": ")
            if node == "/identifier":
                self.statuses[part] = status

    def values(self, part: str) -> dict[str, str]:
        status = self.statuses.get(part)
        return {} if status is None else {entry.key: entry.value for entry in status.values}

    def times(self) -> list[float]:
        """Return the time of the newest data in each estimate, s."""
        stamps = [estimate.header.stamp for estimate in self.estimates]
        return [stamp.sec + 1e-9 * stamp.nanosec for stamp in stamps]

    def until(self) -> float:
        """Return the time of the newest data in the newest estimate, s."""
        return self.times()[-1]


def call(graph: Any, kind: type, service: str, request: Any = None) -> Any:
    client = graph.node.create_client(kind, service)
    graph.wait_until(client.service_is_ready)
    answer = client.call_async(kind.Request() if request is None else request)
    graph.wait_until(answer.done)
    return answer.result()


def identifier(graph: Any, **parameters: object) -> Any:
    return graph.start("identifier", model=MODEL, prior_percent=25.0, **parameters)


def bridge(graph: Any, **parameters: object) -> Any:
    return graph.start("mujoco_bridge", wait_for_subscribers=True, **parameters)


def offline(bag: Path, out: Path, *options: object) -> dict[str, Any]:
    given = "--model", MODEL, "--prior-percent", 25, "--no-holdout", *options, "--out", out
    ended = run_symbid("identify", bag, *given, output=out.with_suffix(".symbid"))
    assert ended.returncode == 0, ended.stderr
    return json.loads((out / "estimate.json").read_text())


def assert_same(live: Path, bag: Path) -> None:
    """Compare information (to 1e-9 of its size) and estimates (to 1e-6 of a standard deviation)."""
    pairs = zip(*(load_archive(out / "information.npz") for out in (live, bag)), strict=True)
    for one, other in pairs:
        assert (one.window, one.rows.samples) == (other.window, other.rows.samples)
        found, expected = (x.rows.factor.T @ x.rows.factor for x in (one, other))
        scale = np.sqrt(np.diag(expected))
        assert np.all(np.abs(found - expected) <= 1e-9 * np.outer(scale, scale))
    found, expected = (json.loads((out / "estimate.json").read_text()) for out in (live, bag))
    for name, entry in expected["parameters"].items():
        assert abs(found["parameters"][name]["value"] - entry["value"]) <= 1e-6 * entry["std"]


def test_topics_give_the_same_estimate_as_their_bag(graph, tmp_path: Path) -> None:
    probe = EstimateProbe(graph)
    recorder = graph.start("recorder", bag=tmp_path / "bag", topics=SENSORS)
    live = identifier(graph, out=tmp_path / "live", solve_period=0.5, **LINKS)
    inertias: list[InertiaStamped] = []
    graph.node.create_subscription(
        InertiaStamped, "/identifier/inertia/base_link", inertias.append, LATCHED
    )
    played = json.loads(bridge(graph, moves=1, motion_seed=8, subscribers=2).ended().out)
    answer = call(graph, Trigger, "/identifier/save")
    assert answer.success
    assert str(tmp_path / "live") in answer.message
    recorder.send(signal.SIGINT)
    recorded = json.loads(recorder.ended().out)["recorded"]
    graph.wait_until(lambda: probe.until() == played["steps"] * 1e-3 and inertias)
    # Several estimates of the whole robot were published; the last one was saved.
    assert len(probe.estimates) > 3
    offline(tmp_path / "bag", tmp_path / "offline", "--joint-terms", "none")
    assert_same(tmp_path / "live", tmp_path / "offline")
    document = json.loads((tmp_path / "live" / "estimate.json").read_text())
    require_valid("estimate", document)
    assert inertias[-1].inertia.m == document["parameters"]["base_link/m"]["value"]
    assert set(recorded) <= set(document["inputs"])

    live.send(signal.SIGTERM)
    ended = live.ended()
    assert ended.status == 0
    summary = json.loads(ended.out.splitlines()[-1])
    assert summary["received"] == recorded == {name: played["published"][name] for name in recorded}
    assert set(summary["missing"].values()) == {0}


def test_a_player_serves_as_well_as_a_robot(graph, simulated, tmp_path: Path) -> None:
    bag = simulated("smooth", moves=1, motion_seed=21, noise_seed=5)
    # At full speed, the stamps of topics may differ by seconds.
    live = identifier(graph, out=tmp_path / "live", lag=30.0, **LINKS)
    player = graph.start(
        "player", bag=f"['{bag}']", rate=0.0, topics=SENSORS, wait_for_subscribers=True
    )
    assert player.ended().status == 0
    assert call(graph, Trigger, "/identifier/save").success
    offline(bag, tmp_path / "offline", "--joint-terms", "none")
    assert_same(tmp_path / "live", tmp_path / "offline")
    live.send(signal.SIGINT)
    assert live.ended().status == 0


def test_services_solve_enable_and_reset(graph) -> None:
    probe, markers = EstimateProbe(graph), []
    graph.node.create_subscription(MarkerArray, "/identifier/markers", markers.append, LATCHED)
    live = identifier(graph, solve_period=0.5, **LINKS)
    early = call(graph, Trigger, "/identifier/solve")
    assert not early.success
    assert "no sensor topics yet" in early.message
    bridge(graph, moves=40)
    graph.wait_until(lambda: probe.estimates and probe.until() > 1.5)

    assert "determined by" in call(graph, Trigger, "/identifier/solve").message
    unnamed = call(graph, Trigger, "/identifier/save")
    assert not unnamed.success
    assert "parameter out: empty" in unnamed.message

    assert call(graph, SetBool, "/identifier/enable", SetBool.Request(data=False)).success
    known = call(graph, Trigger, "/identifier/solve").message
    graph.wait_until(lambda: probe.statuses["estimate"].message == "not enabled")
    assert call(graph, Trigger, "/identifier/solve").message == known
    assert call(graph, SetBool, "/identifier/enable", SetBool.Request(data=True)).success

    graph.wait_until(lambda: probe.statuses["estimate"].message != "not enabled")
    rows = int(probe.values("estimate")["samples"])
    assert call(graph, Trigger, "/identifier/reset").success
    graph.wait_until(lambda: int(probe.values("estimate").get("samples", rows)) < rows)
    # The markers of the old estimate were deleted.
    actions = [{marker.action for marker in message.markers} for message in markers]
    assert Marker.DELETEALL in actions[0]
    assert {Marker.DELETE} in actions
    namespaces = {marker.ns for message in markers for marker in message.markers}
    assert {"inertia", "com", "total_com"} <= namespaces
    live.send(signal.SIGINT)
    assert live.ended().status == 0


def test_running_nodes_reconnect_to_restarted_ones(graph) -> None:
    probe = EstimateProbe(graph)
    live = identifier(graph, solve_period=0.5, **LINKS)
    robot = bridge(graph, moves=40)
    graph.wait_until(lambda: probe.estimates and probe.until() > 1.5)
    robot.kill()
    again = bridge(graph, moves=40)
    graph.wait_until(lambda: probe.values("streams").get("clock_jumps") == "1")
    rows = int(probe.values("estimate")["samples"])
    graph.wait_until(lambda: int(probe.values("estimate")["samples"]) > rows)

    live.kill()
    count = len(probe.estimates)
    other = identifier(graph, solve_period=0.5, **LINKS)
    graph.wait_until(lambda: len(probe.estimates) > count + 1)
    for node in (other, again):
        node.send(signal.SIGINT)
    ended = other.ended()
    assert (ended.status, again.ended().status) == (0, 0)
    assert "Traceback" not in ended.err


def test_a_late_wrench_topic_restarts_identification(graph, simulated) -> None:
    bag = simulated("smooth", moves=1, motion_seed=21, noise_seed=5)
    probe = EstimateProbe(graph)
    identifier(graph, solve_period=0.3, **LINKS)
    player = {"bag": f"['{bag}']", "loop": True, "wait_for_subscribers": True}
    without = graph.start("player", topics="[joint_states, imu/data]", **player)
    graph.wait_until(
        lambda: (
            "estimate" in probe.statuses
            and "measured wrenches differ" in probe.statuses["estimate"].message
        )
    )
    without.kill()
    assert not probe.estimates
    graph.start("player", topics=SENSORS, **player)
    graph.wait_until(lambda: probe.estimates)


def test_a_change_caused_by_a_payload_names_its_link(graph) -> None:
    probe = EstimateProbe(graph)
    identifier(graph, memory=5.0, **LINKS)
    bridge(graph, moves=60, motion_seed=3)
    graph.wait_until(lambda: "change" in probe.statuses)
    graph.wait_until(
        lambda: probe.statuses["change"].message == "no change"
    )  # there are enough data by now
    graph.wait_until(lambda: probe.until() > 10.0)
    request = SetParameters.Request(
        parameters=[
            Parameter(name="payload_link", value=ParameterValue(type=4, string_value="L_thigh")),
            Parameter(
                name="payload_position",
                value=ParameterValue(type=8, double_array_value=[0.2, 0.0, 0.05]),
            ),
            Parameter(name="payload_mass", value=ParameterValue(type=3, double_value=2.0)),
        ]
    )
    attached = call(graph, SetParameters, "/mujoco_bridge/set_parameters", request)
    assert all(result.successful for result in attached.results)
    # Two updates are tested together, and this one may have begun before the payload.
    earliest = probe.times()[-3]
    graph.wait_until(lambda: "changed" in probe.statuses["change"].message)
    assert probe.values("change")["link"] == "L_thigh"
    assert float(probe.values("change")["since"]) > earliest - 0.1
    graph.wait_until(lambda: abs(float(probe.values("change")["mass"]) - 2.0) < 0.2)


def test_sensor_errors_are_estimated_after_a_tare(graph, simulated) -> None:
    robot = {"errors": "typical", "error_seed": 11}
    hanging = simulated("tare", noise_seed=7, **robot)
    moving = simulated("smooth", moves=6, motion_seed=5, noise_seed=6, **robot)
    probe = EstimateProbe(graph)
    live = identifier(graph, sensor_errors="[typical]", total_mass=41.05, **LINKS)
    assert "no sensor topics yet" in call(graph, Trigger, "/identifier/tare").message
    player = {"topics": SENSORS, "loop": True, "wait_for_subscribers": True}
    first = graph.start("player", bag=f"['{hanging}']", **player)
    graph.wait_until(lambda: int(probe.values("streams").get("/imu/data/received", 0)) > 100)
    answer = call(graph, Trigger, "/identifier/tare")
    assert answer.message.startswith("left_sole, right_sole tared"), answer.message
    first.kill()
    assert call(graph, Trigger, "/identifier/reset").success
    graph.start("player", bag=f"['{moving}']", **player)
    graph.wait_until(lambda: "sensors" in probe.statuses)
    offset = "left_sole/plate_offset_force_z"
    assert float(probe.values("sensors")[f"{offset}/std"]) < 0.1  # by the tare
    live.send(signal.SIGINT)
    assert live.ended().status == 0


def test_a_tare_needs_sensor_errors(graph) -> None:
    identifier(graph, **LINKS)
    answer = call(graph, Trigger, "/identifier/tare")
    assert not answer.success
    assert "parameter sensor_errors: none" in answer.message


def test_parameters_are_described_and_checked(graph) -> None:
    probe = EstimateProbe(graph)
    live = identifier(graph)
    graph.wait_until(lambda: probe.statuses)  # live parameters can be set from then on
    listed = call(graph, ListParameters, "/identifier/list_parameters").result.names
    described = call(
        graph,
        DescribeParameters,
        "/identifier/describe_parameters",
        DescribeParameters.Request(names=listed),
    ).descriptors
    for descriptor in described:
        if not descriptor.name.startswith(("qos_overrides", "start_type_description")):
            assert descriptor.description, descriptor.name
    period = Parameter(name="solve_period", value=ParameterValue(type=3, double_value=0.25))
    memory = Parameter(name="memory", value=ParameterValue(type=3, double_value=5.0))
    fixed = Parameter(name="lag", value=ParameterValue(type=3, double_value=5.0))
    wrong = Parameter(name="solve_period", value=ParameterValue(type=3, double_value=-1.0))
    results = [
        call(
            graph,
            SetParameters,
            "/identifier/set_parameters",
            SetParameters.Request(parameters=[one]),
        ).results[0]
        for one in (period, memory, fixed, wrong)
    ]
    assert [result.successful for result in results] == [True, True, False, False]
    live.send(signal.SIGINT)  # before any topic has appeared
    ended = live.ended()
    assert ended.status == 2
    assert "stopped without an estimate: no sensor topics yet; waiting for" in ended.err


@pytest.mark.parametrize(
    ("parameters", "says"),
    [
        ({"mode": "offline"}, "parameter bag: empty"),
        ({"mode": "online", "bag": "[log]"}, "parameter bag: not read online"),
        ({"bag": "[log]", "resume": "x.npz"}, "parameter resume: for topics only"),
        ({"mode": "sideways"}, "parameter mode: 'sideways' is not valid"),
        ({"memory": -1.0}, "parameter memory: not a valid value"),
        ({"solve_period": 0.0}, "parameter solve_period: not a valid value"),
    ],
    ids=lambda value: ",".join(value) if isinstance(value, dict) else "",
)
def test_parameters_that_contradict_each_other(graph, parameters: dict, says: str) -> None:
    ended = identifier(graph, **parameters).ended()
    assert ended.status == 2
    assert ended.err.count("\n") == 1, ended.err
    assert says in ended.err


def test_a_file_that_cannot_be_resumed_is_refused_at_once(graph, tmp_path: Path) -> None:
    bridge(graph, moves=20)
    ended = identifier(graph, resume=tmp_path / "none.npz").ended()
    assert ended.status == 2
    assert "none.npz: cannot read it" in ended.err
