"""Robots with fewer sensors, and the rows of the equation of motion that they are left with.

The base's rows need no torque sensor, for the motors act between links (Eq. 4). Without wrench
sensors the contact wrenches f_e are unknown at every instant, and what is left are the rows
N(q) K φ = N(q) Sᵀ f_a with N(q) J_gᵀ(q) = 0, in which no wrench on a contact shows.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import qr

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.contact import RANK_TOLERANCE, contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import StudyError
from symbid_ros.estimation.information import RowLayout, random_motions
from symbid_ros.estimation.observations import Observations
from symbid_ros.identification.dataset import SAMPLES_AT_ONCE, Dataset, observe
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sensor_samples import SensorSamples, at_base
from symbid_ros.signals.weak_form import CHUNK, SampledRows, sticking_left_out

Sensing = Literal["all", "base_rows", "joint_rows", "no_plates"]

# A wrench that the coordinates feel less than this share of the best felt one damps the rows that
# are left: which of them it leaves alone turns ever faster as it fades, down to encoder noise.
# With the legs in parallel planes the feet twisted against each other are felt at 1e-3 and less.
FAINT = 3e-4
# Instants at which the directions are looked at that stay free of contact wrenches.
PROBES = 1000


@dataclass(frozen=True)
class Annihilator:
    """N(q) = d(q) N₀ᵀ P(q), through which no wrench on the contacts passes.

    P projects onto the complement of the range of J_gᵀ. Averages over windows need an N that
    is smooth in time; P is not where J_g loses rank, and d = det(J Jᵀ) / det(J Jᵀ + ε²), which
    vanishes there, makes it so: det(J Jᵀ) P = det(J Jᵀ) - Jᵀ adj(J Jᵀ) J is a polynomial of J.
    Newtons and newton metres may stand side by side: other units give other combinations of the
    same rows, and rows are weighted by the covariance of their residuals.

    Attributes
    ----------
    model : RobotModel
        The robot, of n coordinates.
    frames : tuple of str
        Where unknown wrenches act.
    components : (r,) int64
        Those of the wrenches' 6 F components, angular first, whose effects are independent:
        two frames may sit on one link.
    faint : float
        ε, in J's units.
    basis : (n, n - r) float64
        N₀.
    """

    model: RobotModel
    frames: tuple[str, ...]
    components: IntArray
    faint: float
    basis: FloatArray

    @classmethod
    def of(cls, model: RobotModel, samples: Samples) -> "Annihilator":
        """Find N₀ for the wrench frames and the postures of some samples.

        Raises
        ------
        StudyError
            When there is no wrench sensor, or unknown wrenches leave no row.
        """
        frames = samples.wrench_frames
        if not frames:
            raise StudyError(
                f"no_plates: the log of {model.source} has no wrench topic whose frame would tell "
                "where contacts act; record them, or study other rows"
            )
        anywhere = _contacts(model, frames, random_motions(model, 1).position)[0]
        _, R, order = qr(anywhere.T, mode="economic", pivoting=True)
        size = np.abs(R.diagonal())
        rank = int(np.sum(size > RANK_TOLERANCE * size.max(initial=0.0)))
        if rank == model.dof:
            raise StudyError(
                f"no_plates: unknown wrenches at {', '.join(frames)} explain any motion of "
                f"{model.source}; leave one of their topics out, or study other rows"
            )
        probes = samples[:: max(1, len(samples) // PROBES)]
        largest = np.linalg.norm(_contacts(model, frames, probes.position), 2, axis=(1, 2)).max()
        components = np.sort(order[:rank])
        whole = cls(model, frames, components, FAINT * float(largest), np.eye(model.dof))
        # Directions that the contacts leave free in most postures lose least by projection.
        _, directions = np.linalg.eigh(whole.at(probes.position).mean(axis=0))
        return replace(whole, basis=directions[:, rank:])

    def at(self, position: FloatArray) -> FloatArray:
        """Return N (N, n - r, n) at joint positions (N, J)."""
        J = _contacts(self.model, self.frames, position)[:, self.components]
        Q, R = np.linalg.qr(J.transpose(0, 2, 1), mode="complete")
        felt = np.prod(np.diagonal(R, axis1=1, axis2=2) ** 2, axis=1)
        rank = len(self.components)
        damped = np.linalg.det(J @ J.transpose(0, 2, 1) + self.faint**2 * np.eye(rank))
        free = Q[:, :, rank:]
        N: FloatArray = (self.basis.T @ free) @ free.transpose(0, 2, 1)
        N *= (felt / damped)[:, None, None]
        return N


def _contacts(model: RobotModel, frames: tuple[str, ...], position: FloatArray) -> FloatArray:
    """Return J_g (N, 6 F, n) at joint positions (N, J)."""
    return contact_jacobian(model, frames, link_poses(model, position))


@dataclass(frozen=True)
class SensedRows:
    """The rows of the equation of motion that a robot's sensors leave it with.

    Attributes
    ----------
    parameters : ParameterSet
        The robot's p columns.
    layout : RowLayout
        Of the rows that are there; the others have neither place nor weight in it.
    selection : slice or Annihilator
        Coordinates whose rows are there, or what eliminates the contact wrenches.
    """

    parameters: ParameterSet
    layout: RowLayout
    selection: slice | Annihilator

    @classmethod
    def of(cls, parameters: ParameterSet, sensing: Sensing, samples: Samples) -> "SensedRows":
        """Return the rows left by some sensors.

        Without wrench sensors, rows are combined as suits the wrench frames and postures of these
        samples. Records to be merged should share one such choice, for their residuals get one
        covariance.

        Raises
        ------
        StudyError
            When no row is left.
        """
        model, every = parameters.model, RowLayout.of(parameters)
        if sensing == "no_plates":
            annihilator = Annihilator.of(model, samples)
            names = tuple(f"unloaded/{index}" for index in range(annihilator.basis.shape[1]))
            structure = np.tile(every.structure.any(axis=0), (len(names), 1))
            return cls(parameters, RowLayout(names, every.parameters, structure), annihilator)
        first_joint = 6 * model.floating
        there = {
            "all": slice(0, model.dof),
            "base_rows": slice(0, first_joint),
            "joint_rows": slice(first_joint, model.dof),
        }[sensing]
        if there.start == there.stop:
            lacks = "a fixed base" if sensing == "base_rows" else "no joint"
            raise StudyError(f"{sensing}: {model.source} has {lacks}; study other rows of it")
        layout = RowLayout(every.coordinates[there], every.parameters, every.structure[there])
        return cls(parameters, layout, there)

    def at(self, samples: Samples) -> SampledRows:
        """Return the rows at single instants; where a joint may stick, its rows are not valid."""
        valid = sticking_left_out(self.parameters, samples.velocity)
        if isinstance(self.selection, slice):
            rows, there = equation_of_motion(self.parameters, samples), self.selection
            chosen = Rows(rows.K[:, there], rows.y[:, there])
            return SampledRows(samples.stamp, chosen, valid[:, there])
        unmeasured = replace(samples, wrenches=np.zeros_like(samples.wrenches))
        rows = equation_of_motion(self.parameters, unmeasured)
        N = self.selection.at(samples.position)
        left = Rows(N @ rows.K, np.einsum("nij,nj->ni", N, rows.y))
        # Each of them combines all joints.
        slipping: BoolArray = np.repeat(valid.all(axis=1, keepdims=True), N.shape[1], axis=1)
        return SampledRows(samples.stamp, left, slipping)

    def build(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of readings: a :data:`symbid_ros.signals.weak_form.RowBuilder`."""
        for start in range(0, len(readings), CHUNK):
            yield self.at(at_base(readings[start : start + CHUNK], self.parameters.model))


def observe_sensed(
    record: Dataset, parameters: ParameterSet, sensing: Sensing
) -> tuple[Observations, ...]:
    """Return what a record says to a robot with fewer sensors.

    Rows are windowed or taken at single instants as those of the record were.

    Raises
    ------
    StudyError
        When no row is left.
    """
    if sensing == "all":
        return record.observations
    rows = SensedRows.of(parameters, sensing, record.samples)
    windows = [one.window for one in record.observations]
    if 0.0 in windows:
        (at_instants,) = record.observations
        blocks = map(rows.at, record.samples.blocks(SAMPLES_AT_ONCE))
        return (Observations.unwindowed(rows.layout, blocks, at_instants.inflation),)
    return observe(record.segments, rows.build, rows.layout, windows)
