"""Weighing, left/right symmetry and bounds as rows."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import CONFIG, random_phi, random_rotation

from symbid_ros.errors import EstimateError
from symbid_ros.estimation.constraints import (
    Bounds,
    mirror_pairs,
    mirror_rows,
    total_mass_row,
)
from symbid_ros.estimation.prior import model_prior
from symbid_ros.model.inertia import phi_from_pseudo_inertia, transform_phi
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import Joint, Link, RobotModel


@pytest.fixture(scope="module")
def symbitron():
    return ParameterSet(load_model(CONFIG / "symbitron.xml"), terms=("viscous",))


@pytest.mark.parametrize("file", ["symbitron.xml", "symbitron.urdf"])
def test_the_symbitron_is_mirrored_in_its_links_z_axes(file):
    parameters = ParameterSet(load_model(CONFIG / file))
    pairs = mirror_pairs(parameters)
    parts = ("haa", "thigh", "shank", "ankle", "foot")
    assert [(p.left, p.right) for p in pairs] == [(f"L_{x}", f"R_{x}") for x in parts]
    # m, then mc_x to mc_z, then Ixx, Ixy, Ixz, Iyy, Iyz, Izz
    signs = [1, 1, 1, -1, 1, 1, -1, 1, -1, 1]
    for pair in pairs:
        np.testing.assert_allclose(pair.transform, np.diag(signs), atol=1e-12)


def test_the_true_symbitron_satisfies_its_symmetry_and_weight(symbitron):
    prior = model_prior(symbitron)
    rows, targets = mirror_rows(symbitron, prior.std, 0.1)
    assert rows.shape == (50, len(symbitron))
    np.testing.assert_allclose(rows @ symbitron.values, targets, atol=1e-9)
    row, target = total_mass_row(symbitron, 41.05, 0.02)
    assert target == pytest.approx(41.05 / 0.02)
    assert row @ symbitron.values * 0.02 == pytest.approx(symbitron.model.phi[:, 0].sum())


def test_mirror_rows_have_the_given_share_of_the_priors_deviation(symbitron):
    std = model_prior(symbitron).std
    rows, _ = mirror_rows(symbitron, std, 0.1)
    mass = symbitron.names.index("L_thigh/m")
    changed = symbitron.values.copy()
    changed[mass] += 0.1 * std[mass]
    residual = rows @ changed
    assert np.count_nonzero(np.abs(residual) > 1e-6) == 1
    assert np.abs(residual).max() == pytest.approx(1, rel=1e-9)


def mirrored_robot(rng, *, left="left", right="right"):
    """Two random legs of two links, mirror images by their point masses, in unlike frames."""
    mirror = np.diag([1.0, -1.0, 1.0])
    links, joints = [Link("body", random_phi(rng))], []
    chain = []
    for part in ("thigh", "shank"):
        origin, axis = rng.normal(size=3) * 0.3, rng.normal(size=3)
        points = rng.normal(size=(6, 3)) * 0.2 + origin
        mass = rng.uniform(0.1, 1.0, 6)
        chain.append((part, origin, axis / np.linalg.norm(axis), points, mass))
    for side, flip in ((left, np.eye(3)), (right, mirror)):
        parent_rotation, parent_origin, parent = np.eye(3), np.zeros(3), 0
        for part, origin, axis, points, mass in chain:
            rotation = random_rotation(rng)
            # A hinge's frame may sit anywhere on its axis.
            place = flip @ (origin + rng.normal() * 0.1 * axis)
            local = (points @ flip.T - place) @ rotation
            homogeneous = np.c_[local, np.ones(6)]
            phi = phi_from_pseudo_inertia(homogeneous.T @ (homogeneous * mass[:, None]))
            links.append(Link(f"{side}_{part}", phi))
            joints.append(
                Joint(
                    f"{side}_{part}_joint",
                    "revolute",
                    parent,
                    parent_rotation.T @ rotation,
                    parent_rotation.T @ (place - parent_origin),
                    rotation.T @ flip @ axis * rng.choice([-1, 1]),
                )
            )
            parent, parent_rotation, parent_origin = len(links) - 1, rotation, place
    return RobotModel(
        "mirrored", tuple(links), tuple(joints), (), True, np.array([0, 0, -9.81]), "test"
    )


@pytest.mark.parametrize("seed", range(5))
def test_mirror_images_may_have_any_frames(seed):
    parameters = ParameterSet(mirrored_robot(np.random.default_rng(seed)))
    pairs = mirror_pairs(parameters)
    assert [pair.left for pair in pairs] == ["left_thigh", "left_shank"]
    for pair in pairs:
        left, right = (
            parameters.model.phi[parameters.model.link_names.index(name)]
            for name in (pair.left, pair.right)
        )
        np.testing.assert_allclose(pair.transform @ right, left, atol=1e-12)


def test_legs_that_are_not_mirror_images_are_not_tied():
    rng = np.random.default_rng(1)
    model = mirrored_robot(rng)
    moved = list(model.joints)
    moved[1] = replace(moved[1], translation=moved[1].translation + 0.01)
    other = ParameterSet(replace(model, joints=tuple(moved)))
    # The thigh carries that knee, so that neither half is the other's image.
    assert mirror_pairs(other) == ()
    with pytest.raises(EstimateError, match="leave `mirror` out"):
        mirror_rows(other, np.ones(len(other)), 0.1)
    swapped = ParameterSet(mirrored_robot(rng, left="first", right="second"))
    assert mirror_pairs(swapped) == ()


@pytest.mark.parametrize(
    ("left", "right"),
    [
        ("left", "right"),
        ("L", "R"),
        ("l", "r"),
        ("Left", "Right"),
        ("FL", "FR"),
        ("RL", "RR"),
        ("LH", "RH"),
        ("front_left", "front_right"),
        ("leg-left", "leg-right"),
    ],
)
def test_sides_are_known_by_their_usual_names(left, right):
    model = mirrored_robot(np.random.default_rng(3), left=left, right=right)
    pairs = mirror_pairs(ParameterSet(model))
    assert [(p.left, p.right) for p in pairs] == [
        (f"{left}_{part}", f"{right}_{part}") for part in ("thigh", "shank")
    ]


@pytest.mark.parametrize(
    "names", [("LThigh", "RThigh"), ("thigh_l", "thigh_r"), ("leftThigh", "rightThigh")]
)
def test_the_side_may_be_at_either_end_of_a_name(names):
    model = mirrored_robot(np.random.default_rng(3))
    renamed = {"left_thigh": names[0], "right_thigh": names[1]}
    links = tuple(replace(link, name=renamed.get(link.name, link.name)) for link in model.links)
    pairs = mirror_pairs(ParameterSet(replace(model, links=links)))
    assert (pairs[0].left, pairs[0].right) == names


def test_a_reflection_maps_point_masses():
    rng = np.random.default_rng(0)
    points, mass = rng.normal(size=(6, 3)), rng.uniform(1, 2, 6)
    reflection, offset = np.diag([1.0, 1.0, -1.0]) @ random_rotation(rng), rng.normal(size=3)

    def phi(points):
        homogeneous = np.c_[points, np.ones(6)]
        return phi_from_pseudo_inertia(homogeneous.T @ (homogeneous * mass[:, None]))

    np.testing.assert_allclose(
        transform_phi(phi(points), reflection, offset),
        phi(points @ reflection.T + offset),
        rtol=1e-10,
        atol=1e-10,
    )


def test_bounds_are_one_sided_rows_with_equations_first(symbitron):
    matrix = np.eye(3, 4)
    bounds = Bounds(
        ("a", "b", "c"), matrix, np.array([-np.inf, 2.0, 1.0]), np.array([5.0, 2.0, 3.0])
    )
    rows, offset, equations = bounds.one_sided(6)
    assert equations == 1
    np.testing.assert_array_equal(rows[:, :4], matrix[[1, 2, 0, 2]] * [[1], [1], [-1], [-1]])
    np.testing.assert_array_equal(rows[:, 4:], 0)
    np.testing.assert_array_equal(offset, [2, 1, -5, -3])
    both = bounds + bounds
    assert both.names == ("a", "b", "c") * 2
    assert Bounds.nonnegative(ParameterSet(symbitron.model)).names == ()


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (lambda p: total_mass_row(p, -1.0, 0.1), "kg is not valid"),
        (lambda p: total_mass_row(p, 40.0, 0.0), "kg is not valid"),
        (lambda p: total_mass_row(p, np.nan, 0.1), "kg is not valid"),
        (lambda p: mirror_rows(p, np.ones(len(p)), 0.0), "positive"),
        (lambda p: Bounds.total_mass(p, 3.0, 2.0), "nothing lies between 3 and 2"),
        (lambda p: Bounds.total_mass(p, np.nan, 2.0), "nothing lies between"),
        (
            lambda p: Bounds(("x",), np.zeros((1, 4)), np.zeros(1), np.ones(1)),
            "x: the bound concerns no parameter",
        ),
    ],
)
def test_invalid_constraints_are_rejected(symbitron, build, message):
    with pytest.raises(EstimateError, match=message) as caught:
        build(symbitron)
    assert "\n" not in str(caught.value)
