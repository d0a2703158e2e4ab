"""Estimates of any robot without an identification: its file's values, from an inaccurate prior."""

import numpy as np

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel


def drawn_estimate(model: RobotModel, seed: int = 0) -> tuple[ParameterSet, Estimate]:
    """Return the file's values as an estimate; the prior's links are up to 25 % heavier or lighter.

    The n-th link has n mod 11 determined parameters.
    """
    parameters = ParameterSet(model)
    rng = np.random.default_rng(seed)
    value = parameters.values.copy()
    prior = value.copy()
    phi = parameters.link_phi(prior)
    phi *= rng.uniform(0.75, 1.25, (len(phi), 1))
    count = np.arange(len(phi)) % 11
    determined = (np.arange(10) < count[:, None]).ravel()
    names = parameters.link_names
    return parameters, Estimate(
        method="map_lmi",
        model=model.name,
        names=parameters.names,
        units=parameters.units,
        value=value,
        prior=prior,
        std=0.05 * np.abs(prior) + 1e-4,
        determined=determined,
        rank=None,
        condition=10.0,
        samples=100,
        residual_rmse=dict.fromkeys(model.coordinates, 1.0),
        consistent={
            name: is_consistent(own)
            for name, own in zip(names, parameters.link_phi(value), strict=True)
        },
        inputs=("drawn",),
        software="symbid_ros",
    )
