"""A model that is given as the true robot must explain the forces of the simulation."""

import pytest
from random_robots import CONFIG

from symbid_ros.identification.predictions.evaluation import check_true_robot
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import read_true_motion

ROBOT = load_model(CONFIG / "symbitron.xml")


def warnings_about(robot, bag, caplog) -> str:
    caplog.clear()
    check_true_robot(robot, read_true_motion([bag], ROBOT))
    return caplog.text


@pytest.mark.parametrize("is_ideal", [True, False])
def test_noise_is_no_evidence_against_the_true_robot(simulated, is_ideal, caplog) -> None:
    bag = simulated("smooth", moves=1, motion_seed=22, ideal=is_ideal)
    said = warnings_about(ROBOT, bag, caplog)
    # Errors of forces would be those of the noise.
    assert ("the wrenches of the bag are noisy" in said) == (not is_ideal)
    assert "so it is not the true robot" not in said
    # A model whose masses are wrong by 5 % is found in the noise as well.
    other = ROBOT.with_phi(1.05 * ROBOT.phi)
    assert "leaves 5 % of the bag's forces unexplained" in warnings_about(other, bag, caplog)


def test_errors_of_force_sensors_are_not_noise(simulated, caplog) -> None:
    bag = simulated("smooth", moves=1, motion_seed=22, ideal=True, errors="wrench_gain")
    assert "the bag has a payload or sensor errors" in warnings_about(ROBOT, bag, caplog)
