"""The balance controller at work with what each method believes."""

import json
from dataclasses import asdict
from pathlib import Path

import numpy as np

from symbid_ros.atomic_write import write_text
from symbid_ros.errors import StudyError
from symbid_ros.identification.problem import GAUSSIAN
from symbid_ros.report.content import TRUTH
from symbid_ros.simulation.balance import BalanceRun, balance
from symbid_ros.study.data_set import Log
from symbid_ros.study.draws import load_draw
from symbid_ros.study.logs import identified
from symbid_ros.study.plan import ClosedLoop, Plan, Spread
from symbid_ros.study.scores import REFERENCE, Case
from symbid_ros.study.workspace import Workspace


def believers(plan: Plan) -> list[str]:
    """Return whose models the controller is given, beside the truth."""
    return [REFERENCE, *plan.methods]


def run_loop(
    loop: ClosedLoop, space: Workspace, spread: Spread, iteration: int, method: str
) -> None:
    """Let the controller believe one estimate."""
    cutoff = None if method == REFERENCE or method in GAUSSIAN else loop.filter
    draw = load_draw(space.draw(loop.data, spread, iteration))
    values = np.array(draw[Case(loop.data, str(spread), method, cutoff)].values)
    parameters = identified(Log())
    inertias = dict(zip(parameters.link_names, parameters.link_phi(values), strict=True))
    _write(
        balance(inertias, moves=loop.moves, motion_seed=loop.motion_seed),
        space.loop(spread, iteration, method),
    )


def run_truth(loop: ClosedLoop, space: Workspace) -> None:
    """Let the controller know the truth."""
    _write(balance(None, moves=loop.moves, motion_seed=loop.motion_seed), space.check(TRUTH))


def load_runs(plan: Plan, space: Workspace, spread: Spread) -> dict[str, list[BalanceRun]]:
    """Read the runs of one kind of prior, by method; the truth comes last."""
    loop = plan.closed_loop
    if loop is None:
        return {}
    runs = {
        method: [
            _read(space.loop(spread, iteration, method)) for iteration in range(loop.iterations)
        ]
        for method in believers(plan)
    }
    return runs | {TRUTH: [_read(space.check(TRUTH))]}


def _write(run: BalanceRun, file: Path) -> None:
    write_text(file, json.dumps(asdict(run)) + "\n")


def _read(file: Path) -> BalanceRun:
    try:
        return BalanceRun(**json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise StudyError(f"{file}: cannot be read ({error}); delete it and start again") from None
