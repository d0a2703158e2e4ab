"""The peers' own code on the same logs: FIGAROH, mujoco.sysid and plain weighted least squares.

    .venv/bin/python bench/peers.py [--problems ur5 anymal tx40] [--data DIR]

Each problem is the log of an arm or of a robot whose base is held, since the peers have no
floating base with joint torques. `ur5` and `anymal` are simulated: 60 s at 250 Hz, friction and
armature present, sensor noise, and a model file that is wrong by up to 25 %; their held-out efforts
are free of noise. The others are public logs (bench/real_logs.py), of which DIR holds the files.

All programs get the same samples and filter them as they do. Their torques for the held-out motion
are judged on the same rows as in bench/real_logs.py. Peers run in an environment of their own,
which `make bench-peers` installs from bench/peers/requirements.txt. Their programs in bench/peers/
are what a user would have to write; the lines between `user: begin` and `user: end` count.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages
from foreign_robots import RATE, inaccurate, load_robot, move, plain, torque, with_friction
from least_squares import Sampled, columns, sample, score, solve
from real_data import REAL_DATA, FloatArray, RealLog, Recording, to_log
from real_logs import predicted_force
from tables import markdown, versions
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet

HERE = Path(__file__).resolve().parent
SIMULATED = ("ur5", "anymal")
SECONDS = 60.0, 20.0  # of the training and of the held-out log
ENCODER = 2e-5  # rad
EFFORT = 1e-3  # of a joint's RMS effort
# Judged while a joint moves faster, rad/s: the low-pass carries the jump of a simulated Coulomb
# friction, which no model of friction near rest shares, a tenth of a second far.
MOVING = 0.1
PEERS = {
    "FIGAROH": ("figaroh", HERE / "peers" / "figaroh_peer.py"),
    "mujoco.sysid": ("mujoco_sysid", HERE / "peers" / "mujoco_sysid_peer.py"),
}
PROGRAM = """\
robot = sy.load_model("model.urdf")
log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
result = sy.identify(robot, log)
"""


@dataclass(frozen=True)
class Outcome:
    """One program on one problem.

    Attributes
    ----------
    error : float
        100 ‖e‖/‖y‖ of the held-out torques.
    impossible : str
        Links whose identified inertia no body can have; a dash without link parameters.
    seconds, lines : float, int
        Of the identification, and what a user writes for it; not counted for the references.
    """

    error: float
    impossible: str
    seconds: float
    lines: int


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--problems", nargs="+", default=list(SIMULATED))
    parser.add_argument("--data", type=Path, metavar="DIR")
    parser.add_argument("--peers", nargs="*", choices=list(PEERS), default=list(PEERS))
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--python", type=Path, default=Path("build/peers/bin/python"))
    given = parser.parse_args()
    require_packages(EXAMPLE_ROBOTS)
    threadpool_limits(1)
    installed = subprocess.run(
        [given.python, "-m", "pip", "list", "--format", "json"], capture_output=True, check=True
    )
    known = {each["name"]: each["version"] for each in json.loads(installed.stdout)}
    print(versions(), *(f"{name} {known[name]}" for name in ("figaroh", "mujoco")), sep=", ")
    print()
    rows = []
    for name in given.problems:
        log = simulated(name, given.seed) if name in SIMULATED else real(name, given.data)
        moving = {"slipping": MOVING} if name in SIMULATED else {}
        for title, outcome in outcomes(log, given.python, given.peers, moving):
            rows.append([name, title, *vars(outcome).values()])
            print(rows[-1], file=sys.stderr, flush=True)
    head = ["log", "program", "held-out error, %", "impossible links", "s", "lines"]
    print(markdown(head, rows, digits=3))


def real(name: str, folder: Path | None) -> RealLog:
    if name not in REAL_DATA or folder is None:
        raise SystemExit(f"{name}: not one of {', '.join(REAL_DATA)} with --data DIR")
    data = REAL_DATA[name]
    return data.convert(data.find(folder))


def simulated(name: str, seed: int) -> RealLog:
    """Return the log of a robot with friction whose base is held."""
    robot, _ = load_robot(name, "fixed")
    rng = np.random.default_rng(seed)
    motions = [move(robot, (), rng, seconds) for seconds in SECONDS]
    size = np.sqrt(np.mean(torque(plain(robot), motions[0]) ** 2, axis=0))
    size = np.maximum(size, 0.05 * size.max())
    truth = with_friction(robot, True, size, rng)
    recordings = []
    for part, motion in zip(("training", "held-out"), motions, strict=True):
        position, effort = motion.position, torque(truth, motion)
        if part == "training":
            position = position + ENCODER * rng.standard_normal(position.shape)
            effort = effort + EFFORT * size * rng.standard_normal(effort.shape)
        clock = np.arange(len(position)) / RATE
        recordings.append(Recording(part, clock, position, effort))
    model = inaccurate(truth, False, size, seed, rng)
    terms = ("viscous", "coulomb", "offset", "armature")
    return RealLog(model, *recordings, cutoff=10.0, terms=terms)


def outcomes(
    log: RealLog, python: Path, peers: Sequence[str], moving: dict[str, float]
) -> Iterator[tuple[str, Outcome]]:
    """Yield what each program makes of a problem."""
    training = sample(log.robot, log.training, log.cutoff)
    heldout = sample(log.robot, log.heldout, log.cutoff, **moving)

    def error(predicted: FloatArray) -> float:
        return score(heldout, heldout.filtered(predicted)).overall

    stated = columns(log.robot, heldout, ()) @ ParameterSet(log.robot).values
    yield "model file", Outcome(score(heldout, stated).overall, "0", 0.0, 0)
    start = time.perf_counter()
    found = solve(columns(log.robot, training, log.terms), training)
    seconds = time.perf_counter() - start
    predicted = columns(log.robot, heldout, log.terms) @ found
    yield "plain WLS", Outcome(score(heldout, predicted).overall, "-", seconds, lines_of_wls())
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_problem(log, heldout, folder)
        for title in peers:
            stem, script = PEERS[title]
            answer = subprocess.run(
                [python.absolute(), script, folder], capture_output=True, text=True, check=False
            )
            if answer.returncode != 0:
                print(answer.stderr, file=sys.stderr)
                yield title, Outcome(float("nan"), "-", float("nan"), user_lines(script))
                continue
            result = np.load(folder / f"{stem}.npz")
            impossible = "-" if result["impossible"] < 0 else str(result["impossible"])
            took = float(result["seconds"])
            yield title, Outcome(error(result["torque"]), impossible, took, user_lines(script))
    start = time.perf_counter()
    result = sy.identify(log.robot, to_log(log.robot, log.training))
    seconds = time.perf_counter() - start
    ours = score(heldout, predicted_force(result, heldout)).overall
    yield "symbid_ros", Outcome(ours, "0", seconds, len(PROGRAM.splitlines()))


def write_problem(log: RealLog, heldout: Sampled, folder: Path) -> None:
    """Write model.urdf, and the arrays that the programs in bench/peers/ read.

    training.npz: time (N,), position and effort (N, J); heldout.npz: position, velocity and
    acceleration (N, J), filtered as for the other programs; joints names the columns of both.
    """
    (folder / "model.urdf").write_text(urdf_text(log.robot, None))  # without meshes
    joints = np.array(log.robot.measured_joint_names)
    training = {key: getattr(log.training, key) for key in ("time", "position", "effort")}
    np.savez(folder / "training.npz", joints=joints, **training)
    motion = {key: getattr(heldout, key) for key in ("position", "velocity", "acceleration")}
    np.savez(folder / "heldout.npz", joints=joints, **motion)


def user_lines(script: Path) -> int:
    """Count the lines that a user writes: neither empty nor comments."""
    text = script.read_text().split("# user: begin")[1].split("# user: end")[0]
    return sum(bool(line.strip()) and not line.strip().startswith("#") for line in text.split("\n"))


def lines_of_wls() -> int:
    text = (HERE / "least_squares.py").read_text().split("@dataclass", 1)[1]
    return sum(bool(line.strip()) for line in text.splitlines())


if __name__ == "__main__":
    main()
