"""Combined rows of the equation of motion that no unmeasured contact wrench enters."""

from dataclasses import replace

import numpy as np
import pytest
from quadruped_log import FEET, quadruped_urdf

from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.errors import ModelError
from symbid_ros.estimation.information import random_motions
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.weak_form import sampled_rows

POINTS = tuple(f"{foot}:point" for foot in FEET)


@pytest.fixture(scope="module")
def quadruped(tmp_path_factory):
    path = tmp_path_factory.mktemp("model") / "quadruped.urdf"
    path.write_text(quadruped_urdf())
    return load_model(path)


@pytest.mark.parametrize("contacts", [POINTS, POINTS[:2], FEET[:2], (FEET[0], "LF_HAA_link:point")])
def test_no_wrench_at_a_contact_enters_the_rows(quadruped, contacts):
    model = with_contacts(quadruped, contacts)
    frames = tuple(name.partition(":")[0] for name in contacts)
    rng = np.random.default_rng(1)
    motion = random_motions(quadruped, 30)
    wrenches = 100 * rng.normal(size=(30, len(frames), 6))
    wrenches[:, [name.endswith(":point") for name in contacts], :3] = 0.0
    touched = replace(motion, wrenches=wrenches, wrench_frames=frames)
    parameters = ParameterSet(model)
    with_load, without = (equation_of_motion(parameters, one) for one in (touched, motion))
    size = np.abs(equation_of_motion(ParameterSet(quadruped), touched).y).max()
    np.testing.assert_allclose(with_load.y, without.y, atol=1e-9 * size)
    np.testing.assert_array_equal(with_load.K, without.K)
    # As many rows are left as there are directions without contact.
    components = sum(3 if name.endswith(":point") else 6 for name in contacts)
    left = model.contacts.coordinates
    assert len(left) >= model.dof - components
    assert np.linalg.matrix_rank(without.K[:, left].reshape(len(left) * 30, -1)) > len(left)


def test_a_missing_effort_or_a_sticking_joint_spoils_only_combinations_that_contain_it(quadruped):
    two = with_contacts(quadruped, POINTS[:2])
    parameters = ParameterSet(two)
    motion = random_motions(quadruped, 10)
    effort = np.zeros((10, 12))
    effort[:3, 0] = np.nan  # a joint of a leg that touches
    effort[5:, 8] = np.nan  # a joint of a leg in the air
    rows = sampled_rows(parameters, replace(motion, effort=effort))
    first = 6 + 6  # the legs in the air
    kept = two.contacts.coordinates
    touching = kept[kept < first]
    assert set(range(first, 18)) <= set(kept.tolist())
    assert not rows.valid[:3, touching].any()
    assert rows.valid[3:, touching].all()
    assert rows.valid[:5, first:].all()
    assert not rows.valid[5:, 6 + 8].any()
    assert rows.valid[5:, 6 + 9].all()
    assert not rows.valid[:, np.setdiff1d(np.arange(18), kept)].any()


def test_contacts_that_explain_everything_are_refused(quadruped):
    with pytest.raises(ModelError, match="mark points as FRAME:point"):
        with_contacts(quadruped, FEET)
