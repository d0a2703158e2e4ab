"""Twelve bags on two workers give what one process does, even when a worker is killed."""

import json
import logging
import os
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from arm_log import arm_streams
from dask_cluster import local_cluster
from documented_robots import ur5_urdf
from expected_errors import raises_code
from quadruped_log import FEET, quadruped_urdf, record_log, standing_log
from random_logs import write_bag

from symbid_ros.cluster import connection
from symbid_ros.cluster.connection import connected
from symbid_ros.cluster.log_job import ClusterRequest, divided
from symbid_ros.errors import SymbidError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.pipeline import identify_problem
from symbid_ros.identification.rows.aligned_log import SPAN
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import BagRequest
from symbid_ros.progress import reported_to

pytest.importorskip("distributed", reason="clusters are not tested: Dask is not installed")

BAGS = 12
# Bags of one minute each, of which a few seconds are recorded.
SPACING = 61_000_000_000
OPTIONS = IdentifyOptions(joint_terms=("viscous", "coulomb"), unchecked=True, window=0.161)


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    folder = tmp_path_factory.mktemp("bags")
    arm = load_model(ur5_urdf(), "fixed")
    written = []
    for number in range(BAGS):
        streams = arm_streams(arm, 6.0, number, rate=100.0, friction=0.05)
        joints = replace(streams.joints, stamp=streams.joints.stamp + number * SPACING)
        written.append(write_bag(replace(streams, joints=joints), folder / f"run_{number}"))
    return tuple(written)


@pytest.fixture(scope="module")
def request_of_all(bags) -> BagRequest:
    return BagRequest(bags, ur5_urdf(), OPTIONS, LogOptions(), "fixed")


@pytest.fixture(scope="module")
def alone(request_of_all):
    """Return the identification by one process."""
    return identify_problem(request_of_all.load())[1]


def assert_equal(found, expected) -> None:
    for one, two in zip(found, expected, strict=True):
        for kind in ("rows", "noise"):
            R, S = getattr(one, kind).factor, getattr(two, kind).factor
            norm = np.linalg.norm(S, axis=0)
            scale = np.where(norm > 0, norm, 1.0)
            assert np.abs((R.T @ R - S.T @ S) / np.outer(scale, scale)).max() < 1e-10
        assert np.array_equal(one.counts, two.counts)
        assert one.seconds == two.seconds
        assert one.rows.samples == two.rows.samples


def test_parts_cover_the_log_once() -> None:
    second = 1_000_000_000
    begin = 10**18 // SPAN * SPAN
    spans = [(begin + 3 * second, begin + 50 * second), (begin + 50 * second, begin + 900 * second)]
    spans.append((begin + 5000 * second, begin + 5001 * second))
    parts = divided(spans)
    assert [one.stop for one in parts[:-1]] == [one.start for one in parts[1:]]
    assert all(one.start % SPAN == 0 for one in parts[1:])
    assert parts[0].start < spans[0][0]
    assert parts[-1].stop > spans[-1][1]
    # Both bags lie in the first slice; a part reads the bag that it starts in.
    assert (parts[0].first, parts[0].last) == (0, 1)
    assert (parts[1].first, parts[1].last) == (1, 1)
    assert (parts[-1].first, parts[-1].last) == (1, 2)


