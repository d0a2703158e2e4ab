import mujoco
import numpy as np
import pytest

from symbid_ros.errors import SimulationError
from symbid_ros.share import config_file
from symbid_ros.simulation.plant import Plant
from symbid_ros.simulation.scenario import SOLES


def test_equation_of_motion_closes_with_what_is_published(run, body):
    worst = 0.0
    for instant in run.instants[::7]:
        body.set(instant)
        mujoco.mj_inverse(body.model, body.data)
        residual = body.data.qfrc_inverse.copy()
        residual[6:] -= instant.true_effort
        for sensor, wrench in zip(run.sensors, instant.wrenches, strict=True):
            origin, rotation, link = body.site(sensor.frame_id)
            force = np.zeros(body.model.nv)
            mujoco.mj_applyFT(
                body.model,
                body.data,
                rotation @ wrench[:3],
                rotation @ wrench[3:],
                origin,
                link,
                force,
            )
            residual -= force
        worst = max(worst, np.abs(residual).max())
    assert worst < 1e-8


def test_feet_carry_the_weight_when_standing_still(smooth, body):
    for instant in smooth.instants[:400:50]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        total = sum(
            body.site(sensor.frame_id)[1] @ wrench[:3]
            for sensor, wrench in zip(smooth.sensors, instant.wrenches, strict=True)
        )
        weight = 41.05 * 9.81
        np.testing.assert_allclose(total, [0.0, 0.0, weight], atol=1e-3 * weight)
        assert np.all(instant.wrenches[:, 2] > 0.4 * weight)


def test_imu_moves_with_the_base_and_its_lever_arm(run, body):
    site = body.model.site("imu_link")
    to_base = np.zeros(9)
    mujoco.mju_quat2Mat(to_base, site.quat)
    to_base = to_base.reshape(3, 3)
    arm = site.pos
    for instant in run.instants[::50]:
        body.set(instant)
        mujoco.mj_kinematics(body.model, body.data)
        to_world = body.data.xmat[1].reshape(3, 3)
        spin, spun = instant.base_angular_velocity, instant.base_angular_acceleration
        specific = (
            instant.base_linear_acceleration
            + np.cross(spun, arm)
            + np.cross(spin, np.cross(spin, arm))
            + to_world.T @ [0.0, 0.0, 9.81]
        )
        np.testing.assert_allclose(instant.imu_angular_velocity, to_base.T @ spin, atol=1e-12)
        np.testing.assert_allclose(instant.imu_linear_acceleration, to_base.T @ specific, atol=1e-9)
        attitude = np.zeros(9)
        mujoco.mju_quat2Mat(attitude, instant.imu_orientation[[3, 0, 1, 2]])
        np.testing.assert_allclose(attitude.reshape(3, 3), to_world @ to_base, atol=1e-12)


def test_truth_is_consistent_in_time(smooth):
    period = 1e-3
    position, velocity, acceleration = (
        smooth.array(name) for name in ("true_position", "true_velocity", "true_acceleration")
    )
    # Semi-implicit Euler: the velocity takes the acceleration, the position the new velocity.
    np.testing.assert_allclose(np.diff(velocity, axis=0), period * acceleration[:-1], atol=1e-12)
    np.testing.assert_allclose(np.diff(position, axis=0), period * velocity[1:], atol=1e-12)


def test_wrenches_are_the_sum_of_the_contact_forces():
    plant = Plant(config_file("symbitron.xml"), SOLES)
    plant.data.qpos[2] -= 1e-3
    for _ in range(20):
        plant.observe()
        truth = plant.advance(np.full(plant.model.nu, 2.0))
        data, model = plant.data, plant.model
        assert data.ncon > 0
        expected = np.zeros((2, 6))
        for index in range(data.ncon):
            contact, force = data.contact[index], np.zeros(6)
            mujoco.mj_contactForce(model, data, index, force)
            in_world = contact.frame.reshape(3, 3).T @ force[:3]
            foot = model.geom_bodyid[contact.geom[1]]
            for row, name in enumerate(SOLES):
                site = model.site(name).id
                if model.site_bodyid[site] == foot:
                    rotation = data.site_xmat[site].reshape(3, 3)
                    moment = np.cross(contact.pos - data.site_xpos[site], in_world)
                    expected[row] += np.concatenate([in_world @ rotation, moment @ rotation])
        np.testing.assert_allclose(truth.wrenches, expected, atol=1e-9)


def test_drives_stop_at_their_limits():
    plant = Plant(config_file("symbitron.xml"), SOLES)
    plant.observe()
    effort = plant.advance(np.full(plant.model.nu, 1e4)).effort
    undriven = [plant.joint_names.index(name) for name in ("R_aie", "L_aie")]
    np.testing.assert_array_equal(effort[undriven], 0.0)
    np.testing.assert_array_equal(np.delete(effort, undriven), 100.0)


def test_unreadable_model_is_named(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text("<mujoco><worldbody><body></mujoco>")
    with pytest.raises(SimulationError, match=r"robot\.xml: MuJoCo refuses"):
        Plant(path, SOLES)


def test_model_without_a_floating_base_is_refused(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(config_file("symbitron.xml").read_text().replace("<freejoint", "<joint"))
    with pytest.raises(SimulationError) as caught:
        Plant(path, SOLES)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["imu_linear_acceleration", "left_sole"])
def test_model_without_a_needed_part_is_refused(tmp_path, name):
    path = tmp_path / "robot.xml"
    path.write_text(config_file("symbitron.xml").read_text().replace(f'"{name}"', '"other"'))
    with pytest.raises(SimulationError, match=name):
        Plant(path, SOLES)
