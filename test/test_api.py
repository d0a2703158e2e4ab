"""The public API, as the README and a notebook use it."""

import json
import pickle
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from expected_errors import raises_code
from random_robots import random_robot
from threadpoolctl import threadpool_info, threadpool_limits
from tree_simulation import TreeSimulation

import symbid_ros as sy
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.offline.bags import BagRequest
from symbid_ros.simulation.recording import record

NAMES = [
    "BagError",
    "BaseMotion",
    "CandidateModel",
    "DataError",
    "Diagnosis",
    "EstimateError",
    "ForceError",
    "ForcePrediction",
    "IdentifyOptions",
    "LinkEstimate",
    "Log",
    "LogInformation",
    "LogOptions",
    "METHODS",
    "Metrics",
    "ModelError",
    "ModelGate",
    "OptionError",
    "ParameterEstimate",
    "PriorError",
    "Result",
    "RobotModel",
    "SymbidError",
    "Validation",
    "__version__",
    "diagnose",
    "evaluate",
    "identify",
    "load_bag",
    "load_model",
    "merge",
    "regressor",
    "validate",
]


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """A floating tree with an IMU and a wrench sensor: its model and three bags."""
    folder = tmp_path_factory.mktemp("tree")
    robot = random_robot(1, links=4, floating=True, wrench_frames=1)
    (folder / "robot.xml").write_text(mjcf_text(robot))
    for name, seconds, seed in (("log", 2.5, 1), ("more", 2.5, 2), ("other", 0.8, 3)):
        record(TreeSimulation(robot, seconds, seed), folder / name)
    return folder


@pytest.fixture(scope="module")
def robot(folder) -> sy.RobotModel:
    return sy.load_model(str(folder / "robot.xml"))


@pytest.fixture(scope="module")
def log(folder, robot) -> sy.Log:
    return sy.load_bag(str(folder / "log"), robot)


@pytest.fixture(scope="module")
def result(robot, log) -> sy.Result:
    return sy.identify(robot, log, prior_percent=25)


def test_public_names_are_these() -> None:
    assert sy.__all__ == dir(sy) == NAMES
    for name in NAMES:
        assert getattr(sy, name) is not None
    with pytest.raises(AttributeError, match="has no attribute 'nothing'"):
        _ = sy.nothing


def test_importing_needs_numpy_alone() -> None:
    code = (
        "import sys, symbid_ros as sy; before = set(sys.modules); "
        "print(*sorted({name.partition('.')[0] for name in sys.modules} & {'numpy', 'scipy', "
        "'mcap', 'rosbags', 'clarabel', 'mujoco', 'rclpy', 'yaml'}))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert set(found.stdout.split()) <= {"numpy"}


def test_python_and_the_command_give_equal_results(folder, result) -> None:
    options = sy.IdentifyOptions(prior_percent=25)
    expected = BagRequest((folder / "log",), folder / "robot.xml", options).load().solve().estimate
    np.testing.assert_array_equal(result.estimate.value, expected.value)
    assert result.estimate.inputs == expected.inputs


def test_results_do_not_depend_on_threads_of_the_caller(robot, log, result) -> None:
    def threads() -> set[int]:
        return {each["num_threads"] for each in threadpool_info() if each["user_api"] == "blas"}

    with threadpool_limits(2, user_api="blas"):
        again = sy.identify(robot, log, prior_percent=25)
        assert threads() == {2}
    assert again.estimate.value.tobytes() == result.estimate.value.tobytes()


def test_arrays_and_their_bag_give_equal_results(robot, log, result) -> None:
    streams = log.streams()
    joints, columns = streams.joints, []
    columns = [joints.names.index(name) for name in robot.measured_joint_names]
    (imu,), (wrench,) = streams.imus, streams.wrenches
    arrays = sy.Log.from_arrays(
        robot,
        time=joints.stamp,
        position=joints.position[:, columns],
        velocity=joints.velocity[:, columns],
        effort=joints.effort[:, columns],
        imus={imu.frame_id: np.hstack([imu.angular_velocity, imu.linear_acceleration])},
        wrenches={wrench.frame_id: np.hstack([wrench.force, wrench.torque])},
    )
    found = sy.identify(robot, arrays, prior_percent=25)
    np.testing.assert_allclose(found.estimate.value, result.estimate.value, rtol=1e-12, atol=1e-14)
    assert found.alarms == result.alarms


def test_a_result_tells_parameters_links_and_alarms(robot, result) -> None:
    name = robot.links[0].name
    mass = result.parameters[f"{name}/m"]
    assert mass.value == result.links[name].mass == result.estimate.value[0]
    assert mass.unit == "kg"
    assert mass.value == pytest.approx(robot.phi[0, 0], abs=5 * mass.std)
    assert result.links[name].is_possible
    assert result.alarms == result.estimate.verdict.alarms
    assert result.covariance.shape == (len(result.parameters),) * 2
    std = np.sqrt(np.diag(result.covariance))
    np.testing.assert_allclose(
        std[: 10 * len(result.links) : 10], result.estimate.std[: 10 * len(result.links) : 10]
    )
    assert np.all(std >= result.estimate.std * (1 - 1e-9))
    assert name in repr(result)
    assert f"{mass.value:.4g}" in repr(mass)
    assert f"<td>{name}/m</td>" in result._repr_html_()


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"friction": True, "offset": True},
        {"filter": "butterworth", "cutoff": 30},
        {"method": "wls_rc", "cutoff": 20},
        {"sensor_errors": "imu_bias,torque_gain"},
    ],
    ids=str,
)
def test_errors_of_a_prediction_are_those_of_the_report(robot, log, options) -> None:
    result = sy.identify(robot, log, prior_percent=25, **options)
    prediction = result.predict(log)
    reported = result.estimate.residual_rmse
    assert prediction.rmse.keys() == reported.keys()
    largest = np.nanmax(np.abs(prediction.measured))
    shares = np.isfinite(prediction.error).mean(axis=0)  # others count as zero in the report
    for (name, value), share in zip(prediction.rmse.items(), shares[shares > 0], strict=True):
        expected = pytest.approx(reported[name], rel=1e-6, abs=1e-9 * largest)
        assert value * np.sqrt(share) == expected
    assert np.all(np.diff(prediction.stamp) > 0)


