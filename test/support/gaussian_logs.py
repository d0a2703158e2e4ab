"""Logs drawn from the very model that estimators assume, row by row and with a known truth."""

from dataclasses import dataclass, replace

import numpy as np
from random_robots import random_robot

from symbid_ros.dynamics.regressor import Rows, equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import Prior, draw_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.weak_form import WindowedRows


@dataclass(frozen=True)
class Log:
    """Rows y = K φ + e, what noise in the motion changes in them, and which of them count."""

    parameters: ParameterSet
    layout: RowLayout
    K: np.ndarray
    y: np.ndarray
    noise_rows: np.ndarray
    noise_targets: np.ndarray
    valid: np.ndarray
    window: float = 0.081
    inflation: float = 1.0

    def __len__(self):
        return len(self.K)

    def __getitem__(self, part):
        names = ("K", "y", "noise_rows", "noise_targets", "valid")
        return replace(self, **{name: getattr(self, name)[part] for name in names})

    @property
    def truth(self):
        return self.parameters.values

    def rows(self):
        """Return the rows as windows would give them: zero where they do not count."""
        seen = self.valid[:, :, None]
        return WindowedRows(
            Rows(self.K * seen, self.y * self.valid),
            Rows(self.noise_rows * seen, self.noise_targets * self.valid),
            self.valid,
            np.arange(len(self.valid)),
        )

    def observations(self):
        empty = replace(Observations.empty(self.layout, self.window), inflation=self.inflation)
        return empty.fold([self.rows()])

    def measured(self, rng, root):
        """Return the log measured again, with noise of covariance root rootᵀ in each row."""
        noise = rng.normal(size=self.y.shape) @ root.T
        return replace(self, y=self.K @ self.truth + noise)

    def with_noisy_regressor(self, rng, size):
        """Return the log with K disturbed, and as much again, drawn apart, as its noise part."""
        shape = self.K.shape
        spread = size * np.sqrt(np.mean(self.K**2, axis=0))
        return replace(
            self,
            K=self.K + spread * rng.normal(size=shape),
            noise_rows=spread * rng.normal(size=shape),
        )


def smooth_samples(model, count, rng, seconds=20.0):
    """Return a motion of three sines per joint and base axis, its derivatives exact."""
    joints = len(model.joints)
    time = np.linspace(0.0, seconds, count)[:, None, None]
    shape = (1, joints + 6, 3)
    omega = rng.uniform(1.0, 12.0, shape)
    amplitude = rng.uniform(0.2, 1.0, shape) / omega
    angle = omega * time + rng.uniform(0.0, 2 * np.pi, shape)
    position = np.sum(amplitude * np.sin(angle), axis=2)
    velocity = np.sum(amplitude * omega * np.cos(angle), axis=2)
    acceleration = -np.sum(amplitude * omega**2 * np.sin(angle), axis=2)
    force = acceleration[:, joints + 3 :] - np.array([0.0, 0.0, -9.81])
    nothing = np.zeros((count, 3))
    floats = model.floating
    return Samples(
        stamp=np.arange(count, dtype=np.int64) * 40_000_000,
        position=position[:, :joints],
        velocity=velocity[:, :joints],
        acceleration=acceleration[:, :joints],
        effort=np.zeros((count, joints)),
        base_angular_velocity=velocity[:, joints : joints + 3] if floats else nothing,
        base_angular_acceleration=acceleration[:, joints : joints + 3] if floats else nothing,
        base_specific_force=force if floats else nothing - model.gravity,
        wrenches=np.zeros((count, 0, 6)),
        wrench_frames=(),
    )


def gaussian_log(seed, *, links=3, count=60, floating=True, terms=()):
    """Return a smooth log of a random robot whose noise is correlated across coordinates."""
    rng = np.random.default_rng(seed)
    parameters = ParameterSet(random_robot(seed, links, floating=floating), terms)
    K = equation_of_motion(parameters, smooth_samples(parameters.model, count, rng)).K
    n = K.shape[1]
    log = Log(
        parameters,
        RowLayout.of(parameters),
        K,
        np.zeros((count, n)),
        np.zeros_like(K),
        np.zeros((count, n)),
        np.ones((count, n), dtype=bool),
    )
    return log.measured(rng, noise_root(rng, n))


def noise_root(rng, n):
    """Return a root of a covariance (n, n): unlike deviations, well correlated."""
    return rng.uniform(0.1, 2.0, n)[:, None] * np.linalg.cholesky(correlation(rng, n))


def correlation(rng, size):
    """Return a random correlation matrix, far from singular."""
    mixing = np.eye(size) + rng.normal(size=(size, size)) / np.sqrt(size)
    covariance = mixing @ mixing.T + 0.2 * np.eye(size)
    deviation = np.sqrt(np.diag(covariance))
    return covariance / np.outer(deviation, deviation)


def correlated(prior, rng):
    """Return the prior with its parameters correlated."""
    root = np.linalg.cholesky(correlation(rng, len(prior.std)))
    return replace(prior, factor=prior.std[:, None] * root)


def scattered(prior, truth, rng):
    """Return the prior about another mean, drawn so that it is right about the truth."""
    return replace(prior, mean=truth + prior.covariance_factor() @ rng.normal(size=len(truth)))


def prior_of(log, seed, *, percent=25.0, related=False) -> Prior:
    """Return a prior about the log's robot, its parameters correlated if ``related``."""
    prior = draw_prior(log.parameters, "percent", percent, seed)
    return correlated(prior, np.random.default_rng(seed)) if related else prior
