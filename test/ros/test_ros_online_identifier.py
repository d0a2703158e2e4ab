"""The online identifier as a process: its topics against those of their bag, and services."""

import json
import signal
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import InertiaStamped
from json_schemas import require_valid
from online_node import LATCHED, LINKS, MODEL, SENSORS, EstimateProbe, bridge, call, identifier
from preloaded import run_symbid
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import Marker, MarkerArray

from symbid_ros.estimation.archive import load_archive
from symbid_ros.ros.monitor_messages import DISABLED


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
    live = identifier(graph, solve_period=0.5, stop=8.0, **LINKS)
    early = call(graph, Trigger, "/identifier/solve")
    assert not early.success
    assert "no sensor topics yet; waiting for topic /joint_states" in early.message
    bridge(graph, moves=40)
    graph.wait_until(lambda: probe.estimates and probe.until() > 1.5)

    assert "determined by" in call(graph, Trigger, "/identifier/solve").message
    unnamed = call(graph, Trigger, "/identifier/save")
    assert not unnamed.success
    assert "parameter out: empty" in unnamed.message

    assert call(graph, SetBool, "/identifier/enable", SetBool.Request(data=False)).success
    known = call(graph, Trigger, "/identifier/solve").message
    graph.wait_until(lambda: probe.statuses["estimate"].message == DISABLED)
    assert call(graph, Trigger, "/identifier/solve").message == known
    assert call(graph, SetBool, "/identifier/enable", SetBool.Request(data=True)).success

    graph.wait_until(lambda: probe.statuses["estimate"].message != DISABLED)
    # Statuses come once a second: after a reset, one of them has fewer rows than of ten seconds.
    graph.wait_until(lambda: probe.until() > 10.0)
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
    ended = live.ended()
    assert ended.status == 0
    # A robot file may name what only logs have.
    assert "`stop` has no effect live" in ended.err


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
    assert "no wrench sensor is in use" in probe.statuses["streams"].message
    without.kill()
    assert not probe.estimates
    graph.start("player", topics=SENSORS, **player)
    graph.wait_until(lambda: probe.estimates)
