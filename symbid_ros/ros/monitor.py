"""The node monitor: what an identifier currently knows, in the terminal."""

import math
import sys
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from threading import Event, Lock
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rclpy.node import Node
from rich import box
from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SymbidError
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.formatting import ABSENT, fixed, with_std
from symbid_ros.ros.endpoints import latched_qos, reliable_qos
from symbid_ros.ros.monitor_messages import (
    AS_FLAGS,
    DISABLED,
    IdentifierStatus,
    PublishedLink,
    RobotEstimate,
    StreamCounts,
    read_estimate,
    read_status,
)
from symbid_ros.ros.parameters import Parameter
from symbid_ros.ros.process import run_node
from symbid_ros.ros.reporting import NUMBER

SILENCE = 3.0  # s without a status until it is reported; the identifier publishes every second
LEGEND = "known: parameters that the data determine; σ ÷: first σ divided by the present one"
ERROR_LEGEND = "; error: RMS of the ten"
IMPOSSIBLE = "physically impossible"
POLL = 0.1  # s
REFRESH = 1.0  # s; the duration of a silence grows without messages
PARAMETERS = (
    Parameter("identifier", "identifier", "Name of the node to watch."),
    Parameter("truth", "", "True model, URDF or MJCF, to show errors; empty: none."),
    Parameter("estimates", 0, "Number of estimates after which to end; 0: no limit.", minimum=0),
    Parameter(
        "timeout", 0.0, "Time without an estimate after which to fail, s; 0: none.", minimum=0.0
    ),
    AS_FLAGS,
)


@dataclass(frozen=True)
class MonitorView:
    """State of an identifier at one moment."""

    identifier: str  # fully qualified name of the node
    estimate: RobotEstimate | None  # the newest; None before the first
    first: Mapping[str, PublishedLink]  # first estimate of each link
    status: IdentifierStatus
    silence: float  # time since the last status, or since the start of the monitor, s
    truth: Mapping[str, FloatArray]  # true parameters (10,) by link; empty if unknown


class Screen:
    """Displays views: a live table on a terminal, elsewhere a line for each change.

    A change is an estimate from newer data, or another warning. Without a terminal, the table is
    printed once at the end.
    """

    def __init__(self, console: Console) -> None:
        self._console = console
        self._live = Live(console=console, auto_refresh=False) if console.is_interactive else None
        self._last: MonitorView | None = None
        self._shown: tuple[int | None, str] | None = None

    @contextmanager
    def display(self) -> Iterator[None]:
        """Keep the live table on the terminal, or print it once at the end."""
        try:
            with self._live or nullcontext():
                yield
        finally:
            if self._live is None and self._last is not None and self._last.estimate is not None:
                self._console.print(page(self._last, self._console))

    def show(self, view: MonitorView) -> None:
        """Show a view; a log gets only what is new, except for other numbers in a warning."""
        self._last = view
        if self._live is not None:
            self._live.update(page(view, self._console), refresh=True)
            return
        if view.estimate is None:
            stamp, text = None, "; ".join([progress(view), *view.status.warnings])
            state = text
        else:
            stamp, text = view.estimate.stamp, line(view, view.estimate)
            state = "; ".join(view.status.warnings)
        if (shown := (stamp, NUMBER.sub("#", state))) != self._shown:
            self._shown = shown
            self._console.print(text, soft_wrap=True, highlight=False, markup=False, emoji=False)


def page(view: MonitorView, console: Console) -> RenderableType:
    """Return heading, table of links and warnings, as wide as the console."""
    if view.estimate is None:
        warnings = [Text(warning) for warning in view.status.warnings]
        return Group(Text(progress(view), style="dim"), *warnings)
    return Group(
        _head(view, view.estimate),
        _links(view, view.estimate, console),
        *_warnings(view, view.estimate),
    )


def progress(view: MonitorView) -> str:
    """Return how far the identifier is on its way to the first estimate."""
    status = view.status
    if not status.values and not status.warnings:
        return f"preparing: waiting for {view.identifier}, which compiles at the first start"
    is_ready = status.streams and status.is_ready
    state = "ready: move the robot" if is_ready else f"waiting for {view.identifier}/estimate"
    return "; ".join(filter(None, [state, ", ".join(map(_stream, status.streams))]))


