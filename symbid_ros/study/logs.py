"""Simulated logs of a study, and the robots in them."""

import shutil
from functools import lru_cache
from pathlib import Path
from typing import Any

from symbid_ros.atomic_write import write_text
from symbid_ros.bags import bag_log
from symbid_ros.choices import Channels, Term
from symbid_ros.estimation.archive import write_archive
from symbid_ros.identification.dataset import AlignedLog, Processing, fold_dataset
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.study.plan import Log
from symbid_ros.study.sensor_subsets import Sensing, observe_sensed
from symbid_ros.study.workspace import Workspace

# Between the seeds of a log's noise and its tare's: one and the same noise would cancel.
TARE_APART = 100_000


def record_log(log: Log, space: Workspace) -> None:
    """Simulate a log and write its bag, and the robot as simulated beside it."""
    simulator = Simulator(log.scenario, moves=log.moves, **_options(log))
    write_text(space.robot(log), simulator.robot)
    _record_whole(simulator, space.log(log))


def record_tare(log: Log, space: Workspace) -> None:
    """Let the same robot hang still."""
    options = _options(log) | {"noise_seed": log.noise_seed + TARE_APART}
    _record_whole(Simulator("tare", **options), space.tare(log))


@lru_cache(maxsize=4)
def identified(log: Log) -> ParameterSet:
    """Return the columns to identify: kinematics and inertias of the file that ships."""
    return ParameterSet(load_model(config_file("symbitron.xml")), _terms(log))


@lru_cache(maxsize=4)
def truth(log: Log, space: Workspace) -> ParameterSet:
    """Return the same columns of the robot that was simulated."""
    return ParameterSet(load_model(space.robot(log)), _terms(log))


def _terms(log: Log) -> tuple[Term, ...]:
    return ("viscous", "coulomb", "armature") if log.friction else ()


def _options(log: Log) -> dict[str, Any]:
    return {
        "motion_seed": log.motion_seed,
        "noise_seed": log.noise_seed,
        "noise_factor": log.noise,
        "ideal": log.noise == 0,
        "friction": log.friction,
        "errors": log.errors,
        "error_seed": log.error_seed,
    }


def _record_whole(simulator: Simulator, bag: Path) -> None:
    """Write a bag beside its place, then move it there: what is in its place is whole."""
    begun = bag.parent / ".begun" / bag.name  # by which its file is named, too
    shutil.rmtree(begun, ignore_errors=True)
    begun.parent.mkdir(parents=True, exist_ok=True)
    record(simulator, begun)
    begun.rename(bag)


def fold_rows(
    log: Log, space: Workspace, sensing: Sensing, cutoff: float | None, channels: Channels
) -> None:
    """Write a log's rows behind one filter; None: averaged over windows."""
    smoothing = None if cutoff is None else LowPass(cutoff, channels)
    parameters = identified(log)
    bag = space.log(log)
    record = fold_dataset(_segments(bag, log), str(bag), parameters, Processing(smoothing))
    observations = observe_sensed(record, parameters, sensing)
    write_archive(space.rows(log, sensing, cutoff), observations)


# One log after the other: all filters of one see what was read once.
@lru_cache(maxsize=1)
def _segments(bag: Path, log: Log) -> tuple[Segment, ...]:
    model = identified(log).model
    return AlignedLog(bag_log([bag], model), model).contiguous_segments()
