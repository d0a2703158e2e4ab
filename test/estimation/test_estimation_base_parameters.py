"""The grouping of parameters: against closed forms, Pinocchio's regressor and dense rank."""

import numpy as np
import pinocchio
import pytest
from random_robots import CONFIG, random_robot, random_samples

from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.base_parameters import base_parameters
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Joint, Link, RobotModel

FRICTION = ("viscous", "coulomb")


def arm(axes, length=0.5, gravity=(0.0, -9.81, 0.0)):
    """A fixed base and one revolute joint per axis, each ``length`` along x from the last."""
    joints = tuple(
        Joint(
            name=f"joint_{k + 1}",
            kind="revolute",
            parent=k,
            rotation=np.eye(3),
            translation=np.array([length if k else 0.0, 0.0, 0.0]),
            axis=np.asarray(axis) / np.linalg.norm(axis),
        )
        for k, axis in enumerate(axes)
    )
    links = tuple(Link(f"link_{k}", np.zeros(10)) for k in range(len(axes) + 1))
    return RobotModel("arm", links, joints, (), False, np.array(gravity), "arm.urdf")


def grouped(parameters):
    """Return each base parameter as {parameter: coefficient}."""
    base = base_parameters(parameters)
    return [
        {base.names[column]: row[column] for column in np.flatnonzero(row)} for row in base.matrix
    ]


def assert_grouping(parameters, expected):
    for found, wanted in zip(grouped(parameters), expected, strict=True):
        assert found == pytest.approx(wanted, rel=1e-12)


def stacked_regressor(parameters, seed, count=200):
    """Return unscaled rows (m, p) of motions that the grouping was not made from."""
    model = parameters.model
    samples = random_samples(model, count, np.random.default_rng(seed), ())
    return equation_of_motion(parameters, samples).K.reshape(-1, len(parameters))


def assert_reproduces(base, K):
    residual = K - K[:, base.independent] @ base.matrix
    assert np.abs(residual).max() < 1e-10 * np.abs(K).max()


ROBOTS = [
    *[(random_robot(s, links=2 + s, floating=s % 2 == 0), ()) for s in range(1, 9)],
    *[(random_robot(s, links=7, floating=s % 2 == 0), FRICTION) for s in range(4)],
    (load_model(CONFIG / "symbitron.xml"), ()),
    (load_model(CONFIG / "symbitron.urdf", "fixed"), FRICTION),
]


@pytest.mark.parametrize(("model", "terms"), ROBOTS)
def test_forces_depend_on_parameters_through_the_base_parameters_alone(model, terms):
    parameters = ParameterSet(model, terms)
    base = base_parameters(parameters)
    K = stacked_regressor(parameters, 11)
    assert_reproduces(base, K)
    rng = np.random.default_rng(12)
    _, _, directions = np.linalg.svd(base.matrix)
    unseen = directions[len(base) :]
    shift = unseen.T @ rng.normal(size=len(unseen))
    assert np.abs(K @ shift).max() < 1e-10 * np.abs(K).max()


@pytest.mark.parametrize(("model", "terms"), ROBOTS)
def test_their_number_is_the_rank_of_the_regressor(model, terms):
    parameters = ParameterSet(model, terms)
    base = base_parameters(parameters)
    K = stacked_regressor(parameters, 13, 400)
    K = K[:, base.effect > 0]
    assert len(base) == np.linalg.matrix_rank(K / np.linalg.norm(K, axis=0), tol=1e-8)
    assert base.clear
    assert base.kept > 1e6 * base.dropped


