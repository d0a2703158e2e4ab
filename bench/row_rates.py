"""Estimates from decimated rows, compared with those from all rows and with those of NumPy.

Each draw is a simulated log of the Symbitron at 1 kHz, whose model file is wrong by up to 25 %. It
is identified three times: by default, with `full_rate`, and by default with the rows of NumPy
instead of the compiled kernel. Printed are the largest differences from the default in standard
deviations, the mean square of the determined links' errors in standard deviations (1 if these are
right), the share of true values inside the 90 % interval, and the alarms.

    .venv/bin/python bench/row_rates.py [--draws 5] [--moves 12]
"""

import argparse
import logging
import os
import tempfile
from pathlib import Path

import numpy as np
from intervals import inaccurate, judge
from tables import markdown
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.dynamics.inertial_rows import KERNEL, NUMBA, NUMPY
from symbid_ros.identification.predictions.intervals import HALF_WIDTH
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

WAYS = {"default": (NUMBA, False), "full rate": (NUMBA, True), "NumPy": (NUMPY, False)}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=5)
    parser.add_argument("--moves", type=int, default=12)
    given = parser.parse_args()
    logging.disable(logging.WARNING)
    rows: list[list[object]] = []
    with threadpool_limits(1):
        for seed in range(given.draws):
            rows += compare(seed, given.moves)
    head = ["draw", "rows", "largest difference, σ", "σ ratio", "mean square", "covered", "alarms"]
    print(markdown(head, rows, 3))


def compare(seed: int, moves: int) -> list[list[object]]:
    """Return a row of the table for each way to identify one log."""
    true = sy.load_model(config_file("symbitron.urdf"))
    parameters = ParameterSet(true)
    truth = dict(zip(parameters.names, parameters.values.tolist(), strict=True))
    model = inaccurate(true, seed)
    rows: list[list[object]] = []
    reference = None
    with tempfile.TemporaryDirectory() as folder:
        options = SimulateOptions(moves=moves, motion_seed=seed, noise_seed=100 + seed)
        record(Simulator(options), Path(folder) / "log")
        for way, (kernel, full_rate) in WAYS.items():
            os.environ[KERNEL] = kernel
            log = sy.load_bag(Path(folder) / "log")
            found = sy.identify(model, log, no_holdout=True, full_rate=full_rate)
            estimate, score = found.estimate, judge(found, truth)
            reference = reference or estimate
            std = np.where(reference.std > 0, reference.std, np.inf)
            difference = np.abs(estimate.value - reference.value) / std
            ratio = np.median((estimate.std / std)[np.isfinite(std)])
            covered = np.mean(np.abs(score.links) <= HALF_WIDTH)
            square = np.mean(score.links**2)
            figures = (float(difference.max()), float(ratio), float(square), float(covered))
            rows.append([seed, way, *figures, score.alarms])
    return rows


if __name__ == "__main__":
    main()
