"""Bodies assembled into links, against MuJoCo; identified links divided among their bodies."""

import mujoco
import numpy as np
import pytest
from expected_errors import raises_code
from random_robots import random_phi, random_rotation, random_samples
from scipy.linalg import eigh

from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.model.bodies import (
    ROUNDING,
    Body,
    BodyJoint,
    assemble,
    divide,
    is_rounding,
    updated_bodies,
)
from symbid_ros.model.export_mjcf import full_inertia
from symbid_ros.model.inertia import com_from_phi, is_consistent, pseudo_inertia, transform_phi
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.rotation import quaternion_from_rotation

NOWHERE = np.eye(3), np.zeros(3)


def words(values):
    return " ".join(repr(float(value)) for value in values)


def random_mjcf(rng, floating):
    """Return an MJCF whose bodies have up to three joints, anywhere in the body, or none."""

    def placed(rotation):
        return (
            f'pos="{words(rng.normal(size=3))}" quat="{words(quaternion_from_rotation(rotation))}"'
        )

    def inertial():
        mass, com, inertia = com_from_phi(random_phi(rng))
        return (
            f'<inertial mass="{mass!r}" pos="{words(com)}" fullinertia="{full_inertia(inertia)}"/>'
        )

    def joint(name):
        kind = rng.choice(["hinge", "slide"])
        return (
            f'<joint name="{name}" type="{kind}" axis="{words(rng.normal(size=3))}" '
            f'pos="{words(rng.normal(size=3))}" ref="{rng.normal()!r}"/>'
        )

    def body(name, depth):
        joints = "".join(joint(f"{name}_{i}") for i in range(rng.integers(0, 4)))
        inside = "".join(body(f"{name}{i}", depth - 1) for i in range(2)) if depth else ""
        site = f'<site name="site_{name}" {placed(random_rotation(rng))}/>'
        return (
            f'<body name="{name}" {placed(random_rotation(rng))}>{joints}{inertial()}{site}{inside}'
            "</body>"
        )

    root = "<freejoint/>" if floating else ""
    return (
        '<mujoco model="random"><compiler angle="radian" boundmass="0"/><worldbody>'
        f'<body name="root">{root}{inertial()}{body("a", 2)}</body></worldbody></mujoco>'
    )


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("floating", [True, False])
def test_bodies_with_several_joints_and_welded_bodies_obey_mujoco(seed, floating, tmp_path):
    rng = np.random.default_rng(seed)
    (tmp_path / "robot.xml").write_text(text := random_mjcf(rng, floating))
    model = load_model(tmp_path / "robot.xml")
    compiled = mujoco.MjModel.from_xml_string(text)
    compiled.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    data = mujoco.MjData(compiled)
    samples = random_samples(model, 3, rng, ())
    parameters = ParameterSet(model)
    needed = equation_of_motion(parameters, samples).K @ parameters.values
    poses = link_poses(model, samples.position)
    first, count = 6 * model.floating, len(model.joints)
    assert count == compiled.nv - first
    if floating:
        data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
        compiled.opt.gravity[:] = 0
    for k in range(len(samples)):
        data.qpos[compiled.nq - count :] = samples.position[k]
        data.qvel[first:], data.qacc[first:] = samples.velocity[k], samples.acceleration[k]
        if floating:
            data.qvel[3:6] = samples.base_angular_velocity[k]
            data.qacc[:3] = samples.base_specific_force[k]
            data.qacc[3:6] = samples.base_angular_acceleration[k]
        mujoco.mj_inverse(compiled, data)
        for index in range(1, compiled.nbody):
            name = compiled.body(index).name
            for mount, truth in (
                (model.frame(name), data.body(name)),
                *([(model.frame(f"site_{name}"), data.site(f"site_{name}"))] if index > 1 else []),
            ):
                axes, origin = poses.rotation[k, mount.link], poses.position[k, mount.link]
                found = axes @ mount.rotation, origin + axes @ mount.translation
                np.testing.assert_allclose(found[0], truth.xmat.reshape(3, 3), atol=1e-12)
                np.testing.assert_allclose(found[1], truth.xpos, atol=1e-12)
        force = data.qfrc_inverse.copy()
        if floating:
            force[:6] = force[[3, 4, 5, 0, 1, 2]]
        np.testing.assert_allclose(needed[k], force, atol=1e-9 * np.abs(force).max())


