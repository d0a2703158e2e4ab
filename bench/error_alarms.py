"""Alarms against errors: which wrong estimates raise an alarm, and which alarms are false.

Each row is one error of the sensors or of the geometry, or several at once, in simulated logs of
the Symbitron, and what is estimated of them; a tare and a weighing are given where anything is.

- alarmed: number of logs with an alarm
- CoM, all: errors in standard deviations, of the centre of mass along an ideal log of another
  motion, and of the determined directions of the parameters; root mean square per component, the
  mean over the logs and the largest
- missed: logs without an alarm in which the centre of mass errs by more than 2.5 of these
- false: logs with an alarm in which both are below 1.5

    .venv/bin/python bench/error_alarms.py [--seed N] [--logs N] [--only NAME ...]

Takes some two minutes per row and log.
"""

import argparse
import logging
import shutil
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from noise_bound import com_slope
from numpy.typing import NDArray
from sensor_errors import MODEL, WEIGHED, Bench
from threadpoolctl import threadpool_limits

from symbid_ros.estimation.directions import DETERMINED, determined_directions
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.prior_file import load_prior
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest
from symbid_ros.simulation.systematic_errors import TYPICAL

FloatArray = NDArray[np.float64]
NONE: tuple[str, ...] = ()
USUAL = ("typical",)
KINEMATIC = ("typical", "link_length")
LATE = ("typical", "sensor_delay")
EVERY = ("typical", "link_length", "sensor_delay")
ALL_ERRORS = "typical,link_length,delays,sample_rates,quantisation"
# What is estimated of each error. Two errors at once are those that could hide each other.
ROWS: dict[str, tuple[tuple[str, ...], ...]] = {
    "": (NONE, USUAL),
    **dict.fromkeys(TYPICAL, (NONE, USUAL)),
    "sample_rates": (NONE,),
    "quantisation": (NONE,),
    "delays": (NONE, LATE),
    "link_length": (NONE, USUAL, KINEMATIC),
    "wrench_position,imu_mounting": (NONE,),
    "torque_gain,wrench_gain": (NONE,),
    "encoder_offset,link_length": (NONE, USUAL),
    "typical": (NONE, USUAL),
    "typical,delays": (USUAL, LATE),
    "typical,link_length": (USUAL, KINEMATIC),
    ALL_ERRORS: (USUAL, EVERY),
}
MISSED, FALSE = 2.5, 1.5


@dataclass(frozen=True)
class Outcome:
    """Whether there was an alarm, and the errors of CoM and parameters in deviations."""

    is_alarmed: bool
    com: float
    parameters: float

    @property
    def is_missed(self) -> bool:
        """Whether the centre of mass is wrong without an alarm."""
        return not self.is_alarmed and self.com > MISSED

    @property
    def is_false(self) -> bool:
        """Whether an alarm warns of an estimate that is right."""
        return self.is_alarmed and max(self.com, self.parameters) < FALSE


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=800)
    parser.add_argument("--logs", type=int, default=1, help="logs of each row")
    parser.add_argument("--only", nargs="*", default=list(ROWS), help="errors to try")
    given = parser.parse_args()
    logging.disable(logging.WARNING)  # a tare loads the load cell as intended
    columns = "error", "estimated", "alarmed", "CoM (largest)", "all (largest)", "missed", "false"
    print(f"| {' | '.join(columns)} |\n{len(columns) * '|---'}|", flush=True)
    for name in given.only:
        found: list[list[Outcome]] = [[] for _ in ROWS[name]]
        for seed in range(given.seed, given.seed + given.logs):
            with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
                bench = Bench(Path(folder), seed)
                log, tare = bench.simulate(name, "smooth"), bench.simulate(name, "tare")
                for kinds, outcomes in zip(ROWS[name], found, strict=True):
                    known = WEIGHED | {"tare": (tare,), "sensor_errors": kinds} if kinds else {}
                    options = IdentifyOptions(prior=bench.prior, **known)
                    estimate = BagRequest((log,), MODEL, options).load().solve()
                    outcomes.append(
                        judge(estimate, load_prior(bench.prior, bench.parameters), bench)
                    )
                shutil.rmtree(log)
        for kinds, outcomes in zip(ROWS[name], found, strict=True):
            print(table_row(name, kinds, outcomes), flush=True)


def judge(found: Identification, prior: Prior, bench: Bench) -> Outcome:
    """Compare an estimate with the truth, in its own standard deviations."""
    # With the joint terms that the log asked for, if any.
    parameters = ParameterSet.of_names(bench.parameters.model, found.estimate.names)
    error = found.estimate.value - parameters.values
    factor = found.deviation_factor
    assert factor is not None
    slope = com_slope(parameters, bench.motion.samples)
    root = slope @ factor
    left = np.linalg.solve(root @ root.swapaxes(1, 2), (slope @ error)[..., None])[..., 0]
    com = float(np.sqrt(np.mean(left * (slope @ error))))
    known = determined_directions(
        prior.for_columns(parameters).covariance_factor(),
        np.linalg.qr(factor.T, mode="r").T,
        parameters.names,
        DETERMINED,
    )
    squares = (known.coordinates @ error / known.ratios)[known.determined] ** 2
    verdict = found.estimate.verdict
    assert verdict is not None
    return Outcome(bool(verdict.alarms), com, float(np.sqrt(np.mean(squares))))


def table_row(name: str, kinds: tuple[str, ...], outcomes: list[Outcome]) -> str:
    """Return the counts and the errors' means and largest values."""

    def sizes(field: str) -> str:
        values = [getattr(one, field) for one in outcomes]
        return f"{np.mean(values):.1f} ({max(values):.1f})"

    what = "all five" if name == ALL_ERRORS else name.replace(",", ", ") or "none"
    alarmed, missed, false = (
        sum(getattr(one, field) for one in outcomes)
        for field in ("is_alarmed", "is_missed", "is_false")
    )
    return (
        f"| {what} | {', '.join(kinds) or '–'} | {alarmed} of {len(outcomes)} | {sizes('com')} | "
        f"{sizes('parameters')} | {missed} | {false} |"
    )


if __name__ == "__main__":
    main()