@pytest.mark.parametrize(("terms", "count"), [((), 80), (FRICTION, 100)])
def test_symbitron_has_the_thesis_base_parameters(terms, count):
    for name in ("symbitron.xml", "symbitron.urdf"):
        base = base_parameters(ParameterSet(load_model(CONFIG / name), terms))
        assert len(base) == count
        assert np.all(base.effect > 0)
        assert np.abs(base.matrix).max() == pytest.approx(1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("floating", [True, False])
def test_the_grouping_holds_for_pinocchios_regressor(seed, floating, tmp_path):
    rng = np.random.default_rng(seed)
    model = random_robot(seed, links=6, floating=floating)
    path = tmp_path / "robot.urdf"
    path.write_text(urdf_text(model))
    pin = pinocchio.buildModelFromUrdf(
        str(path), *([pinocchio.JointModelFreeFlyer()] if floating else [])
    )
    pin.gravity.linear = np.array([0, 0, -9.81]) if floating else model.gravity
    data = pin.createData()
    ours = {f"{link}/{name}": k for k, (link, name) in enumerate(_parameter_pairs(model))}
    # Pinocchio orders the inertia by columns of its lower triangle.
    order = [PARAMETERS.index(n) for n in ("m", "mc_x", "mc_y", "mc_z", "Ixx", "Ixy", "Iyy")]
    order += [PARAMETERS.index(n) for n in ("Ixz", "Iyz", "Izz")]
    child = {joint.name: model.link_names[k + 1] for k, joint in enumerate(model.joints)}
    child["root_joint"] = model.link_names[0]
    columns = [
        ours[f"{child[name]}/{PARAMETERS[parameter]}"]
        for name in list(pin.names)[1:]
        for parameter in order
    ]
    rows = []
    for _ in range(20):
        q = pinocchio.randomConfiguration(pin, np.full(pin.nq, -1.0), np.full(pin.nq, 1.0))
        v, a = rng.normal(size=(2, pin.nv))
        K = np.zeros((pin.nv, len(ours)))
        K[:, columns] = pinocchio.computeJointTorqueRegressor(pin, data, q, v, a)
        rows.append(K)
    assert_reproduces(base_parameters(ParameterSet(model)), np.concatenate(rows))


def _parameter_pairs(model):
    return [(link, name) for link in model.link_names for name in PARAMETERS]


def test_a_planar_arm_in_gravity_has_the_textbook_grouping():
    """Khalil and Dombre 2002, Modeling, Identification and Control of Robots, sec. 9.4."""
    parameters = ParameterSet(arm([(0, 0, 1)] * 2))
    assert_grouping(
        parameters,
        [
            {"link_1/mc_x": 1, "link_2/m": 0.5},
            {"link_1/mc_y": 1},
            {"link_1/Izz": 1, "link_2/m": 0.25},
            {"link_2/mc_x": 1},
            {"link_2/mc_y": 1},
            {"link_2/Izz": 1},
        ],
    )
    base = base_parameters(parameters)
    assert base.describe(0) == "link_1/mc_x + 0.5·link_2/m"
    assert base.describe(2, terms=1) == "link_1/Izz + … (1 more)"
    alone = {"link_1/mc_y", "link_2/mc_x", "link_2/mc_y", "link_2/Izz"}
    assert {base.names[k] for k in np.flatnonzero(base.alone)} == alone
    planar = {f"{link}/{name}" for link in ("link_1", "link_2") for name in ("mc_x", "mc_y", "Izz")}
    silent = {base.names[k] for k in np.flatnonzero(base.effect == 0)}
    assert silent == set(base.names) - planar - {"link_2/m"}


def test_a_planar_arm_without_gravity_has_fewer_base_parameters():
    parameters = ParameterSet(arm([(0, 0, 1)] * 2, gravity=(0.0, 0.0, -9.81)))
    assert_grouping(
        parameters,
        [
            {"link_1/Izz": 1, "link_2/m": 0.25},
            {"link_2/mc_x": 1},
            {"link_2/mc_y": 1},
            {"link_2/Izz": 1},
        ],
    )


def test_a_rotors_inertia_is_grouped_with_its_link_on_a_fixed_base():
    parameters = ParameterSet(arm([(0, 0, 1)] * 2), ("armature",))
    groups = grouped(parameters)
    shared = {"link_1/Izz": 1, "link_2/m": 0.25, "joint_1/armature": 1}
    assert groups[2] == pytest.approx(shared)
    assert groups[-1] == {"joint_2/armature": 1}


def test_perpendicular_axes_give_the_difference_of_two_moments():
    """The link's trace about its axis goes to the link before it (Gautier and Khalil 1990)."""
    groups = grouped(ParameterSet(arm([(0, 1, 0), (0, 0, 1)], gravity=(0, 0, -9.81))))
    assert pytest.approx({"link_2/Ixx": 1, "link_2/Iyy": -1}) in groups
    (carrier,) = (group for group in groups if "link_1/Iyy" in group)
    assert carrier == pytest.approx({"link_1/Iyy": 1, "link_2/Iyy": 1, "link_2/m": 0.25})


def test_an_oblique_axis_eliminates_its_largest_component():
    groups = grouped(ParameterSet(arm([(0, 1, 0), (0, 0, 1), (0.6, 0.0, 0.8)])))
    (moment,) = (group for group in groups if "link_3/mc_x" in group and "link_3/mc_z" in group)
    # m·c enters only by its part across the axis: mc_x - (0.6 / 0.8) mc_z.
    assert moment["link_3/mc_x"] == 1
    assert moment["link_3/mc_z"] == pytest.approx(-0.75)


def test_a_floating_robots_first_base_parameter_is_its_total_mass():
    parameters = ParameterSet(load_model(CONFIG / "symbitron.xml"))
    assert grouped(parameters)[0] == pytest.approx(
        {f"{link}/m": 1 for link in parameters.link_names}
    )


def test_units_of_length_change_coefficients_only_by_their_powers():
    metres, hundredths = (
        base_parameters(ParameterSet(arm([(0, 1, 0), (0, 0, 1), (1, 0, 0)], length)))
        for length in (0.5, 0.005)
    )
    np.testing.assert_array_equal(metres.independent, hundredths.independent)
    power = np.tile([0, 1, 1, 1, 2, 2, 2, 2, 2, 2], 4)
    scaling = 0.01 ** (power[metres.independent][:, None] - power)
    np.testing.assert_allclose(hundredths.matrix, metres.matrix * scaling, rtol=1e-9, atol=1e-15)


def test_nearly_parallel_axes_are_reported():
    def turning_about(tilt):
        axes = [(0.6, 0, 0.8), (0.6 + tilt, 0, 0.8), (0.6, tilt / 2, 0.8)]
        return base_parameters(ParameterSet(arm(axes)))

    for tilt, count in ((0.0, 9), (1e-3, 17)):
        assert turning_about(tilt).clear
        assert len(turning_about(tilt)) == count
    assert not turning_about(1e-6).clear


def test_base_parameters_are_described_as_sums():
    base = base_parameters(ParameterSet(arm([(0, 0, 1)] * 2), ("viscous",)))
    assert (len(base), len(base.names), np.sum(base.alone)) == (8, 32, 6)
    described = [base.describe(index) for index in range(8)]
    assert (described[0], described[7]) == ("link_1/mc_x + 0.5·link_2/m", "joint_2/viscous")
    assert [base.units[base.independent[index]] for index in (0, 7)] == ["kg m", "Nm s/rad"]
    silent = np.array(base.names)[base.effect == 0]
    assert {"link_0/m", "link_0/mc_x", "link_2/mc_z"} <= set(silent)


def test_a_robot_that_cannot_move_is_refused():
    with pytest.raises(EstimateError, match="no joint moves"):
        base_parameters(ParameterSet(arm([])))
