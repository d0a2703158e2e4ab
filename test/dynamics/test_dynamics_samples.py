"""Samples: a selection of instants applies to each array."""

from dataclasses import fields, replace

import numpy as np
import pytest
from random_robots import random_robot, random_samples

from symbid_ros.dynamics.samples import Samples

# All but the first are None for single instants.
OTHERS = "wrench_frames", "sliding", "leading", "creeping", "friction_state", "upward"
ARRAYS = [field.name for field in fields(Samples) if field.name not in OTHERS]


@pytest.fixture(scope="module")
def samples():
    found = random_samples(random_robot(0), 11, np.random.default_rng(0))
    return replace(found, touching=np.arange(22).reshape(11, 2) % 3 > 0)


@pytest.mark.parametrize("index", [slice(2, 7), slice(None, None, 3), np.array([9, 0, 4])])
def test_a_selection_applies_to_each_array(samples, index):
    chosen = samples[index]
    assert chosen.wrench_frames == samples.wrench_frames
    for name in ARRAYS:
        np.testing.assert_array_equal(getattr(chosen, name), getattr(samples, name)[index])


@pytest.mark.parametrize(
    ("size", "lengths"), [(4, [4, 4, 3]), (11, [11]), (20, [11]), (1, [1] * 11)]
)
def test_blocks_are_consecutive_and_complete(samples, size, lengths):
    blocks = list(samples.blocks(size))
    assert [len(block) for block in blocks] == lengths
    for name in ARRAYS:
        joined = np.concatenate([getattr(block, name) for block in blocks])
        np.testing.assert_array_equal(joined, getattr(samples, name))


def test_samples_without_instants_have_the_shapes_of_the_robot():
    empty = Samples.none(("hip", "knee"))
    assert len(empty) == 0
    assert empty.stamp.dtype == np.int64
    shapes = {name: getattr(empty, name).shape for name in ARRAYS if name != "touching"}
    assert shapes == {
        "stamp": (0,),
        **dict.fromkeys(("position", "velocity", "acceleration", "effort"), (0, 2)),
        "base_angular_velocity": (0, 3),
        "base_angular_acceleration": (0, 3),
        "base_specific_force": (0, 3),
        "wrenches": (0, 0, 6),
    }
    assert empty.wrench_frames == ()
    assert empty.touching is None
    assert not list(empty.blocks(5))
