"""Defaults and limits of each element of a URDF."""

import mujoco
import numpy as np
import pytest
from expected_errors import raises_code

from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.fixed_frames import FixedTransform, with_fixed_frames
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.urdf import MAX_DEPTH, expanded_name

INERTIAL = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1"/></inertial>'


def link(name, inside=INERTIAL):
    return f'<link name="{name}">{inside}</link>'


def joint(name, parent, child, kind="revolute", inside=""):
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f"{inside}</joint>"
    )


def loaded(tmp_path, *elements, base="auto"):
    path = tmp_path / "robot.urdf"
    path.write_text(f'<robot name="r">{"".join(elements)}</robot>')
    return load_model(path, base)


def knee(tmp_path, inside="", kind="revolute"):
    return loaded(tmp_path, link("a"), link("b"), joint("knee", "a", "b", kind, inside)).joints[0]


def test_a_joint_without_elements_has_the_formats_defaults(tmp_path):
    found = knee(tmp_path)
    np.testing.assert_array_equal(found.axis, [1, 0, 0])
    np.testing.assert_array_equal(found.rotation, np.eye(3))
    np.testing.assert_array_equal(found.translation, [0, 0, 0])
    assert (found.lower, found.upper, found.effort) == (-np.inf, np.inf, np.inf)
    assert (found.damping, found.friction_loss, found.armature, found.mimic) == (0, 0, 0, None)


@pytest.mark.parametrize(
    ("kind", "limit", "expected"),
    [
        ("revolute", 'lower="-1" upper="2" effort="3"', ("revolute", -1, 2, 3)),
        ("prismatic", 'lower="-1" upper="2" effort="0"', ("prismatic", -1, 2, 0)),
        ("revolute", 'effort="0" velocity="3"', ("revolute", -np.inf, np.inf, 0)),
        ("revolute", 'effort="0" velocity="0"', ("revolute", -np.inf, np.inf, np.inf)),
        (
            "revolute",
            'lower="0" upper="0" effort="0" velocity="0"',
            ("revolute", -np.inf, np.inf, np.inf),
        ),
        ("continuous", 'lower="-1" upper="2"', ("revolute", -np.inf, np.inf, np.inf)),
        ("revolute", 'lower="-1" effort="3"', ("revolute", -np.inf, np.inf, 3)),
        ("revolute", 'upper="1"', ("revolute", -np.inf, np.inf, np.inf)),
    ],
)
def test_limits_are_complete_or_none(tmp_path, kind, limit, expected):
    found = knee(tmp_path, f"<limit {limit}/>", kind)
    assert (found.kind, found.lower, found.upper, found.effort) == expected


@pytest.mark.parametrize(("inside", "multiplier", "offset"), [("", 1, 0), ('multiplier="0"', 0, 0)])
def test_a_mimic_follows_one_to_one_by_default(tmp_path, inside, multiplier, offset):
    follower = joint("toe", "b", "c", inside=f'<mimic joint="knee" {inside}/>')
    robot = loaded(tmp_path, link("a"), link("b"), link("c"), joint("knee", "a", "b"), follower)
    mimic = robot.joints[1].mimic
    assert (mimic.leader, mimic.multiplier, mimic.offset) == (0, multiplier, offset)


def ball(radius, xyz="0 0 0"):
    geometry = f'<geometry><sphere radius="{radius}"/></geometry>'
    return f'<collision><origin xyz="{xyz}"/>{geometry}</collision>'


@pytest.mark.parametrize(
    ("shin", "foot", "expected"),
    [
        ("", ball(0.02), {"foot": (0.02, -0.3)}),
        ("", ball(0.02, "0 0 -.1"), {"foot": (0, -0.3), "foot_end": (0.02, -0.4)}),
        (ball(0.03, "0 0 -.2"), "", {"foot": (0, -0.3), "shin_end": (0.03, -0.2)}),
        # Several balls, or none that is valid, are no foot; shapes need not be valid.
        ("", 2 * ball(0.02), {"foot": (0, -0.3)}),
        ("", ball(0), {"foot": (0, -0.3)}),
        ("", ball("large"), {"foot": (0, -0.3)}),
        ("", ball(-1), {"foot": (0, -0.3)}),
        ("", "<collision/>", {"foot": (0, -0.3)}),
    ],
)
def test_the_ball_at_the_end_of_a_leg_is_a_frame(tmp_path, shin, foot, expected):
    robot = loaded(
        tmp_path,
        link("trunk", INERTIAL + ball(0.5)),
        link("shin", INERTIAL + shin),
        link("foot", foot),
        joint("knee", "trunk", "shin"),
        joint("ankle", "shin", "foot", "fixed", '<origin xyz="0 0 -0.3"/>'),
    )
    found = {one.name: (one.radius, one.translation[2]) for one in robot.frames}
    assert found == {name: pytest.approx(values) for name, values in expected.items()}