def line(view: MonitorView, estimate: RobotEstimate) -> str:
    """Return an estimate in one line."""
    parts = [
        _count(estimate),
        f"σ ÷ {_factor(_overall_shrinkage(view, estimate))}",
        f"{fixed(sum(link.phi[0] for link in estimate.links), 3)} kg in total",
    ]
    if view.truth:
        parts.append(f"error {fixed(_overall_error(view, estimate), 2)} σ")
    parts += _age(view.status)
    warnings = "; ".join(view.status.warnings) or view.status.no_warning
    return f"data to {_clock(estimate.stamp)}: {', '.join(parts)}; {warnings}"


def _head(view: MonitorView, estimate: RobotEstimate) -> Text:
    status = view.status
    parts = [status.values["method"]] if "method" in status.values else []
    parts.append(f"data to {_clock(estimate.stamp)}")
    parts += _age(status)
    if math.isfinite(samples := status.number("samples")):
        parts.append(f"{samples:.0f} rows")
    if (window := status.number("window")) > 0:
        parts.append(f"windows of {1e3 * window:.0f} ms")
    return Text.assemble((estimate.model, "bold"), " ", ", ".join(parts))


def _links(view: MonitorView, estimate: RobotEstimate, console: Console) -> Table:
    """Return the most detailed table that fits the console."""
    unlimited = console.options.update(max_width=1000)  # else rich measures every table as fitting
    for has_com, gap in ((True, " "), (True, ""), (False, " "), (False, "")):
        table = _table(view, estimate, has_com=has_com, gap=gap)
        if console.measure(table, options=unlimited).maximum <= console.width:
            break
    return table


def _table(view: MonitorView, estimate: RobotEstimate, *, has_com: bool, gap: str) -> Table:
    table = Table(
        box=box.SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, 1 + len(gap), 0, 0),
        caption=LEGEND + ERROR_LEGEND * bool(view.truth),
        caption_justify="left",
    )
    table.add_column("link", no_wrap=True)
    com_headers = ("CoM x\nmm", "y\nmm", "z\nmm") if has_com else ()
    headers = ["mass\nkg", *com_headers, "known\nof 10", "σ ÷\n"]
    for header in [*headers, "error\nin σ"] if view.truth else headers:
        table.add_column(header, justify="right", no_wrap=True)
    for link in estimate.links:
        com = zip(1e3 * link.com, 1e3 * link.com_std, strict=True) if has_com else ()
        pairs = ((link.phi[0], link.std[0]), *com)
        cells = [_measured(*pair).replace(" ", gap) for pair in pairs]
        cells.append(ABSENT if link.determined is None else str(link.determined))
        cells.append(_factor(link.shrinkage(view.first[link.name])))
        if view.truth:
            truth = view.truth.get(link.name)
            cells.append(ABSENT if truth is None else fixed(link.error(truth), 1))
        table.add_row(Text(link.name, style="" if link.is_possible else "red"), *cells)
    return table


def _warnings(view: MonitorView, estimate: RobotEstimate) -> list[RenderableType]:
    status = view.status
    lines = [Text(_count(estimate))]
    if status.streams:
        lines.append(Text(", ".join(map(_stream, status.streams))))
    if status.followed:
        lines.append(Text(status.followed))
    warnings = list(status.warnings)
    impossible = [link.name for link in estimate.links if not link.is_possible]
    # The diagnostics report this as well, up to a second later.
    if impossible and not any(IMPOSSIBLE in warning for warning in warnings):
        warnings.append(f"warning: {IMPOSSIBLE}: {', '.join(impossible)}")
    if view.silence > SILENCE:
        warnings.append(f"error: no diagnostics of {view.identifier} for {view.silence:.0f} s")
    if not warnings:
        return [*lines, Text(status.no_warning, style="green" if status.is_judged else "")]
    return [*lines, *(Text(warning, style="bold red") for warning in warnings)]


def _clock(stamp: int) -> str:
    seconds = stamp * 1e-9
    # Simulated time starts at 0, robots use Unix time.
    if seconds < 1e9:
        return f"{seconds:.1f} s"
    return datetime.fromtimestamp(seconds, UTC).strftime("%H:%M:%S UTC")


def _count(estimate: RobotEstimate) -> str:
    known = ABSENT if estimate.determined is None else str(estimate.determined)
    return f"{known} of {estimate.parameters} single parameters determined"


def _stream(stream: StreamCounts) -> str:
    rate = f" {stream.rate:.0f} Hz" if math.isfinite(stream.rate) else ""
    return "".join([stream.topic, rate, *(f" ({fault})" for fault in stream.counted_faults)])


