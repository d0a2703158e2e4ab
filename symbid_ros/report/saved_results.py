"""Results to report on, read from their folders."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.estimation.provenance import digest
from symbid_ros.identification.predictions.predictor import ForcePredictor, load_result_robot
from symbid_ros.identification.report_data import PredictedLog, ReportData, load_report_data
from symbid_ros.identification.report_series import predicted_log
from symbid_ros.identification.result_files import load_estimated_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.report.robot_summary import RobotSummary, summarise_robot
from symbid_ros.signals.log import Log

MODEL_SUFFIXES = ".urdf", ".xml"
METHOD_TITLES = {
    "ols": "OLS",
    "wls_r": "WLS-R",
    "wls_c": "WLS-C",
    "wls_rc": "WLS-RC",
    "map": "MAP",
    "map_lmi": "MAP-LMI",
}


@dataclass(frozen=True)
class ReportedResult:
    """A result to show.

    Attributes
    ----------
    estimate : Estimate
    parameters : ParameterSet
        Its p parameters.
    deviation_factor : (p, r) float64 or None
        L of the covariance L Lᵀ; None if the method gives none.
    log : ReportData or None
        What the result keeps of its log; None in results of live identification and of earlier
        versions.
    given : PredictedLog or None
        Another log, whose forces and motion are shown instead.
    """

    estimate: Estimate
    parameters: ParameterSet
    deviation_factor: FloatArray | None = None
    log: ReportData | None = None
    given: PredictedLog | None = None

    @property
    def free_deviations(self) -> FloatArray | None:
        """(p, r) the same factor, zero for the joint terms that were not identified."""
        if self.deviation_factor is None:
            return None
        return np.where(self._is_fixed[:, None], 0.0, self.deviation_factor)

    @property
    def deviations(self) -> FloatArray | None:
        """(p, r + 1) these deviations with that of the gain that no residual shows."""
        free = self.free_deviations
        if free is None:
            return None
        names = self.estimate.names
        change = np.zeros(len(names))
        if self.log is not None and set(self.log.spread.names) == set(names):
            saved = dict(zip(self.log.spread.names, self.log.spread.scale_change, strict=True))
            change = np.array([saved[name] for name in names])
        return np.column_stack([free, np.where(self._is_fixed, 0.0, change)])

    @property
    def _is_fixed(self) -> BoolArray:
        """(p,) which parameters were not identified."""
        return np.array([name in self.estimate.fixed for name in self.estimate.names], dtype=bool)

    @property
    def prior_std(self) -> FloatArray | None:
        """(p,) standard deviations before the data; None if they are not saved."""
        names = self.estimate.names
        spread = None if self.log is None else self.log.spread
        if spread is None or not len(spread.prior_std) or set(spread.names) != set(names):
            return None
        saved = dict(zip(spread.names, spread.prior_std, strict=True))
        return np.array([saved[name] for name in names])

    @property
    def summary(self) -> RobotSummary:
        """Mass and centre of mass of the robot."""
        log = self.log
        if log is None and self.given is not None:
            log = self.given.data
        coverage = None if log is None else log.coverage
        model = self.parameters.model
        known = coverage is not None and coverage.joints == model.joint_names
        return summarise_robot(
            self.parameters,
            self.estimate.value,
            self.estimate.prior,
            self.deviations,
            coverage.mean_posture if coverage is not None and known else None,
            prior_std=self.prior_std,
        )


def load_result(folder: Path, model: RobotModel | None = None) -> ReportedResult:
    """Read the folder of an identification.

    Parameters
    ----------
    folder : Path
    model : RobotModel, optional
        The robot; by default that in the folder.

    Raises
    ------
    SymbidError
        When a file is missing, malformed or of another robot.
    """
    if model is None:
        estimate = load_estimate(folder / "estimate.json")
        model = _with_shapes(load_result_robot(folder, estimate), estimate)
    found = load_estimated_model(folder, model)
    if found.estimate is None:
        raise EstimateError(
            f"{folder}: holds a prior; give the folder of an identification", "E556"
        )
    return ReportedResult(
        found.estimate, found.parameters, found.deviation_factor, load_report_data(folder)
    )


def _with_shapes(model: RobotModel, estimate: Estimate) -> RobotModel:
    """Return the robot with the file that was identified as its source, if that is unchanged.

    Its meshes lie beside or above that file, not beside the result's.
    """
    files = () if estimate.provenance is None else estimate.provenance.inputs
    for one in files:
        path = Path(one.path)
        if one.path not in estimate.inputs or path.suffix not in MODEL_SUFFIXES:
            continue
        if path.is_file() and digest(path).sha256 == one.sha256:
            return replace(model, source=one.path)
    return model


def with_forces_of(result: ReportedResult, folder: Path, log: Log) -> ReportedResult:
    """Return the result of a folder that shows the forces and the motion of another log.

    Raises
    ------
    SymbidError
        When the log is invalid, or of another robot.
    """
    return replace(result, given=predicted_log(ForcePredictor.load(folder), log))


def labels(folders: Sequence[Path], estimates: Sequence[Estimate]) -> list[str]:
    """Return a label for each result: its method, and its folder if methods repeat."""
    titles = [METHOD_TITLES.get(one.method, one.method) for one in estimates]
    if len(set(titles)) == len(titles):
        return titles
    return [f"{title}, {folder}" for title, folder in zip(titles, folders, strict=True)]
