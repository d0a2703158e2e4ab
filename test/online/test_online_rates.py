"""Live topics at low and different rates give the estimate of their bag."""

from pathlib import Path

import numpy as np
import pytest
from live_feed import feed_of
from random_logs import LogPlan, random_streams, small_robot, write_bag

from symbid_ros.estimation.archive import write_archive
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import BagRequest
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.signals.weak_form import ALL_WINDOWS, suitable_windows

START = 1_723_456_789_012_345_678


@pytest.fixture(scope="module", params=[20.0], ids="{:g} Hz".format)
def robot_and_bag(request, tmp_path_factory) -> tuple[Path, Path, float]:
    folder = tmp_path_factory.mktemp("slow")
    path = folder / "robot.urdf"
    path.write_text(urdf_text(small_robot(3, floating=True)))
    # Over the end of a minute, where an offline run begins another slice.
    plan = LogPlan(request.param, round(65 * request.param), START, ratios=(2.0, 0.5))
    return path, write_bag(random_streams(load_model(path), plan, 1), folder / "log"), plan.rate


def test_data_that_end_before_the_first_estimate_are_used(robot_and_bag) -> None:
    model, bag, _ = robot_and_bag
    options = IdentifyOptions(prior_percent=25.0, method="map")
    feed = feed_of(bag)
    live = OnlineIdentification(
        InitialState.of(load_model(model), options), feed.selected, Pace(in_step=True)
    )
    feed.into(live)
    list(live._scheduler.partial_blocks())  # the parts of blocks that have arrived
    live.advance()
    assert live.has_news
    outcome = live.solve()
    live.close()
    assert outcome is not None
    assert outcome.until > feed.messages[0][0]
    assert not live.has_news  # equal data would give the same estimate again and again


def test_live_messages_at_low_rates_give_the_estimate_of_their_bag(robot_and_bag, tmp_path) -> None:
    model, bag, rate = robot_and_bag
    expected = suitable_windows(ALL_WINDOWS, rate)

    def initial(**chosen) -> InitialState:
        options = IdentifyOptions(prior_percent=25.0, method="map", **chosen)
        return InitialState.of(load_model(model), options)

    live = OnlineIdentification(initial(), (feed := feed_of(bag)).selected, Pace(share=1))
    outcomes = feed.into(live, solving=8.0)
    assert [outcome for outcome in outcomes if outcome is not None]
    exact = live.solve(exactly=True).found
    live.close()
    solved = BagRequest((bag,), model, initial().options).load().solved
    offline = solved.problem.data
    assert [one.window for one in exact.observations] == [one.window for one in offline]
    assert tuple(one.window for one in offline) == expected
    for one, other in zip(exact.observations, offline, strict=True):
        assert one.rows.samples == other.rows.samples
        gram, known = (each.rows.factor.T @ each.rows.factor for each in (one, other))
        scale = np.sqrt(np.diag(known))
        assert np.all(np.abs(gram - known) <= 1e-9 * np.outer(scale, scale))

    # Resumed, it has the windows of the run before.
    archive = tmp_path / "information.npz"
    write_archive(archive, exact.observations)
    resumed = initial(information=archive)
    assert tuple(one.window for one in resumed.observations) == expected
