"""report_data.npz: what a report shows of the log that a robot was identified from."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, get_type_hints

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.atomic_write import write_through
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.npz_file import read_arrays

FILE_NAME = "report_data.npz"
FORMAT = 1
QUANTILES = (0.0, 0.01, 0.05, 0.25, 0.5, 0.75, 0.95, 0.99, 1.0)


@dataclass(frozen=True)
class ForceSeries:
    """Measured and predicted forces in N rows of n coordinates, for plots.

    Attributes
    ----------
    coordinates, units : tuple of str
        Moment and force of a floating base, then the joints; Nm or N.
    time : (N,) float64
        Centres of the rows, s from the start of the log.
    measured, before, after : (N, n) float64
        Motor efforts and the wrench on the base, measured and predicted by the original and the
        identified model; NaN where a row is not used.
    frequency : (F,) float64
        Hz.
    power_measured, power_before, power_after : (F, n) float64
        One-sided power spectral densities of the measured force and of both errors, unit²/Hz, over
        the whole evaluated part.
    speed : (M, n) float64
        Speed of the joints at M other rows, rad/s or m/s; NaN for the base and where unknown.
    speed_before, speed_after : (M, n) float64
        Errors of both models at these rows.
    rms_measured, rmse_before, rmse_after : (n,) float64
        Over the whole evaluated part; NaN without rows.
    start, stop : float
        The evaluated part, s from the start of the log.
    is_held_out : bool
        Whether the identified model is that of a trial identification without this part.
    """

    coordinates: tuple[str, ...]
    units: tuple[str, ...]
    time: FloatArray
    measured: FloatArray
    before: FloatArray
    after: FloatArray
    frequency: FloatArray
    power_measured: FloatArray
    power_before: FloatArray
    power_after: FloatArray
    speed: FloatArray
    speed_before: FloatArray
    speed_after: FloatArray
    rms_measured: FloatArray
    rmse_before: FloatArray
    rmse_after: FloatArray
    start: float
    stop: float
    is_held_out: bool

    @property
    def has_rows(self) -> BoolArray:
        """(n,) whether a coordinate has rows."""
        return np.asarray(np.isfinite(self.rmse_after))


@dataclass(frozen=True)
class Coverage:
    """What a log consists of, and which motion it contains.

    Attributes
    ----------
    log : str
        Name of the log.
    begin : int
        Stamp of the start of the log, ns.
    used : (S, 2) float64
        Beginnings and ends of the parts in which every sensor has data, s from the start.
    faults : tuple of mapping
        ``kind``, ``stream``, ``start`` and ``stop`` (s from the start) of the times in which a
        topic had no usable messages.
    findings : tuple of mapping
        Findings of the doctor, as in ``symbid bag doctor --json``, worst first.
    is_checked : bool
        Whether the log was checked.
    joints : tuple of str
        Names of the J joints.
    position, speed : (J, 9) float64
        Quantiles (``QUANTILES``) of the position, rad or m, and of the absolute speed.
    mean_posture : (J,) float64
        Mean position of the joints, rad or m.
    """

    log: str
    begin: int
    used: FloatArray
    faults: tuple[Mapping[str, Any], ...]
    findings: tuple[Mapping[str, Any], ...]
    is_checked: bool
    joints: tuple[str, ...]
    position: FloatArray
    speed: FloatArray
    mean_posture: FloatArray

    @property
    def duration(self) -> float:
        """Time to the end of the last used part, s."""
        return float(self.used[-1, 1]) if len(self.used) else 0.0

    @property
    def seconds(self) -> float:
        """Length of all used parts, s."""
        return float(np.sum(self.used[:, 1] - self.used[:, 0]))


@dataclass(frozen=True)
class ParameterSpread:
    """Standard deviations that estimate.json and information.npz do not hold.

    Attributes
    ----------
    names : tuple of str
        The p parameters.
    prior_std : (p,) float64
        Standard deviations before the data; empty if the method has no prior.
    scale_change : (p,) float64
        Change of the parameters with one deviation of the gain that no residual shows; see
        :class:`symbid_ros.identification.identification.Identification`.
    """

    names: tuple[str, ...]
    prior_std: FloatArray
    scale_change: FloatArray


@dataclass(frozen=True)
class ReportData:
    """What a report shows of a log, beside estimate and information.

    Attributes
    ----------
    forces : ForceSeries or None
        None if the log is too short.
    coverage : Coverage
    spread : ParameterSpread
    """

    forces: ForceSeries | None
    coverage: Coverage
    spread: ParameterSpread

    def write(self, path: Path) -> None:
        """Write report_data.npz atomically."""
        content: dict[str, Any] = {"format": np.array(FORMAT)}
        for part in (self.forces, self.coverage, self.spread):
            if part is not None:
                name = type(part).__name__
                content |= {
                    f"{name}.{one.name}": _packed(getattr(part, one.name)) for one in fields(part)
                }
        write_through(path, lambda stream: np.savez_compressed(stream, **content))


@dataclass(frozen=True)
class PredictedLog:
    """A log whose forces a result predicts, beside the log that it was identified from.

    Attributes
    ----------
    data : ReportData
    seconds, seconds_used : float
        Length of the log, and of its part that the identification used, s.
    """

    data: ReportData
    seconds: float
    seconds_used: float


def load_report_data(folder: Path) -> ReportData | None:
    """Read report_data.npz of a result; None if the folder has none.

    Raises
    ------
    EstimateError
        When the file is damaged, or of a later version.
    """
    path = folder / FILE_NAME
    if not path.exists():
        return None
    content = read_arrays(path, f"a {FILE_NAME}", "E470")
    try:
        if int(content["format"]) != FORMAT:
            raise EstimateError(
                f"{path}: written in format {int(content['format'])}, this version reads {FORMAT}; "
                "identify the log again",
                "E470",
            )
        has_forces = any(name.startswith(f"{ForceSeries.__name__}.") for name in content)
        data = ReportData(
            _unpacked(ForceSeries, content) if has_forces else None,
            _unpacked(Coverage, content),
            _unpacked(ParameterSpread, content),
        )
        _check_shapes(data)
    except (KeyError, ValueError, TypeError, IndexError) as error:
        raise EstimateError(
            f"{path}: not a {FILE_NAME} ({error}); identify the log again, or delete the file",
            "E470",
        ) from None
    return data


def _packed(value: Any) -> np.ndarray:
    if isinstance(value, np.ndarray):
        # Seven digits are more than a figure shows.
        return value.astype(np.float32) if value.ndim > 1 else value
    if isinstance(value, tuple):
        return np.array(json.dumps(value))
    return np.asarray(value)


def _unpacked(kind: type, content: Mapping[str, np.ndarray]) -> Any:
    values: dict[str, Any] = {}
    for name, hint in get_type_hints(kind).items():
        array = content[f"{kind.__name__}.{name}"]
        if hint in (int, float, bool, str):
            values[name] = hint(array.item())
        elif str(hint).startswith("tuple"):
            values[name] = tuple(json.loads(array.item()))
        else:
            if array.dtype.kind != "f":
                raise ValueError(f"{name} is of type {array.dtype}, not real numbers")
            values[name] = array.astype(np.float64)
    return kind(**values)


def _check_shapes(data: ReportData) -> None:
    """Raise an error if arrays do not match in length."""
    joints, names = len(data.coverage.joints), len(data.spread.names)
    expected: dict[str, tuple[Any, tuple[int, ...]]] = {
        "position": (data.coverage.position, (joints, len(QUANTILES))),
        "speed": (data.coverage.speed, (joints, len(QUANTILES))),
        "mean_posture": (data.coverage.mean_posture, (joints,)),
        "used": (data.coverage.used, (len(data.coverage.used), 2)),
        "scale_change": (data.spread.scale_change, (names,)),
    }
    if len(data.spread.prior_std):
        expected["prior_std"] = data.spread.prior_std, (names,)
    forces = data.forces
    if forces is not None:
        count = len(forces.coordinates)
        for group, length in (
            (("measured", "before", "after"), len(forces.time)),
            (("power_measured", "power_before", "power_after"), len(forces.frequency)),
            (("speed", "speed_before", "speed_after"), len(forces.speed)),
        ):
            expected |= {
                f"{one} of the forces": (getattr(forces, one), (length, count)) for one in group
            }
        for one in ("rms_measured", "rmse_before", "rmse_after"):
            expected[one] = getattr(forces, one), (count,)
        if len(forces.units) != count:
            raise ValueError(f"{len(forces.units)} units for {count} coordinates")
    for name, (array, shape) in expected.items():
        if array.shape != shape:
            raise ValueError(f"{name} has shape {array.shape}, not {shape}")