def body(name, parent, phi=None, **options):
    return Body(name, parent, *NOWHERE, np.zeros(10) if phi is None else phi, **options)


def hinge(name, **options):
    return BodyJoint(name, "revolute", np.array([0.0, 0.0, 2.0]), np.zeros(3), **options)


def assembled(*bodies):
    gravity = np.array([0, 0, -9.81])
    return assemble("robot", bodies, floating=True, gravity=gravity, source="file")


def test_constants_of_joints_are_kept():
    terms = {"reference": 0.1, "lower": -0.2, "upper": 0.3, "effort": 4.0}
    drive = {"damping": 5.0, "friction_loss": 6.0, "armature": 7.0}
    robot = assembled(body("base", -1), body("leg", 0, joints=(hinge("knee", **terms, **drive),)))
    (joint,) = robot.joints
    for name, value in (terms | drive).items():
        assert getattr(joint, name) == value
    np.testing.assert_array_equal(joint.axis, [0, 0, 1])
    plain = assembled(body("base", -1), body("leg", 0, joints=(hinge("knee"),))).joints[0]
    assert (plain.lower, plain.upper, plain.effort) == (-np.inf, np.inf, np.inf)
    assert (plain.reference, plain.damping, plain.friction_loss, plain.armature) == (0, 0, 0, 0)
    assert plain.mimic is None


@pytest.mark.parametrize("wrong", [np.nan, np.inf])
@pytest.mark.parametrize(
    "where", ["rotation", "translation", "phi", "axis", "anchor", "damping", "frame"]
)
def test_numbers_that_are_not_finite_are_rejected(where, wrong):
    options = {"axis": np.array([0.0, 0, 1]), "anchor": np.zeros(3), "damping": 0.0}
    pose = {"rotation": np.eye(3), "translation": np.zeros(3), "phi": np.zeros(10)}
    if where in options:
        options[where] = options[where] + wrong
    elif where in pose:
        pose[where] = pose[where] + wrong
    frames = {"tip": (np.eye(3), np.full(3, wrong if where == "frame" else 0.0))}
    joint = BodyJoint("knee", "revolute", **options)
    leg = Body("leg", 0, joints=(joint,), frames=frames, **pose)
    with raises_code("E108", "leg"):
        assembled(body("base", -1), leg)


def test_zero_axes_and_repeated_frames_are_rejected():
    still = BodyJoint("knee", "revolute", np.zeros(3), np.zeros(3))
    with raises_code("E108", "knee"):
        assembled(body("base", -1), body("leg", 0, joints=(still,)))
    with raises_code("E105", "tip"):
        assembled(body("base", -1, frames={"tip": NOWHERE}), body("tip", 0))


def cloud(seed, count=3):
    rng = np.random.default_rng(seed)
    return np.array([random_phi(rng) for _ in range(count)])


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("first_can_carry", [True, False])
def test_the_first_body_or_the_heaviest_takes_the_change(seed, first_can_carry):
    stated = cloud(seed)
    stated[:, 0] += [0, 1, 3]
    total = 1.1 * stated.sum(axis=0)
    division = divide(stated, total, first_can_carry=first_can_carry)
    receiver = 0 if first_can_carry else 2
    assert (division.receiver, division.kept) == (receiver, 1.0)
    others = np.delete(stated, receiver, axis=0).sum(axis=0)
    np.testing.assert_allclose(division.phi + others, total, atol=1e-12)
    stated[0] = 0.0
    assert divide(stated, total, first_can_carry=first_can_carry).receiver == 2


def test_bodies_without_mass_take_a_change_only_where_the_first_can_carry():
    nothing, total = np.zeros((2, 10)), cloud(0)[0]
    division = divide(nothing, total)
    assert (division.receiver, division.kept) == (0, 1.0)
    np.testing.assert_array_equal(division.phi, total)
    assert divide(nothing, total, first_can_carry=False) is None
    # A first body with a first moment alone has inertia in the file.
    odd = np.zeros((2, 10))
    odd[0, 1], odd[1, 0] = 1.0, 2.0
    assert divide(odd, total).receiver == 0