def test_frames_at_the_centre_of_a_ball_have_its_radius(tmp_path):
    """Also those that a log adds, as on /tf_static."""
    robot = loaded(
        tmp_path,
        link("trunk", INERTIAL),
        link("shin", INERTIAL + ball(0.03, "0 0 -.2")),
        link("foot"),
        link("sole"),
        joint("knee", "trunk", "shin"),
        joint("ankle", "shin", "foot", "fixed", '<origin xyz="0 0 -0.2"/>'),
        joint("rubber", "shin", "sole", "fixed", '<origin xyz="0 0 -0.23"/>'),
    )
    added = FixedTransform("sole", "sensor", np.eye(3), np.array([0, 0, 0.03]))
    radii = {one.name: one.radius for one in with_fixed_frames(robot, [added]).frames}
    assert radii == {"foot": 0.03, "sensor": 0.03, "shin_end": 0.03, "sole": 0}


def test_inertias_are_in_the_axes_of_their_origin(tmp_path):
    inertial = (
        '<inertial><origin xyz=".1 .2 .3" rpy=".4 .5 .6"/><mass value="2"/>'
        '<inertia ixx=".3" ixy=".01" ixz=".02" iyy=".4" iyz=".03" izz=".5"/></inertial>'
    )
    robot = loaded(tmp_path, link("a", inertial), link("b", inertial), joint("knee", "a", "b"))
    compiled = mujoco.MjModel.from_xml_path(str(tmp_path / "robot.urdf"))
    mass, com, central = com_from_phi(robot.phi[1])
    index = compiled.body("b").id
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, compiled.body_iquat[index])
    axes = axes.reshape(3, 3)
    assert mass == compiled.body_mass[index] == 2
    np.testing.assert_allclose(com, compiled.body_ipos[index])
    expected = axes @ np.diag(compiled.body_inertia[index]) @ axes.T
    np.testing.assert_allclose(central, expected, atol=1e-12)


@pytest.mark.parametrize(
    ("elements", "code", "names"),
    [
        ([link("a"), link("a")], "E105", "link name 'a' is used twice"),
        ([link("a"), "<link/>"], "E105", "no name"),
        (
            [link("a"), link("b"), joint("i", "a", "b"), joint("j", "a", "b")],
            "E106",
            "'b' is the child of two joints",
        ),
        (
            [link("a"), link("b"), link("c"), joint("i", "b", "c"), joint("j", "c", "b")],
            "E106",
            "2 links are in a loop of joints that is not connected to 'a'",
        ),
        ([link("a"), link("b"), joint("j", "x", "b")], "E106", "unknown parent link 'x'"),
        (
            [link("a", '<inertial><mass value="1"/></inertial>')],
            "E108",
            "'a' lacks mass or inertia",
        ),
        ([link("a", "<inertial><inertia/></inertial>")], "E108", "'a' lacks mass or inertia"),
        ([link("a", "<inertial><mass/><inertia/></inertial>")], "E108", "a mass of 0 kg or more"),
        (
            [link("a", '<inertial><mass value="-1e-9"/><inertia/></inertial>')],
            "E108",
            "a mass of 0 kg or more",
        ),
        ([link("a", INERTIAL.replace('"1"', '"1e10"', 1))], "E108", "outside a robot's range"),
    ],
)
def test_contradictions_are_named(tmp_path, elements, code, names):
    with raises_code(code, names):
        loaded(tmp_path, *elements)


@pytest.mark.parametrize("mass", ["0", "1e9"])
def test_masses_up_to_the_largest_are_accepted(tmp_path, mass):
    inertial = f'<inertial><mass value="{mass}"/><inertia/></inertial>'
    robot = loaded(tmp_path, link("a"), link("b", inertial), joint("j", "a", "b"))
    assert robot.phi[1, 0] == float(mass)


@pytest.mark.parametrize(
    ("origin", "names"),
    [('xyz="1 2"', "three numbers"), ('rpy="1 2 3 4"', "three numbers"), ('xyz="1 2 x"', "'x'")],
)
def test_vectors_have_three_numbers(tmp_path, origin, names):
    with raises_code("E108", names):
        knee(tmp_path, f"<origin {origin}/>")