def test_the_command_gives_the_numbers_of_one_process(cluster, bags, alone, tmp_path) -> None:
    command = [sys.executable, "-m", "symbid_ros.cli.main", "identify", *map(str, bags)]
    command += ["--model", str(ur5_urdf()), "--base", "fixed", "--out", str(tmp_path / "out")]
    command += ["--joint-terms", "viscous,coulomb", "--unchecked", "--window", "0.161"]
    command += ["--dask", cluster.address]
    ran = subprocess.run(command, capture_output=True, text=True, check=False)
    assert ran.returncode in (0, 1), ran.stderr
    assert_equal(load_archive(tmp_path / "out" / "information.npz"), alone.observations)
    estimate = json.loads((tmp_path / "out" / "estimate.json").read_text())
    expected = alone.estimate
    std = np.maximum(expected.std, 1e-300)
    value = np.array([estimate["parameters"][name]["value"] for name in expected.names])
    assert np.abs((value - expected.value) / std)[expected.std > 0].max() < 1e-6
    assert estimate["holdout"]["percent_after"] == pytest.approx(expected.holdout.percent_after)
    assert estimate["inputs"][:BAGS] == list(map(str, bags))
    inputs = {one["path"]: one["sha256"] for one in estimate["provenance"]["inputs"]}
    named = {one.path: one.sha256 for one in expected.provenance.inputs}
    assert inputs == named


def test_a_killed_worker_costs_no_result(request_of_all, bags, alone, tmp_path) -> None:
    steps = []
    with local_cluster(tmp_path) as started, connected(started.address) as cluster:

        def kill_midway(step: str, _: float | None) -> None:
            if step.startswith("folding") and step not in steps:
                steps.append(step)
                os.kill(started.workers[0].pid, signal.SIGKILL)

        request = ClusterRequest(tuple(map(str, bags)), request_of_all)
        with reported_to(kill_midway):
            problem = request.load(cluster, tmp_path / "out")
        assert started.workers[0].wait() == -signal.SIGKILL
    assert steps == [f"folding {BAGS} parts on the cluster"]
    assert_equal(problem.dataset.observations, alone.observations)


def test_bags_at_urls_are_fetched(cluster, bags, request_of_all, tmp_path) -> None:
    with connected(cluster.address) as dask:
        first = f"file://{bags[0]}"
        found = ClusterRequest((first,), request_of_all).load(dask, tmp_path / "out")
        expected = replace(request_of_all, bags=bags[:1]).load()
    assert_equal(found.dataset.observations, expected.dataset.observations)


def test_bases_and_contacts_are_assumed_as_in_one_process(
    cluster, request_of_all, tmp_path
) -> None:
    of_arm = replace(request_of_all, bags=request_of_all.bags[:1], base="auto")
    model = tmp_path / "quadruped.urdf"
    model.write_text(quadruped_urdf())
    log = standing_log(load_model(model), 12.0, 3)
    short = {topic: log[topic] for topic in ("/joint_states", "/imu")}
    bag = record_log(short, load_model(model), tmp_path / "bag")
    of_legs = BagRequest((bag,), model, replace(OPTIONS, joint_terms=("none",)))
    with connected(cluster.address) as dask:
        for request in (of_arm, of_legs):
            here = request.load()
            there = ClusterRequest(tuple(map(str, request.bags)), request)
            found = there.load(dask, tmp_path / "out")
            assert found.parameters.model.floating == (request is of_legs)
            assert found.options.contacts == here.options.contacts
            assert_equal(found.dataset.observations, here.dataset.observations)
    assert here.options.contacts == tuple(f"{foot}:point" for foot in FEET)


def test_errors_of_workers_are_those_of_one_process(cluster, bags, request_of_all) -> None:
    with connected(cluster.address) as dask:
        for places, code in (
            ((bags[0].parent / "missing",), "E955"),
            ((f"unknown://{bags[0]}",), "E955"),
            ((bags[1], bags[0]), "E958"),
            ((bags[0], bags[0]), "E958"),  # equal clocks
        ):
            request = ClusterRequest(tuple(map(str, places)), request_of_all)
            with pytest.raises(SymbidError) as raised:
                request.load(dask, Path("unused"))
            assert raised.value.code == code
            assert str(places[0]) in str(raised.value)
        checked = replace(request_of_all, options=IdentifyOptions(drive_gain=("elbow_joint",)))
        with pytest.raises(SymbidError, match="drive_gain") as raised:
            ClusterRequest(tuple(map(str, bags)), checked).load(dask, Path("unused"))
        assert raised.value.code == "E956"


