"""What an MJCF must have to be one robot."""

import numpy as np
import pytest
from expected_errors import raises_code

from symbid_ros.model.load import load_model

INERTIA = '<inertial mass="2" pos="0 0 0" diaginertia="1 1 1"/>'
HINGE = '<joint name="{}" axis="0 1 0"/>'


def body(name, inside="", joint="", **attributes):
    given = "".join(f' {key}="{value}"' for key, value in attributes.items())
    return f'<body name="{name}"{given}>{joint}{INERTIA}{inside}</body>'


def loaded(tmp_path, *bodies, base="auto"):
    path = tmp_path / "robot.xml"
    path.write_text(f"<mujoco><worldbody>{''.join(bodies)}</worldbody></mujoco>")
    return load_model(path, base)


LEG = body("leg", joint=HINGE.format("hip"))
FREE = "<freejoint/>"


@pytest.mark.parametrize(
    ("bodies", "links", "floating"),
    [
        ([body("base", LEG, FREE)], ["base", "leg"], True),
        ([body("base", LEG)], ["base", "leg"], False),
        ([body("base", LEG), body("table")], ["base", "leg"], False),
        ([LEG], ["world", "leg"], False),
        ([LEG, body("arm", joint=HINGE.format("shoulder"))], ["world", "leg", "arm"], False),
        ([body("base", LEG), body("arm", joint=HINGE.format("a"))], ["world", "leg", "arm"], False),
        ([body("table"), body("base", LEG, FREE)], ["base", "leg"], True),
        # What a robot may grasp is no robot, nor part of one.
        ([body("ball", joint=FREE), body("base", LEG, FREE)], ["base", "leg"], True),
        ([body("base", LEG), body("ball", joint=FREE)], ["base", "leg"], False),
        ([LEG, body("ball", body("skin"), FREE)], ["world", "leg"], False),
    ],
)
def test_the_moving_tree_is_the_robot(tmp_path, bodies, links, floating):
    robot = loaded(tmp_path, *bodies)
    assert list(robot.link_names) == links
    assert robot.floating is floating


def test_a_robot_that_hangs_has_its_free_base_welded(tmp_path):
    """Where the file has it: tilted here, so gravity points elsewhere in its axes."""
    tilt = {"pos": "0 0 1", "quat": "0.8 0.6 0 0"}
    welded = loaded(tmp_path, body("base", LEG, FREE, **tilt), base="fixed")
    without = loaded(tmp_path, body("base", LEG, **tilt))
    assert not welded.floating
    assert welded.joint_names == without.joint_names
    np.testing.assert_array_equal(welded.phi, without.phi)
    np.testing.assert_allclose(welded.gravity, without.gravity)
    assert abs(welded.gravity[1]) > 9
    with raises_code("E115", "its base has no free joint"):
        loaded(tmp_path, body("base", LEG), base="floating")


@pytest.mark.parametrize(
    ("bodies", "code", "names"),
    [
        ([body("a", joint=FREE), body("b", joint=FREE)], "E114", "more than one moving tree"),
        ([body("base", LEG, FREE), body("arm", joint=HINGE.format("a"))], "E114", "more than one"),
        (
            [body("base", body("leg", joint="<joint/>"))],
            "E105",
            r": line \d+: a joint has no name",
        ),
        (
            [body("base", body("leg", joint='<joint name="hip" type="ball"/>'))],
            "E107",
            "'hip' is a ball",
        ),
        ([body("base")], "E114", "no joint moves"),
    ],
)
def test_other_trees_are_rejected(tmp_path, bodies, code, names):
    with raises_code(code, names):
        loaded(tmp_path, *bodies)


def test_gravity_is_in_the_axes_of_a_fixed_base(tmp_path):
    turned = body("base", LEG, quat="0.5 0.5 0.5 0.5", pos="1 2 3")  # x to y, y to z, z to x
    np.testing.assert_allclose(loaded(tmp_path, turned).gravity, [0, -9.81, 0], atol=1e-12)
    free = body("base", LEG, FREE, quat="0.5 0.5 0.5 0.5")
    np.testing.assert_array_equal(loaded(tmp_path, free).gravity, [0, 0, -9.81])
    np.testing.assert_array_equal(loaded(tmp_path, LEG).gravity, [0, 0, -9.81])


def test_sites_are_frames_unless_they_are_a_bodys_origin(tmp_path):
    sites = (
        '<site name="leg"/><site name="tip" pos="0 0 1"/><site pos="0 1 0"/>'
        '<site name="base" pos="0 0 .5"/>'
    )
    leg = body("leg", sites, HINGE.format("hip"))
    robot = loaded(tmp_path, body("base", leg, FREE))
    assert [frame.name for frame in robot.frames] == ["base:site", "tip"]
    np.testing.assert_array_equal(robot.frame("tip").translation, [0, 0, 1])
    assert robot.frame("base").link == 0
    aside = body("leg", '<site name="leg" pos="0 0 1e-3"/>', HINGE.format("hip"))
    frames = loaded(tmp_path, body("base", aside, FREE)).frames
    assert [frame.name for frame in frames] == ["leg:site"]


