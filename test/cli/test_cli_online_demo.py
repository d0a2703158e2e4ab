"""The online demo identifies while the robot moves, and always ends all of its nodes."""

import json
import os
import re
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from bag_editing import topic_counts
from preloaded import run_symbid
from report_pages import Page

from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file

DEADLINE = 300.0  # s; only a hang takes as long
NODES = {"identifier", "recorder", "monitor", "mujoco_bridge"}
AT_THE_LIMIT = 2  # parameters that are just determined, or just not


def test_the_estimates_converge_and_are_reported(tmp_path: Path, monkeypatch) -> None:
    out = tmp_path / "demo"
    monkeypatch.setenv("COLUMNS", "120")
    words = ("demo", "--online", "--moves", 1, "--out", out)
    ended = run_symbid(*words, output=tmp_path / "symbid")
    assert ended.returncode == 0, ended.stderr
    lines = ended.stdout.splitlines()
    told = [line for line in lines if line.startswith("data to")]
    determined = [int(re.findall(r": (\d+) of \d+ single parameters", line)[0]) for line in told]
    assert determined[-1] > 0
    # Live estimates are exact to a hundredth of a deviation, which may decide at the limit.
    assert determined[-1] >= max(determined) - AT_THE_LIMIT
    parameters = ParameterSet(load_model(config_file("symbitron.xml")))
    for link in parameters.link_names:
        assert any(line.startswith(f"{link} ") for line in lines)

    saved = json.loads((out / "online" / "estimate.json").read_text())
    exactly = sum(each["determined"] for each in saved["parameters"].values())
    assert abs(determined[-1] - exactly) <= AT_THE_LIMIT
    value, std, prior = (
        np.array([saved["parameters"][name][key] for name in parameters.names])
        for key in ("value", "std", "prior")
    )
    truth = parameters.values
    assert np.sqrt(np.mean(((value - truth) / std) ** 2)) < 2
    masses = [parameters.names.index(f"{link}/m") for link in parameters.link_names]
    assert abs(value[masses].sum() - truth[masses].sum()) < 0.2
    assert abs(value[masses].sum() - truth[masses].sum()) < abs(
        prior[masses].sum() - truth[masses].sum()
    )
    for name in ("information.npz", "model.urdf", "model.xml"):
        assert (out / "online" / name).is_file()
    sensors = {"/joint_states", "/imu/data", "/left_foot/wrench", "/right_foot/wrench"}
    assert topic_counts(out / "bag").keys() >= sensors

    page = Page((out / "report.html").read_text())
    assert {row[0] for row in page.rows} >= {"prior", "MAP-LMI, online", "truth"}
    assert "Identified live" in page.source
    assert f"{out}/report.html" in ended.stdout.replace("\n", "")


def test_the_page_is_offered_while_a_payload_is_attached(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    words = ("demo", "--online", "--web", "--port", 0, "--moves", 1, "--out", out)
    ended = run_symbid(*words, output=tmp_path / "symbid")
    assert ended.returncode == 0, ended.stderr
    assert re.search(r"Open http://127\.0\.0\.1:\d+/\?token=\S+", ended.stdout)
    saved = json.loads((out / "online" / "estimate.json").read_text())["parameters"]
    total = sum(entry["value"] for name, entry in saved.items() if name.endswith("/m"))
    truth = ParameterSet(load_model(config_file("symbitron.xml")))
    true_total = truth.link_phi(truth.values)[:, 0].sum()
    # The estimate follows the payload of 3 kg while older data are forgotten.
    assert true_total + 0.5 < total < true_total + 3.2


class Demo:
    """A demo that runs, and the processes that it has started."""

    def __init__(self, out: Path) -> None:
        self._process = subprocess.Popen(
            [Path(sys.executable).parent / "symbid", "demo", "--online", "--out", out],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env={**os.environ, "COLUMNS": "300"},
            start_new_session=True,
        )
        self.nodes: dict[str, int] = {}
        wait_until(lambda: self._find_nodes() == NODES)

    def _find_nodes(self) -> set[str]:
        number = self._process.pid
        for child in Path(f"/proc/{number}/task/{number}/children").read_text().split():
            try:
                command = Path(f"/proc/{child}/cmdline").read_bytes().decode()
            except (FileNotFoundError, ProcessLookupError):  # it has ended meanwhile
                continue
            if match := re.search(r"symbid_ros\.ros\.start import (\w+)", command):
                self.nodes[match[1]] = int(child)
        return set(self.nodes)

    def send(self, number: signal.Signals) -> None:
        self._process.send_signal(number)

    def ended(self) -> tuple[int, str]:
        """Return exit status and stderr, once it has ended with all of its nodes."""
        _, err = self._process.communicate(timeout=DEADLINE)
        # A node whose parent has gone stays in /proc until init has collected its status.
        wait_until(lambda: not any(Path(f"/proc/{node}").exists() for node in self.nodes.values()))
        return self._process.returncode, err

    def kill(self) -> None:
        for number in (self._process.pid, *self.nodes.values()):
            if Path(f"/proc/{number}").exists():
                os.kill(number, signal.SIGKILL)
        self._process.communicate()


def wait_until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + DEADLINE
    while not condition():
        assert time.monotonic() < deadline, "the condition did not come about"
        time.sleep(0.01)


@pytest.fixture
def demo(tmp_path: Path) -> Iterator[Demo]:
    demo = Demo(tmp_path / "demo")
    try:
        yield demo
    finally:
        demo.kill()


@pytest.mark.parametrize("node", ["identifier", "recorder", "mujoco_bridge"])
def test_a_failed_node_ends_the_demo_with_one_line(demo: Demo, node: str) -> None:
    os.kill(demo.nodes[node], signal.SIGKILL)
    status, err = demo.ended()
    assert status == 2
    (line,) = err.splitlines()
    assert line.startswith(f"symbid: {node} was killed by signal 9")


@pytest.mark.parametrize(
    ("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 128 + signal.SIGTERM)]
)
def test_a_signal_ends_the_demo_and_its_nodes(
    demo: Demo, number: signal.Signals, status: int
) -> None:
    demo.send(number)
    ended, err = demo.ended()
    assert ended == status
    assert "Traceback" not in err