@pytest.mark.parametrize(("axis", "is_valid"), [("1e-8 0 0", True), ("1e-10 0 0", False)])
def test_an_axis_has_a_direction(tmp_path, axis, is_valid):
    if is_valid:
        np.testing.assert_allclose(knee(tmp_path, f'<axis xyz="{axis}"/>').axis, [1, 0, 0])
    else:
        with raises_code("E108", "'knee' has a zero axis"):
            knee(tmp_path, f'<axis xyz="{axis}"/>')


def test_a_root_floats_unless_it_is_fixed(tmp_path):
    parts = [link("a"), link("b"), joint("knee", "a", "b")]
    assert loaded(tmp_path, *parts).floating
    for base in ("floating", "fixed"):
        robot = loaded(tmp_path, *parts, base=base)
        assert robot.floating is (base == "floating")
        np.testing.assert_array_equal(robot.gravity, [0, 0, -9.81])


@pytest.mark.parametrize("kind", ["fixed", "revolute"])
def test_a_joint_may_hang_from_a_world_that_no_link_defines(tmp_path, kind):
    """Drake's URDFs do so."""
    path = tmp_path / "robot.urdf"
    rest = link("a"), link("b"), joint("hip", "world", "a", kind), joint("knee", "a", "b")

    def heavier(*elements):
        robot = ParameterSet(loaded(tmp_path, *elements, base="fixed"))
        return urdf_text(robot.apply(1.5 * robot.values), path)

    defined = heavier(link("world", ""), *rest)
    assert defined.count('mass value="1.5"') == 2
    assert heavier(*rest) == defined.replace(link("world", ""), "")


@pytest.mark.parametrize("kind", ["fixed", "floating"])
def test_a_massless_world_only_holds_the_base(tmp_path, kind):
    parts = [link("a"), link("b"), joint("knee", "a", "b")]
    turned = '<origin xyz="1 2 3" rpy="1.5707963267948966 0 0"/>'
    robot = loaded(tmp_path, link("world", ""), *parts, joint("base", "world", "a", kind, turned))
    assert robot.link_names == ("a", "b")
    assert robot.floating is (kind == "floating")
    if kind == "fixed":
        np.testing.assert_allclose(robot.gravity, [0, -9.81, 0], atol=1e-9)
    # A world with mass, with two robots or below a moving joint is a link like others.
    heavy = loaded(tmp_path, link("world"), *parts, joint("base", "world", "a", "fixed"))
    assert heavy.link_names == ("world", "b")
    assert not heavy.floating
    hinged = loaded(tmp_path, link("world", ""), *parts, joint("base", "world", "a"))
    assert hinged.link_names == ("world", "a", "b")
    assert not hinged.floating
    two = [link("c"), joint("second", "world", "c", "fixed")]
    both = loaded(tmp_path, link("world", ""), *parts, joint("base", "world", "a", "fixed"), *two)
    assert both.link_names == ("world", "b")
    assert not both.floating


def test_chains_have_a_limited_length(tmp_path):
    def chain(count):
        names = [f"l{i}" for i in range(count)]
        joints = (joint(f"j{i}", f"l{i}", f"l{i + 1}") for i in range(count - 1))
        return [*map(link, names), *joints]

    assert len(loaded(tmp_path, *chain(MAX_DEPTH)).links) == MAX_DEPTH
    with raises_code("E102", f"'l{MAX_DEPTH}' is the end of a chain of more than {MAX_DEPTH}"):
        loaded(tmp_path, *chain(MAX_DEPTH + 1))


@pytest.mark.parametrize(
    ("name", "expanded"),
    [
        ("arm.urdf.xacro", "arm.urdf"),
        ("arm.xacro", "arm.urdf"),
        ("arm.urdf", "arm_expanded.urdf"),
        ("arm", "arm.urdf"),
    ],
)
def test_expanded_files_have_another_name(tmp_path, name, expanded):
    assert expanded_name(tmp_path / name) == expanded


@pytest.mark.parametrize(("factor", "is_named"), [(1.0, False), (1e3, True)])
def test_masses_in_grams_are_reported(factor, is_named, tmp_path, caplog):
    """A rod of aluminium, 0.4 m long, with mass and inertia times a factor."""
    mass, turning = 0.7 * factor, 9.4e-3 * factor
    path = tmp_path / "rod.urdf"
    path.write_text(
        '<robot name="rod"><link name="world"/><joint name="j" type="continuous">'
        '<parent link="world"/><child link="arm"/></joint><link name="arm"><inertial>'
        f'<mass value="{mass}"/><inertia ixx="{0.02 * turning}" iyy="{turning}" izz="{turning}" '
        'ixy="0" ixz="0" iyz="0"/></inertial></link></robot>'
    )
    load_model(path)
    assert ("masses may be in g" in caplog.text) == is_named
