"""Joint terms chosen by the data, against the drives that made the data."""

import re
from dataclasses import replace

import numpy as np
import pytest
from documented_robots import ur5_urdf
from drive_logs import RATE, SECONDS, arm, drives, log_of, samples_of, slow_waves

import symbid_ros as sy
from symbid_ros.choices import TERMS
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.errors import OptionError
from symbid_ros.estimation.group_moments import GROUPS, GroupMoments
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.prior import default_prior
from symbid_ros.estimation.row_layout import RowLayout, random_motions
from symbid_ros.identification import problem_setup
from symbid_ros.identification.loaded_problem import load_problem
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.terms.choice import choose_terms
from symbid_ros.identification.terms.priors import candidate_prior
from symbid_ros.identification.terms.remarks import replaceable_terms
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.sampled_rows import slipping_coordinates, valid_coordinates
from symbid_ros.signals.weak_form import WindowedRows


def chosen(result, log):
    """Return the determined terms that make up at least 1 % of some joint's effort."""
    effort = log.streams().joints.effort
    size = dict(zip(result.robot.joint_names, np.sqrt(np.mean(effort**2, axis=0)), strict=True))
    estimate = result.estimate
    alike = {one.split()[0] for one in estimate.remarks if " acts like " in one}
    found = set()
    for joint, terms in estimate.joint_terms.items():
        for term in terms:
            one = result.parameters[f"{joint}/{term}"]
            if one.is_determined and one.name not in alike and abs(one.value) > 0.01 * size[joint]:
                found.add(term)
    return found


@pytest.mark.parametrize(
    "terms", [{}, {"viscous": 0.4}, {"viscous": 0.4, "coulomb": 0.8}, {"armature": 0.3}]
)
def test_the_terms_that_made_the_data_are_chosen(terms):
    robot = arm()
    truth = drives(robot, **terms)
    log = log_of(robot, truth)
    result = sy.identify(robot, log, unchecked=True)
    assert chosen(result, log) == set(terms)
    for joint in robot.joint_names:
        for term, value in terms.items():
            found = result.parameters[f"{joint}/{term}"]
            assert abs(found.value - value) < 5 * found.std


@pytest.mark.parametrize("terms", ["auto", "viscous,coulomb"])
def test_drives_that_rub_more_than_a_leg(terms):
    """The default deviations of named terms are 1 Nm s/rad and 2 Nm."""
    robot, truth = arm(), {"viscous": 150.0, "coulomb": 40.0}
    log = log_of(robot, drives(robot, **truth))
    result = sy.identify(robot, log, unchecked=True, no_holdout=True, joint_terms=terms)
    for joint in robot.joint_names:
        for term, value in truth.items():
            found = result.parameters[f"{joint}/{term}"]
            assert abs(found.value - value) < max(5 * found.std, 0.01 * value)


def test_offsets_are_chosen():
    robot = arm()
    log = log_of(robot, drives(robot), offset=0.7)
    result = sy.identify(robot, log, unchecked=True)
    assert chosen(result, log) == {"offset"}


def test_without_friction_the_choice_equals_no_terms():
    robot = arm()
    log = log_of(robot, drives(robot))
    auto = sy.identify(robot, log, unchecked=True)
    none = sy.identify(robot, log, unchecked=True, joint_terms=("none",))
    links = 10 * len(none.links)
    # At most a term within its noise is added.
    change = (auto.estimate.value[:links] - none.estimate.value) / none.estimate.std
    assert np.sqrt(np.mean(change**2)) < 0.5


@pytest.mark.parametrize("stated", [0.003, 10.0])
def test_friction_of_the_model_file_may_be_wrong(stated):
    robot = arm()
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    wrong = drives(robot, viscous=stated, coulomb=stated).model
    result = sy.identify(wrong, log_of(robot, truth), unchecked=True)
    for joint in robot.joint_names:
        for term, value in (("viscous", 0.4), ("coulomb", 0.8)):
            found = result.parameters[f"{joint}/{term}"]
            assert found.prior == stated
            assert abs(found.value - value) < 5 * found.std


