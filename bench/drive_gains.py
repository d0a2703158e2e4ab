"""Factors of a real arm's motor currents, from a payload of which the mass alone is known.

    .venv/bin/python bench/drive_gains.py --data DIR

DIR holds the files that the script names when they are absent. A UR10e follows one motion without
and with a payload. Its currents are identified with default options: with the place of the payload
as an unknown, and with guesses of it. The table shows the factors over published ones.
"""

import argparse
import logging
from pathlib import Path

import numpy as np
from real_data import MissingDataError, RealData, Recording, to_log, ur10e
from threadpoolctl import threadpool_limits

import symbid_ros as sy

FOLDER = "dataset_ur10e/identification_data"
DATA = RealData(
    "UR10e, 6 joints, motor currents without and with a payload, 100 Hz, 57 s each",
    "https://github.com/shamilmamedov/dynamic_calibration commit 11af40e",
    "data: none stated; URDF: BSD",
    {
        f"{FOLDER}/ur-20_02_19_14harm50sec.csv": ""
        "cd503afc985c41a6ad8fbe47d443c961eadbde4822a87ff3e17adcb2a24fa103",
        f"{FOLDER}/ur-20_02_19_14harm50secLoad.csv": ""
        "e689a99e5ff00ac38d03a2b9302e77688de0db8388b1d9c0e6aad3f77962758c",
        "URe/urdf/ur10e.urdf": "0d2abc6ebc70725c691a35aa6c2d03fd6e8158017a1b7da7a10a3ef52de7b821",
    },
    ur10e,
    "The repository gives the mass of the payload (estimate_drive_gains.m), and not its place.",
)
LINK, MASS = "wrist_3_link", 2.805  # kg
PUBLISHED = np.array([14.87, 13.26, 11.13, 10.62, 11.03, 11.47])  # Nm/A, main.m
PAUSE = 100.0  # s between the recordings, whose clocks begin alike
PLACES = {"unknown": "", "guess (0, 0, 0) mm": ",0,0,0", "guess (0, 0, 50) mm": ",0,0,0.05"}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, required=True, metavar="DIR")
    try:
        files = DATA.find(parser.parse_args().data)
    except MissingDataError as error:
        raise SystemExit(str(error)) from None
    print(DATA.describe(files))
    threadpool_limits(1)
    logging.disable(logging.WARNING)
    robot = sy.load_model(files[-1], base="fixed")
    first, second = (np.loadtxt(path, delimiter=",") for path in files[:2])
    second[:, 0] += first[-1, 0] + PAUSE - second[0, 0]
    free, loaded = (
        to_log(robot, Recording(name, rows[:, 0], rows[:, 1:7], rows[:, 13:19]))
        for name, rows in (("free", first), ("loaded", second))
    )
    columns = ["place of the payload", *robot.measured_joint_names, "held out, %", "alarms"]
    print(f"\n| {' | '.join(columns)} |\n{len(columns) * '|---'}|", flush=True)
    for title, given in PLACES.items():
        payload = [(loaded, f"{LINK},{MASS}{given}")]
        estimate = sy.identify(robot, free, payload=payload, drive_gain="all").estimate
        values = {one.name: one.value for one in estimate.verdict.sensors}
        gains = [values[f"{name}/drive_gain"] for name in robot.measured_joint_names]
        ratios = " | ".join(f"{ratio:.2f}" for ratio in gains / PUBLISHED)
        error = estimate.holdout.percent_after
        found = [line[line.index("at (") :] for line in estimate.verdict.describe_payload_places()]
        place = "".join(f", found {one.removesuffix(' in its axes')}" for one in found)
        print(
            f"| {title}{place} | {ratios} | {error:.2g} | {len(estimate.verdict.alarms)} |",
            flush=True,
        )


if __name__ == "__main__":
    main()
