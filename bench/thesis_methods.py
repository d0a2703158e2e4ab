"""Accuracy of the thesis's four methods over several priors, as a Markdown table.

Usage: .venv/bin/python bench/thesis_methods.py [--scenario smooth] [--cutoff 30] [--priors 10]
"""

import argparse
import tempfile
from dataclasses import astuple
from pathlib import Path

import numpy as np
from threadpoolctl import threadpool_limits

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.thesis import METHODS
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.evaluation import evaluate, read_true_motion
from symbid_ros.offline.identification import Problem, Solver, Truncation
from symbid_ros.offline.record import Processing, read_record
from symbid_ros.report.compose import TITLES
from symbid_ros.share import config_file
from symbid_ros.signals.filters import LowPass
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator


def main() -> None:
    """Simulate, identify with every method and prior, print the means."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--scenario", default="smooth")
    options.add_argument("--cutoff", type=float, default=30.0)
    options.add_argument("--channels", default="all")
    options.add_argument("--percent", type=float, default=25.0)
    options.add_argument("--priors", type=int, default=10)
    options.add_argument("--seed", type=int, default=0, help="first seed of motion and noise")
    given = options.parse_args()
    parameters = ParameterSet(load_model(config_file("symbitron.xml")))
    processing = Processing(LowPass(given.cutoff, given.channels))
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        bags = Path(folder)
        motion = {"motion_seed": given.seed + 10, "noise_seed": given.seed}
        record(Simulator(given.scenario, **motion), bags / "log")
        record(Simulator(given.scenario, motion_seed=given.seed + 11, ideal=True), bags / "ideal")
        log = read_record([bags / "log"], parameters, processing)
        ideal = read_record([bags / "ideal"], parameters, processing)
        truth = read_true_motion([bags / "ideal"], parameters.model)
    rows = {name: [] for name in ("prior", *METHODS)}
    for seed in range(given.seed, given.seed + given.priors):
        prior = draw_prior(parameters, "percent", given.percent, seed)
        vectors, ranks = {"prior": prior.mean}, {"prior": np.nan}
        solver = Solver.of(Problem(log.observations, parameters, prior))
        for method in METHODS:
            found = solver.truncated(method, Truncation(validation=ideal.observations)).estimate
            vectors[method], ranks[method] = found.value, found.rank
        for name, metrics in evaluate(parameters, vectors, parameters.values, truth).items():
            rows[name].append((*astuple(metrics), ranks[name]))
    print("| | gen. force (N, Nm) | torque (Nm) | CoM (mm) | momentum | parameters (%) | z |")
    print("|---|---|---|---|---|---|---|")
    for name, figures in rows.items():
        cells = " | ".join(f"{mean:.3g}" for mean in np.mean(figures, axis=0))
        print(f"| {TITLES.get(name, name)} | {cells} |".replace("nan", "–"))


if __name__ == "__main__":
    main()
