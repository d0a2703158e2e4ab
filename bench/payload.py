"""Detection of a payload on a moving robot: delay, named link and estimated mass.

Each row of the table is one simulated Symbitron, identified online with a finite memory. About 30 s
after the start a payload of 2 kg is attached to its body or a thigh. The row shows the time from
then to the alarm, the link named 5 s after the change, and the estimated and true mass of the link
three memories after the change. ``--quiet`` counts alarms without a change, ``--plot`` plots one
run.

    .venv/bin/python bench/payload.py [--seeds 10] [--quiet MINUTES] [--plot FILE.png]

Takes about half a minute per row and process.
"""

import argparse
import multiprocessing
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from multiprocessing.pool import Pool
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
from threadpoolctl import threadpool_limits

from symbid_ros.bags import Recording
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.topics import Topic, TopicSelection, TopicSelector
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.online.estimate import OnlineEstimate
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

MODEL = config_file("symbitron.xml")
MASS = 2.0  # kg
PLACES = {
    "base_link": (0.0, 0.0, 0.2),
    "L_thigh": (0.2, 0.0, 0.05),
    "R_thigh": (0.2, 0.0, 0.05),
}
MEMORY = 10.0  # s
BEFORE = 30.0  # s
NAMED_AFTER = 5.0  # s
PROCESSES = 2


@dataclass(frozen=True)
class Snapshot:
    """The state at one time, s: named links or "", masses (links,) and their deviations, kg."""

    time: float
    alarm: str
    mass: np.ndarray
    std: np.ndarray


