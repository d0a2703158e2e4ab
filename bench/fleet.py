"""Six simulated robots of one type, one with a link 10 % heavier: is it named?

    .venv/bin/python bench/fleet.py [--draws 10]

Each robot is a UR5 that follows a trajectory of its own. Its links, its friction and the gain of
its efforts differ a little from those of the others. The model's inertias are off by up to 25 %.
"""

import argparse
import sys
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "test" / "support"))

from arm_log import arm_streams
from documented_robots import ur5_urdf

from symbid_ros.estimation.fleet import FleetEstimate
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.identification.fleet import fleet
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.prior_options import load_parameters
from symbid_ros.identification.rows.dataset import read_dataset
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.log import Log

ROBOTS = 6
HEAVIER = 1.1
# Links whose mass the joints feel; a tenth of the last link, 19 g, is below the sensors' noise.
LINKS = "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link"
# Relative deviations between robots, of links and of the gain of efforts. Friction differs by 30 %.
LINK_STD, GAIN_STD = 0.003, 0.005
SECONDS, RATE, FRICTION = 40.0, 100.0, 0.02


@dataclass(frozen=True)
class Draw:
    """A fleet, and which robot and link is heavier; ``link`` is empty if none is."""

    estimate: FleetEstimate
    robot: str
    link: str
    truth: np.ndarray

    @property
    def is_named(self) -> bool:
        """Whether exactly the heavier link is named."""
        named = [(one.robot, one.place) for one in self.estimate.deviations]
        return named == ([(self.robot, self.link)] if self.link else [])


def simulate(seed: int, *, changed: bool = True, seconds: float = SECONDS) -> Draw:
    """Simulate and compare a fleet, one link of which is heavier if ``changed``."""
    rng = np.random.default_rng(seed)
    true = load_model(ur5_urdf(), "fixed")
    parameters = ParameterSet(true)
    nominal = true.with_phi(
        parameters.link_phi(draw_prior(ParameterSet(true), "consistent", 25, seed).mean)
    )
    columns = load_parameters(nominal, IdentifyOptions())
    robot, link = int(rng.integers(ROBOTS)), LINKS[rng.integers(len(LINKS))] if changed else ""
    data = {}
    for index in range(ROBOTS):
        factors = 1 + LINK_STD * rng.standard_normal(len(true.links))
        if changed and index == robot:
            factors[true.link_names.index(link)] *= HEAVIER
        own = true.with_phi(true.phi * factors[:, None])
        streams = arm_streams(own, seconds, 100 * seed + index, rate=RATE, friction=FRICTION)
        effort = streams.joints.effort * (1 + GAIN_STD * rng.standard_normal())
        log = Log.from_streams(replace(streams, joints=replace(streams.joints, effort=effort)))
        data[f"robot_{index}"] = read_dataset(log, columns).observations
    return Draw(fleet(nominal, data), f"robot_{robot}", link, parameters.values)


def describe(draw: Draw) -> str:
    """Return one line about a draw."""
    found = "; ".join(
        f"{one.robot} {one.place} p {one.p_value:.1e}, evidence {one.evidence:.0f}"
        + (
            ""
            if one.relative is None
            else f", {100 * one.relative:+.1f} ± {100 * one.relative_std:.1f} %"
        )
        + (f" (or {', '.join(one.alternatives)})" if one.alternatives else "")
        for one in draw.estimate.deviations
    )
    estimate = draw.estimate
    ratio = estimate.common_std / np.median(estimate.single_stds, axis=0)
    spread = ", ".join(f"{name} {100 * size:.2g} %" for name, size in estimate.spread.items())
    return (
        f"{draw.robot} {draw.link or 'unchanged'}: {'named' if draw.is_named else 'NOT NAMED'}; "
        f"found {found or 'none'}; common σ over one robot's: {ratio.min():.2f} to "
        f"{ratio.max():.2f}; "
        f"spread {spread}"
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--draws", type=int, default=10)
    parser.add_argument("--first", type=int, default=0, help="seed of the first draw")
    parser.add_argument("--unchanged", action="store_true", help="no link is heavier")
    options = parser.parse_args()
    require_packages(EXAMPLE_ROBOTS)
    named = 0
    for seed in range(options.first, options.first + options.draws):
        draw = simulate(seed, changed=not options.unchanged)
        named += draw.is_named
        print(describe(draw), flush=True)
    print(f"right in {named} of {options.draws} draws")


if __name__ == "__main__":
    main()
