"""Nothing is found in logs in which nothing is wrong."""

import pytest
from random_robots import CONFIG

from symbid_ros.bags import bag_log
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet

MODEL = load_model(CONFIG / "symbitron.xml")


def believed(kind: str, seed: int):
    """The robot as its maker believes it: its inertias are off by up to a quarter."""
    parameters = ParameterSet(MODEL)
    return MODEL.with_phi(parameters.link_phi(draw_prior(parameters, kind, 25, seed).mean))


MOVING = [
    ("smooth", {"moves": 3, "motion_seed": 21, "noise_seed": 5}),
    ("smooth", {"moves": 1, "motion_seed": 22, "ideal": True}),
    ("squat", {"moves": 1, "motion_seed": 34, "errors": "typical,quantisation"}),
    ("vibrating", {"moves": 1, "motion_seed": 35}),
    ("suspended", {"moves": 1, "motion_seed": 36}),
]


@pytest.mark.parametrize(("scenario", "options"), MOVING, ids=str)
def test_nothing_is_found_in_a_clean_log(simulated, scenario, options) -> None:
    bag = simulated(scenario, **options)
    seed = options["motion_seed"]
    for model in (believed("percent", seed), believed("consistent", seed)):
        diagnosis = diagnose(bag_log([bag], model), model)
        assert [one.message for one in diagnosis.findings] == []
        assert diagnosis.severity is Severity.CLEAN
        is_standing = scenario != "suspended"
        told = diagnosis.figures.get("/imu/data/angle_deg")
        assert (told is not None) is is_standing
        assert any("no foot stands" in reason for reason in diagnosis.left_out) is not is_standing


@pytest.mark.parametrize("options", [{"noise_seed": 41}, {"ideal": True}], ids=["noisy", "ideal"])
def test_a_tare_excites_nothing_and_has_no_other_fault(simulated, options) -> None:
    bag = simulated("tare", **options)
    (found,) = diagnose(bag_log([bag]), believed("percent", 7)).findings
    assert found.kind is Kind.EXCITATION
    assert found.severity is Severity.WARNING
    alone = diagnose(bag_log([bag]))
    assert alone.severity is Severity.CLEAN
    assert alone.left_out == ("all checks against a model: no model is given",)


@pytest.mark.parametrize(("seed", "floating"), [(0, True), (1, True), (4, True), (2, False)])
def test_nothing_is_found_in_the_log_of_any_tree(tree_log, tmp_path, seed, floating) -> None:
    robot, log = tree_log(seed, floating)
    (tmp_path / "robot.xml").write_text(mjcf_text(robot))
    diagnosis = diagnose(bag_log([log]), load_model(tmp_path / "robot.xml"))
    assert [one.message for one in diagnosis.findings] == []
