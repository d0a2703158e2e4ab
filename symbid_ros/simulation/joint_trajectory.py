"""Trajectories of joints as files: CSV with a column of times and one of positions per joint."""

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from scipy.interpolate import make_interp_spline

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import SimulationError
from symbid_ros.user_files import open_regular

TRAJECTORY_FILE = "trajectory.csv"
TIME = "time"
POSITION, VELOCITY, ACCELERATION, EFFORT = "position", "velocity", "acceleration", "effort"
# Of a floating base: position, m, and quaternion wxyz.
BASE_POSE = tuple(f"base/{name}" for name in ("x", "y", "z", "qw", "qx", "qy", "qz"))
CENTRE_OF_MASS = tuple(f"com/{name}" for name in "xyz")  # m, in the world
# A quintic spline needs six points.
FEWEST_POINTS = 6
MAX_BYTES = 256 * 2**20


@dataclass(frozen=True)
class JointTrajectory:
    """Positions of joints over time; velocity and acceleration are those of a quintic spline.

    Attributes
    ----------
    names : tuple of str
        The D joints.
    time : (N,) float64
        Seconds, strictly increasing from 0.
    position : (N, D) float64
        rad or m.
    effort : (N, D) float64, optional
        Nm or N.
    base : (N, 7) float64, optional
        Position, m, and quaternion wxyz of a floating base.
    """

    names: tuple[str, ...]
    time: FloatArray
    position: FloatArray
    effort: FloatArray | None = None
    base: FloatArray | None = None

    @property
    def duration(self) -> float:
        """Seconds."""
        return float(self.time[-1])

    @cached_property
    def _splines(self) -> tuple[object, ...]:
        spline = make_interp_spline(self.time, self.position, k=5)
        return spline, spline.derivative(1), spline.derivative(2)

    def at(self, time: FloatArray) -> FloatArray:
        """Return position, velocity and acceleration (3, N, D) at times (N,), s."""
        return np.stack([spline(time) for spline in self._splines])  # type: ignore[operator]

    def effort_at(self, time: FloatArray) -> FloatArray:
        """Return the efforts (N, D) at times (N,), s; zero if there are none."""
        if self.effort is None:
            return np.zeros((len(time), len(self.names)))
        return np.asarray(make_interp_spline(self.time, self.effort, k=3)(time))


def read_trajectory(path: Path, joints: Sequence[str]) -> JointTrajectory:
    """Read a trajectory of a robot from a CSV file, or from the folder of `symbid excite`.

    The first line names the columns: ``time``, and ``JOINT`` or ``JOINT/position`` for each joint
    that moves. Efforts, ``JOINT/effort``, and the base's pose are read if all their columns are
    present. ``JOINT/velocity``, ``JOINT/acceleration`` and the centre of mass are ignored.

    Parameters
    ----------
    path : Path
    joints : sequence of str
        Names of the robot's joints.

    Raises
    ------
    SimulationError
        When the file cannot be read or has another form.
    """
    file = path / TRAJECTORY_FILE if path.is_dir() else path
    try:
        with open_regular(file) as stream:
            content = stream.read(MAX_BYTES + 1)
    except OSError as error:
        raise SimulationError(
            f"{file}: cannot be read ({error.strerror}); give `trajectory` the folder of "
            "`symbid excite` or a CSV file",
            "E680",
        ) from None
    if len(content) > MAX_BYTES:
        raise SimulationError(f"{file}: is larger than {MAX_BYTES >> 20} MiB; shorten it", "E681")
    rows = list(csv.reader(content.decode("utf-8", errors="replace").splitlines()))
    header = [name.strip() for name in rows[0]] if rows else []
    places: dict[str, int] = {}
    for column, name in enumerate(header):
        joint, _, kind = name.rpartition("/")
        if name in joints:
            places[name] = column
        elif joint in joints and kind == POSITION:
            places[joint] = column
        elif name not in {TIME, *BASE_POSE, *CENTRE_OF_MASS} and not (
            joint in joints and kind in (VELOCITY, ACCELERATION, EFFORT)
        ):
            raise SimulationError(
                f"{file}: column {name!r} is not a joint of the robot; name its columns "
                f"{TIME!r} and one of {', '.join(joints)}",
                "E681",
            )
    if TIME not in header or not places:
        raise SimulationError(
            f"{file}: lacks a column {TIME!r} or positions of joints; write these names in the "
            "first line",
            "E681",
        )
    try:
        values = np.array(rows[1:], dtype=np.float64).reshape(len(rows) - 1, len(header))
    except ValueError:
        raise SimulationError(
            f"{file}: a line has something else than {len(header)} numbers; correct it", "E681"
        ) from None
    time = values[:, header.index(TIME)]
    if len(time) < FEWEST_POINTS or not np.all(np.isfinite(values)) or np.any(np.diff(time) <= 0):
        raise SimulationError(
            f"{file}: needs at least {FEWEST_POINTS} lines of finite numbers with increasing times",
            "E681",
        )
    efforts = [f"{name}/{EFFORT}" for name in places]
    others = [
        values[:, [header.index(name) for name in names]] if {*names} <= {*header} else None
        for names in (efforts, BASE_POSE)
    ]
    return JointTrajectory(tuple(places), time - time[0], values[:, list(places.values())], *others)
