"""Effect of each sensor error, and of its correction by tare, weighing and sensor columns.

Each row is one simulated log of the Symbitron with that error alone. It is identified as it is, and
with `--tare` and `--total-mass`, which make the sensor errors unknowns; link lengths and delays are
estimated where the log has them. A row below `typical` shows
the correction without a tare. Prediction errors are those along an ideal log of another motion. In
brackets: the estimate's own standard deviation of the centre of mass.

    .venv/bin/python bench/sensor_errors.py [--seed N] [--only NAME ...] [--moves N] [--constant]

Several errors at once are joined by commas. Offsets and biases that drift are found in logs of two
minutes and more (``--only typical,drift --moves 128``); with ``--constant`` they are taken as
constant. Takes about a minute per row of the default length.
"""

import argparse
import logging
import tempfile
from pathlib import Path

from threadpoolctl import threadpool_limits

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.evaluation import evaluate
from symbid_ros.identification.predictions.intervals import summarise_intervals
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, read_true_motion
from symbid_ros.package_paths import config_file
from symbid_ros.signals.sensor_drift import SensorDrift
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.systematic_errors import ERRORS, TYPICAL

MODEL = config_file("symbitron.xml")
WEIGHED = {"total_mass": 41.05, "total_mass_std": 0.02}
# What is estimated beside typical errors, if a log has them.
MORE = {"link_length": ("link_length",), "delays": ("sensor_delay",)}
NAMES = ("", *TYPICAL, "typical", *(name for name in ERRORS if name not in TYPICAL))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=500)
    parser.add_argument("--only", nargs="*", default=NAMES, help="errors to try")
    parser.add_argument("--moves", type=int, default=20, help="length of the logs, 2.3 s each")
    parser.add_argument("--constant", action="store_true", help="without drift as an unknown")
    arguments = parser.parse_args()
    if arguments.constant:
        SensorDrift.possible = lambda *_: None
    logging.disable(logging.WARNING)  # a tare loads the load cell as intended
    print(f"{'error':16} {'uncorrected':>28} {'corrected':>28}  alarms")
    print(f"{'':16} " + f"{'gen. force  torque  CoM mm':>28} " * 2)
    with tempfile.TemporaryDirectory() as folder, threadpool_limits(1):
        bench = Bench(Path(folder), arguments.seed, arguments.moves)
        for name in arguments.only:
            log, tare = bench.simulate(name, "smooth"), bench.simulate(name, "tare")
            plain = bench.identify(log)
            kinds = ("typical", *MORE.get(name, ()))
            corrected = bench.identify(log, **WEIGHED, tare=(tare,), sensor_errors=kinds)
            print(
                f"{name or 'none':16} {plain[0]} {corrected[0]}  {plain[1]}, {corrected[1]}",
                flush=True,
            )
            if name == "typical":
                without = bench.identify(log, **WEIGHED, sensor_errors=("typical",))
                print(f"{'  without a tare':16} {'':28} {without[0]}  -, {without[1]}", flush=True)


class Bench:
    """One robot, one prior and one ideal log for evaluation."""

    def __init__(self, folder: Path, seed: int, moves: int = 20) -> None:
        self.folder, self.seed, self.moves = folder, seed, moves
        model = load_model(MODEL)
        self.parameters = ParameterSet(model)
        self.prior = folder / "prior.json"
        write_prior(self.prior, draw_prior(self.parameters, "percent", 25.0, seed))
        ideal = folder / "ideal"
        record(Simulator(SimulateOptions("smooth", motion_seed=seed + 1, ideal=True)), ideal)
        self.motion = read_true_motion([ideal], model)[::10]

    def simulate(self, errors: str, scenario: str) -> Path:
        """Return a bag of the scenario with these errors."""
        bag = self.folder / f"{errors}-{scenario}"
        seeds = {"motion_seed": self.seed, "noise_seed": self.seed + (scenario == "tare")}
        options = SimulateOptions(
            scenario, errors=errors, error_seed=self.seed, moves=self.moves, **seeds
        )
        record(Simulator(options), bag)
        return bag

    def identify(self, log: Path, **known: object) -> tuple[str, int]:
        """Return the errors as text, and the number of alarms."""
        options = IdentifyOptions(prior=self.prior, **known)
        found = BagRequest((log,), MODEL, options).load().solve()
        # With the joint terms that the log asked for, if any.
        parameters = ParameterSet.of_names(self.parameters.model, found.estimate.names)
        value, truth = found.estimate.value, parameters.values
        metrics = evaluate(parameters, {"it": value}, truth, self.motion)["it"]
        known = summarise_intervals(parameters, value, found.deviation_factor, truth, self.motion)
        text = (
            f"{metrics.gen_force_rmse:8.3f} {metrics.torque_rmse:8.3f} "
            f"{metrics.com_position_rmse_mm:6.2f} ({known.com_std_mm:.2f})"
        )
        return f"{text:>28}", len(found.estimate.verdict.alarms)


if __name__ == "__main__":
    main()
