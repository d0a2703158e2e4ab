"""An online identifier that ends saves its estimate or reports why there is none."""

import json
import signal
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from threading import Event

import pytest
import rclpy
from live_feed import Feed, feed_of
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter
from std_srvs.srv import SetBool

from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.online.identification import OnlineIdentification
from symbid_ros.package_paths import config_file
from symbid_ros.ros.identifier_parameters import PARAMETERS
from symbid_ros.ros.monitor_messages import TOO_EARLY_TO_FIT
from symbid_ros.ros.online_identifier import EXACT_COST, OnlineIdentifier
from symbid_ros.ros.parameters import declare
from symbid_ros.ros.reporting import OK, WARN, NodeStatus
from symbid_ros.ros.sensor_topics import SensorTopics

MODEL = config_file("symbitron.xml")
FILES = {"estimate.json", "information.npz", "model.urdf", "model.xml"}


def newest_data(simulated) -> Feed:
    return feed_of(simulated("smooth", moves=2, motion_seed=7, noise_seed=3))


@pytest.fixture
def fed(domain: int, simulated, tmp_path: Path) -> Iterator[OnlineIdentifier]:
    """An identifier with two seconds of a log and no estimate yet."""
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    given = {"model": str(MODEL), "prior_percent": 25.0, "out": str(tmp_path / "out")}
    overrides = [Parameter(name, value=value) for name, value in given.items()]
    node = Node("identifier", context=context, parameter_overrides=overrides)
    identifier = OnlineIdentifier(node, declare(node, PARAMETERS))
    feed = newest_data(simulated).between(0.0, 2.0)
    live = OnlineIdentification(identifier._initial_state, feed.selected, identifier._pace)
    identifier._identification, identifier._selected = live, feed.selected
    feed.into(live)
    yield identifier
    node.destroy_node()
    context.try_shutdown()


def age_of(identifier: OnlineIdentifier) -> float:
    (age,) = (
        one.values["age"] for one in identifier._diagnostics.statuses() if "age" in one.values
    )
    return float(str(age))


def stopped() -> Event:
    stop = Event()
    stop.set()
    return stop


def test_data_are_saved_though_the_node_ends_before_its_first_estimate(
    fed: OnlineIdentifier, tmp_path: Path, capsys
) -> None:
    fed.run(stopped())
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES
    saved = json.loads((tmp_path / "out" / "estimate.json").read_text())
    rows = saved["rows"]
    assert (rows["filter"], rows["window_s"] > 0) == ("weak", True)
    summary = json.loads(capsys.readouterr().out)
    assert (summary["solves"], "written to" in summary["saved"]) == (1, True)
    assert summary["alarms"] == saved["verdict"]["alarms"]


def test_an_end_without_time_for_an_estimate_states_what_the_newest_lacks(
    fed: OnlineIdentifier, simulated, capsys
) -> None:
    assert fed._solve() is not None
    newest_data(simulated).between(2.0, 3.5).into(fed._live)
    fed._solve_times.append(10.0)  # s
    fed._solve_times.popleft()
    fed.run(stopped())
    late, *_, early = json.loads(capsys.readouterr().out)["warnings"]
    assert "saving the newest one, which lacks the last 1.5 s of the data" in late
    assert early == TOO_EARLY_TO_FIT  # there is no verdict


def test_an_end_without_time_for_an_exact_estimate_uses_all_data(
    fed: OnlineIdentifier, simulated, capsys
) -> None:
    assert fed._solve() is not None
    rest = newest_data(simulated).between(2.0, 3.5)
    rest.into(fed._live)
    fed._solve_times.append(1.0)  # s
    fed._solve_times.popleft()
    fed.run(stopped())
    (inexact, *_) = json.loads(capsys.readouterr().out)["warnings"]
    assert "the saved one is of all data" in inexact
    assert fed._newest is not None
    assert fed._newest.until >= rest.messages[-1][0] - 10**7


