"""Row weights from sensor noise (Eq. 28) against MuJoCo's response to each noisy component."""

import mujoco
import numpy as np
import pytest
from random_robots import random_robot, random_samples

from symbid_ros.estimation.truncated_svd import SensorNoise, sensor_row_std
from symbid_ros.model.export_mjcf import mjcf_text

SENSORS = SensorNoise(effort=0.3, force=2.0, moment=0.7)


def generalised_forces(model, position, frame, rng):
    """Return what unit moments and forces on a frame do in MuJoCo (6, n), in our rows."""
    compiled = mujoco.MjModel.from_xml_string(mjcf_text(model))
    data = mujoco.MjData(compiled)
    base = np.eye(3)
    if model.floating:  # noise is the same however the base lies
        data.qpos[3:7] = rng.normal(size=4)
        data.qpos[3:7] /= np.linalg.norm(data.qpos[3:7])
        mujoco.mju_quat2Mat(flat := np.empty(9), data.qpos[3:7])
        base = flat.reshape(3, 3)
    data.qpos[data.qpos.size - len(position) :] = position
    mujoco.mj_kinematics(compiled, data)
    mujoco.mj_comPos(compiled, data)
    axes, place = data.site(frame).xmat.reshape(3, 3), data.site(frame).xpos
    responses = []
    for component in range(6):
        moment, force = np.zeros((2, 3))
        (moment, force)[component // 3][component % 3] = 1.0
        response = np.zeros(compiled.nv)
        body = compiled.site(frame).bodyid[0]
        mujoco.mj_applyFT(compiled, data, axes @ force, axes @ moment, place, body, response)
        if model.floating:  # MuJoCo: force first, in world axes
            response[:6] = np.r_[response[3:6], base.T @ response[:3]]
        responses.append(response)
    return np.array(responses)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("floating", [True, False])
def test_deviations_are_what_noise_does_to_the_rows(seed, floating) -> None:
    rng = np.random.default_rng(seed)
    model = random_robot(seed, links=3 + seed, floating=floating, wrench_frames=1 + seed)
    samples = random_samples(model, 5, rng)
    variance = np.zeros((len(samples), model.dof))
    variance[:, 6 * floating :] = SENSORS.effort**2
    components = np.repeat([SENSORS.moment, SENSORS.force], 3)
    for instant, position in enumerate(samples.position):
        for frame in samples.wrench_frames:
            responses = components[:, None] * generalised_forces(model, position, frame, rng)
            variance[instant] += np.sum(responses**2, axis=0)
    found = sensor_row_std(model, samples, SENSORS)
    np.testing.assert_allclose(found, np.sqrt(variance.mean(axis=0)), rtol=1e-9)
