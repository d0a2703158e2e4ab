import mujoco
import numpy as np
import pytest

from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.plant import Plant
from symbid_ros.simulation.scenario import SOLES


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


def test_torques_are_clipped_to_their_limits():
    plant = Plant(config_file("symbitron.xml"), SOLES)
    plant.observe()
    effort = plant.advance(np.full(plant.model.nu, 1e4)).effort
    undriven = [plant.joint_names.index(name) for name in ("R_aie", "L_aie")]
    np.testing.assert_array_equal(effort[undriven], 0.0)
    np.testing.assert_array_equal(np.delete(effort, undriven), 100.0)


def test_unreadable_model_is_named(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text("<mujoco><worldbody><body></mujoco>")
    with pytest.raises(SimulationError, match=r"robot\.xml") as caught:
        Plant(path, SOLES)
    assert caught.value.code == "E601"


def test_model_without_floating_base_raises_an_error(tmp_path):
    path = tmp_path / "robot.xml"
    path.write_text(config_file("symbitron.xml").read_text().replace("<freejoint", "<joint"))
    with pytest.raises(SimulationError) as caught:
        Plant(path, SOLES)
    assert caught.value.code == "E601"
    assert str(path) in str(caught.value)


@pytest.mark.parametrize("name", ["imu_linear_acceleration", "left_sole"])
def test_model_without_a_required_element_raises_an_error(tmp_path, name):
    path = tmp_path / "robot.xml"
    path.write_text(config_file("symbitron.xml").read_text().replace(f'"{name}"', '"other"'))
    with pytest.raises(SimulationError, match=name) as caught:
        Plant(path, SOLES)
    assert caught.value.code == "E602"