def test_rows_that_are_used_choose_the_terms(monkeypatch):
    """Noise may spoil rows for all candidates together, and not for the chosen terms."""
    robot = arm()
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    expected = sy.identify(robot, log, unchecked=True, no_holdout=True)
    windows = []

    def elsewhere(problem):
        choice = choose_terms(problem)
        windows.append(tuple(one.window for one in problem.observations))
        # As if all rows together had chosen in windows of another length.
        return replace(choice, window=choice.window if len(windows) > 1 else -1.0)

    monkeypatch.setattr(problem_setup, "choose_terms", elsewhere)
    found = sy.identify(robot, log, unchecked=True, no_holdout=True)
    assert len(windows[0]) == 3
    assert windows[1:] == [(found.estimate.rows.window,)]
    assert found.estimate.joint_terms == expected.estimate.joint_terms
    np.testing.assert_allclose(found.estimate.value, expected.estimate.value, rtol=1e-6, atol=1e-9)
    # Other logs may need the other lengths.
    assert [one.window for one in found.information.observations] == list(windows[0])


def test_saved_information_gives_the_same_choice(tmp_path):
    robot = arm()
    log = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8))
    result = sy.identify(robot, log, unchecked=True)
    result.information.save(tmp_path / "information.npz")
    again = sy.identify(robot, sy.LogInformation.load(tmp_path / "information.npz"))
    assert again.estimate.joint_terms == result.estimate.joint_terms
    np.testing.assert_allclose(again.estimate.value, result.estimate.value, rtol=1e-9, atol=1e-12)


def test_logs_with_different_choices_are_merged():
    robot = arm()
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    still = np.arange(len(robot.joints)) > 0
    first = sy.identify(robot, log_of(robot, truth, moving=still), unchecked=True)
    second = sy.identify(robot, log_of(robot, truth, seed=1), unchecked=True)
    both = sy.identify(robot, sy.merge([first.information, second.information]))
    for term in ("viscous", "coulomb"):
        name = f"{robot.joint_names[0]}/{term}"
        assert not first.parameters[name].is_determined
        assert both.parameters[name].is_determined


def test_a_resting_joint_is_named():
    robot = arm()
    still = np.arange(len(robot.joints)) > 0
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    result = sy.identify(robot, log_of(robot, truth, moving=still), unchecked=True)
    assert any(
        one.startswith(f"{robot.joint_names[0]}: moved faster") for one in result.estimate.remarks
    )
    for term in ("viscous", "coulomb"):
        found = result.parameters[f"{robot.joint_names[0]}/{term}"]
        assert found.std > 0.1
        assert not found.is_determined


def test_armature_of_the_first_joint_is_named_as_inseparable():
    robot = arm(seed=4)
    assert robot.joints[0].kind == "revolute"
    result = sy.identify(robot, log_of(robot, drives(robot, armature=0.3)), unchecked=True)
    first = f"{robot.joint_names[0]}/armature acts like "
    assert any(one.startswith(first) for one in result.estimate.remarks)


def test_an_armature_is_named_beside_the_inertia_about_the_joints_axis():
    parameters = ParameterSet(sy.load_model(ur5_urdf(), "fixed"), ("armature", "offset"))
    pan, lift = replaceable_terms(parameters, np.ones(len(parameters), dtype=bool))
    end = "; the data determine only their sum"
    assert pan == f"shoulder_pan_joint/armature acts like shoulder_link/Izz{end}"
    assert lift == f"shoulder_lift_joint/armature acts like upper_arm_link/Iyy{end}"


@pytest.mark.parametrize("seed", range(4))
def test_the_combination_that_is_named_is_all_that_efforts_show(seed):
    robot = arm(seed)
    parameters = ParameterSet(robot, ("armature", "offset"))
    remarks = replaceable_terms(parameters, np.ones(len(parameters), dtype=bool))
    assert remarks
    K = equation_of_motion(parameters, random_motions(robot, 20)).K.reshape(-1, len(parameters))
    for remark in remarks:
        stated = re.search(r"determine only (\S+) ([+−]) (\S+) × (\S+)$", remark)
        link, sign, factor, term = stated.groups()
        # One more of the term, and as much less of the link's parameter: nothing changes.
        columns = K[:, [parameters.names.index(name) for name in (link, term)]]
        change = columns @ [float(sign.replace("−", "-") + factor), -1.0]
        assert np.linalg.norm(change) < 0.01 * np.linalg.norm(columns[:, 1])