def main() -> None:
    """Print the table, and count alarms or plot a run if requested."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--quiet", type=float, default=0.0, metavar="MINUTES")
    parser.add_argument("--plot", type=Path)
    arguments = parser.parse_args()
    threadpool_limits(1)
    if arguments.plot is not None:
        plot(arguments.plot)
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        if arguments.seeds:
            table(pool, arguments.seeds)
        if arguments.quiet:
            pieces = PROCESSES
            alarms = pool.map(partial(quiet, minutes=arguments.quiet / pieces), range(pieces))
            print(f"{arguments.quiet:g} minutes without a change: {sum(alarms)} alarms")


def table(pool: Pool, seeds: int) -> None:
    """Print a row for each seed and link, and a summary."""
    runs = [
        (seed, link)
        for seed in range(seeds)
        for link in ("base_link", "L_thigh" if seed % 2 else "R_thigh")
    ]
    print(f"{'seed':>4}  {'payload on':<10} {'alarm after':>11}  {'named':<10} {'mass':>20}  truth")
    rows = []
    for (seed, link), row in zip(runs, pool.imap(_row, runs), strict=True):
        rows.append((link, *row))
        after, named, mass, std, truth = row
        print(
            f"{seed:>4}  {link:<10} {after:>9.2f} s  {named:<10} {mass:>8.2f} ± {std:.2f} kg"
            f"  {truth:>8.2f}",
            flush=True,
        )
    for place, links in (("body", ("base_link",)), ("thigh", ("L_thigh", "R_thigh"))):
        some = [row for row in rows if row[0] in links]
        in_time = sum(row[1] <= NAMED_AFTER for row in some)
        right = sum(row[2] == row[0] for row in some)
        near = sum(abs(row[3] - row[5]) <= max(0.1 * row[5], 2 * row[4]) for row in some)
        print(
            f"{place}: {in_time} of {len(some)} detected within {NAMED_AFTER:g} s, {right} links "
            f"named, {near} masses within 10 % or 2 deviations after {3 * MEMORY:g} s"
        )


def _row(run: tuple[int, str]) -> tuple[float, str, float, float, float]:
    """Return delay of the alarm, named link, estimated mass, its deviation, and true mass."""
    seed, link = run
    threadpool_limits(1)
    attached = BEFORE + float(np.random.default_rng(seed).uniform(0.0, 4.0))
    snapshots = list(track(seed, Payload(link, MASS, PLACES[link]), attached))
    alarms = [one.time for one in snapshots if one.alarm]
    named = [one.alarm for one in snapshots if one.time <= attached + NAMED_AFTER and one.alarm]
    parameters = ParameterSet(load_model(MODEL))
    index = parameters.link_names.index(link)
    last = next(one for one in snapshots if one.time >= attached + 3 * MEMORY)
    truth = float(parameters.link_phi(parameters.values)[index, 0]) + MASS
    after = alarms[0] - attached if alarms else np.inf
    return after, named[-1] if named else "nothing", last.mass[index], last.std[index], truth


def track(seed: int, payload: Payload, attached: float) -> Iterator[Snapshot]:
    """Yield a snapshot each second until three memories after the change."""
    seconds = attached + 3 * MEMORY + 2.0
    simulator = Simulator(
        SimulateOptions(
            "smooth", moves=40, motion_seed=seed, noise_seed=seed, payload_time=attached
        ),
        payload=payload,
    )
    yield from _snapshots(simulator, seconds, seed, MEMORY)


def quiet(seed: int, *, minutes: float) -> int:
    """Return the number of alarms along a run without a change."""
    threadpool_limits(1)
    simulator = Simulator(
        SimulateOptions("smooth", moves=round(30 * minutes), motion_seed=1000 + seed)
    )
    before, count = "", 0
    for one in _snapshots(simulator, 60 * minutes, 1000 + seed, np.inf):
        count += bool(one.alarm and not before)
        before = one.alarm
    return count


def _snapshots(
    simulator: Simulator, seconds: float, seed: int, memory: float
) -> Iterator[Snapshot]:
    simulator.steps = min(simulator.steps, round(seconds * 1e9 / simulator.period_ns))
    parameters = ParameterSet(load_model(MODEL))
    with tempfile.TemporaryDirectory() as folder:
        record(simulator, Path(folder) / "bag")
        write_prior(Path(folder) / "prior.json", draw_prior(parameters, "percent", 25, seed))
        recording = Recording.of([Path(folder) / "bag"])
        selector = TopicSelector("live", TopicSelection())
        topics = {name: Topic(name, one.msgtype) for name, one in recording.topics.items()}
        selector.counts = {topic: 1 for topic in topics.values() if selector.wants(topic)}
        selected = selector.select()
        options = IdentifyOptions(prior=Path(folder) / "prior.json")
        initial = InitialState.of(load_model(MODEL), options)
        live = OnlineIdentification(initial, selected, Pace(memory, share=1.0))
        due = recording.start + 1_000_000_000
        names = {topic.name for topic in selected.all}
        for message in recording.messages(names, recording.start, recording.end + 1):
            live.intake.feed(topics[message.topic], message.payload)
            if message.log_time >= due:
                due += 1_000_000_000
                outcome = live.solve()
                if outcome is not None:
                    yield _snapshot(message.log_time * 1e-9, outcome, parameters)
        live.close()


def _snapshot(time: float, outcome: OnlineEstimate, parameters: ParameterSet) -> Snapshot:
    estimate, change = outcome.found.estimate, outcome.change
    assert estimate.std is not None
    return Snapshot(
        time,
        "" if change is None else " or ".join(one.subject for one in change.suspects),
        parameters.link_phi(estimate.value)[:, 0],
        parameters.link_phi(estimate.std)[:, 0],
    )


def plot(file: Path) -> None:
    """Plot the estimated masses of body and thigh before and after a change."""
    link, attached, seed = "R_thigh", BEFORE, 4
    parameters = ParameterSet(load_model(MODEL))
    snapshots = list(track(seed, Payload(link, MASS, PLACES[link]), attached))
    time = np.array([one.time for one in snapshots])
    alarm = next(one.time for one in snapshots if one.alarm)
    truth = parameters.link_phi(parameters.values)[:, 0]
    shown = ("base_link", link)
    figure, axes = plt.subplots(len(shown), 1, sharex=True, figsize=(8, 5), layout="constrained")
    for axis, name in zip(axes, shown, strict=True):
        index = parameters.link_names.index(name)
        mass = np.array([one.mass[index] for one in snapshots])
        std = np.array([one.std[index] for one in snapshots])
        true = truth[index] + MASS * (name == link) * (time >= attached)
        axis.fill_between(time, mass - 2 * std, mass + 2 * std, color="#4477aa", alpha=0.2, lw=0)
        axis.plot(time, mass, color="#4477aa", label="estimate, ± 2 deviations")
        axis.step(time, true, color="#222222", ls="--", lw=1, where="post", label="truth")
        axis.axvline(alarm, color="#cc3311", lw=1)
        axis.set_ylabel(f"mass of {name} (kg)")
        axis.spines[["top", "right"]].set_visible(False)
    figure.legend(*axes[0].get_legend_handles_labels(), frameon=False, loc="upper right", ncols=2)
    axes[1].annotate(
        f"alarm: {link}",
        (alarm, 1.0),
        xycoords=("data", "axes fraction"),
        xytext=(-4, -12),
        textcoords="offset points",
        ha="right",
        color="#cc3311",
    )
    axes[-1].set_xlabel("time (s)")
    title = f"{MASS:g} kg attached to {link} at {attached:g} s, memory {MEMORY:g} s"
    figure.suptitle(title, x=0.01, ha="left", fontsize=11)
    figure.savefig(file, dpi=130)


if __name__ == "__main__":
    main()