class Reaction(logging.Handler):
    """Calls a function at the first warning."""

    def __init__(self, function: Callable[[], object]) -> None:
        super().__init__(logging.WARNING)
        self.function, self.messages = function, []

    def emit(self, record: logging.LogRecord) -> None:
        self.messages.append(record.getMessage())
        if len(self.messages) == 1:
            self.function()


@pytest.mark.parametrize("ending", ["workers", "scheduler"])
def test_workers_and_a_scheduler_that_end_midway_are_named(
    tmp_path, monkeypatch, caplog, ending
) -> None:
    """Without workers the tasks wait, so a worker that is started then computes them."""
    monkeypatch.setattr(connection, "CHECK_PERIOD", 0.2)
    with local_cluster(tmp_path, workers=1) as started:
        react = Reaction(started.start_worker if ending == "workers" else started.scheduler.kill)
        connection.logger.addHandler(react)
        try:
            with (
                nullcontext() if ending == "workers" else raises_code("E953", "the scheduler"),
                connected(started.address) as dask,
            ):
                started.workers[0].kill()
                assert dask.results([dask.submit(max, 1, 2)], "waiting") == [2]
        finally:
            connection.logger.removeHandler(react)
    assert {record.name for record in caplog.records} == {connection.logger.name}
    (message,) = react.messages
    assert f"dask worker {started.address}" in message


def test_a_scheduler_that_ends_during_a_study_is_named(tmp_path) -> None:
    """The tasks of an executor do not say why they were cancelled."""
    with (
        local_cluster(tmp_path, workers=1) as started,
        raises_code("E953", "the scheduler"),
        connected(started.address) as dask,
    ):
        started.workers[0].kill()
        task = dask.client.get_executor(pure=False).submit(max, 1, 2)
        started.scheduler.kill()
        task.result()


@pytest.mark.parametrize("call", ["submit", "run"])
def test_work_after_the_scheduler_ended_is_refused(tmp_path, monkeypatch, call) -> None:
    monkeypatch.setattr(connection, "CONNECTING_TIME", 2.0)
    with (
        local_cluster(tmp_path, workers=1) as started,
        raises_code("E953", "the scheduler"),
        connected(started.address) as dask,
    ):
        started.scheduler.kill()
        started.scheduler.wait()
        if call == "run":
            dask.executor_of(tmp_path)
        else:
            dask.results([dask.submit(max, 1, 2)], "waiting")


def test_a_missing_scheduler_is_named(monkeypatch) -> None:
    monkeypatch.setattr(connection, "CONNECTING_TIME", 0.2)
    with (
        pytest.raises(SymbidError, match="no scheduler answers") as raised,
        connected("tcp://127.0.0.1:1"),
    ):
        pass
    assert raised.value.code == "E951"


def test_a_server_that_is_no_scheduler_is_named(monkeypatch) -> None:
    """It accepts connections and never answers, as the web server of Dask's dashboard does."""
    monkeypatch.setattr(connection, "CONNECTING_TIME", 0.2)
    with (
        socket.create_server(("127.0.0.1", 0)) as server,
        raises_code("E951", "another program listens there"),
        connected(f"tcp://127.0.0.1:{server.getsockname()[1]}"),
    ):
        pass


@pytest.mark.parametrize("address", ["nowhere", "nowhere://127.0.0.1:1", ""])
def test_an_invalid_address_creates_no_client(monkeypatch, address: str) -> None:
    """One that exists waits 20 s for an event loop and prints a traceback when it is deleted."""
    monkeypatch.setattr("distributed.Client", None)
    with pytest.raises(SymbidError, match="no scheduler answers") as raised, connected(address):
        pass
    assert raised.value.code == "E951"


def test_dask_is_asked_for_when_it_is_missing(monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "distributed", None)
    with (
        pytest.raises(SymbidError, match=r"symbid_ros\[dask\]") as raised,
        connected("tcp://127.0.0.1:1"),
    ):
        pass
    assert raised.value.code == "E950"
