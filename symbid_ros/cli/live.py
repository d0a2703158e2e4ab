"""``symbid live``: identify a running robot from its topics, shown in terminal and browser."""

import logging
import os
import re
import shutil
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer
from rich.console import Console

from symbid_ros.cli.flags import BaseKind, Robot, flag, require_model, with_flags
from symbid_ros.cli.processes import NodeProcess, unused_node_name
from symbid_ros.errors import OptionError, SymbidError
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.options import changed, spelled
from symbid_ros.report.formatting import counted

logger = logging.getLogger(__name__)

POLL = 0.2  # s
SAVING_TIME = 300.0  # s; a solve may be under way, and a slow machine may lag behind
SAVE_TIME = 120.0  # s for the last estimate
# Of a relative or absolute ROS namespace.
NAMESPACE = re.compile(r"/?|/?[A-Za-z_]\w*(/[A-Za-z_]\w*)*/?", re.ASCII)
AS_IT_IS: dict[str, Any] = {"soft_wrap": True, "markup": False, "highlight": False}
# Parameters of the identifier that the page needs as well.
SHARED_WITH_PAGE = "prior", "joint_topic", "rename_joint", "flip_joint", "hold_joint"

OF_COMPLETE_LOGS = (
    *("start", "stop", "jobs", "no_holdout", "full_rate", "export_kinematics"),
    *("filter", "cutoff", "channels", "choose_truncation", "validate", "select_by", "sensor_std"),
)

WebPage = Annotated[
    bool, typer.Option("--web", help="Also show a page in the browser, with the robot in 3D.")
]
WebPort = Annotated[
    int, typer.Option(min=0, max=65535, help="Port of the page; 0: any that is free.")
]


@partial(with_flags, hidden=OF_COMPLETE_LOGS)
def live(
    *,
    model: Annotated[
        Path | None, typer.Argument(help="Robot model, URDF or MJCF.", show_default=False)
    ] = None,
    robot: Robot = None,
    base: BaseKind = "auto",
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the result, which is written at the end and by Save."),
    ] = None,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Replace the result of an earlier run in --out.")
    ] = False,
    memory: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="<s>",
            help="Time constant of forgetting: older data lose weight, so that the estimate "
            "follows changes; 0: data are never forgotten.",
        ),
    ] = 0.0,
    namespace: Annotated[
        str,
        typer.Option(
            metavar="<name>",
            help="Namespace of the robot's topics and of the nodes that are started.",
        ),
    ] = "/",
    web: WebPage = False,
    host: Annotated[
        str,
        typer.Option(help="Address of the page; any but 127.0.0.1 lets other machines open it."),
    ] = "127.0.0.1",
    port: WebPort = 8377,
    options: IdentifyOptions,
    log: LogOptions,
) -> None:
    """Identify a running robot from its ROS 2 topics, until Ctrl-C or SIGTERM.

    It starts the nodes identifier and monitor, and with --web also web_monitor, in the ROS domain
    of this terminal. If an identifier runs there already, this one gets another name, which is
    printed. Sensor errors, also imu_bias, are identified only if --sensor-errors names them.

    Exit status: 0 ended, 1 ended with alarms (do not trust the numbers yet), 2 no estimate.
    """
    from symbid_ros.atomic_write import require_no_files
    from symbid_ros.identification.result_files import CALIBRATED, RESULT_FILES
    from symbid_ros.model.load import load_model
    from symbid_ros.online.initial_state import unused_live
    from symbid_ros.shutdown import exit_on_signals, interrupt_on_sigterm

    _require_namespace(namespace)
    path = require_model(model, "MODEL")
    for name, reason in unused_live(options, log).items():
        if name not in log.of_robot:  # a robot file also serves commands that read logs
            raise OptionError(f"{reason}; leave it out", "E503")
    load_model(path, base)  # an error is better shown here than in the log of a node
    if out is not None:
        require_no_files(out, (*RESULT_FILES, *CALIBRATED), overwrite=overwrite)
    exit_on_signals()
    interrupt_on_sigterm()
    console = Console()
    logs = Path(tempfile.mkdtemp(prefix="symbid_live_"))
    common: dict[str, object] = {"model": str(path.resolve()), "base": base}
    given = given_parameters(options, log)
    parameters = common | given | {"mode": "online", "memory": memory, "save_time": SAVE_TIME}
    if out is not None:
        parameters |= {"out": str(out.resolve()), "overwrite": overwrite}
    shared = {name: given[name] for name in SHARED_WITH_PAGE if name in given}
    page = common | shared | {"host": host, "port": port}
    environment = dict(os.environ)
    space = f"/{namespace.strip('/')}"
    console.print(
        f"preparing: starting the nodes; their logs are in {logs}, which is kept after an error",
        **AS_IT_IS,
    )
    remapped = {"__ns": space}
    with (
        unused_node_name("identifier", space, environment) as name,
        NodeProcess(
            "identifier",
            parameters,
            environment,
            logs / "identifier.log",
            remapped=remapped | {"__node": name},
        ) as identifier,
        saved_part_named(identifier, out),
        ExitStack() as others,
    ):
        try:
            if name != "identifier":
                console.print(
                    f"{space.rstrip('/')}/identifier is running already: this one is {name}; give "
                    "--namespace if each robot has its topics in a namespace",
                    **AS_IT_IS,
                )
            watched: dict[str, object] = {"identifier": name, "as_flags": True}
            shown = [identifier]
            if web:
                started = start_page(page | watched, environment, logs, console, remapped)
                shown.append(others.enter_context(started))
            monitor = NodeProcess(
                "monitor",
                watched,
                environment,
                logs / "monitor.log",
                remapped=remapped,
                is_shown=True,
            )
            shown.append(others.enter_context(monitor))
            while True:
                for node in shown:
                    node.require_running()
                time.sleep(POLL)
        except KeyboardInterrupt:
            others.close()
            if out is not None:
                console.print("saving: the estimate from all data is computed", **AS_IT_IS)
            summary = _finish(identifier)
    shutil.rmtree(logs, ignore_errors=True)
    report_end(summary, console)