@pytest.mark.parametrize("part", [slice(0, 1), slice(1, 4), slice(4, 10)])
@pytest.mark.parametrize("entry", [0, -1])
def test_rounding_is_relative_to_mass_first_moment_and_inertia(part, entry):
    value = np.array([1e3, 1, 2, -3, 1e-3, 0, 0, 2e-3, 0, 4e-3])
    for factor, expected in ((0.99, True), (-0.99, True), (1.01, False), (-1.01, False)):
        change = np.zeros(10)
        change[part][entry] = factor * ROUNDING * np.abs(value[part]).max()
        assert is_rounding(change, value) is expected
        stated = np.array([value - change])
        if abs(factor) > 1:  # a change far above rounding of the sum itself
            stated[0][part][entry] -= 1e3 * change[part][entry]
            assert divide(stated, value) is not None
    assert divide(np.array([value]), value) is None


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("lighter", [0.35, 0.6])
def test_other_bodies_give_up_no_more_mass_than_the_total_requires(seed, lighter):
    """They keep nine tenths of what leaves the receiver semi-definite, by eigenvalues."""
    stated = cloud(seed)
    # Most of the link is in the others, and all of it becomes lighter.
    stated[0] *= 0.05
    total = lighter * stated.sum(axis=0)
    division = divide(stated, total)
    others = stated[1:].sum(axis=0)
    assert not is_consistent(stated[0] + total - stated.sum(axis=0))
    assert 0 < division.kept < 1
    np.testing.assert_allclose(division.phi + division.kept * others, total, atol=1e-12)
    assert is_consistent(division.phi)
    most = 1 / eigh(pseudo_inertia(others), pseudo_inertia(total), eigvals_only=True)[-1]
    assert division.kept == pytest.approx(min(0.9 * most, lighter, 1), rel=1e-6)


def test_an_inconsistent_total_changes_only_the_receiver():
    stated = cloud(3)
    stated[0] *= 0.05
    division = divide(stated, -stated.sum(axis=0))
    assert (division.receiver, division.kept) == (0, 1.0)
    np.testing.assert_allclose(division.phi + stated[1:].sum(axis=0), -stated.sum(axis=0))


@pytest.mark.parametrize("scale", [1.2, 0.4])
@pytest.mark.parametrize("rewrite", [True, False])
def test_updated_bodies_add_up_to_the_links(scale, rewrite):
    rng = np.random.default_rng(4)
    leg = Body(
        "leg", 0, random_rotation(rng), rng.normal(size=3), 0.05 * random_phi(rng), (hinge("a"),)
    )
    foot = Body("foot", 1, random_rotation(rng), rng.normal(size=3), random_phi(rng))
    cover = Body("cover", 1, random_rotation(rng), rng.normal(size=3), random_phi(rng))
    frame = Body("marker", 1, *NOWHERE, np.zeros(10))
    bodies = [body("base", -1, random_phi(rng)), leg, foot, cover, frame]
    stated = {one.name: one.phi for one in bodies[::-1]}
    robot = assembled(*bodies)
    same = updated_bodies(robot, stated, rewrite=rewrite)
    assert set(same) == ({"base", "leg", "foot", "cover"} if rewrite else set())
    changed = robot.with_phi(np.array([robot.phi[0], scale * robot.phi[1]]))
    updated = updated_bodies(changed, stated, rewrite=rewrite)
    is_divided = scale < 1
    expected = {"leg", *(("foot", "cover") if is_divided or rewrite else ())}
    assert set(updated) == expected | ({"base"} if rewrite else set())
    total = np.zeros(10)
    for one in (leg, foot, cover):
        mount = robot.frame(one.name)
        phi = updated.get(one.name, one.phi)
        total += transform_phi(phi, mount.rotation, mount.translation)
        assert is_consistent(phi)
    np.testing.assert_allclose(total, changed.phi[1], atol=1e-12)
    if is_divided:
        share = updated["foot"][0] / foot.phi[0]
        assert 0 < share < 1
        np.testing.assert_allclose(updated["cover"], share * cover.phi)
