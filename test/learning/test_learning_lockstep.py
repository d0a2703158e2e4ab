"""A robot with a wrong model learns its own in simulated time, and widens its moves with it."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_editing import topic_counts

from symbid_ros.estimation.prior import draw_prior
from symbid_ros.learning import lockstep
from symbid_ros.learning.lockstep import SMOOTH, LearningRecord, LearningRun, LearningTask
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload
from symbid_ros.simulation.reach import least_reach, safe_reach
from symbid_ros.simulation.scenario import WIDE_MOVES

TRUTH = config_file("symbitron.xml")
SIZE = float(WIDE_MOVES.half_widths.max())


@pytest.fixture(scope="module")
def task(tmp_path_factory) -> LearningTask:
    parameters = ParameterSet(load_model(TRUTH))
    wrong = parameters.apply(draw_prior(parameters, "percent", 25.0, 2).mean)
    model = tmp_path_factory.mktemp("model") / "wrong.xml"
    model.write_text(mjcf_text(wrong, TRUTH))
    return LearningTask(model, seconds=3.1)


@pytest.fixture(scope="module")
def bag(tmp_path_factory) -> Path:
    return tmp_path_factory.mktemp("bag") / "bag"


@pytest.fixture(scope="module")
def learning(task, bag) -> LearningRecord:
    return LearningRun(task, learns=True, bag=bag).run()


def test_models_are_taken_over_while_the_deviations_shrink(learning) -> None:
    accepted = [event.time for event in learning.events if event.kind == "accepted"]
    assert accepted[0] == pytest.approx(1.0)
    assert learning.fall is None
    stds = [known.com_std for known in learning.estimates]
    assert np.all(np.diff(stds) < 0)
    truth = load_model(TRUTH).phi[:, 0].sum()
    newest = learning.estimates[-1]
    assert abs(newest.mass - truth) < 5 * newest.mass_std + 0.01 * truth


def test_moves_begin_small_and_widen_with_what_is_known(learning) -> None:
    before = learning.time < 1.0
    assert np.all(learning.reach[before] == least_reach(SIZE))
    assert np.all(np.diff(learning.reach) >= 0)
    first = learning.estimates[0]
    wanted = safe_reach(first.mass_std / first.mass, first.com_std, SIZE)
    assert least_reach(SIZE) < learning.reach[-1] < wanted


def test_the_first_windows_at_rest_do_not_make_a_wrong_file_certain(task, monkeypatch) -> None:
    """Two residuals can all be noise; nothing then says that the file's numbers are exact."""
    monkeypatch.setattr(lockstep, "ESTIMATE_EVERY", 350)
    estimates = LearningRun(replace(task, seconds=1.1), learns=True).run().estimates
    assert len(estimates) == 3
    truth = load_model(TRUTH).phi[:, 0].sum()
    for known in estimates:
        assert abs(known.mass - truth) < 3 * known.mass_std


def test_the_bag_holds_all_topics_of_the_run(learning, bag) -> None:
    counts = topic_counts(bag)
    assert set(counts.values()) == {3100}
    assert {"/joint_states", "/imu/data", "/left_foot/wrench", "/ground_truth/joints"} <= set(
        counts
    )


def test_equal_tasks_give_equal_records(task, learning) -> None:
    again = LearningRun(replace(task, seconds=1.6), learns=True).run()
    assert again.estimates
    np.testing.assert_array_equal(again.applied, learning.applied[: len(again.applied)])
    assert again.estimates == learning.estimates[: len(again.estimates)]


def test_a_payload_moves_the_true_centre_of_mass(task) -> None:
    load = Payload("base_link", 2.0, (0.0, 0.0, 0.2))
    carrying = replace(
        task, model=TRUTH, seconds=1.0, scenario=SMOOTH, payload=load, attached=0.2, removed=0.6
    )
    record = LearningRun(carrying, learns=False).run()
    assert [(event.time, event.kind) for event in record.events] == [
        (0.2, "attached"),
        (0.6, "removed"),
    ]
    # The robot sinks under the load, and rises again without it.
    height = record.error[:, 2]
    loaded, free = (np.argmin(np.abs(record.time - time)) for time in (0.58, 0.98))
    assert height[loaded] < -3e-3
    assert height[free] > height[loaded]
    assert record.feed_forward_share(0.2, 0.6) < record.feed_forward_share(0.0, 0.2)
    assert np.all(record.reach == 1.0)


def test_a_robot_learns_what_it_carries(task) -> None:
    """From the time that the payload is named, the model in use is soon that of the whole."""
    attached, load = 13.1, Payload("L_thigh", 5.0, (0.2, 0.0, 0.05))
    carrying = replace(
        task,
        model=TRUTH,
        seconds=20.5,
        scenario=SMOOTH,
        payload=load,
        attached=attached,
        memory=10.0,
    )
    record = LearningRun(carrying, learns=True).run()
    assert record.fall is None
    (named,) = (event for event in record.events if event.kind == "changed")
    assert named.text.startswith("L_thigh has changed")
    assert named.time < attached + 3.0
    assert [one for one in record.between(named.time, 20.5) if one.kind == "accepted"]
    truth = load_model(TRUTH).phi[:, 0].sum() + load.mass
    newest = record.estimates[-1]
    assert abs(newest.mass - truth) < 5 * newest.mass_std + 0.01
    assert record.com_error(19.5, 20.5) < 0.5 * record.com_error(14.0, 15.0)
    assert np.all(np.diff([known.time for known in record.estimates]) > 0)
