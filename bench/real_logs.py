"""Identifies robots from public logs, beside plain weighted least squares and published figures.

    .venv/bin/python bench/real_logs.py tx40 --data DIR [--option friction=true] [--reference-only]

DIR holds the files that the script names when they are absent: a checkout of the repository at
the commit, or the files side by side. The first three quarters of the log are identified with
default options. The table shows 100 ‖e‖/‖y‖ of the measured force y in the last quarter, or in the
part that `--held-out` names, for each joint and for all. `--replace NAME=FILE` reads another run.
All lines are judged on the same samples: those of `least_squares.py`, at which the joint slips.
"""

import argparse
import logging
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import yaml
from further_data import FURTHER_DATA
from laboratory_data import LABORATORY_DATA
from least_squares import Sampled, Score, columns, error_ratio, sample, score, solve
from real_data import REAL_DATA, FloatArray, MissingDataError, RealLog, to_log, write_files
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.parameters import ParameterSet

# Identified and held-out shares of a log.
PARTS = {
    "last": ((0.0, 0.75), (0.75, 1.0)),
    "first": ((0.25, 1.0), (0.0, 0.25)),
    "second-half": ((0.0, 0.5), (0.5, 1.0)),
    "first-half": ((0.5, 1.0), (0.0, 0.5)),
}
ALL_DATA = REAL_DATA | FURTHER_DATA | LABORATORY_DATA


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name", choices=sorted(ALL_DATA))
    parser.add_argument("--data", type=Path, required=True, metavar="DIR")
    parser.add_argument(
        "--option",
        action="append",
        default=[],
        metavar="NAME=VALUE",
        help="option of the identification, instead of its default",
    )
    parser.add_argument("--held-out", choices=list(PARTS), help="part of the log")
    parser.add_argument(
        "--replace",
        action="append",
        default=[],
        metavar="NAME=FILE",
        help="file in place of one of this name, such as that of another run",
    )
    parser.add_argument("--reference-only", action="store_true")
    parser.add_argument("--mass-scale", type=float, default=1.0, help="of the model file's links")
    parser.add_argument("--bags", type=Path, metavar="FOLDER", help="write these, and no table")
    asked = parser.parse_args()
    threadpool_limits(1)
    logging.basicConfig(level=logging.WARNING, format="%(message)s", stream=sys.stderr)
    data = ALL_DATA[asked.name]
    others = dict(each.split("=", 1) for each in asked.replace)
    try:
        files = data.find(asked.data, {name: Path(path) for name, path in others.items()})
    except MissingDataError as error:
        raise SystemExit(str(error)) from None
    print(data.describe(files))
    options = dict(each.split("=", 1) for each in asked.option)
    given = {name: yaml.safe_load(value) for name, value in options.items()}
    log = data.convert(files)
    if asked.held_out is not None:
        log = parted(log, asked.held_out)
    log = scaled(log, asked.mass_scale)
    if asked.bags is not None:
        write_files(log, asked.bags)
        print(f"wrote {asked.bags}: robot.urdf and the bags training and held_out")
        return
    report(log, None if asked.reference_only else given)


def parted(log: RealLog, held_out: str) -> RealLog:
    """Return the log with another part held out."""
    whole = log.training.joined(log.heldout)
    training, heldout = (whole.part(*shares) for shares in PARTS[held_out])
    return replace(log, training=training, heldout=heldout)


def report(log: RealLog, options: dict[str, object] | None) -> None:
    """Print the table; without options, of the references alone."""
    training, heldout = (
        sample(log.robot, part, log.cutoff, contacts=log.contacts)
        for part in (log.training, log.heldout)
    )
    length = (log.training.time[-1] - log.training.time[0], np.ptp(log.heldout.time))
    rows = heldout.is_used
    judged = np.flatnonzero(rows.any(axis=0))
    print(
        f"  {length[0]:.1f} s identified, {length[1]:.1f} s held out, low-pass {log.cutoff:g} Hz, "
        f"{100 * rows[:, judged].mean():.0f} % of the held-out rows used\n"
    )
    names = [log.robot.coordinates[index] for index in judged]
    print("| held-out error, % | all | " + " | ".join(names) + " |")
    print("|---|" + "---|" * (len(names) + 1))
    force = np.where(rows, heldout.force, 0.0)[:, judged]
    size = np.sqrt((force**2).sum(axis=0) / rows[:, judged].sum(axis=0))
    print("| measured, RMS, Nm or N | | " + " | ".join(f"{one:.3g}" for one in size) + " |")

    def show(title: str, result: Score) -> None:
        each = " | ".join(f"{one:.3g}" for one in result.each[judged])
        print(f"| {title} | {result.overall:.3g} | {each} |", flush=True)

    for title, reference in references(log, training, heldout):
        show(title, reference)
    if options is None:
        return
    title, found, notes = identified(log, heldout, options)
    show(title, found)
    ratio, low, high = error_ratio(found, reference, heldout)
    print(
        f"\nerror over that of the last line of least squares: {ratio:.3g}, "
        f"{low:.3g} to {high:.3g} in 90 %\n{notes}"
    )


