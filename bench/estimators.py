"""Accuracy and interval coverage of an estimator over several logs and priors.

Usage: .venv/bin/python bench/estimators.py [--seed 100] [--draws 9] [--cases smooth vibrating]
[--method map_lmi] [--percent 25]

Prints a Markdown table. One draw is a prior and a log with its noise. Logs are simulated one by one
into a temporary folder. The estimates are evaluated on an ideal smooth log of another motion. The
cases smooth, vibrating, one_leg and stepping have no systematic errors. In the case errors, a
smooth log of a robot with typical systematic errors is identified with a tare and a weighing, in
the case uncorrected without them. The cases lengths, delays and everything add wrong link lengths,
late sensors, and both with different sample rates and quantisation; these are estimated as well.
The case tracked has the logs of everything with a topic of the base's pose. A draw takes about a
minute.

With `--bound` the Bayesian Cramér-Rao bounds of the centre of mass and of the torque are printed
too: roots of their means over the draws, and in brackets the ratios of the errors' to them. The
unknowns are those of the estimate, columns are those of the true robot, and the noise is known.
Soles at rest count with the deviations that the estimate gives them. This takes another minute.
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from noise_bound import NO_ERRORS, Unknowns, bound_covariance, expected_errors
from scipy.spatial.transform import Rotation
from threadpoolctl import threadpool_limits

from symbid_ros.bags import bag_log, read_streams, read_truth
from symbid_ros.choices import METHODS
from symbid_ros.estimation.directions import DETERMINED, determined_directions
from symbid_ros.estimation.prior import Prior, draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.identification.calibration.tares import read_tare
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem, load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.evaluation import TrueMotion, evaluate
from symbid_ros.identification.predictions.intervals import HALF_WIDTH, summarise_intervals
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, read_true_motion
from symbid_ros.package_paths import config_file
from symbid_ros.signals.base_pose import PoseStream
from symbid_ros.signals.log import Log
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.settings import ChannelValues, load_noise
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.systematic_errors import RESOLUTION, SAMPLE_RATES, parse_errors

MODEL = config_file("symbitron.xml")
# By case: scenario, systematic errors, and those that are estimated with a tare and a weighing
CASES = {
    "smooth": ("smooth", "", ()),
    "vibrating": ("vibrating", "", ()),
    "errors": ("smooth", "typical", ("typical",)),
    "uncorrected": ("smooth", "typical", ()),
    "lengths": ("smooth", "typical,link_length", ("typical", "link_length")),
    "delays": ("smooth", "typical,delays", ("typical", "sensor_delay")),
    "everything": (
        "smooth",
        "typical,link_length,delays,sample_rates,quantisation",
        ("typical", "link_length", "sensor_delay"),
    ),
    "one_leg": ("one_leg", "", ()),
    "stepping": ("stepping", "", ()),
}
# The same logs with a topic of the base's pose: 1 mm and 1 mrad of noise at 100 Hz.
CASES["tracked"] = CASES["everything"]
POSE_NOISE, POSE_STRIDE = 1e-3, 10
WEIGHING_STD = 0.02  # kg
# Every STRIDE-th sample of the ideal log is evaluated, as its motion is slow.
STRIDE = 5
# Difference between the seeds of cases. With equal noise, two cases would be almost equal draws,
# as windows average vibrations out.
SEED_OFFSET = 10_000


@dataclass(frozen=True)
class Score:
    """The result of one draw.

    Attributes
    ----------
    gen_force, torque, com, parameters : float
        Errors, N and Nm, Nm, mm, %.
    impossible : int
        Number of physically impossible links.
    covered, com_covered : float
        Share of true values inside 90 % intervals, of determined parameters and of the CoM.
    squares : (d,) float64
        Squared normalised errors in the determined directions.
    alarms : int
        Number of alarms of the verdict.
    window : float
        Window length, s.
    com_bound, torque_bound : float
        Least errors in the mean, mm, Nm; NaN if they are not computed.
    """

    gen_force: float
    torque: float
    com: float
    parameters: float
    impossible: int
    covered: float
    com_covered: float
    squares: np.ndarray
    alarms: int
    window: float
    com_bound: float = np.nan
    torque_bound: float = np.nan


def main() -> None:
    """Simulate, identify, evaluate and print."""
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("--seed", type=int, default=100, help="first seed of motion and noise")
    options.add_argument(
        "--draws", type=int, default=9, help="number of priors times logs of each case"
    )
    options.add_argument("--priors", type=int, default=3, help="priors of each log")
    options.add_argument("--moves", type=int, default=20, help="moves of each log")
    options.add_argument("--percent", type=float, default=25.0)
    options.add_argument("--method", choices=METHODS, default="map_lmi")
    options.add_argument("--bound", action="store_true", help="compute the least errors")
    options.add_argument("--cases", nargs="+", choices=CASES, default=["smooth", "vibrating"])
    given = options.parse_args()
    parameters = ParameterSet(load_model(MODEL))
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        motion = true_motion(Path(folder), "smooth", given.seed + 5000, 10)[::STRIDE]
        print(
            "| case | gen. force | torque | CoM mm (worst) | parameters % | impossible links | "
            "covered | CoM covered | normalised ms (directions) | alarms | torque bound (ratio) | "
            "CoM bound (ratio) |"
        )
        print(12 * "|---" + "|", flush=True)
        for case in given.cases:
            scores = []
            for score in draws(case, given, parameters, motion, Path(folder)):
                scores.append(score)
                print(
                    f"{case} {len(scores)}/{given.draws}: CoM {score.com:.3f} mm, gen. force "
                    f"{score.gen_force:.3f}, torque {score.torque:.4f}, windows of "
                    f"{1e3 * score.window:g} ms; bounds {score.com_bound:.3f}, "
                    f"{score.torque_bound:.4f}",
                    file=sys.stderr,
                    flush=True,
                )
            print(table_row(case, scores), flush=True)


def true_motion(folder: Path, scenario: str, seed: int, moves: int) -> TrueMotion:
    """Return the motion of a simulated robot without errors."""
    ideal = folder / "ideal"
    record(Simulator(SimulateOptions(scenario, moves=moves, motion_seed=seed, ideal=True)), ideal)
    motion = read_true_motion([ideal], load_model(MODEL))
    shutil.rmtree(ideal)
    return motion


def draws(
    case: str,
    given: argparse.Namespace,
    parameters: ParameterSet,
    motion: TrueMotion,
    folder: Path,
) -> Iterator[Score]:
    """Yield the scores of one case, several priors for each log."""
    scenario, errors, estimated = CASES[case]
    of = "everything" if case == "tracked" else case
    start = given.seed + SEED_OFFSET * list(CASES).index(of)
    for seed in range(start, start + given.draws, given.priors):
        robot = {"errors": errors, "error_seed": seed, "noise_seed": seed}
        log, tare = folder / "log", folder / "tare"
        record(
            Simulator(
                SimulateOptions(scenario, moves=given.moves, motion_seed=seed + 1000, **robot)
            ),
            log,
        )
        if estimated:
            record(Simulator(SimulateOptions("tare", **robot | {"noise_seed": seed + 2000})), tare)
        priors = [
            draw_prior(parameters, "percent", given.percent, number)
            for number in range(seed, min(seed + given.priors, start + given.draws))
        ]
        true = None
        if given.bound:
            true = true_motion(folder, scenario, seed + 1000, given.moves).samples
        for loaded, found in identified(log, case, parameters, priors, given):
            one = score(found, loaded.prior, parameters, motion)
            if true is not None:
                covariance = bound_covariance(parameters, true, unknowns(loaded, errors))
                com, torque = expected_errors(parameters, covariance, motion)
                one = replace(one, com_bound=com, torque_bound=torque)
            yield one
        shutil.rmtree(log)
        shutil.rmtree(tare, ignore_errors=True)


def identified(
    log: Path,
    case: str,
    parameters: ParameterSet,
    priors: list[Prior],
    given: argparse.Namespace,
) -> Iterator[tuple[LoadedProblem, Identification]]:
    """Yield the log's problem and estimate under each prior; the log is read once."""
    first, tare, estimated = log.parent / "prior.json", log.parent / "tare", CASES[case][2]
    write_prior(first, priors[0])
    # The checks of the log allow for what is estimated.
    options = IdentifyOptions(prior=first, sensor_errors=estimated)
    if case == "tracked":
        problem = load_problem(load_model(MODEL), with_poses(log, priors[0].seed or 0), options)
    else:
        problem = BagRequest((log,), MODEL, options).load()
    tares = read_tare(bag_log([tare])) if estimated else None
    for prior in priors:
        options = None
        if estimated:
            rng = np.random.default_rng(prior.seed)
            mass = parameters.values[: parameters.inertial : 10].sum()
            weighed = mass + WEIGHING_STD * rng.normal()
            options = replace(
                problem.options,
                total_mass=weighed,
                total_mass_std=WEIGHING_STD,
                tare=(tare,),
                sensor_errors=estimated,
            )
        loaded = problem.with_prior(prior, options, tares)
        yield loaded, loaded.solve(given.method)


