"""A payload added to a running robot is detected, attributed to its link, and tracked."""

import itertools

import numpy as np
import pytest
from live_feed import feed_of

from symbid_ros.estimation.change import LinkChange
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.change_monitor import QUIET, Change
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload

MODEL = config_file("symbitron.xml")
BEGUN, MASS = 11.0, 2.0
PLACE = (0.2, 0.0, 0.05)


@pytest.fixture(scope="module")
def estimates(simulated):
    """Return time and estimate for each second, with a change at 15.5 s."""
    bag = simulated(
        "smooth",
        moves=12,
        motion_seed=3,
        payload=Payload("L_thigh", MASS, PLACE),
        payload_time=BEGUN,
    )
    feed = feed_of(bag)
    options = IdentifyOptions(prior_percent=25.0, joint_terms=("none",))
    state = InitialState.of(load_model(MODEL), options)
    live = OnlineIdentification(state, feed.selected, Pace(memory=5.0, share=1.0))
    results = feed.into(live, solving=1.0)
    live.close()
    return [(result.until * 1e-9, result) for result in results if result is not None]


def test_there_is_no_alarm_before_the_change_and_one_soon_after(estimates) -> None:
    alarms = [(time, result.change) for time, result in estimates if result.change is not None]
    first, change = alarms[0]
    assert BEGUN < first < BEGUN + 5.0
    assert change.suspect.link == "L_thigh"
    assert abs(change.since * 1e-9 - BEGUN) < 2.0
    assert str(change).startswith("L_thigh has changed since 1")


def test_an_alarm_remains_until_the_estimate_starts_anew(estimates) -> None:
    standing = [result.change is not None for _, result in estimates]
    first = standing.index(True)
    last = len(standing) - standing[::-1].index(True)
    assert all(standing[first:last])
    assert last - first < 5
    alarmed = [result.change for _, result in estimates[first:last]]
    assert len({change.since for change in alarmed}) == 1
    assert all(result.followed is None for _, result in estimates[:last])
    followed = [result.followed for _, result in estimates if result.followed is not None]
    assert len(followed) >= QUIET
    assert {(one.since, one.suspect.link) for one in followed} == {(alarmed[0].since, "L_thigh")}
    assert np.all(np.diff([time for time, _ in estimates]) > 0)


def test_an_alarm_names_one_link_if_the_motion_identifies_it(estimates) -> None:
    changes = [result.change for _, result in estimates if result.change is not None]
    assert all(len(change.suspects) == 1 for change in changes)
    assert " or " not in str(changes[0])


def test_an_alarm_names_both_links_if_they_move_alike() -> None:
    std = np.full(10, 0.01)
    on_parent = LinkChange("L_haa", 905.0, 910.0, np.array([2.0, 0.3, 0.0, 0.36, *[0.0] * 6]), std)
    on_child = LinkChange("L_thigh", 900.0, 909.0, np.array([2.0, *[0.0] * 9]), std)
    assert str(Change(14_000_000_000, (on_parent, on_child))) == (
        "L_haa or L_thigh has changed since 14.0 s, the motion does not show which: "
        "+2.00 ± 0.01 kg at (0.15, 0.00, 0.18) m on L_haa, "
        "+2.00 ± 0.01 kg at (0.00, 0.00, 0.00) m on L_thigh"
    )


def test_an_alarm_states_mass_and_position_of_the_payload(estimates) -> None:
    suspect = [result.change for _, result in estimates if result.change is not None][-1].suspect
    assert suspect.phi[0] == pytest.approx(MASS, abs=max(3 * suspect.std[0], 0.1))
    for moment, deviation, place in zip(suspect.phi[1:3], suspect.std[1:3], PLACE, strict=False):
        assert moment == pytest.approx(MASS * place, abs=max(4 * deviation, 0.03))


def test_the_estimate_after_a_change_is_from_later_data_and_what_was_known(estimates) -> None:
    """The first prior stays the reference for what the data have determined."""
    parameters = ParameterSet(load_model(MODEL))
    thigh = parameters.names.index("L_thigh/m")
    time = next(
        time
        for (_, before), (time, result) in itertools.pairwise(estimates)
        if before.change is not None and result.change is None
    )
    assert time < BEGUN + 6.0
    estimate = next(one.found.estimate for at, one in estimates if at > time + 2.0)
    assert estimate.value[thigh] == pytest.approx(
        parameters.values[thigh] + MASS, abs=max(4 * estimate.std[thigh], 0.1)
    )
    before = next(one.found.estimate for at, one in estimates if at > BEGUN - 1.0)
    np.testing.assert_array_equal(estimate.prior, before.prior)
    assert estimate.determined.any()
    total = parameters.link_phi(estimate.value)[:, 0].sum()
    assert total == pytest.approx(41.05 + MASS, abs=0.1)


def test_the_estimate_converges_within_three_time_constants(estimates) -> None:
    parameters = ParameterSet(load_model(MODEL))
    index = parameters.names.index("L_thigh/m")
    time, result = estimates[-1]
    assert time > BEGUN + 15.0
    estimate = result.found.estimate
    truth = parameters.values[index] + MASS
    near = max(0.1 * truth, 2 * estimate.std[index])
    assert estimate.value[index] == pytest.approx(truth, abs=near)
    total = parameters.link_phi(estimate.value)[:, 0].sum()
    assert total == pytest.approx(41.05 + MASS, abs=0.3)