def references(log: RealLog, training: Sampled, heldout: Sampled) -> Iterator[tuple[str, Score]]:
    """Yield the scores of the model file, of published parameters and of least squares."""
    stated = ParameterSet(log.robot).values
    inertial = columns(log.robot, heldout, ()) @ stated
    yield "model file, inertias alone", score(heldout, inertial)
    for title, torque in (log.published or {}).items():
        predicted = inertial + heldout.filtered(torque(heldout.velocity, heldout.acceleration))
        yield title, score(heldout, predicted)
    plain = "least squares: " + (", ".join(("links", *log.terms)))
    for title, extra in [(plain, None), *(log.extra or {}).items()]:
        parts = [
            columns(
                log.robot,
                part,
                log.terms,
                None if extra is None else extra(part.velocity, part.acceleration),
            )
            for part in (training, heldout)
        ]
        predicted = parts[1] @ solve(parts[0], training)
        yield title if extra is None else f"the same {title}", score(heldout, predicted)
    if log.gravity is not None:
        robot = log.robot.with_gravity(log.gravity)
        parts = [columns(robot, part, log.terms) for part in (training, heldout)]
        direction = ", ".join(f"{one:g}" for one in log.gravity)
        title = f"the same with gravity along ({direction})"
        yield title, score(heldout, parts[1] @ solve(parts[0], training))


def identified(
    log: RealLog, heldout: Sampled, options: dict[str, object]
) -> tuple[str, Score, str]:
    """Return the title and the score of an identification, and what else is to be said of it."""
    begun = time.perf_counter()
    named = {"contact": [f"{frame}:point" for frame in log.contacts]} if log.contacts else {}
    result = sy.identify(log.robot, to_log(log.robot, log.training), **named | options)
    seconds = time.perf_counter() - begun
    words = ", ".join(f"{name}={value}" for name, value in options.items()) or "default options"
    mass = sum(one.mass for one in result.links.values())
    notes = [
        f"{seconds:.0f} s; total mass {mass:.2f} kg",
        *(f"ALARM {one}" for one in result.alarms),
    ]
    found = score(heldout, predicted_force(result, heldout))
    return f"symbid, {words}", found, "\n".join(notes)


def predicted_force(result: sy.Result, samples: Sampled) -> FloatArray:
    """Return the generalised forces (N, n) that an identified robot predicts at samples.

    ``Result.predict`` averages over windows whose length each identification chooses. Here all
    predictions are compared at the same samples.
    """
    count, joints = samples.position.shape
    robot = result.robot
    rest = np.zeros((count, 3))
    base = samples.base or sy.BaseMotion(rest, rest, rest - robot.gravity)
    # Rows of a robot with unmeasured contacts are combined; these are projected.
    parameters = replace(result._parameters, model=replace(result._parameters.model, contacts=None))
    rows = equation_of_motion(
        parameters,
        Samples(
            stamp=np.arange(count),
            position=samples.position,
            velocity=samples.velocity,
            acceleration=samples.acceleration,
            effort=np.zeros((count, joints)),
            base_angular_velocity=base.angular_velocity,
            base_angular_acceleration=base.angular_acceleration,
            base_specific_force=base.specific_force,
            wrenches=np.zeros((count, 0, 6)),
            wrench_frames=(),
        ),
    )
    found = rows.K @ result.estimate.value - rows.y
    first = found.shape[1] - joints
    for sensor in result.estimate.verdict.sensors if result.estimate.verdict else ():
        joint, _, kind = sensor.name.rpartition("/")
        if kind == "drive_gain":  # the readings have another unit
            found[:, first + robot.joint_names.index(joint)] /= sensor.value
    return samples.filtered(found)


def scaled(log: RealLog, factor: float) -> RealLog:
    """Return the log with a robot whose inertias are multiplied by a factor."""
    parameters = ParameterSet(log.robot)
    return replace(log, robot=parameters.apply(parameters.values * factor))


if __name__ == "__main__":
    main()
