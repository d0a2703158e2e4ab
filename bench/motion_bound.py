"""How much a log can tell if its motion is unknown too: a bound on every estimator.

Usage: .venv/bin/python bench/motion_bound.py [--seed 300] [--draws 6] [--cases smooth vibrating]

All sensors of the Symbitron are noisy at 1 kHz, and nothing is filtered. The motion is measured by
encoders and IMU alone, so their noise, differentiated as often as the equation of motion asks for,
hides fast motion: that of an encoder grows with the square of the frequency. Prints the Bayesian
Cramér-Rao bound with the information in each band of frequencies, and the errors of `map_lmi` on
the same logs, as roots of means of squares over draws. The information about the legs is the sum
over their links, by the bound and by `map_lmi`.

That the soles stay at rest is not used, neither here nor by `symbid identify`.
"""

import argparse
import shutil
import sys
import tempfile
from itertools import pairwise
from pathlib import Path

import numpy as np
from estimators import DETERMINED, MODEL, STRIDE, identified
from noise_bound import EDGES, band_information, expected_errors
from threadpoolctl import threadpool_limits

from symbid_ros.estimation.directions import determined_directions
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.predictions.evaluation import TrueMotion, evaluate
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_true_motion
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

PERCENT = 25.0
BASE = "base_link"  # the other links are those of the legs


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seed", type=int, default=300)
    options.add_argument("--draws", type=int, default=6)
    options.add_argument("--moves", type=int, default=20)
    options.add_argument("--method", default="map_lmi")
    options.add_argument("--cases", nargs="+", default=["smooth", "vibrating"])
    given = options.parse_args()
    parameters = ParameterSet(load_model(MODEL))
    bands = [f"{low:g}–{high:.0f} Hz" for low, high in pairwise(EDGES)]
    columns = "log", "s", "joint accelerations, rad/s²", "CoM, mm: bound", "error"
    columns = *columns, "torque, Nm: bound", "error", "legs, bits: bound", "estimate"
    columns = *columns, *(f"bits, {band}" for band in bands)
    print(f"| {' | '.join(columns)} |\n{len(columns) * '|---'}|", flush=True)
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        for case in given.cases:
            print(row(case, given, parameters, Path(folder)), flush=True)


def row(case: str, given: argparse.Namespace, parameters: ParameterSet, folder: Path) -> str:
    """Return the figures of one kind of motion: roots of means of squares over the draws."""
    judged = simulated(folder / f"judged_{case}", "smooth", given.seed + 5000, 10)[::STRIDE]
    figures = []
    for seed in range(given.seed, given.seed + given.draws):
        log = folder / f"{case}_{seed}"
        noisy = SimulateOptions(case, moves=given.moves, motion_seed=seed, noise_seed=seed)
        record(Simulator(noisy), log)
        samples = read_true_motion([log], load_model(MODEL)).samples
        prior = draw_prior(parameters, "percent", PERCENT, seed)
        scale = prior.covariance_factor()
        bits, total = [], np.eye(len(parameters))
        for part in band_information(parameters, samples):
            before = np.linalg.slogdet(total)[1]
            total = total + scale.T @ part @ scale
            bits.append(0.5 * (np.linalg.slogdet(total)[1] - before) / np.log(2))
        factor = scale @ np.linalg.inv(np.linalg.cholesky(total)).T
        ((_, found),) = identified(log, case, parameters, [prior], given)
        shutil.rmtree(log)
        estimate = found.estimate
        # With the joint terms that the log asked for, if any; the true ones are 0.
        asked = ParameterSet.of_names(parameters.model, estimate.names)
        errors = evaluate(asked, {"": estimate.value}, asked.values, judged)[""]
        com, torque = expected_errors(parameters, factor @ factor.T, judged)
        least = determined_directions(scale, factor, parameters.names, DETERMINED).link_gain
        verdict = estimate.verdict
        figures.append(
            [
                1e-9 * float(samples.stamp[-1] - samples.stamp[0]),
                np.sqrt(np.mean(samples.acceleration**2)),
                *(com, errors.com_position_rmse_mm, torque, errors.torque_rmse),
                *(leg_bits(least), np.nan if verdict is None else leg_bits(verdict.link_gain)),
                *bits,
            ]
        )
        terms = estimate.names[len(parameters) :]
        numbers = (f"{value:.4g}" for value in figures[-1])
        print(case, seed, *numbers, *terms, file=sys.stderr, flush=True)
    means = np.sqrt(np.mean(np.square(figures), axis=0))
    cells = [f"{value:.3g}" for value in means[:7]] + [f"{value:.1f}" for value in means[7:]]
    return f"| {case} | {' | '.join(cells)} |"


def leg_bits(link_gain: dict[str, float]) -> float:
    """Return the information about the links of the legs, summed over the links."""
    return sum(bits for link, bits in link_gain.items() if link != BASE)


def simulated(bag: Path, scenario: str, seed: int, moves: int) -> TrueMotion:
    """Return the true motion of a simulation."""
    record(Simulator(SimulateOptions(scenario, moves=moves, motion_seed=seed, ideal=True)), bag)
    return read_true_motion([bag], load_model(MODEL))


if __name__ == "__main__":
    main()