def test_a_joint_that_moves_one_way_does_not_tell_coulomb_from_offset():
    robot = arm(seed=1, links=2)  # a joint that turns: the weight of one that slides is an offset
    truth = drives(robot, coulomb=0.8)
    time = np.arange(0.0, SECONDS, 1 / RATE)
    rate = 0.5 + 0.3 * np.sin(2 * time)
    position = 0.5 * time - 0.15 * np.cos(2 * time)
    acceleration = 0.6 * np.cos(2 * time)
    motion = (each[:, None] for each in (position, rate, acceleration))
    samples = samples_of(robot, time, *motion)
    rows = equation_of_motion(truth, samples)
    effort = rows.K @ truth.values - rows.y
    effort += 1e-3 * np.random.default_rng(0).normal(size=effort.shape)
    log = sy.Log.from_arrays(robot, time=time, position=samples.position, effort=effort)
    result = sy.identify(robot, log, unchecked=True)
    assert any("cannot distinguish coulomb from offset" in one for one in result.estimate.remarks)


def test_stribeck_friction_is_chosen():
    robot = arm(links=3)
    truth = drives(robot, viscous=0.3, coulomb=1.0)
    columns = ParameterSet(truth.model, ("stribeck",))
    rng = np.random.default_rng(0)
    time = np.arange(0.0, SECONDS, 1 / RATE)
    motion = slow_waves(rng, time, len(robot.joints), 0.6)
    samples = samples_of(robot, time, *motion)
    phi = np.append(truth.values, np.full(len(robot.joints), 0.5))
    rows = equation_of_motion(columns, samples)
    effort = rows.K @ phi - rows.y + 1e-3 * rng.normal(size=motion[0].shape)
    log = sy.Log.from_arrays(robot, time=time, position=motion[0], effort=effort)
    result = sy.identify(robot, log, unchecked=True)
    for joint in robot.joint_names:
        found = result.parameters[f"{joint}/stribeck"]
        assert found.value == pytest.approx(0.5, abs=max(5 * found.std, 0.05))


