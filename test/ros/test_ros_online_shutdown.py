"""An online identifier that ends saves its estimate or reports why there is none."""

import signal
from collections.abc import Iterator
from pathlib import Path
from threading import Event

import pytest
import rclpy
from live_feed import feed_of
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter

from symbid_ros.estimation.archive import load_archive
from symbid_ros.online.identification import OnlineIdentification
from symbid_ros.package_paths import config_file
from symbid_ros.ros.identifier_parameters import PARAMETERS
from symbid_ros.ros.online_identifier import OnlineIdentifier
from symbid_ros.ros.parameters import declare
from symbid_ros.ros.sensor_topics import SensorTopics

MODEL = config_file("symbitron.xml")
FILES = {"estimate.json", "information.npz", "model.urdf", "model.xml"}


@pytest.fixture
def learnt(domain: int, simulated, tmp_path: Path) -> Iterator[OnlineIdentifier]:
    """An identifier with an estimate from two seconds of a log."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    given = {"model": str(MODEL), "prior_percent": 25.0, "out": str(tmp_path / "out")}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = Node("identifier", context=context, parameter_overrides=overrides)
    identifier = OnlineIdentifier(node, declare(node, PARAMETERS))
    feed = feed_of(simulated("smooth", moves=2, motion_seed=7, noise_seed=3)).between(0.0, 2.0)
    live = OnlineIdentification(identifier._initial_state, feed.selected, identifier._pace)
    identifier._identification, identifier._selected = live, feed.selected
    feed.into(live)
    assert identifier._solve() is not None
    yield identifier
    node.destroy_node()
    context.try_shutdown()


def test_the_newest_estimate_is_saved_when_an_error_ends_the_node(
    learnt: OnlineIdentifier, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(_: SensorTopics) -> None:
        raise MemoryError("the graph is too large")

    monkeypatch.setattr(SensorTopics, "find", fail)
    with pytest.raises(MemoryError):
        learnt.run(Event())
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    assert load_archive(tmp_path / "out" / "information.npz")[0].rows.samples > 0


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_stopping_without_an_estimate_is_an_error_that_states_why(graph, tmp_path, number) -> None:
    process = graph.execute("identifier", model=MODEL, out=tmp_path / "out")
    graph.wait_for_node("identifier")
    graph.wait_until(lambda: graph.node.count_publishers("/identifier/estimate"))
    process.send(number)
    ended = process.ended()
    assert ended.status != 0
    if ended.status == 2:  # stopped after it had read its files
        assert (
            "stopped without an estimate: no sensor topics yet; waiting for topic /jo" in ended.err
        )
    assert not (tmp_path / "out").exists()