def test_a_pickled_result_predicts_as_before(log, result) -> None:
    again = pickle.loads(pickle.dumps(result))
    np.testing.assert_array_equal(again.predict(log).error, result.predict(log).error)


def test_errors_of_a_prediction_are_those_of_the_rows_that_are_used() -> None:
    measured = np.array([[3.0, np.nan], [np.nan, np.nan], [3.0, np.nan]])
    found = sy.ForcePrediction(np.arange(3), ("a", "b"), measured, np.zeros((3, 2)))
    assert found.rmse == {"a": 3.0}


def test_a_robot_may_be_named_by_its_file(folder, robot, log) -> None:
    given = sy.diagnose(robot.source, log)
    assert given.findings == sy.diagnose(robot, log).findings
    read = sy.load_bag(folder / "log", robot.source).streams()
    np.testing.assert_array_equal(read.joints.position, log.streams().joints.position)
    readings = np.zeros((60, len(robot.measured_joint_names)))
    arrays = {"time": np.arange(60) / 50, "position": readings, "effort": readings}
    assert sy.Log.from_arrays(robot.source, **arrays).streams().joints.names == robot.joint_names


def test_functions_document_what_they_take_return_and_raise() -> None:
    functions = [getattr(sy, name) for name in sy.__all__ if name.islower() and name[0] != "_"]
    functions += [sy.Result.predict, sy.Result.save, sy.Log.from_arrays]
    assert sy.load_bag in functions
    for function in functions:
        for section in ("Parameters", "Returns", "Raises"):
            if (function, section) != (sy.Log.from_arrays, "Returns"):  # a constructor
                title = f"{section}\n *{'-' * len(section)}\n"
                assert re.search(title, function.__doc__), f"{function.__name__}: {section}"


@pytest.mark.parametrize("base", ["float", "FIXED", None])
def test_a_base_is_one_of_three(robot, base) -> None:
    with pytest.raises(sy.OptionError, match="choose from auto, floating, fixed"):
        sy.load_model(robot.source, base)


def test_objects_that_hold_arrays_are_equal_to_themselves_alone(robot, result) -> None:
    for one in (robot, result, result.information):
        assert one == one  # noqa: PLR0124
        assert one != pickle.loads(pickle.dumps(one))


@pytest.mark.parametrize("function", [sy.identify, sy.diagnose])
def test_other_things_than_robots_and_logs_are_named(function, robot, log, result) -> None:
    with raises_code("E511", r"robot must be .*load_model.*, not Log"):
        function(log, robot)
    with raises_code("E511", r"log must be .*load_bag.*, not Result"):
        function(robot, result)
    with raises_code("E511", r"log must be .*load_bag.*, not str"):
        function(robot, "my_bag")


