"""The result of an identification, as a user of the library sees it."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.atomic_write import refuse_bag_folder
from symbid_ros.blas_threads import on_one_blas_thread
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.archive import load_archive, write_archive
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.observations import Observations, covered_seconds
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.result_files import write_identification
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.identification.stored_information import (
    merged_observations,
    require_constant_friction,
)
from symbid_ros.model.held_joints import without_held_joints
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.model.wrist_sensors import without_wrist_sensors
from symbid_ros.signals.log import Log, require_log
from symbid_ros.user_files import as_path

if TYPE_CHECKING:
    import pandas


@dataclass(frozen=True)
class ParameterEstimate:
    """One identified parameter.

    Attributes
    ----------
    name, unit : str
        ``<link>/<m|mc_x|...|Izz>`` or ``<joint>/<viscous|coulomb|armature|offset>``, SI unit.
    value, prior : float
        Estimate and prior mean.
    std : float
        Standard deviation of the estimate; NaN if the method gives none.
    is_determined : bool
        Whether the data, not the prior, determine the value.
    """

    name: str
    unit: str
    value: float
    std: float
    prior: float
    is_determined: bool

    def __repr__(self) -> str:
        source = "from the data" if self.is_determined else "from the prior"
        return f"<{self.name} = {self.value:.4g} ± {self.std:.2g} {self.unit}, {source}>"


@dataclass(frozen=True)
class LinkEstimate:
    """Inertia of one identified link.

    Attributes
    ----------
    name : str
    mass : float
        kg.
    com : (3,) float64
        Centre of mass in the link's frame, m.
    inertia : (3, 3) float64
        About the centre of mass, in the axes of the link's frame, kg m².
    is_possible : bool
        Whether a rigid body can have this inertia.
    """

    name: str
    mass: float
    com: FloatArray
    inertia: FloatArray
    is_possible: bool

    def __repr__(self) -> str:
        com = ", ".join(f"{1e3 * one:.1f}" for one in self.com)
        note = "" if self.is_possible else ", physically impossible"
        return f"<{self.name}: {self.mass:.4g} kg, centre of mass ({com}) mm{note}>"


@dataclass(frozen=True, eq=False)
class ForcePrediction:
    """Measured and predicted generalised forces of a log.

    The equation of motion is averaged over the same windows as in the identification (or evaluated
    at the same filtered instants), so the errors equal those of the report.

    Attributes
    ----------
    stamp : (N,) int64
        Middles of the windows, ns.
    coordinates : tuple of str
        Names of the n coordinates: moments and forces on a floating base, then the joints.
    measured, predicted : (N, n) float64
        Generalised forces, Nm or N; NaN where the equation does not hold, as at a sticking joint.
    """

    stamp: IntArray
    coordinates: tuple[str, ...]
    measured: FloatArray
    predicted: FloatArray

    @property
    def error(self) -> FloatArray:
        """(N, n) measured minus predicted forces, Nm or N."""
        return self.measured - self.predicted

    @property
    def rmse(self) -> dict[str, float]:
        """Root mean square error of each coordinate that has rows, over these rows, Nm or N.

        ``residual_rmse`` of estimate.json counts rows that are left out as zero.
        """
        squares, counts = np.nansum(self.error**2, axis=0), np.isfinite(self.error).sum(axis=0)
        return {
            name: float(np.sqrt(square / count))
            for name, square, count in zip(self.coordinates, squares, counts, strict=True)
            if count
        }

    def __repr__(self) -> str:
        errors = ", ".join(f"{name} {value:.3g}" for name, value in self.rmse.items())
        return f"<ForcePrediction at {len(self.stamp)} instants; RMSE {errors}>"


@dataclass(frozen=True, eq=False)
class LogInformation:
    """Information about a robot from one or more logs; it can be saved, merged and solved again.

    Attributes
    ----------
    observations : tuple of Observations
        One for each length of window.
    """

    observations: tuple[Observations, ...] = field(repr=False)

    @classmethod
    def load(cls, path: str | Path) -> "LogInformation":
        """Read information.npz.

        Raises
        ------
        EstimateError
            When the file is missing or invalid.
        """
        return cls(load_archive(Path(path)))

    def save(self, path: str | Path) -> None:
        """Write information.npz in one step."""
        write_archive(Path(path), self.observations)

    def merged(self, other: "LogInformation") -> "LogInformation":
        """Return the sum of both; see :func:`symbid_ros.merge`."""
        require_constant_friction(self.observations, other.observations)
        return LogInformation(merged_observations(self.observations, other.observations))

    @property
    def seconds(self) -> int:
        """Length of the logs, s."""
        return len(covered_seconds(self.observations))

    def __repr__(self) -> str:
        windows = ", ".join(f"{1e3 * one.window:g}" for one in self.observations)
        count = len(self.observations[0].layout.parameters)
        return f"<LogInformation of {self.seconds} s on {count} parameters, windows {windows} ms>"


@dataclass(frozen=True, repr=False, eq=False)
class Result:
    """An identified robot.

    Attributes
    ----------
    estimate : Estimate
        Everything that estimate.json holds.
    options : IdentifyOptions
        How it was identified.
    """

    estimate: Estimate
    options: IdentifyOptions
    _identification: Identification
    _parameters: ParameterSet

    @cached_property
    def parameters(self) -> Mapping[str, ParameterEstimate]:
        """The identified parameters by name."""
        found = self.estimate
        count = len(found.names)
        std = np.full(count, np.nan) if found.std is None else found.std
        determined = np.zeros(count, bool) if found.determined is None else found.determined
        return {
            name: ParameterEstimate(
                name,
                found.units[i],
                float(found.value[i]),
                float(std[i]),
                float(found.prior[i]),
                bool(determined[i]),
            )
            for i, name in enumerate(found.names)
        }

    @cached_property
    def links(self) -> Mapping[str, LinkEstimate]:
        """The inertias of the links by name."""
        inertias = self._parameters.link_phi(self.estimate.value)
        return {
            name: LinkEstimate(name, *com_from_phi(phi), self.estimate.consistent[name])
            for name, phi in zip(self._parameters.link_names, inertias, strict=True)
        }

    @property
    def alarms(self) -> tuple[str, ...]:
        """Reasons not to trust the result, one sentence each."""
        return self._identification.alarms

    @property
    def covariance(self) -> FloatArray:
        """(p, p) covariance of the parameters, with the gain that all force sensors may share.

        It contains this gain in all parameters, because it scales them together: it cancels in
        a centre of mass. ``std`` of an estimate contains it in the masses only, unless
        ``force_scale_std`` is given.

        Raises
        ------
        EstimateError
            When the method gives no covariance.
        """
        factor = self._identification.deviation_factor
        if factor is None or self.estimate.std is None:
            raise EstimateError(
                f"{self.estimate.method} gives no covariance; use `method` map or map_lmi", "E507"
            )
        fixed = np.array([name in self.estimate.fixed for name in self.estimate.names])
        factor = np.where(fixed[:, None], 0.0, factor)
        covariance: FloatArray = factor @ factor.T
        if (change := self._identification.scale_change) is not None:
            change = np.where(fixed, 0.0, change)
            covariance += np.outer(change, change)
        return covariance

    @cached_property
    def robot(self) -> RobotModel:
        """The robot with the identified parameters."""
        found = without_wrist_sensors(self._parameters.apply(self.estimate.value))
        found = without_held_joints(found)
        return replace(found, contacts=None)

    @property
    def information(self) -> LogInformation:
        """The information of the log, to be merged with that of other logs."""
        return LogInformation(self._identification.observations)

    @on_one_blas_thread
    def predict(self, log: Log) -> ForcePrediction:
        """Predict the generalised forces of a log from its motion.

        Parameters
        ----------
        log : Log
            Of this robot, from :func:`symbid_ros.load_bag` or :meth:`symbid_ros.Log.from_arrays`.

        Returns
        -------
        ForcePrediction
            Measured and predicted forces (N, n), Nm or N, in the N windows of the log.

        Raises
        ------
        BagError, DataError, ModelError
            When the log is invalid or of another robot.
        EstimateError
            When the log is too short for a window.
        """
        require_log(log)
        predictor, model = self.predictor, self._parameters.model
        parts = [
            (part.stamp, part.valid, part.rows.y, part.rows.K @ predictor.unknowns)
            for part in predictor.rows(AlignedLog(log, model), log.source)
        ]
        if not parts:
            raise EstimateError(
                f"{log.source}: too short to predict forces; give a longer log", "E508"
            )
        stamp, valid, *forces = (np.concatenate(each) for each in zip(*parts, strict=True))
        measured, predicted = (np.where(valid, one, np.nan) for one in forces)
        return ForcePrediction(stamp, model.coordinates, measured, predicted)

    @property
    def predictor(self) -> ForcePredictor:
        """Predicts forces on the rows of this identification."""
        return ForcePredictor.of(self._identification, self._parameters)

    def to_frame(self) -> "pandas.DataFrame":
        """Return the parameters as a table, one row each, indexed by name.

        Returns
        -------
        pandas.DataFrame
            Columns ``unit``, ``value``, ``std``, ``prior`` and ``is_determined``.

        Raises
        ------
        EstimateError
            When pandas is not installed.
        """
        try:
            import pandas  # noqa: PLC0415
        except ModuleNotFoundError:
            raise EstimateError(
                "to_frame needs pandas, which is not installed; run `pip install pandas`", "E509"
            ) from None
        table = pandas.DataFrame([vars(one) for one in self.parameters.values()])
        return table.set_index("name")

    def save(self, folder: str | Path, *, kinematics: bool = False) -> Path:
        """Write estimate.json, information.npz, report_data.npz, model.urdf and model.xml.

        Parameters
        ----------
        folder : str or Path
            New folder, or that of an earlier result.
        kinematics : bool
            Whether to write calibrated.urdf and calibrated.xml as well, in which joints have the
            placements that ``sensor_errors`` link_length and joint_axis found.

        Returns
        -------
        Path
            The folder.

        Raises
        ------
        DataError
            When ``folder`` is not a path.
        SymbidError
            When it is the folder of a bag.
        EstimateError
            When a file cannot be written. The folder is then left as it is, and the message names
            the temporary folder with the files that can be written.
        """
        path = as_path("the folder", folder)
        refuse_bag_folder(path)
        write_identification(self._identification, self._parameters, path, kinematics=kinematics)
        return path

    def __repr__(self) -> str:
        lines = [
            f"<Result of {self.estimate.method} for {self.estimate.model}: "
            f"{self.estimate.describe_determined()} determined, {len(self.alarms)} alarms",
            *(f"  ALARM {alarm}" for alarm in self.alarms),
            *(f"  {str(link)[1:-1]}" for link in self.links.values()),
        ]
        return "\n".join(lines) + ">"

    def _repr_html_(self) -> str:
        alarms = "".join(f"<p><b>Alarm:</b> {escape(alarm)}</p>" for alarm in self.alarms)
        rows = "".join(
            f"<tr><td>{escape(one.name)}</td><td>{one.value:.4g}</td><td>{one.std:.2g}</td>"
            f"<td>{one.prior:.4g}</td><td>{escape(one.unit)}</td>"
            f"<td>{'data' if one.is_determined else 'prior'}</td></tr>"
            for one in self.parameters.values()
        )
        head = "".join(
            f"<th>{title}</th>" for title in ("parameter", "value", "±", "prior", "unit", "from")
        )
        title = f"{escape(self.estimate.model)}, {escape(self.estimate.method)}"
        return f"<h4>{title}</h4>{alarms}<table><tr>{head}</tr>{rows}</table>"
