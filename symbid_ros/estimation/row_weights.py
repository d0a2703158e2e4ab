"""Row weights from the sensors' own noise, Eq. 28, as the plates' noise reaches each row."""

from dataclasses import dataclass, replace

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.dynamics.kinematics import joint_axes, link_poses
from symbid_ros.dynamics.regressor import generalised_force
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import EstimateError
from symbid_ros.model.tree import RobotModel


@dataclass(frozen=True)
class SensorDeviation:
    """Standard deviations of the force sensors' white noise.

    Attributes
    ----------
    effort : float
        Joint torque or force, Nm or N.
    force, moment : float
        Wrench sensors, N and Nm per axis.
    """

    effort: float
    force: float
    moment: float

    def __post_init__(self) -> None:
        """Refuse a deviation that would give a row infinite weight."""
        if not min(self.effort, self.force, self.moment) > 0:
            raise EstimateError(
                f"sensor deviations {self.effort}, {self.force}, {self.moment} must all be positive"
            )


def sensor_row_deviation(
    model: RobotModel, samples: Samples, sensors: SensorDeviation
) -> FloatArray:
    """Return σ (n,) of the generalised force, root mean square over the samples.

    y is linear in efforts and wrenches, so its variance is the sum of the responses
    to each component alone.
    """
    probe = samples[:: max(1, len(samples) // 500)]
    poses = link_poses(model, probe.position)
    axes = joint_axes(model, poses)
    variance = np.zeros(model.dof)
    variance[6 * model.floating :] = sensors.effort**2
    wrench_std = np.repeat([sensors.moment, sensors.force], 3)
    for sensor in range(len(samples.wrench_frames)):
        for component, std in enumerate(wrench_std):
            alone = np.zeros_like(probe.wrenches)
            alone[:, sensor, component] = std
            unit = replace(probe, effort=np.zeros_like(probe.effort), wrenches=alone)
            variance += np.mean(generalised_force(model, unit, poses, axes) ** 2, axis=0)
    if np.any(variance == 0):
        raise EstimateError(
            "the base has no wrench sensor, so sensor deviations give its rows no weight; weigh by "
            "residuals instead"
        )
    deviation: FloatArray = np.sqrt(variance)
    return deviation
