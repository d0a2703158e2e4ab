"""Any tree is simulated, recorded, read, identified, written and evaluated."""

import numpy as np
import pytest
from tree_simulation import TreeSimulation

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.evaluation import evaluate
from symbid_ros.identification.result_files import write_identification
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, read_true_motion
from symbid_ros.simulation.recording import record


@pytest.fixture(scope="module", params=[(0, True), (1, True), (4, True), (2, False)], ids=str)
def tree(request, tmp_path_factory, tree_log):
    """A random tree's model file, two bags of its ideal sensors and a prior."""
    seed, floating = request.param
    folder = tmp_path_factory.mktemp("tree")
    robot, log = tree_log(seed, floating)
    (folder / "robot.xml").write_text(mjcf_text(robot))
    truth = ParameterSet(load_model(folder / "robot.xml"))
    record(TreeSimulation(robot, 0.8, seed + 100), folder / "other")
    write_prior(folder / "prior.json", draw_prior(truth, "percent", 25, seed))
    return folder, log, truth


METHODS = [
    {"method": "map_lmi"},
    {"method": "map", "filter": "savitzky_golay", "window": 0.011},
    {"method": "wls_rc", "cutoff": 0.0},
]


@pytest.mark.parametrize("chosen", METHODS, ids=lambda chosen: chosen["method"])
def test_any_tree_is_identified_from_its_bag(tree, chosen, tmp_path):
    folder, log, truth = tree
    method = chosen["method"]
    options = IdentifyOptions(
        prior=folder / "prior.json",
        choose_truncation=folder / "other" if method == "wls_rc" else None,
        joint_terms=("none",),
        **chosen,
    )
    prepared = BagRequest((log,), folder / "robot.xml", options).load()
    found = prepared.solve()
    motion = read_true_motion([folder / "other"], truth.model)
    vectors = {"found": found.estimate.value, "prior": prepared.prior.mean}
    metrics = evaluate(truth, vectors, truth.values, motion)
    after, before = metrics["found"], metrics["prior"]
    assert after.gen_force_rmse < 0.05 * before.gen_force_rmse
    assert after.torque_rmse < 0.05 * before.torque_rmse
    assert after.parameter_error_pct < before.parameter_error_pct
    if method == "map_lmi":
        assert all(found.estimate.consistent.values())

    write_identification(found, truth, tmp_path)
    urdf = load_model(tmp_path / "model.urdf")
    written = ParameterSet(urdf).link_phi(ParameterSet(urdf).values)
    np.testing.assert_allclose(written, truth.link_phi(found.estimate.value), rtol=1e-9, atol=1e-12)
