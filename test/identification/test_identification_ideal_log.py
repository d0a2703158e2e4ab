"""A log without noise: what is left are errors of the simulator, which are no evidence."""

import pytest
from random_robots import CONFIG

from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.evaluation import evaluate
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, read_true_motion

MODEL = CONFIG / "symbitron.xml"


@pytest.mark.parametrize("seed", [3, 6])
def test_a_log_without_noise_gives_the_true_robot_by_default(simulated, seed):
    bag = simulated("smooth", moves=6, motion_seed=seed, ideal=True)
    found = BagRequest((bag,), MODEL, IdentifyOptions(no_holdout=True)).load().solve().estimate
    assert not found.verdict.alarms
    # The model file is true, and its drives have neither friction nor armature.
    robot = ParameterSet(load_model(MODEL))
    motion = read_true_motion([bag], robot.model)[::10]
    (errors,) = evaluate(robot, {"": found.value[: len(robot)]}, robot.values, motion).values()
    assert errors.com_position_rmse_mm < 0.2
    assert errors.torque_rmse < 0.01
    assert not any("negative" in remark for remark in found.remarks)
