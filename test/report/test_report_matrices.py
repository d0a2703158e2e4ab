"""Matrices show what they say: share of information, sign and size of correlations, changes."""

import base64
import io
from dataclasses import replace

import numpy as np
import pytest
from matplotlib.image import imread
from report_pages import content_of_a_log

from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.report.content import ParameterCorrelation
from symbid_ros.report.matrices import (
    NEGATIVE,
    POSITIVE,
    correlation_image,
    determined_matrices,
    largest_changes,
)


def test_the_picture_has_the_sign_as_colour_and_the_size_as_opacity():
    matrix = np.array([[1.0, 0.5, -0.2], [0.5, 1.0, 0.0], [-0.2, 0.0, 1.0]])
    names = ("base/m", "arm/m", "elbow/viscous")
    image = correlation_image(ParameterCorrelation(names, matrix))
    data = base64.b64decode(image.address.partition(",")[2])
    pixels = np.round(255 * imread(io.BytesIO(data), format="png")).astype(int)
    assert pixels.shape == (3, 3, 4)
    assert tuple(pixels[0, 1]) == (*POSITIVE, 128)
    assert tuple(pixels[2, 0]) == (*NEGATIVE, 51)
    assert pixels[1, 2, 3] == pixels[0, 0, 3] == 0
    assert image.groups == (("base", 1), ("arm", 1), ("joint terms", 1))
    assert image.pairs[0] == ("base/m", "arm/m", "+0.500")
    assert image.pairs[1] == ("base/m", "elbow/viscous", "−0.200")


def test_the_share_of_information_is_that_of_the_variances():
    estimate = content_of_a_log(2).estimate
    prior_std = 2 * estimate.std
    (matrix,) = determined_matrices(estimate, prior_std)
    assert len(matrix.rows) == 3
    for _, cells in matrix.rows:
        assert [cell.share for cell in cells] == [0.75] * 10
        assert [cell.is_determined for cell in cells] == [True, False] * 5
    assert "75 % from the data" in matrix.rows[0][1][0].text


def test_without_saved_deviations_cells_say_yes_or_no():
    estimate = content_of_a_log(2).estimate
    (matrix,) = determined_matrices(estimate, None)
    assert [cell.share for cell in matrix.rows[0][1]] == [1.0, 0.0] * 5


def test_largest_changes_are_in_deviations_of_the_original():
    estimate = content_of_a_log(2).estimate
    prior_std = np.full(len(estimate.names), 0.05)
    found = largest_changes(estimate, prior_std)
    change = np.abs(estimate.value - estimate.prior) / 0.05
    assert found[0].name == estimate.names[int(np.argmax(change))]
    sizes = [float(one.deviations.replace("−", "-")) for one in found]
    assert sizes == pytest.approx(np.sort(change)[::-1][: len(found)], abs=0.051)
    assert largest_changes(estimate, None) == ()


def test_changes_of_links_come_before_larger_ones_of_joint_terms():
    estimate = content_of_a_log(2).estimate
    names = (*estimate.names[:-1], "elbow/armature")
    estimate = replace(estimate, names=names)
    prior_std = np.full(len(names), 0.05)
    prior_std[-1] = 1e-6
    found = [one.name for one in largest_changes(estimate, prior_std)]
    assert found.count("elbow/armature") == 1
    assert found[-1] == "elbow/armature"


def test_names_beside_the_correlations_of_a_large_robot_have_room():
    names = tuple(f"link_{link}/{kind}" for link in range(60) for kind in PARAMETERS)
    picture = correlation_image(ParameterCorrelation(names, np.eye(len(names))))
    starts = np.cumsum([0, *(count for _, count in picture.groups)])[:-1]
    named = [start for start, (name, _) in zip(starts, picture.groups, strict=True) if name]
    assert starts[-1] == 590
    assert np.diff(named).min() * 22 >= len(names)
