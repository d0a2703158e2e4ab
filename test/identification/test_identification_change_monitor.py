"""A payload fastened to a running robot is noticed, laid at the right link's door, and followed."""

import numpy as np
import pytest
from live_feed import feed_of

from symbid_ros.estimation.change import LinkChange
from symbid_ros.identification.change_monitor import Change
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload

MODEL = config_file("symbitron.xml")
BEGUN, MASS = 15.5, 2.0
PLACE = (0.2, 0.0, 0.05)


@pytest.fixture(scope="module")
def looks(simulated):
    """Return, second by second, the time and what was known, through a change at 15.5 s."""
    bag = simulated(
        "smooth",
        moves=14,
        motion_seed=3,
        payload=Payload("L_thigh", MASS, PLACE),
        payload_time=BEGUN,
    )
    feed = feed_of(bag)
    state = InitialState.of(load_model(MODEL), IdentifyOptions(prior_percent=25.0))
    live = OnlineIdentification(state, feed.selected, Pace(memory=5.0, share=1.0))
    outcomes = feed.into(live, solving=1.0)
    live.close()
    return [(outcome.until * 1e-9, outcome) for outcome in outcomes if outcome is not None]


def test_there_is_no_alarm_before_the_change_and_one_soon_after(looks) -> None:
    alarms = [(time, outcome.change) for time, outcome in looks if outcome.change is not None]
    first, change = alarms[0]
    assert BEGUN < first < BEGUN + 5.0
    assert change.suspect.link == "L_thigh"
    assert abs(change.since * 1e-9 - BEGUN) < 2.0
    assert str(change).startswith("L_thigh has changed since 1")


def test_an_alarm_stands_until_the_estimate_has_followed(looks) -> None:
    """Even if windows of another length turn out to tell more meanwhile, as they do here."""
    standing = [outcome.change is not None for _, outcome in looks]
    first = standing.index(True)
    last = len(standing) - standing[::-1].index(True)
    assert all(standing[first:last])
    assert len({outcome.change.since for _, outcome in looks[first:last]}) == 1


def test_an_alarm_names_the_link_alone_that_the_motion_tells(looks) -> None:
    changes = [outcome.change for _, outcome in looks if outcome.change is not None]
    assert all(len(change.suspects) == 1 for change in changes)
    assert " or " not in str(changes[0])


def test_an_alarm_names_both_links_that_move_alike() -> None:
    std = np.full(10, 0.01)
    on_parent = LinkChange("L_haa", 905.0, 910.0, np.array([2.0, 0.3, 0.0, 0.36, *[0.0] * 6]), std)
    on_child = LinkChange("L_thigh", 900.0, 909.0, np.array([2.0, *[0.0] * 9]), std)
    assert str(Change(14_000_000_000, (on_parent, on_child))) == (
        "L_haa or L_thigh has changed since 14.0 s, the motion does not tell which: "
        "+2.00 ± 0.01 kg at (0.15, 0.00, 0.18) m on L_haa, "
        "+2.00 ± 0.01 kg at (0.00, 0.00, 0.00) m on L_thigh"
    )


def test_what_was_added_is_told_with_the_alarm(looks) -> None:
    within = [outcome.change for time, outcome in looks if BEGUN + 3.0 < time < BEGUN + 6.0]
    suspect = within[-1].suspect
    assert suspect.phi[0] == pytest.approx(MASS, abs=max(3 * suspect.std[0], 0.1))
    for moment, deviation, place in zip(suspect.phi[1:3], suspect.std[1:3], PLACE, strict=False):
        assert moment == pytest.approx(MASS * place, abs=max(4 * deviation, 0.03))


def test_the_estimate_follows_within_three_memories(looks) -> None:
    parameters = ParameterSet(load_model(MODEL))
    index = parameters.names.index("L_thigh/m")
    time, outcome = looks[-1]
    assert time > BEGUN + 15.0
    estimate = outcome.found.estimate
    truth = parameters.values[index] + MASS
    near = max(0.1 * truth, 2 * estimate.std[index])
    assert estimate.value[index] == pytest.approx(truth, abs=near)
    total = parameters.link_phi(estimate.value)[:, 0].sum()
    assert total == pytest.approx(41.05 + MASS, abs=0.3)
