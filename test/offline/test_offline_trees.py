"""Any tree goes through every room: simulated, recorded, read, identified, written, judged."""

import numpy as np
import pytest
from random_robots import random_robot
from tree_simulation import TreeSimulation

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.evaluation import evaluate, read_true_motion
from symbid_ros.offline.identification import write_identification
from symbid_ros.offline.job import Job, prepare
from symbid_ros.offline.record import Processing
from symbid_ros.signals.filters import LowPass
from symbid_ros.simulation.recording import record


@pytest.mark.parametrize(("seed", "floating"), [(0, True), (1, True), (4, True), (2, False)])
def test_any_tree_is_identified_from_its_bag(seed, floating, tmp_path):
    robot = random_robot(seed, links=5, floating=floating, wrench_frames=seed)
    path = tmp_path / "robot.xml"
    path.write_text(mjcf_text(robot))
    truth = ParameterSet(load_model(path))
    record(TreeSimulation(robot, 2.5, seed), tmp_path / "log")
    record(TreeSimulation(robot, 0.8, seed + 100), tmp_path / "other")
    draw_prior(truth, "percent", 25, seed).write(tmp_path / "prior.json")

    job = Job(
        bags=(tmp_path / "log",),
        model=path,
        prior=tmp_path / "prior.json",
        processing=Processing(LowPass(cutoff=0)),
        validation=tmp_path / "other",
    )
    prepared = prepare(job)
    estimate = prepared.solve("wls_rc")
    motion = read_true_motion([tmp_path / "other"], truth.model)
    vectors = {"found": estimate.value, "prior": prepared.prior.mean}
    metrics = evaluate(truth, vectors, truth.values, motion)
    found, prior = metrics["found"], metrics["prior"]
    assert found.gen_force_rmse < 0.05 * prior.gen_force_rmse
    assert found.torque_rmse < 0.05 * prior.torque_rmse
    assert found.parameter_error_pct < prior.parameter_error_pct

    write_identification(estimate, truth, tmp_path / "out")
    urdf = load_model(tmp_path / "out/model.urdf")
    written = ParameterSet(urdf).link_phi(ParameterSet(urdf).values)
    np.testing.assert_allclose(written, truth.link_phi(estimate.value), rtol=1e-9, atol=1e-12)