BALL = '<geom {}type="sphere" size="0.02" pos="0 0 -0.3"/>'
CAPSULE = '<geom name="shin" type="capsule" size="0.03 0.1" pos="0 0 -0.1"/>'


@pytest.mark.parametrize(
    ("shapes", "frame", "place", "radius"),
    [
        (BALL.format('name="foot" '), "foot", -0.3, 0.02),
        (BALL.format(""), "leg_end", -0.3, 0.02),
        (BALL.format("") + CAPSULE, "leg_end", -0.3, 0.02),
        (CAPSULE, "shin", -0.2, 0.03),
        # Shapes with meshes, which need not exist, and shapes that touch nothing.
        ('<geom type="mesh" mesh="lost"/>' + BALL.format(""), "leg_end", -0.3, 0.02),
        (BALL.format('contype="0" conaffinity="0" '), None, 0, 0),
        # Not one ball, or not at the end.
        (2 * BALL.format(""), None, 0, 0),
        (BALL.format("") + body("toe", joint=HINGE.format("toe")), None, 0, 0),
        ('<geom type="box" size="0.1 0.1 0.1"/>', None, 0, 0),
        # The name is that of another frame.
        (BALL.format('name="base" '), "leg_end", -0.3, 0.02),
    ],
)
def test_the_ball_at_the_end_of_a_leg_is_a_frame(tmp_path, shapes, frame, place, radius):
    leg = body("leg", shapes, HINGE.format("hip"))
    robot = loaded(tmp_path, body("base", leg, FREE))
    found = {one.name: one for one in robot.frames}
    if frame is None:
        assert not found
        return
    assert list(found) == [frame]
    assert found[frame].radius == radius
    assert robot.link_names[found[frame].link] == "leg"
    np.testing.assert_allclose(found[frame].translation, [0, 0, place], atol=1e-12)


SITE = '<site name="{}" pos="0 0 {}"/>'


@pytest.mark.parametrize(
    ("inside", "radii"),
    [
        # As in the file of Unitree's Go1: shape and site share their name.
        (BALL.format('name="FR" ') + SITE.format("FR", -0.3), {"FR": 0.02}),
        (BALL.format('name="FR" ') + SITE.format("FR", -0.2), {"FR": 0, "leg_end": 0.02}),
        (
            BALL.format('name="FR" ') + SITE.format("foot", -0.3009) + SITE.format("shin", -0.302),
            {"FR": 0.02, "foot": 0.02, "shin": 0},
        ),
        # Of two balls, that at a site.
        (2 * BALL.format("") + SITE.format("foot", -0.3), {"foot": 0}),
        (
            BALL.format("") + '<geom size="0.01"/>' + SITE.format("foot", -0.3),
            {"foot": 0.02, "leg_end": 0.02},
        ),
        # A welded body at the centre.
        (body("foot", '<geom size="0.02"/>', pos="0 0 -0.3"), {"foot": 0.02, "foot_end": 0.02}),
    ],
)
def test_frames_at_the_centre_of_a_ball_have_its_radius(tmp_path, inside, radii):
    robot = loaded(tmp_path, body("base", body("leg", inside, HINGE.format("hip")), FREE))
    assert {one.name: one.radius for one in robot.frames} == radii


def test_a_shape_that_cannot_be_compiled_is_left_out(tmp_path):
    path = tmp_path / "robot.xml"
    shape = '<default><geom type="mesh" mesh="lost"/></default>'
    leg = body("leg", "<geom/>", HINGE.format("hip"))
    path.write_text(f"<mujoco>{shape}<worldbody>{body('base', leg, FREE)}</worldbody></mujoco>")
    assert load_model(path).link_names == ("base", "leg")


def test_bodies_without_a_name_are_numbered(tmp_path):
    bare = f"<body>{HINGE.format('hip')}{INERTIA}</body>"
    assert loaded(tmp_path, body("base", bare, FREE)).link_names == ("base", "body_2")


def test_limits_count_only_where_they_are_on(tmp_path):
    joints = (
        '<joint name="a" range="-1 2" limited="true" axis="0 0 1"/>'
        '<joint name="b" range="-1 2" limited="false" type="slide"/>'
        '<joint name="c" axis="1 0 0" ref="30" damping=".1" frictionloss=".2" armature=".3"/>'
    )
    text = f"<compiler angle='degree'/><worldbody>{body('base', body('leg', joint=joints))}"
    path = tmp_path / "robot.xml"
    path.write_text(f"<mujoco>{text}</worldbody></mujoco>")
    a, b, c = load_model(path).joints
    np.testing.assert_allclose([a.lower, a.upper], np.radians([-1, 2]))
    assert (b.lower, b.upper, b.kind) == (-np.inf, np.inf, "prismatic")
    assert c.reference == pytest.approx(np.radians(30))
    assert (c.damping, c.friction_loss, c.armature) == (0.1, 0.2, 0.3)
    assert (a.damping, a.friction_loss, a.armature, a.reference, a.effort) == (0, 0, 0, 0, 0)
