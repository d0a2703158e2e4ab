"""Simulated logs, their robots, and their rows after each filter."""

import shutil
from functools import lru_cache
from pathlib import Path

from symbid_ros.atomic_write import write_text
from symbid_ros.bags import bag_log
from symbid_ros.choices import Channels, Scenario, Term
from symbid_ros.estimation.archive import write_archive
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.identification.rows.dataset import Processing, fold_dataset
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.study.plan import SimulatedLog
from symbid_ros.study.sensor_subsets import SensorSubset, observe_subset
from symbid_ros.study.study_folder import StudyFolder

# Difference between the noise seeds of a log and its tare; equal noise would cancel.
TARE_SEED_OFFSET = 100_000


def record_log(log: SimulatedLog, folder: StudyFolder) -> None:
    """Simulate a log, and write its bag and the simulated robot."""
    simulator = _simulator(log, log.scenario, log.noise_seed)
    write_text(folder.robot(log), simulator.robot)
    _record_atomically(simulator, folder.log(log))


def record_tare(log: SimulatedLog, folder: StudyFolder) -> None:
    """Simulate the same robot, suspended at rest, and write its bag."""
    simulator = _simulator(log, "tare", log.noise_seed + TARE_SEED_OFFSET)
    _record_atomically(simulator, folder.tare(log))


def fold_rows(
    log: SimulatedLog,
    folder: StudyFolder,
    sensors: SensorSubset,
    cutoff: float | None,
    channels: Channels,
) -> None:
    """Write a log's rows after one filter; cutoff None: averaged over windows."""
    low_pass = None if cutoff is None else LowPass(cutoff, channels)
    parameters = nominal_parameters(log)
    bag = folder.log(log)
    dataset = fold_dataset(_segments(bag, log), str(bag), parameters, Processing(low_pass))
    write_archive(folder.rows(log, sensors, cutoff), observe_subset(dataset, parameters, sensors))


# Rows are computed log by log, so all filters of a log share one reading of its bag.
@lru_cache(maxsize=1)
def _segments(bag: Path, log: SimulatedLog) -> tuple[Segment, ...]:
    model = nominal_parameters(log).model
    return AlignedLog(bag_log([bag], model), model).contiguous_segments()


@lru_cache(maxsize=4)
def nominal_parameters(log: SimulatedLog) -> ParameterSet:
    """Return the parameters to identify, of the robot model that ships with the package."""
    return ParameterSet(load_model(config_file("symbitron.xml")), _terms(log))


@lru_cache(maxsize=4)
def true_parameters(log: SimulatedLog, folder: StudyFolder) -> ParameterSet:
    """Return the same parameters of the simulated robot."""
    return ParameterSet(load_model(folder.robot(log)), _terms(log))


def _terms(log: SimulatedLog) -> tuple[Term, ...]:
    return ("viscous", "coulomb", "armature") if log.friction else ()


def _simulator(log: SimulatedLog, scenario: Scenario, noise_seed: int) -> Simulator:
    options = SimulateOptions(
        scenario,
        moves=log.moves,
        motion_seed=log.motion_seed,
        noise_seed=noise_seed,
        ideal=log.noise == 0,
        friction=log.friction,
        errors=log.errors,
        error_seed=log.error_seed,
    )
    return Simulator(options, noise_factor=log.noise)


def _record_atomically(simulator: Simulator, bag: Path) -> None:
    """Write a bag to a temporary folder and then move it, so that existing bags are complete."""
    # The bag's file is named after its folder, which therefore has its final name from the start.
    unfinished = bag.parent / ".unfinished" / bag.name
    shutil.rmtree(unfinished, ignore_errors=True)
    unfinished.parent.mkdir(parents=True, exist_ok=True)
    record(simulator, unfinished)
    unfinished.rename(bag)
