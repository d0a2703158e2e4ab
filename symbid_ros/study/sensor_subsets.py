"""Rows of the equation of motion for robots without some of the sensors.

The base's rows need no torque sensor, as the motors act between links (Eq. 4). Without wrench
sensors the contact wrenches f_e are unknown at every instant. The rows
N(q) K φ = N(q) Sᵀ f_a with N(q) J_gᵀ(q) = 0 remain, which no contact wrench enters.
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
from symbid_ros.dynamics.unmeasured_contacts import DAMPING, annihilator
from symbid_ros.errors import StudyError
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.row_layout import RowLayout, random_motions
from symbid_ros.identification.rows.dataset import SAMPLES_AT_ONCE, Dataset, observe
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.sampled_rows import MOST_AT_ONCE, SampledRows, valid_coordinates
from symbid_ros.signals.sensor_samples import SensorSamples, at_base

SensorSubset = Literal["all", "base_rows", "joint_rows", "no_plates"]

# Number of postures from which the directions without contact wrenches are chosen.
PROBES = 1000


@dataclass(frozen=True)
class Annihilator:
    """N(q) = d(q) N₀ᵀ P(q), which eliminates the contact wrenches from the equation of motion.

    P projects onto the orthogonal complement of the range of J_gᵀ. Averages over windows need an N
    that is smooth in time, and P is not smooth where J_g loses rank. The factor
    d = det(J Jᵀ) / det(J Jᵀ + ε²) vanishes there, and det(J Jᵀ) P = det(J Jᵀ) - Jᵀ adj(J Jᵀ) J is
    a polynomial of J. Units may be mixed: other units give other combinations of the same rows,
    and rows are weighted by the covariance of their residuals.

    Attributes
    ----------
    model : RobotModel
        The robot, of n coordinates.
    frames : tuple of str
        Frames at which unknown wrenches act.
    components : (r,) int64
        Independent ones of the wrenches' 6 F components, angular first. If two frames are on one
        link, some are dependent.
    damping : float
        ε, in J's units.
    basis : (n, n - r) float64
        N₀.
    """

    model: RobotModel
    frames: tuple[str, ...]
    components: IntArray
    damping: float
    basis: FloatArray

    @classmethod
    def of(cls, model: RobotModel, samples: Samples) -> "Annihilator":
        """Compute N₀ from the wrench frames and the postures of some samples.

        Raises
        ------
        StudyError
            If there is no wrench sensor, or if unknown wrenches leave no row.
        """
        frames = samples.wrench_frames
        if not frames:
            raise StudyError(
                f"no_plates: the log of {model.source} has no wrench topic whose frame shows where "
                "contacts act; record one, or choose other sensors",
                "E708",
            )
        generic = _contact_jacobian(model, frames, random_motions(model, 1).position)[0]
        _, R, order = qr(generic.T, mode="economic", pivoting=True)
        size = np.abs(R.diagonal())
        rank = int(np.sum(size > RANK_TOLERANCE * size.max(initial=0.0)))
        if rank == model.dof:
            raise StudyError(
                f"no_plates: unknown wrenches at {', '.join(frames)} explain any motion of "
                f"{model.source}; leave out one of their topics, or choose other sensors",
                "E708",
            )
        probes = samples[:: max(1, len(samples) // PROBES)]
        jacobians = _contact_jacobian(model, frames, probes.position)
        largest = np.linalg.norm(jacobians, 2, axis=(1, 2)).max()
        components = np.sort(order[:rank])
        full = cls(model, frames, components, DAMPING * float(largest), np.eye(model.dof))
        # These directions are without contact wrenches in most postures.
        _, directions = np.linalg.eigh(full.at(probes.position).mean(axis=0))
        return replace(full, basis=directions[:, rank:])

    def at(self, position: FloatArray) -> FloatArray:
        """Return N (N, n - r, n) at joint positions (N, J)."""
        J = _contact_jacobian(self.model, self.frames, position)[:, self.components]
        return annihilator(J, self.damping, self.basis.T)


def _contact_jacobian(
    model: RobotModel, frames: tuple[str, ...], position: FloatArray
) -> FloatArray:
    """Return J_g (N, 6 F, n) at joint positions (N, J)."""
    return contact_jacobian(model, frames, link_poses(model, position))


@dataclass(frozen=True)
class SubsetRows:
    """The rows of the equation of motion that a subset of the sensors provides.

    Attributes
    ----------
    parameters : ParameterSet
        The robot's p columns.
    layout : RowLayout
        Layout of the remaining rows.
    selection : slice or Annihilator
        The coordinates whose rows remain, or the annihilator of the contact wrenches.
    """

    parameters: ParameterSet
    layout: RowLayout
    selection: slice | Annihilator

    @classmethod
    def of(cls, parameters: ParameterSet, sensors: SensorSubset, samples: Samples) -> "SubsetRows":
        """Return the rows that a subset of the sensors provides.

        Without wrench sensors, the wrench frames and postures of the samples determine the
        combination of rows. Logs can be merged only with equal combinations, as their residuals
        share one covariance.

        Raises
        ------
        StudyError
            If no row remains.
        """
        model, full = parameters.model, RowLayout.of(parameters)
        if sensors == "no_plates":
            annihilator = Annihilator.of(model, samples)
            names = tuple(f"unloaded/{index}" for index in range(annihilator.basis.shape[1]))
            structure = np.tile(full.structure.any(axis=0), (len(names), 1))
            return cls(parameters, RowLayout(names, full.parameters, structure), annihilator)
        first_joint = 6 * model.floating
        kept = {
            "all": slice(0, model.dof),
            "base_rows": slice(0, first_joint),
            "joint_rows": slice(first_joint, model.dof),
        }[sensors]
        if kept.start == kept.stop:
            reason = "a fixed base" if sensors == "base_rows" else "no joint"
            raise StudyError(
                f"{sensors}: {model.source} has {reason}; choose other sensors", "E708"
            )
        layout = RowLayout(full.coordinates[kept], full.parameters, full.structure[kept])
        return cls(parameters, layout, kept)

    def at(self, samples: Samples) -> SampledRows:
        """Return the rows at single instants; rows of joints that may stick are invalid."""
        valid = valid_coordinates(self.parameters, samples.velocity)
        if isinstance(self.selection, slice):
            rows, kept = equation_of_motion(self.parameters, samples), self.selection
            chosen = Rows(rows.K[:, kept], rows.y[:, kept])
            return SampledRows(samples.stamp, chosen, valid[:, kept])
        unmeasured = replace(samples, wrenches=np.zeros_like(samples.wrenches))
        rows = equation_of_motion(self.parameters, unmeasured)
        N = self.selection.at(samples.position)
        combined = Rows(N @ rows.K, np.einsum("nij,nj->ni", N, rows.y))
        # Each row combines all joints, so it is valid only if none of them may stick.
        slipping: BoolArray = np.repeat(valid.all(axis=1, keepdims=True), N.shape[1], axis=1)
        return SampledRows(samples.stamp, combined, slipping)

    def build(self, readings: SensorSamples) -> Iterator[SampledRows]:
        """Yield the rows of readings: a :data:`symbid_ros.signals.sampled_rows.RowBuilder`."""
        for start in range(0, len(readings), MOST_AT_ONCE):
            yield self.at(at_base(readings[start : start + MOST_AT_ONCE], self.parameters.model))


def observe_subset(
    dataset: Dataset, parameters: ParameterSet, sensors: SensorSubset
) -> tuple[Observations, ...]:
    """Return the observations that a subset of the sensors of a log provides.

    Rows are averaged over windows or taken at single instants, as in the log's own observations.

    Raises
    ------
    StudyError
        If no row remains.
    """
    if sensors == "all":
        return dataset.observations
    rows = SubsetRows.of(parameters, sensors, dataset.samples)
    windows = [one.window for one in dataset.observations]
    if 0.0 in windows:
        (at_instants,) = dataset.observations
        blocks = map(rows.at, dataset.samples.blocks(SAMPLES_AT_ONCE))
        return (Observations.unwindowed(rows.layout, blocks, at_instants.inflation),)
    return observe(dataset.segments, rows.build, rows.layout, windows)