def _age(status: IdentifierStatus) -> list[str]:
    age = status.number("age")
    parts = [f"{age:.1f} s old"] if math.isfinite(age) else []
    return parts if status.is_enabled else [*parts, DISABLED]


def _overall_shrinkage(view: MonitorView, estimate: RobotEstimate) -> float:
    factors = [link.shrinkage(view.first[link.name]) for link in estimate.links]
    finite = [math.log(factor) for factor in factors if 0 < factor < math.inf]
    return math.exp(sum(finite) / len(finite)) if finite else math.nan


def _overall_error(view: MonitorView, estimate: RobotEstimate) -> float:
    known = (link for link in estimate.links if link.name in view.truth)
    errors = [link.error(view.truth[link.name]) for link in known]
    finite = [error**2 for error in errors if math.isfinite(error)]
    return math.sqrt(sum(finite) / len(finite)) if finite else math.nan


def _measured(value: float, std: float) -> str:
    return with_std(value, std) if math.isfinite(value) else ABSENT


def _factor(value: float) -> str:
    return fixed(value, 1 if value < 100 else 0)


class Monitor:
    """Subscribes to one identifier and displays its estimates and statuses."""

    def __init__(self, node: Node, values: dict[str, Any]) -> None:
        self._identifier: str = node.resolve_topic_name(values["identifier"])
        self._truth = _truth(values["truth"])
        self._wanted: int = values["estimates"]
        self._timeout: float = values["timeout"]
        self._as_flags: bool = values["as_flags"]
        self._lock = Lock()
        self._changed = Event()
        self._estimate: RobotEstimate | None = None
        self._first: dict[str, PublishedLink] = {}
        self._count = 0
        self._statuses: dict[str, DiagnosticStatus] = {}
        self._newest_estimate = self._newest_status = time.monotonic()
        node.create_subscription(
            DiagnosticArray, f"{self._identifier}/estimate", self._on_estimate, latched_qos()
        )
        node.create_subscription(
            DiagnosticArray, "/diagnostics", self._on_diagnostics, reliable_qos(100)
        )

    def run(self, stop: Event) -> None:
        """Display until stopped or until the wanted number of estimates has arrived."""
        shown = 0.0
        screen = Screen(Console(highlight=False))
        with screen.display():
            while not stop.wait(POLL) and not self._is_done():
                now = time.monotonic()
                if self._changed.is_set() or now - shown >= REFRESH:
                    self._changed.clear()
                    screen.show(self._view(now))
                    shown = now
            screen.show(self._view(time.monotonic()))

    def _is_done(self) -> bool:
        with self._lock:
            silence = time.monotonic() - self._newest_estimate
            if self._timeout and silence > self._timeout:
                raise SymbidError(
                    f"{self._identifier}/estimate: no estimate for {silence:.0f} s; check that the "
                    "node runs, its name and ROS_DOMAIN_ID",
                    "E810",
                )
            return 0 < self._wanted <= self._count

    def _view(self, now: float) -> MonitorView:
        with self._lock:
            return MonitorView(
                identifier=self._identifier,
                estimate=self._estimate,
                first=dict(self._first),
                status=read_status(self._statuses, as_flags=self._as_flags),
                silence=now - self._newest_status,
                truth=self._truth,
            )

    def _on_estimate(self, message: DiagnosticArray) -> None:
        estimate = read_estimate(message)
        with self._lock:
            self._estimate = estimate
            self._newest_estimate = time.monotonic()
            self._count += 1
            for link in estimate.links:
                self._first.setdefault(link.name, link)
        self._changed.set()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        prefix = f"{self._identifier}: "
        own = {
            status.name.removeprefix(prefix): status
            for status in message.status
            if status.name.startswith(prefix)
        }
        if own:
            with self._lock:
                self._statuses |= own
                self._newest_status = time.monotonic()
            self._changed.set()


def _truth(path: str) -> dict[str, FloatArray]:
    if not path:
        return {}
    parameters = ParameterSet(load_model(Path(path)))
    phi = parameters.values.reshape(-1, 10)
    return dict(zip(parameters.link_names, phi, strict=True))


def main() -> int:
    """Run the node ``monitor`` and return its exit status."""
    return run_node(
        "monitor",
        lambda node, values, stop: Monitor(node, values).run(stop),
        purpose="Show an identifier's current estimate in the terminal.",
        parameters=PARAMETERS,
    )


if __name__ == "__main__":
    sys.exit(main())