def test_group_moments_are_those_of_each_joints_rows():
    parameters = ParameterSet(arm(), TERMS, candidates=True)
    layout = RowLayout.of(parameters)
    samples = random_motions(parameters.model, 200)
    rows = equation_of_motion(parameters, samples)
    rng = np.random.default_rng(0)
    rows = replace(rows, y=rng.normal(size=rows.y.shape))
    stamp = np.sort(rng.integers(0, 30_000_000_000, len(samples)))
    valid = valid_coordinates(parameters, samples.velocity)
    slips = valid & slipping_coordinates(parameters, samples.velocity)
    block = WindowedRows(rows, rows, valid, stamp, slips)
    groups = GroupMoments.empty(layout, candidates=True).fold([block])
    assert groups.complete == groups.parts
    for part, coordinate in zip(groups.parts, layout.own_coordinates, strict=True):
        assert part.coordinate == coordinate
        columns = layout.columns[coordinate]
        flat = np.column_stack([rows.K[:, coordinate, columns], rows.y[:, coordinate]])
        for group in range(GROUPS):
            some = flat[(stamp // 1_000_000_000) % GROUPS == group]
            np.testing.assert_allclose(part.moments[group], some.T @ some, rtol=1e-12, atol=1e-12)
    np.testing.assert_array_equal(groups.counts.sum(axis=0), valid.sum(axis=0))
    twice = groups.merge(groups).discounted(0.5)
    for one, other in zip(twice.parts, groups.parts, strict=True):
        np.testing.assert_allclose(one.moments, other.moments)


@pytest.mark.parametrize(("coefficient", "low", "high"), [(0.0, 1.0, 1.6), (0.95, 3.0, 60.0)])
def test_correlated_residuals_count_as_fewer_rows(coefficient, low, high):
    parameters = ParameterSet(arm(), ("offset",), candidates=True)
    layout = RowLayout.of(parameters)
    rng = np.random.default_rng(1)
    count = 4000
    samples = random_motions(parameters.model, count)
    rows = equation_of_motion(parameters, samples)
    residual = np.zeros(rows.y.shape)
    white = rng.normal(size=rows.y.shape)
    # The offset's column is constant, so its score follows the residual.
    rows.K[:, :, : parameters.inertial] *= 1e-3
    for i in range(1, count):
        residual[i] = coefficient * residual[i - 1] + white[i]
    rows = replace(rows, y=residual)
    stamp = np.arange(count) * 40_000_000
    block = WindowedRows(rows, rows, np.ones(residual.shape, bool), stamp)
    groups = GroupMoments.empty(layout).fold([block])
    phi = np.zeros(len(parameters))
    phi[parameters.inertial :] = residual.mean(axis=0)
    found = groups.correlation(phi, np.mean((residual - residual.mean(axis=0)) ** 2, axis=0))
    if coefficient:
        assert low < found.max() < high
    else:
        assert low <= found.min() <= found.max() < high


def test_information_about_some_parameters_is_that_of_their_rows():
    parameters = ParameterSet(arm(), TERMS, candidates=True)
    some = ParameterSet(arm(), ("viscous", "offset"))
    samples = random_motions(parameters.model, 60)
    rng = np.random.default_rng(2)
    y = rng.normal(size=(60, parameters.model.dof))
    full = Information.empty(RowLayout.of(parameters)).fold(
        [replace(equation_of_motion(parameters, samples), y=y)]
    )
    direct = Information.empty(RowLayout.of(some)).fold(
        [replace(equation_of_motion(some, samples), y=y)]
    )
    restricted = full.restricted(some.names)
    assert restricted.layout.parameters == some.names
    np.testing.assert_array_equal(restricted.layout.structure, direct.layout.structure)
    np.testing.assert_allclose(
        restricted.factor.T @ restricted.factor, direct.factor.T @ direct.factor, atol=1e-9
    )
    precision = np.cov(rng.normal(size=(len(y[0]), 20)))
    phi = rng.normal(size=len(some))
    discounted = restricted.discounted(0.25), direct.discounted(0.25)
    for one, other in ((restricted, direct), discounted):
        for name, given in (
            ("whitened_moment", precision),
            ("residual_moment", phi),
            ("approximate_residual_moment", phi),
        ):
            expected = getattr(other, name)(given)
            limit = 1e-12 * np.abs(expected).max()
            np.testing.assert_allclose(getattr(one, name)(given), expected, atol=limit)
        np.testing.assert_allclose(one.target_squares, other.target_squares)
        for column in range(some.inertial, len(some)):
            assert one.column_squares(0, column) == pytest.approx(other.column_squares(0, column))
    fewer = some.names[:-1]
    np.testing.assert_array_equal(
        restricted.restricted(fewer).whitened_moment(precision),
        full.restricted(fewer).whitened_moment(precision),
    )


def test_group_moments_of_some_parameters_are_those_of_their_rows():
    parameters = ParameterSet(arm(), TERMS, candidates=True)
    some = ParameterSet(arm(), ("viscous", "offset"))
    samples = random_motions(parameters.model, 60)
    stamp = np.arange(60) * 200_000_000
    y = np.random.default_rng(2).normal(size=(60, parameters.model.dof))
    found = []
    for each in (parameters, some):
        rows = replace(equation_of_motion(each, samples), y=y)
        block = WindowedRows(rows, rows, np.ones(y.shape, bool), stamp)
        found.append(GroupMoments.empty(RowLayout.of(each), candidates=True).fold([block]))
    restricted = found[0].restricted(found[1].layout)
    for one, other in zip(restricted.parts, found[1].parts, strict=True):
        np.testing.assert_array_equal(one.left, other.left)
        np.testing.assert_allclose(one.moments, other.moments, atol=1e-9)


# Springs are candidates where the model file states one.
CANDIDATES = tuple(term for term in TERMS if term != "stiffness")


@pytest.mark.parametrize(
    ("fields", "terms", "chooses"),
    [
        ({}, CANDIDATES, True),
        ({"joint_terms": ("auto",)}, CANDIDATES, True),
        ({"joint_terms": ("none",)}, (), False),
        ({"joint_terms": ("offset, viscous",)}, ("viscous", "offset"), False),
        ({"friction": True}, ("viscous", "coulomb"), False),
        ({"friction": True, "joint_terms": ("stribeck",)}, ("viscous", "coulomb", "stribeck"), 0),
        ({"method": "wls_rc"}, (), False),
        ({"filter": "butterworth"}, (), False),
    ],
)
def test_options_name_the_terms(fields, terms, chooses):
    options = sy.IdentifyOptions(**fields)
    assert options.terms == terms
    assert options.chooses_terms == chooses


@pytest.mark.parametrize(
    ("fields", "code"),
    [
        ({"joint_terms": ("dry",)}, "E501"),
        ({"joint_terms": ("auto", "viscous")}, "E502"),
        ({"joint_terms": ("none",), "armature": True}, "E502"),
        ({"joint_terms": ("auto",), "method": "ols"}, "E503"),
    ],
)
def test_contradictory_terms_are_refused(fields, code):
    with pytest.raises(OptionError) as caught:
        sy.IdentifyOptions(**fields)
    assert caught.value.code.endswith(code)


def test_terms_that_a_model_file_cannot_hold_are_named(tmp_path, caplog):
    (tmp_path / "robot.urdf").write_text(urdf_text(arm()))
    robot = sy.load_model(tmp_path / "robot.urdf", "fixed")
    result = sy.identify(robot, log_of(robot, drives(robot), offset=0.7), unchecked=True)
    result.save(tmp_path / "out")
    assert "only estimate.json holds offset; efforts" in caplog.text


def slow_joint(kind, share):
    """Return a log of an arm with friction whose last joint moves little, and its result."""
    robot = arm()
    joints = (*robot.joints[:-1], replace(robot.joints[-1], kind=kind))
    robot = replace(robot, joints=joints)
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    moving = np.append(np.ones(len(joints) - 1), share)
    log = log_of(robot, truth, moving=moving)
    return log, sy.identify(robot, log, unchecked=True, no_holdout=True)


def test_a_gripper_that_moves_by_millimetres_has_friction():
    log, result = slow_joint("prismatic", 0.02)
    position = log.streams().joints.position[:, -1]
    assert np.std(np.gradient(position, 1 / RATE)) < 0.02
    last = result.robot.joint_names[-1]
    for term, value in (("viscous", 0.4), ("coulomb", 0.8)):
        found = result.parameters[f"{last}/{term}"]
        assert abs(found.value - value) < 5 * found.std
    assert result.parameters[f"{last}/coulomb"].is_determined


@pytest.mark.parametrize("kind", ["revolute", "prismatic"])
def test_friction_of_a_joint_that_is_too_slow_is_unknown(kind):
    _, result = slow_joint(kind, 1e-3)
    last = result.robot.joint_names[-1]
    speed = {"revolute": "0.02 rad/s", "prismatic": "0.002 m/s"}[kind]
    remark = next(one for one in result.estimate.remarks if one.startswith(last))
    assert f"moved faster than {speed} for less than" in remark
    assert "slower motion are left out" in remark
    for term, value in (("viscous", 0.4), ("coulomb", 0.8)):
        found = result.parameters[f"{last}/{term}"]
        assert not found.is_determined
        assert abs(found.value - value) < 5 * found.std


def test_friction_of_the_model_file_leaves_out_joints_that_rest():
    robot = arm()
    truth = drives(robot, coulomb=0.8)
    log = log_of(truth.model, truth, moving=np.zeros(len(robot.joints)), seconds=8.0)
    result = sy.identify(truth.model, log, unchecked=True)
    # Static friction is unknown, so a log at rest determines nothing.
    assert not any(one.is_determined for one in result.parameters.values())


def test_viscous_friction_of_a_short_log_may_be_coulomb_friction():
    robot = arm()
    stated = drives(robot, viscous=0.003).model
    whole = log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), seconds=5.0).streams().joints
    thin = slice(None, None, 7)
    arrays = {"position": whole.position[thin], "effort": whole.effort[thin]}
    log = sy.Log.from_arrays(stated, time=whole.stamp[thin], **arrays)
    result = sy.identify(stated, log, unchecked=True, no_holdout=True)
    for joint in robot.joint_names:
        assert result.estimate.joint_terms[joint] == ("viscous",)
        found = result.parameters[f"{joint}/viscous"]
        assert abs(found.value - 0.4) < 5 * found.std


def test_a_column_that_is_zero_but_for_rounding_keeps_its_default_deviation():
    """A joint of constant speed shows no armature, and a prior by its column would allow any."""
    robot = arm()
    rng = np.random.default_rng(0)
    time = np.arange(0.0, 8.0, 0.005)
    position, velocity, acceleration = slow_waves(rng, time, len(robot.joints), 1.2)
    velocity[:, 2], acceleration[:, 2], position[:, 2] = 0.1, 0.0, 0.1 * time
    truth = drives(robot, viscous=0.4, coulomb=0.8)
    rows = equation_of_motion(truth, samples_of(robot, time, position, velocity, acceleration))
    log = sy.Log.from_arrays(
        robot, time=time, position=position, effort=rows.K @ truth.values - rows.y
    )
    problem = load_problem(robot, log, IdentifyOptions(unchecked=True))
    columns, rows = problem.columns, problem.dataset.observations[0]
    default = default_prior(columns)
    sized = candidate_prior(default, columns, rows)
    steady = columns.term_columns["armature"].start + 2
    assert 0 < rows.rows.column_squares(2, steady) < 1e-18
    assert sized.std[steady] == pytest.approx(default.std[steady])
    assert sized.std[steady - 1] != pytest.approx(default.std[steady - 1])
