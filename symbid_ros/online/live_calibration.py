"""Sensor errors as unknowns of a running identification, and when its rows are linearized anew.

Rows are linear in sensor errors only near a linearization point. The first rows are linearized at
the prior's mean. When the estimate has moved away from the point, the rows of the kept blocks are
built again in the background, about the estimate: one step of Gauss-Newton, as in an offline run.
All rows are equations for the unknowns themselves, not for their distances from the point, so rows
of different points add up.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from symbid_ros.choices import SensorErrorKind
from symbid_ros.estimation.change import SENSOR_CHANGE, SensorHypothesis
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.identification.calibration.extended_problem import (
    ExtendedProblem,
    SensorErrorRequest,
    calibration_windows,
)
from symbid_ros.identification.calibration.tares import Tare
from symbid_ros.identification.problem import Problem
from symbid_ros.identification.rows.accumulator import TimeSpan
from symbid_ros.signals.calibrating_rows import CalibratingRows
from symbid_ros.signals.sampled_rows import RowBuilder

# Bytes of aligned sensor data that are kept to be linearized again: 100 s of the Symbitron.
MOST_KEPT = 32 << 20
# Distance of the estimate from the linearization point, in posterior deviations per unknown, above
# which rows are linearized again. An estimate from nine times as much data is about as far. The
# error of linear rows is of second order: a hundredth of a deviation at this distance.
MOVED = 3.0
# Factor by which the number of blocks grows between two linearizations. Those of this many blocks
# are allowed at any time.
AGAIN = 2
FEW = 4
# Distance of a tare from the estimated offset, in deviations, from which the offset has changed.
CONTRADICTS = 5.0
OFFSET = "wrench_offset"


class LiveCalibration:
    """The unknown sensor errors of a running identification.

    Parameters
    ----------
    problem : Problem
        Without sensor errors and observations.
    first : TimeSpan
        First sensor data, with segments. They tell the frames of the sensors and the rate.
    kinds : tuple of str
        Kinds of errors.
    tares : mapping of str to Tare
        By frame of the wrench sensor.

    Attributes
    ----------
    extended : ExtendedProblem
    windows : tuple of float
        Shortest and longest window length of the rows, s. The last one is solved: few window
        lengths save time.
    """

    def __init__(
        self,
        problem: Problem,
        first: TimeSpan,
        kinds: tuple[SensorErrorKind, ...],
        tares: Mapping[str, Tare],
    ) -> None:
        segment = first.segments[0]
        self.extended = ExtendedProblem.of(
            replace(problem, needs_longest_window=True),
            segment.wrench_frames,
            segment.imu_frames,
            SensorErrorRequest(kinds, tares),
            segment,
        )
        self.windows = calibration_windows(segment.rate)
        self._linearized_at = 0

    @property
    def hypotheses(self) -> tuple[SensorHypothesis, ...]:
        """The sensor errors that may change."""
        errors = self.extended.errors
        return tuple(
            SensorHypothesis(
                f"{sensor}/{kind}",
                errors.names[place],
                errors.units[place],
                SENSOR_CHANGE * errors.std[place],
            )
            for sensor, kind, place in errors.groups
        )

    def with_tares(self, problem: Problem, tares: Mapping[str, Tare]) -> Problem:
        """Return a problem of these unknowns with the tares' priors of the sensors' offsets."""
        prior, names = problem.prior, problem.prior.names
        mean, scale = prior.mean.copy(), np.ones(len(names))
        for frame, tare in tares.items():
            places = self._offsets(names, frame)
            mean[places] = tare.mean[: len(places)]
            scale[places] = tare.std[: len(places)] / prior.std[places]
        return replace(problem, prior=replace(prior.widened(scale), mean=mean))

    def contradicts(self, found: Posterior, tares: Mapping[str, Tare]) -> bool:
        """Return whether tares read other offsets than an estimate says."""
        for frame, tare in tares.items():
            places = self._offsets(found.prior.names, frame)
            std = np.hypot(found.std[places], tare.std[: len(places)])
            if np.any(np.abs(found.mean[places] - tare.mean[: len(places)]) > CONTRADICTS * std):
                return True
        return False

    def _offsets(self, names: Sequence[str], frame: str) -> list[int]:
        """Return the places of a wrench sensor's offset among unknowns; none if it is known."""
        start = f"{frame}/{OFFSET}_"
        return [index for index, name in enumerate(names) if name.startswith(start)]

    @property
    def first_rows(self) -> CalibratingRows:
        """Builds rows about the prior's mean."""
        return self.extended.rows(self.extended.prior_point)

    @property
    def no_observations(self) -> tuple[Observations, ...]:
        """Empty observations, one for each window length."""
        candidates = self.extended.problem.parameters.candidates
        return tuple(
            Observations.empty(self.extended.layout, window, candidates=candidates)
            for window in self.windows
        )

    def better_rows(self, found: Posterior, used: RowBuilder, count: int) -> CalibratingRows | None:
        """Return what builds rows about an estimate; None if those in use are good enough.

        Parameters
        ----------
        found : Posterior
            The estimate, perhaps without joint terms that the data do not ask for.
        used : RowBuilder
            Builds the rows in use.
        count : int
            Number of blocks so far.
        """
        assert isinstance(used, CalibratingRows)
        if count > FEW and count < AGAIN * self._linearized_at:
            return None
        problem, point = self.extended.problem, used.linearization
        names = problem.prior.names
        columns = [names.index(name) for name in found.prior.names]
        unknowns = problem.prior.mean.copy()
        unknowns[columns] = found.mean
        better = self.extended.point(unknowns)
        moved = np.concatenate([better.phi - point.phi, better.theta - point.theta])
        # Rows are linear in joint terms.
        moved[problem.parameters.inertial : len(problem.parameters)] = 0.0
        if np.linalg.norm(found.factor @ moved[columns]) < MOVED * np.sqrt(len(columns)):
            return None
        self._linearized_at = count
        return self.extended.rows(better)