def test_a_result_predicts_and_validates_logs_alone(result, log) -> None:
    for other in (result.information, np.zeros((5, 3)), "my_bag"):
        with raises_code("E511", f"log must be .*, not {type(other).__name__}"):
            sy.validate(result, other)
        with raises_code("E511", f"log must be .*, not {type(other).__name__}"):
            result.predict(other)
    with raises_code("E511", "result must be .*, not LogInformation"):
        sy.validate(result.information, log)


def test_other_things_than_paths_are_named(result) -> None:
    with raises_code("E511", "the model file must be a path, not NoneType"):
        sy.load_model(None)
    for other in (None, [3]):
        with raises_code("E511", "a bag must be a path, not"):
            sy.load_bag(other)
    with raises_code("E511", "the folder must be a path, not NoneType"):
        result.save(None)


def test_a_result_is_not_saved_into_a_bag(folder, result) -> None:
    bag = folder / "log"
    before = sorted(bag.iterdir())
    with raises_code("E551", "is the folder of a bag"):
        result.save(bag)
    assert sorted(bag.iterdir()) == before


def test_options_of_functions_are_one_object_or_fields_of_these_names(robot, log, folder) -> None:
    identify, diagnose = (
        lambda *options, one=one, **fields: one(robot, log, *options, **fields)
        for one in (sy.identify, sy.diagnose)
    )

    def load(*options, **fields):
        return sy.load_bag(folder / "log", robot, *options, **fields)

    for function, kind in ((identify, sy.IdentifyOptions), (load, sy.LogOptions)):
        with raises_code("E501", f"'strat' is not an option; see symbid_ros.{kind.__name__}"):
            function(strat=3)
        with raises_code("E502", "not both"):
            function(kind(), start=3.0)
        with raises_code("E501", f"options is a dict; give a symbid_ros.{kind.__name__}"):
            function({"start": 3.0})
    with raises_code("E502", "not both"):
        diagnose(sy.IdentifyOptions(), contact=("foot",))


def test_a_prior_of_single_links_is_a_mapping(robot, log, tmp_path) -> None:
    path = tmp_path / "prior.json"
    name = f"{robot.link_names[1]}/m"
    given = {
        one: {"value": value, "std": 0.1 * abs(value) + 1e-3}
        for one, value in zip(names_of(robot), robot.inertial_parameters.tolist(), strict=True)
    }
    given[name]["std"] = 1e-4
    document = {"model": robot.name, "kind": "mine", "seed": None, "parameters": given}
    path.write_text(json.dumps(document))
    read = sy.identify(robot, log, prior=path)
    found = sy.identify(robot, log, prior={"parameters": given})
    np.testing.assert_allclose(found.estimate.value, read.estimate.value, rtol=1e-9, atol=1e-12)
    assert found.parameters[name].std <= 1e-4
    found.save(tmp_path / "out")
    saved = json.loads((tmp_path / "out" / "estimate.json").read_text())
    assert saved["provenance"]["options"]["prior"]["parameters"] == given
    del given[name]
    with raises_code("E403", f"the prior lacks {name}"):
        sy.identify(robot, log, prior={"parameters": given})
    with raises_code("E501", "`prior`: 5 is not valid"):
        sy.identify(robot, log, prior=5)
    for wrong in ({"parameters": [1.0]}, {"values": given}):
        with raises_code("E402"):
            sy.identify(robot, log, prior=wrong)


def names_of(robot) -> list[str]:
    parts = "m", "mc_x", "mc_y", "mc_z", "Ixx", "Ixy", "Ixz", "Iyy", "Iyz", "Izz"
    return [f"{link}/{part}" for link in robot.link_names for part in parts]