def with_poses(bag: Path, seed: int) -> Log:
    """Return a log with noisy poses of the base, which the simulator knows."""
    truth = read_truth([bag])
    rng = np.random.default_rng(seed)
    some = slice(None, None, POSE_STRIDE)
    place, turn = truth.base_position[some], Rotation.from_quat(truth.base_orientation[some])
    place = place + POSE_NOISE * rng.standard_normal(place.shape)
    turn *= Rotation.from_rotvec(POSE_NOISE * rng.standard_normal(place.shape))
    base = load_model(MODEL).link_names[0]
    poses = PoseStream("pose", base, "world", truth.stamp[some], place, turn.as_quat())
    return Log.from_streams(replace(read_streams([bag]), poses=(poses,)))


def unknowns(loaded: LoadedProblem, errors: str) -> Unknowns:
    """Return the unknowns, prior and noise of a log with these simulated errors."""
    problem = loaded.solved.problem
    noise = load_noise(config_file("noise.yaml"))
    drawn = parse_errors(errors)
    if "sample_rates" in drawn:
        # Fewer samples are as good as more with larger noise.
        rates = SAMPLE_RATES
        noise = replace(
            noise,
            angular_velocity=noise.angular_velocity * np.sqrt(rates.imu),
            linear_acceleration=noise.linear_acceleration * np.sqrt(rates.imu),
            force=noise.force * np.sqrt(rates.plates),
            moment=noise.moment * np.sqrt(rates.plates),
        )
    if "quantisation" in drawn:
        steps = asdict(RESOLUTION)
        rounded = {
            name: np.hypot(size, steps[name] / np.sqrt(12)) for name, size in asdict(noise).items()
        }
        noise = ChannelValues(**rounded)
    build = problem.calibrated_rows
    return Unknowns(
        NO_ERRORS if build is None else build.errors,
        problem.prior,
        problem.pseudo_measurements,
        noise,
    )