def _require_namespace(name: str) -> None:
    if not NAMESPACE.fullmatch(name):
        raise OptionError(
            f"`namespace`: {name!r} is not a ROS namespace; give names of letters, digits and _ "
            "that begin with a letter, such as robot1/left_arm",
            "E501",
        )


@contextmanager
def saved_part_named(identifier: NodeProcess, out: Path | None) -> Iterator[None]:
    """Let the error of an identifier that was killed tell what of its result is saved."""
    begun = time.time()
    try:
        yield
    except SymbidError as error:
        if out is None or not identifier.was_killed:
            raise
        file = out / "estimate.json"
        saved = f"nothing of this run is saved in {out}"
        if file.is_file() and (at := file.stat().st_mtime) >= begun:
            saved = f"{out} keeps what was saved at {time.strftime('%X', time.localtime(at))}"
        raise SymbidError(f"{error}; {saved}", error.code) from None


def _finish(identifier: NodeProcess) -> dict[str, Any]:
    """Stop an identifier and return its summary."""
    try:
        return identifier.finish(stop=True, patience=SAVING_TIME)
    except SymbidError:
        if identifier.was_interrupted:  # there was nothing to save yet
            raise KeyboardInterrupt from None
        raise


def report_end(summary: Mapping[str, Any], console: Console) -> None:
    """Print what an identifier saved, with its warnings and alarms; alarms give exit status 1."""
    for warning in summary.get("warnings", ()):
        logger.warning("%s", warning)
    console.print(
        f"\n{summary.get('saved', 'nothing saved; give --out to keep the result')}", **AS_IT_IS
    )
    if alarms := summary.get("alarms", ()):
        for alarm in alarms:
            console.print(f"alarm: {spelled(alarm, flag)}", **AS_IT_IS)
        console.print(f"{counted(len(alarms), 'alarm')}: do not trust these numbers yet")
        raise typer.Exit(1)


def start_page(
    parameters: Mapping[str, object],
    environment: Mapping[str, str],
    logs: Path,
    console: Console,
    remapped: Mapping[str, str] | None = None,
) -> NodeProcess:
    """Start the node web_monitor, print the address of its page and return the node."""
    log = logs / "web_monitor.log"
    node = NodeProcess("web_monitor", parameters, environment, log, remapped=remapped)
    try:
        address = node.first_line()
    except BaseException:
        node.__exit__()
        raise
    console.print(f"Open {address}\n", soft_wrap=True, markup=False)
    return node


def given_parameters(*groups: Any) -> dict[str, object]:
    """Return the options that differ from their defaults, as parameters of the identifier."""
    return {
        name: _as_parameter(value) for group in groups for name, value in changed(group).items()
    }


def _as_parameter(value: Any) -> object:
    if isinstance(value, Path):
        return str(value.resolve())
    if isinstance(value, tuple):
        return [_as_parameter(one) for one in value]
    return value