def test_a_table_needs_pandas(result, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(sy.EstimateError, match="pip install pandas"):
        result.to_frame()


def test_a_result_is_saved_and_its_information_solved_again(robot, result, tmp_path) -> None:
    result.save(tmp_path / "out")
    assert sy.load_model(tmp_path / "out" / "model.xml").dof == robot.dof
    information = sy.LogInformation.load(tmp_path / "out" / "information.npz")
    again = sy.identify(robot, information, prior_percent=25)
    np.testing.assert_allclose(again.estimate.value, result.estimate.value, rtol=1e-9, atol=1e-12)


def without_groups(information) -> sy.LogInformation:
    """Return the information whose residuals count as independent, as in files of old versions."""
    return sy.LogInformation(tuple(replace(one, groups=None) for one in information.observations))


def test_merged_information_equals_that_of_both_logs(robot, folder, result) -> None:
    more = sy.identify(robot, sy.load_bag(folder / "more", robot), prior_percent=25)
    information = sy.merge([result.information, more.information])
    assert information.seconds == result.information.seconds + more.information.seconds
    # The data can be solved with other terms than those that each log asked for.
    options = {"prior_percent": 25, "joint_terms": ("none",), "force_scale_std": 0}
    alone, together = (
        sy.identify(robot, one, **options).estimate.std for one in (result.information, information)
    )
    # How much residuals are correlated is estimated from both logs, and may be more than from one.
    assert np.all(together <= 1.01 * alone)
    # Apart from that, no parameter is less certain with more data.
    alone, together = (
        sy.identify(robot, without_groups(one), **options).estimate.std
        for one in (result.information, information)
    )
    assert np.all(together <= (1 + 1e-6) * alone)
    with pytest.raises(sy.EstimateError, match="counted twice"):
        sy.merge([result.information, result.information])
    for wrong in ([result, result], result.information):
        with raises_code("E511", "list of LogInformation"):
            sy.merge(wrong)


def test_a_log_is_diagnosed_and_a_result_evaluated(robot, log, folder, result) -> None:
    diagnosis = sy.diagnose(robot, log)
    assert isinstance(diagnosis, sy.Diagnosis)
    metrics = sy.evaluate(robot, result, folder / "other")
    assert metrics.torque_rmse < 1.0


def test_the_regressor_is_linear_in_the_parameters(robot) -> None:
    rng = np.random.default_rng(4)
    q, v, a = rng.normal(size=(3, 6, len(robot.joints)))
    base = sy.BaseMotion(*rng.normal(size=(3, 6, 3)))
    K = sy.regressor(robot, q, v, a, base=base)
    assert K.shape == (6, robot.dof, 10 * len(robot.links))
    with pytest.raises(sy.DataError, match="floats"):
        sy.regressor(robot, q, v, a)
    with pytest.raises(sy.DataError, match="shapes"):
        sy.regressor(robot, q[:, 1:], v, a, base=base)
    with pytest.raises(sy.DataError, match="shapes"):
        sy.regressor(robot, 0.0, v, a, base=base)


@pytest.mark.parametrize("shape", [(3,), (1, 3), (5, 3), (7, 3), (6, 2)])
@pytest.mark.parametrize("field", ["angular_velocity", "angular_acceleration", "specific_force"])
def test_the_motion_of_the_base_has_a_row_for_each_instant(robot, field, shape) -> None:
    motion = np.zeros((3, 6, len(robot.joints)))
    base = replace(sy.BaseMotion(*np.zeros((3, 6, 3))), **{field: np.zeros(shape)})
    with pytest.raises(sy.DataError, match=rf"base.{field} has shape .*; expected \(6, 3\)"):
        sy.regressor(robot, *motion, base=base)


def test_the_parameters_of_a_body_with_several_joints_fit_its_regressor(tmp_path) -> None:
    """Links between the joints have no columns."""
    path = tmp_path / "ball.xml"
    path.write_text(
        '<mujoco><worldbody><body name="arm"><inertial pos=".1 0 0" mass="2" '
        'diaginertia=".1 .2 .3"/><joint name="x" axis="1 0 0"/><joint name="y" axis="0 1 0"/>'
        "</body></worldbody></mujoco>"
    )
    robot = sy.load_model(path)
    weight = sy.regressor(path, *np.zeros((3, 1, 2)))[0] @ robot.inertial_parameters
    np.testing.assert_allclose(weight, [0.0, -2 * 9.81 * 0.1], atol=1e-12)


def test_a_fixed_bases_regressor_agrees_with_pinocchio(tmp_path) -> None:
    import pinocchio

    arm = random_robot(2, links=4, floating=False, wrench_frames=0)
    (tmp_path / "arm.xml").write_text(mjcf_text(arm))
    robot = sy.load_model(tmp_path / "arm.xml")
    result = sy.regressor(robot, *np.zeros((3, 1, len(robot.joints))))
    from symbid_ros.model.export_urdf import urdf_text

    model = pinocchio.buildModelFromXML(urdf_text(robot))
    weight = pinocchio.computeGeneralizedGravity(model, model.createData(), np.zeros(model.nq))
    order = [model.joints[model.getJointId(name)].idx_v for name in robot.joint_names]
    parameters = np.concatenate([link.phi for link in robot.links if not link.virtual])
    np.testing.assert_allclose(result[0] @ parameters, weight[order], atol=1e-9)


def test_wrong_options_are_named(robot, log) -> None:
    with pytest.raises(sy.OptionError, match="'prior_percentage' is not an option"):
        sy.identify(robot, log, prior_percentage=25)
    with pytest.raises(sy.OptionError, match="not both"):
        sy.identify(robot, log, sy.IdentifyOptions(), method="map")