def test_a_longer_save_time_allows_an_exact_estimate(fed: OnlineIdentifier, capsys) -> None:
    assert fed._solve() is not None
    fed._solve_times.append(10.0)
    fed._solve_times.popleft()
    fed._save_time = 60.0
    fed.run(stopped())
    summary = json.loads(capsys.readouterr().out)
    assert not any("save_time" in one for one in summary["warnings"])
    # It has the verdict of an offline run, which is never too early.
    assert summary["alarms"] == []
    assert TOO_EARLY_TO_FIT not in summary["warnings"]


def test_a_choice_that_makes_one_estimate_slow_leaves_the_end_exact(
    fed: OnlineIdentifier, capsys
) -> None:
    assert fed._solve() is not None
    fed._solve_times.append(30.0)
    fed._save_time = EXACT_COST * fed._solve_times[0] + 1.0
    fed.run(stopped())
    assert not any("save_time" in one for one in json.loads(capsys.readouterr().out)["warnings"])


def test_a_save_answers_with_the_alarms_of_the_result(
    fed: OnlineIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(OnlineIdentifier, "_alarms_of", lambda *_: ("the data contradict it",))
    assert fed._save().endswith("; alarm: the data contradict it")


def test_a_reset_says_that_the_end_replaces_what_was_saved(fed: OnlineIdentifier) -> None:
    assert "replaces" not in fed._reset()
    fed._has_saved = True
    assert f"replaces the result in {fed._out}" in fed._reset()


def test_the_ending_states_why_data_gave_no_estimate(
    fed: OnlineIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(_: OnlineIdentification, *, exactly: bool) -> None:
        raise DataError("the forces do not match the weight", "E313")

    monkeypatch.setattr(OnlineIdentification, "solve", refuse)
    with pytest.raises(EstimateError, match="without an estimate: the forces do not match"):
        fed.run(stopped())


def test_alarms_wait_until_joint_terms_can_be_chosen(
    fed: OnlineIdentifier, monkeypatch: pytest.MonkeyPatch
) -> None:
    outcome = fed._live.solve()
    assert outcome is not None
    alarming = replace(outcome, alarms=("the data widened the prior",))

    def status() -> NodeStatus:
        fed._diagnostics.set_estimate(fed._live, alarming, None, 0.1, 0.0)
        (status,) = (one for one in fed._diagnostics.statuses() if one.part == "estimate")
        return status

    fed._diagnostics.set_estimate(fed._live, replace(outcome, alarms=()), None, 0.1, 0.0)
    (quiet,) = (one for one in fed._diagnostics.statuses() if one.part == "estimate")
    assert (quiet.level, quiet.message) == (OK, TOO_EARLY_TO_FIT)
    early = status()
    assert early.message.startswith("too early to tell whether the model")
    assert early.level == WARN  # no controller may use it
    assert fed._alarms_of(alarming) == ()
    alarming = replace(alarming, is_contradicted=True)
    assert status().message == "the data widened the prior"
    assert fed._alarms_of(alarming) == alarming.alarms
    alarming = replace(alarming, is_contradicted=False)
    monkeypatch.setattr(OnlineIdentification, "can_tell_change", True)
    assert status().message == "the data widened the prior"


def test_the_age_counts_from_when_the_newest_message_was_taken(fed: OnlineIdentifier) -> None:
    fed._taken -= 5.0  # s without data, or of a slow solve
    assert fed._solve() is not None
    assert age_of(fed) >= 5.0


def test_a_disabled_identifier_reports_no_fault(fed: OnlineIdentifier) -> None:
    fed._live.reset()
    fed._enable(SetBool.Request(data=False), SetBool.Response())
    statuses = {status.part: status for status in fed._diagnostics.statuses()}
    for part in ("estimate", "streams"):
        assert (statuses[part].level, statuses[part].message) == (OK, "disabled by ~/enable")
    with pytest.raises(EstimateError, match="disabled by ~/enable"):
        fed.run(stopped())


def test_the_newest_estimate_is_saved_when_an_error_ends_the_node(
    fed: OnlineIdentifier, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert fed._solve() is not None

    def fail(_: SensorTopics) -> None:
        raise MemoryError("the graph is too large")

    monkeypatch.setattr(SensorTopics, "find", fail)
    with pytest.raises(MemoryError):
        fed.run(Event())
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
