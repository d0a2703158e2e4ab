"""The monitor displays an identifier's messages on terminals of any width and in logs."""

import fcntl
import math
import os
import pty
import random
import re
import signal
import struct
import subprocess
import sys
import termios
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from io import StringIO
from pathlib import Path

import numpy as np
import pytest
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.qos import QoSDurabilityPolicy, QoSProfile
from rich.console import Console

from symbid_ros.package_paths import config_file
from symbid_ros.ros.monitor import PARAMETERS, MonitorView, Screen, line, page
from symbid_ros.ros.monitor_messages import (
    DISABLED,
    TOO_EARLY_TO_FIT,
    IdentifierStatus,
    StreamCounts,
    read_estimate,
    read_status,
)

NAMES = ("m", "mc_x", "mc_y", "mc_z", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz")
LATCHED = QoSProfile(depth=1, durability=QoSDurabilityPolicy.TRANSIENT_LOCAL)
TRUNK = np.array([12.0, 0.6, -0.24, 3.6, 1.5, 0.01, -0.02, 1.4, 0.03, 0.4])
LEG = np.array([2.0, 0.0, 0.02, -0.5, 0.2, 0.0, 0.001, 0.2, 0.002, 0.01])
STD = np.array([0.12, 0.006, 0.012, 0.06, *[0.02] * 6])


def status(name: str, level: bytes = DiagnosticStatus.OK, message: str = "", **values: object):
    entries = [KeyValue(key=key.replace("__", "/"), value=str(v)) for key, v in values.items()]
    return DiagnosticStatus(name=name, level=level, message=message, values=entries)


def link(name: str, phi, std, *, known: int = 10, level: bytes = DiagnosticStatus.OK):
    entries: dict[str, object] = {}
    for index, parameter in enumerate(NAMES):
        entries[parameter] = repr(float(phi[index]))
        entries[f"{parameter}/std"] = repr(float(std[index]))
        entries[f"{parameter}/determined"] = "true" if index < known else "false"
    return status(name, level, **entries)


def estimate(*links: DiagnosticStatus, seconds: int = 3) -> DiagnosticArray:
    message = DiagnosticArray(status=list(links))
    message.header.stamp.sec = seconds
    for one in links:
        one.hardware_id = "biped"
    return message


def view(message: DiagnosticArray, *, first: DiagnosticArray | None = None, **state) -> MonitorView:
    seen = read_estimate(first or message)
    return MonitorView(
        identifier="/identifier",
        estimate=read_estimate(message),
        first={each.name: each for each in seen.links},
        status=state.get("status", IdentifierStatus({}, (), ())),
        silence=state.get("silence", 0.0),
        truth=state.get("truth", {}),
    )


def rendered(shown: MonitorView, width: int) -> list[str]:
    console = Console(file=StringIO(), width=width)
    console.print(page(shown, console))
    return console.file.getvalue().splitlines()


def cells(lines: list[str], name: str) -> list[str]:
    (row,) = [re.split(r"\s{2,}", line) for line in lines if line.startswith(name)]
    return row


class TestMessages:
    def test_the_centre_of_mass_varies_as_samples_of_the_parameters_do(self) -> None:
        (trunk,) = read_estimate(estimate(link("trunk", TRUNK, STD))).links
        draws = np.random.default_rng(3).normal(TRUNK[:4], STD[:4], (200_000, 4))
        centres = draws[:, 1:] / draws[:, :1]
        np.testing.assert_allclose(trunk.com, TRUNK[1:4] / TRUNK[0])
        np.testing.assert_allclose(trunk.com_std, centres.std(axis=0), rtol=0.02)

    def test_deviations_shrink_by_their_geometric_mean(self) -> None:
        first, last = (
            read_estimate(estimate(link("trunk", TRUNK, std))).links[0]
            for std in (STD, np.concatenate([STD[:5] / 100, STD[5:]]))
        )
        assert last.shrinkage(first) == pytest.approx(10.0)
        assert first.shrinkage(first) == pytest.approx(1.0)

    def test_errors_are_in_standard_deviations(self) -> None:
        (trunk,) = read_estimate(estimate(link("trunk", TRUNK, STD))).links
        signs = np.array([1, -1] * 5)
        assert trunk.error(TRUNK + 2 * signs * STD) == pytest.approx(2.0)

    def test_determined_parameters_of_links_and_joints_are_counted(self) -> None:
        joint = {"viscous": "0.1", "viscous/std": "0.01", "viscous/determined": "true"}
        joint |= {"coulomb": "0.1", "coulomb/std": "0.2", "coulomb/determined": "false"}
        read = read_estimate(
            estimate(
                link("trunk", TRUNK, STD, known=7),
                link("leg", LEG, STD, known=2),
                status("knee", **joint),
            )
        )
        assert [each.determined for each in read.links] == [7, 2]
        assert (read.determined, read.parameters) == (7 + 2 + 1, 10 + 10 + 2)
        assert (read.stamp, read.model) == (3_000_000_000, "biped")

    def test_missing_values_are_unknown(self) -> None:
        read = read_estimate(estimate(status("trunk", m="12.0", mc_x="none"), status("leg")))
        (trunk,) = read.links
        assert trunk.phi[0] == 12.0
        assert np.isnan(trunk.com).all()
        assert np.isnan([trunk.shrinkage(trunk), trunk.error(TRUNK)]).all()
        assert (trunk.determined, read.determined) == (None, None)
        assert not read_estimate(DiagnosticArray()).links

    def test_status_combines_warnings_and_streams(self) -> None:
        statuses = {
            "estimate": status("", age="0.8", samples="120", method="map"),
            "change": status("", DiagnosticStatus.WARN, "leg: changed"),
            "streams": status(
                "", imu__data__rate="999.6", imu__data__missing="2", joint_states__rate="1000.2 Hz"
            ),
        }
        parsed = read_status(statuses)
        assert (parsed.number("age"), parsed.number("samples")) == (0.8, 120)
        assert math.isnan(parsed.number("method"))
        assert parsed.warnings == ("warning: leg: changed",)
        imu, joints = parsed.streams
        assert (imu.topic, imu.rate, dict(imu.faults)) == ("imu/data", 999.6, {"missing": 2})
        assert (joints.topic, joints.rate, dict(joints.faults)) == ("joint_states", 1000.2, {})
        assert read_status({}) == IdentifierStatus({}, (), ())

    def test_a_warning_names_options_as_the_user_gives_them(self) -> None:
        message = "waiting for topic /a (`joint_topic`); give `base` fixed"
        statuses = {"estimate": status("", DiagnosticStatus.ERROR, message)}
        (parameters,) = read_status(statuses).warnings
        assert parameters == "error: waiting for topic /a (joint_topic); give base fixed"
        (flags,) = read_status(statuses, as_flags=True).warnings
        assert flags == "error: waiting for topic /a (--joint-topic); give --base fixed"


class TestPage:
    def test_a_row_shows_the_values_of_the_message(self) -> None:
        first = estimate(link("trunk", TRUNK, 2 * STD), link("leg", LEG, 2 * STD))
        last = estimate(link("trunk", TRUNK, STD, known=7), link("leg", LEG, STD, known=0))
        truth = {"trunk": TRUNK + 3 * STD}
        lines = rendered(view(last, first=first, truth=truth), 120)
        # σ of the centre of mass along x combines .006/12 and .05·.12/12, in mm.
        x = f"50.00 ± {1e3 * math.hypot(0.006, 0.05 * 0.12) / 12:.2f}"
        trunk = cells(lines, "trunk")
        assert trunk[1:3] == ["12.00 ± 0.12", x]
        assert trunk[5:] == ["7", "2.0", "3.0"]
        assert cells(lines, "leg")[5:] == ["0", "2.0", "—"]
        assert "7 of 20 single parameters determined" in lines

    def test_time_is_shown_in_the_robots_clock(self) -> None:
        leg = link("leg", LEG, STD)
        simulated, real = estimate(leg, seconds=62), estimate(leg, seconds=1_700_000_000)
        assert "data to 62.0 s" in rendered(view(simulated), 80)[0]
        assert "data to 22:13:20 UTC" in rendered(view(real), 80)[0]

    def test_the_reason_for_a_missing_estimate_is_reported(self) -> None:
        statuses = {"estimate": status("", DiagnosticStatus.ERROR, "the data do not fit the model")}
        shown = MonitorView("/identifier", None, {}, read_status(statuses), 0.0, {})
        assert rendered(shown, 80) == [
            "waiting for /identifier/estimate",
            "error: the data do not fit the model",
        ]

    @pytest.mark.parametrize("width", [48, 60, 80, 100, 200])
    def test_no_number_is_truncated_at_any_width(self, width: int) -> None:
        names = ("base_link", "right_hip", "right_ankle")
        message = estimate(*(link(name, TRUNK, STD) for name in names))
        lines = rendered(view(message, truth=dict.fromkeys(names, TRUNK)), width)
        assert max(map(len, lines)) <= width
        assert not any("…" in line for line in lines)
        has_com = any("CoM" in line for line in lines)
        assert has_com == (width >= 80)

    def test_warnings_are_below_the_table(self) -> None:
        parsed = IdentifierStatus({}, ("warning: leg: changed",), ())
        leg = link("leg", LEG, STD, level=DiagnosticStatus.WARN)
        lines = rendered(view(estimate(leg), status=parsed, silence=9.0), 80)
        assert lines[-3:] == [
            "warning: leg: changed",
            "warning: physically impossible: leg",
            "error: no diagnostics of /identifier for 9 s",
        ]
        assert rendered(view(estimate(link("leg", LEG, STD))), 80)[-1] == "no warning"

    def test_a_change_that_the_estimate_has_followed_is_still_shown(self) -> None:
        text = "leg has changed since 2.0 s: +3.00 ± 0.01 kg; the estimate is of later data"
        leg = estimate(link("leg", LEG, STD))
        followed = read_status({"change": status("", message=text, since="2.0")})
        assert rendered(view(leg, status=followed), 120)[-2:] == [text, "no warning"]
        quiet = read_status({"change": status("", message="no change", evidence="0.1")})
        assert not quiet.followed

    def test_before_any_verdict_there_is_no_warning_yet(self) -> None:
        early = read_status({"estimate": status("", message=TOO_EARLY_TO_FIT)})
        lines = rendered(view(estimate(link("leg", LEG, STD)), status=early), 120)
        assert lines[-1] == f"no warning yet: {TOO_EARLY_TO_FIT}"


class TestLog:
    def test_a_line_is_printed_for_each_change_only(self) -> None:
        screen = Screen(Console(file=StringIO(), width=200))
        leg = link("leg", LEG, STD)
        silent = IdentifierStatus({}, ("warning: no message for over 2 s",), ())
        nothing = MonitorView("/identifier", None, {}, IdentifierStatus({}, (), ()), 0.0, {})
        streams = (StreamCounts("/joint_states", 200.0, {}),)
        ready = replace(nothing, status=IdentifierStatus({"since_solved": "1"}, (), streams))
        views = nothing, ready, view(estimate(leg)), view(estimate(leg), status=silent)
        for shown in views:
            screen.show(shown)
            screen.show(shown)
        screen.show(view(estimate(leg, seconds=4)))
        preparing, move, first, warned, last = screen._console.file.getvalue().splitlines()
        assert preparing.startswith("preparing: waiting for /identifier")
        assert move == "ready: move the robot; /joint_states 200 Hz"
        assert first.startswith("data to 3.0 s")
        assert first.endswith("no warning")
        assert warned.endswith("warning: no message for over 2 s")
        assert last.startswith("data to 4.0 s")

    def test_topics_with_a_fault_are_not_ready(self) -> None:
        values = {"joints__rate": "0", "joints__pauses": "1", "joints__dropped": "20"}
        warned = read_status({"streams": status("", DiagnosticStatus.WARN, "dropped", **values)})
        shown = rendered(MonitorView("/identifier", None, {}, warned, 0.0, {}), 200)
        assert shown[0] == ("waiting for /identifier/estimate; joints 0 Hz (1 pause) (20 dropped)")

    def test_a_disabled_identifier_is_named(self) -> None:
        disabled = read_status({"estimate": status("", message=DISABLED, age="1.0")})
        shown = line(
            view(estimate(link("leg", LEG, STD)), status=disabled),
            read_estimate(estimate(link("leg", LEG, STD))),
        )
        assert "1.0 s old, disabled by ~/enable; no warning" in shown


class Identifier:
    """Publishes as an identifier does, with standard deviations that shrink."""

    def __init__(self, graph, namespace: str = "") -> None:
        self._node = f"{namespace}/identifier"
        make: Callable = graph.node.create_publisher
        self._estimate = make(DiagnosticArray, f"{self._node}/estimate", LATCHED)
        self._diagnostics = make(DiagnosticArray, "/diagnostics", 10)
        self._count = 0

    def publish(self) -> None:
        self._count += 1
        std = STD / self._count
        links = link("base_link", TRUNK, std), link("leg", LEG, std)
        self._estimate.publish(estimate(*links, seconds=self._count))
        alarm = DiagnosticStatus.WARN, "leg: its mass has changed"
        statuses = [
            status(f"{self._node}: change", *alarm),
            status("/other: change", alarm[0], "no"),
        ]
        self._diagnostics.publish(DiagnosticArray(status=statuses))


def publish_until_ended(graph, process, identifier: Identifier):
    """Publish until the monitor ends by itself."""
    with ThreadPoolExecutor(1) as pool:
        ended = pool.submit(process.ended)

        def done() -> bool:
            identifier.publish()
            return ended.done()

        graph.wait_until(done)
        return ended.result()


class TestProcess:
    def test_help_lists_every_parameter(self) -> None:
        ended = subprocess.run(
            [Path(sys.executable).parent / "monitor", "--help"],
            capture_output=True,
            text=True,
            check=True,
        )
        for parameter in PARAMETERS:
            assert (
                f"{parameter.name} ({parameter.default!r}): {parameter.description}" in ended.stdout
            )

    def test_a_log_gets_a_line_for_each_estimate_and_a_table_at_the_end(self, graph) -> None:
        monitor = graph.execute("monitor", estimates=3, truth=config_file("symbitron.xml"))
        ended = publish_until_ended(graph, monitor, Identifier(graph))
        assert (ended.status, ended.err) == (0, "")
        lines = ended.out.splitlines()
        shown = [line for line in lines if line.startswith("data to")]
        assert shown
        assert len(shown) == len(set(shown))
        assert all("20 of 20 single parameters determined" in line for line in shown)
        assert all("14.000 kg in total" in line for line in shown)
        assert cells(lines, "base_link")[1].startswith("12.0")
        # The true model has no link named leg.
        assert cells(lines, "leg")[-1] == "—"

    def test_another_identifier_can_be_watched(self, graph) -> None:
        monitor = graph.start("monitor", estimates=1, identifier="/robot/identifier")
        ended = publish_until_ended(graph, monitor, Identifier(graph, "/robot"))
        assert ended.status == 0
        assert any(line.startswith("base_link") for line in ended.out.splitlines())

    def test_a_timeout_is_a_one_line_error(self, graph) -> None:
        ended = graph.start("monitor", timeout=0.2).ended()
        assert ended.status == 2
        (line,) = ended.err.splitlines()
        assert line.startswith("monitor: /identifier/estimate: no estimate for")

    def test_an_invalid_truth_model_is_a_one_line_error(self, graph, tmp_path: Path) -> None:
        ended = graph.start("monitor", truth=tmp_path / "none.xml").ended()
        assert ended.status == 2
        assert ended.err.splitlines() == [ended.err.strip()]
        assert "none.xml" in ended.err

    @pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
    def test_a_terminal_is_restored_at_the_end(self, graph, number: signal.Signals) -> None:
        leader, follower = pty.openpty()
        fcntl.ioctl(follower, termios.TIOCSWINSZ, struct.pack("HHHH", 30, 80, 0, 0))
        monitor = subprocess.Popen(
            [Path(sys.executable).parent / "monitor"],
            env={**os.environ, "TERM": "xterm"},
            stdout=follower,
            stderr=follower,
        )
        os.close(follower)
        shown = bytearray()
        os.set_blocking(leader, False)
        identifier = Identifier(graph)

        def drain() -> None:
            try:
                while data := os.read(leader, 65536):
                    shown.extend(data)
            except OSError:  # nothing to read, or the other end is closed
                pass

        def is_shown() -> bool:
            identifier.publish()
            drain()
            return b"leg: its mass has changed" in shown

        try:
            graph.wait_until(is_shown)
            monitor.send_signal(number)

            def is_over() -> bool:
                drain()
                return monitor.poll() is not None

            graph.wait_until(is_over)
            drain()
        finally:
            monitor.kill()
            monitor.wait()
            os.close(leader)
        assert monitor.returncode == 0
        text = shown.decode()
        assert "Traceback" not in text
        assert text.rindex("\x1b[?25h") > text.rindex("\x1b[?25l")  # the cursor is visible again
        plain = re.sub(r"\x1b\[[0-9;?]*[A-Za-z]", "", text)
        assert max(map(len, re.split(r"[\r\n]", plain))) <= 80


@pytest.mark.parametrize("seed", range(5))
def test_absurd_values_are_displayed_as_far_as_possible(seed: int) -> None:
    draw = random.Random(seed)
    words = ["", "nan", "-inf", "1e308", "5e-324", "-1", "true", "[/red]", "\x1b[31m", "9" * 40]
    keys = [*NAMES, *(f"{name}/std" for name in NAMES), "samples", "window", "age"]
    keys += ["/imu/data/rate", "/imu/data/missing", "/imu/data/late"]

    def absurd(name: str) -> DiagnosticStatus:
        values = {key: draw.choice(words) for key in keys if key == "m" or draw.random() < 0.9}
        return status(name, bytes([draw.choice([0, 2, 255])]), draw.choice(words), **values)

    message = estimate(*(absurd(name) for name in ("base", "[/bold]", "base")))
    message.header.stamp.sec = draw.choice([-(2**31), 2**31 - 1])
    parsed = read_status({part: absurd(part) for part in ("estimate", "streams", "change")})
    shown = view(message, status=parsed, truth={"base": TRUNK})
    assert any("base" in line for line in rendered(shown, 200)), rendered(shown, 200)
    console = Console(file=StringIO(), width=200)
    screen = Screen(console)
    with screen.display():
        screen.show(shown)
    assert "data to" in console.file.getvalue()
