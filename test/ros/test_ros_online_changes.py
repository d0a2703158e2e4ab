"""The online identifier as a process: payloads, sensors' errors and a tare, and parameters."""

import signal
from pathlib import Path

import pytest
from online_node import LINKS, SENSORS, EstimateProbe, bridge, call, identifier
from rcl_interfaces.msg import Parameter, ParameterValue
from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
from std_srvs.srv import Trigger


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
    offset = "left_sole/wrench_offset_force_z"
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