def score(
    found: Identification, prior: Prior, parameters: ParameterSet, motion: TrueMotion
) -> Score:
    """Evaluate one estimate."""
    estimate, factor = found.estimate, found.deviation_factor
    # With the joint terms that the log asked for, if any.
    parameters = ParameterSet.of_names(parameters.model, estimate.names)
    prior, truth = prior.for_columns(parameters), parameters.values
    metrics = evaluate(parameters, {"": estimate.value}, truth, motion)[""]
    covered = com_covered = np.nan
    squares = np.zeros(0)
    error = estimate.value - truth
    if estimate.determined.any():
        inside = np.abs(error) < HALF_WIDTH * estimate.std
        covered = float(np.mean(inside[estimate.determined]))
    if factor is not None:
        com_covered = summarise_intervals(
            parameters, estimate.value, factor, truth, motion
        ).com_coverage
        square = np.linalg.qr(factor.T, mode="r").T
        known = determined_directions(
            prior.covariance_factor(), square, parameters.names, DETERMINED
        )
        squares = (known.coordinates @ error / known.ratios)[known.determined] ** 2
    verdict = estimate.verdict
    return Score(
        metrics.gen_force_rmse,
        metrics.torque_rmse,
        metrics.com_position_rmse_mm,
        metrics.parameter_error_pct,
        sum(not possible for possible in estimate.consistent.values()),
        covered,
        com_covered,
        squares,
        0 if verdict is None else len(verdict.alarms),
        0.0 if verdict is None else verdict.window,
    )


def table_row(case: str, scores: list[Score]) -> str:
    """Return the means over the draws."""

    def mean(name: str) -> float:
        return float(np.mean([getattr(each, name) for each in scores]))

    squares = np.concatenate([each.squares for each in scores])
    directions = len(squares) / len(scores)
    normalised = squares.mean() if len(squares) else np.nan
    worst = max(each.com for each in scores)
    alarmed = sum(each.alarms > 0 for each in scores)

    def bound(name: str) -> str:
        least, errors = (
            np.sqrt(np.mean([getattr(each, field) ** 2 for each in scores]))
            for field in (f"{name}_bound", name)
        )
        return "–" if np.isnan(least) else f"{least:.3f} ({errors / least:.2f})"

    return (
        f"| {case} | {mean('gen_force'):.3f} | {mean('torque'):.3f} | {mean('com'):.3f} "
        f"({worst:.2f}) | {mean('parameters'):.1f} | {sum(each.impossible for each in scores)} | "
        f"{mean('covered'):.2f} | {mean('com_covered'):.2f} | {normalised:.2f} ({directions:.0f}) "
        f"| {alarmed} of {len(scores)} | {bound('torque')} | {bound('com')} |"
    )


if __name__ == "__main__":
    main()
