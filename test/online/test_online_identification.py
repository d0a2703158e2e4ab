"""Live messages give the same estimate as their bag, in spite of disturbances."""

import logging
import re
import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from bag_editing import Messages, edit_bag
from junk_messages import some_malformed
from live_feed import Feed, feed_of

from symbid_ros.bags import read_streams
from symbid_ros.errors import DataError, EstimateError
from symbid_ros.estimation.alarms import Alarm
from symbid_ros.estimation.archive import write_archive
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.dataset import Processing, fold_dataset
from symbid_ros.identification.solved_problem import SolvedProblem
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest
from symbid_ros.online.estimate import OnlineEstimate
from symbid_ros.online.identification import OnlineIdentification, Pace
from symbid_ros.online.initial_state import InitialState
from symbid_ros.online.live_streams import LiveStreams
from symbid_ros.online.live_terms import LiveTerms
from symbid_ros.package_paths import config_file
from symbid_ros.signals.alignment import align_checked

MODEL = config_file("symbitron.xml")
LOG = {"scenario": "smooth", "moves": 2, "motion_seed": 7, "noise_seed": 3}
LINKS = {"joint_terms": ("none",)}  # half the work where joint terms do not matter
UNPACED = Pace(share=1.0)


@pytest.fixture(scope="module")
def parameters():
    return ParameterSet(load_model(MODEL))


@pytest.fixture(scope="module")
def bag(simulated) -> Path:
    return simulated(**LOG)


@pytest.fixture(scope="module")
def feed(bag):
    return feed_of(bag)


@pytest.fixture(scope="module")
def offline(bag):
    return BagRequest((bag,), MODEL, options()).load()


@pytest.fixture(scope="module")
def folded(bag, parameters):
    """Return the observations of the whole log, without joint terms."""
    segments = align_checked(read_streams([bag]), parameters.model)
    return fold_dataset(segments, str(bag), parameters, Processing()).observations


@pytest.fixture
def start(feed):
    """Start online identifications, and close them at the end of the test."""
    begun = []

    def begin(pace=UNPACED, **chosen):
        begun.append(OnlineIdentification(initial(**chosen), feed.selected, pace))
        return begun[-1]

    yield begin
    for one in begun:
        one.close()


def options(**chosen):
    return IdentifyOptions(**({"prior_percent": 25.0, "method": "map"} | chosen))


def initial(**chosen):
    return InitialState.of(load_model(MODEL), options(**chosen))


def gram(observations):
    """Return RᵀR of the rows and of the noise in them."""
    return [one.factor.T @ one.factor for one in (observations.rows, observations.noise)]


def assert_same(online, offline, *, rel=1e-9):
    """Compare what was observed over every window: information 1e-9 relative to its size."""
    assert [one.window for one in online] == [one.window for one in offline]
    for one, other in zip(online, offline, strict=True):
        assert one.rows.samples == other.rows.samples
        assert one.seconds == other.seconds != frozenset()
        np.testing.assert_array_equal(one.counts, other.counts)
        for found, expected in zip(gram(one), gram(other), strict=True):
            scale = np.sqrt(np.diag(expected))
            assert np.all(np.abs(found - expected) <= rel * np.outer(scale, scale))


def test_an_estimate_on_the_way_has_the_alarms_of_a_verdict(start, feed) -> None:
    """Such as the one that the data add nothing to a prior that is nearly certain."""
    live = start(prior_percent=1e-3, **LINKS)
    *_, quick = feed.into(live, solving=1.0)
    exact = live.solve(exactly=True)
    assert quick.found.estimate.verdict is None
    for one in (quick, exact):
        assert any(Alarm.NOTHING in alarm for alarm in one.alarms)
    assert exact.alarms == exact.found.alarms


def test_a_truncated_method_does_not_contradict_possible_links(start, feed) -> None:
    """Its estimate is far from the most probable one, whatever the data say."""
    live = start(method="ols", **LINKS)
    feed.into(live)
    found = live.solve(exactly=True)
    assert found.found.factor is None
    assert found.alarms == ()


def test_live_messages_give_the_estimate_of_their_bag(start, feed, offline) -> None:
    live = start()
    outcomes = feed.into(live, solving=1.0)
    # Estimates on the way know what is new, whole block or not.
    late = [feed.messages[-1][0] - outcomes[-1].until, 0.0]
    assert max(late) < 1e9
    # Such an estimate has no verdict, but says how its rows were averaged.
    assert outcomes[-1].found.estimate.rows.window == outcomes[-1].window
    known = [outcome.found.estimate.std for outcome in outcomes]
    assert np.min(known[-1] / known[0]) < 0.5

    exact = live.solve(exactly=True)
    solved = offline.solved
    assert_same(exact.found.observations, solved.problem.data)
    estimate, expected = exact.found.estimate, offline.solve().estimate
    assert estimate.joint_terms == expected.joint_terms
    assert np.all(np.abs(estimate.value - expected.value) <= 1e-7 * expected.std)
    assert exact.found.estimate.verdict.window == solved.chosen.window
    assert exact.until == feed.messages[-1][0]


def test_an_estimate_includes_the_end_of_a_block_still_being_processed(start, feed) -> None:
    live = start(Pace(share=1e-6))
    feed.between(0.0, 3.5).into(live)
    assert live.solve().until == pytest.approx(3.5e9, abs=2e6)
    feed.between(3.5, 4.2).into(live)
    assert live.solve().until >= 4e9 - 1
    # All of it was taken, a piece of one block after that of another.
    feed.between(4.2, 5.0).into(live)
    assert live.solve().until == pytest.approx(5e9, abs=2e6)


def test_has_news_once_every_topic_has_newer_messages(start, feed) -> None:
    live = start(**LINKS)
    assert not live.has_news
    feed.between(0.0, 3.0).into(live)
    assert live.has_news
    live.solve()
    assert not live.has_news
    later = feed.between(3.0, 3.2)
    replace(later, messages=tuple(m for m in later.messages if "wrench" not in m[1].name)).into(
        live
    )
    assert not live.has_news  # an estimate needs the wrenches as well
    replace(later, messages=tuple(m for m in later.messages if "wrench" in m[1].name)).into(live)
    assert live.has_news
    live.solve(exactly=True)
    assert not live.has_news
    live.reset()
    assert not live.has_news


def test_live_and_offline_data_are_equal_at_any_time(start, feed, parameters, bag) -> None:
    streams = read_streams([bag])
    live, done = start(**LINKS), 0.0
    for stop in (3.0, 4.0, 7.3, 8.0):
        feed.between(done, stop).into(live)
        done = stop
        segments = align_checked(_cut(streams, stop), parameters.model)
        cut = fold_dataset(segments, str(bag), parameters, Processing())
        assert_same(live.solve(exactly=True).found.observations, cut.observations)


def _cut(streams, stop):
    """Return the streams up to ``stop``, s."""

    def part(stream, *names):
        kept = stream.stamp * 1e-9 < stop
        return replace(stream, **{name: getattr(stream, name)[kept] for name in names})

    joints = part(streams.joints, "stamp", "position", "velocity", "effort")
    imus = tuple(
        part(one, "stamp", "orientation", "angular_velocity", "linear_acceleration")
        for one in streams.imus
    )
    wrenches = tuple(part(one, "stamp", "force", "torque") for one in streams.wrenches)
    return replace(streams, joints=joints, imus=imus, wrenches=wrenches)


def test_bursts_and_disordered_messages_change_nothing(start, feed, folded) -> None:
    live = start(**LINKS)
    # Each topic comes in bursts of a quarter of a second, and within it backwards in pairs.
    shuffled = sorted(
        enumerate(feed.messages),
        key=lambda entry: (entry[1][0] // 250_000_000, entry[1][1].name, -entry[0] // 8),
    )
    replace(feed, messages=tuple(message for _, message in shuffled)).into(live, solving=0.7)
    assert_same(live.solve(exactly=True).found.observations, folded)


def test_topics_that_begin_late_lose_nothing_within_the_lag(start, feed, folded) -> None:
    live = start(replace(UNPACED, lag=10.0), **LINKS)
    clock, begin = live.streams.selected.clock.name, feed.messages[0][0]
    # The first three seconds of the joint states arrive before any message of the others.
    ordered = sorted(feed.messages, key=lambda m: m[1].name != clock or m[0] > begin + 3 * 10**9)
    replace(feed, messages=tuple(ordered)).into(live, solving=100.0)
    assert live.streams.stale == 0
    assert_same(live.solve(exactly=True).found.observations, folded)


def test_a_backward_clock_jump_restarts_the_clock_and_loses_nothing(
    start, feed, folded, caplog: pytest.LogCaptureFixture
) -> None:
    live = start(**LINKS)
    with caplog.at_level(logging.WARNING):
        feed.into(live, solving=2.0)
        # What is left over of the old time comes late, behind the first two of the new one.
        first, *others = feed.messages
        second = next(m for m in others if m[1] == first[1])
        others.remove(second)
        *_, straggler = (m for m in feed.messages if m[1] != first[1])
        replace(feed, messages=(first, second, straggler, *others)).into(live, solving=2.0)
    assert any("jumps back" in one and "counts twice" in one for one in caplog.messages)
    assert (live.intake.clock_jumps, live.streams.stale) == (1, 1)
    twice = [one.merge(one) for one in folded]
    assert_same(live.solve(exactly=True).found.observations, twice)


def test_a_run_resumes_from_saved_information(start, feed, folded, tmp_path: Path) -> None:
    first = start(**LINKS)
    feed.between(0.0, 8.0).into(first)
    saved = first.solve(exactly=True).found
    write_archive(tmp_path / "information.npz", saved.observations)
    second = start(information=tmp_path / "information.npz", **LINKS)
    feed.between(8.0, np.inf).into(second)
    observations = second.solve(exactly=True).found.observations
    assert_same(observations, folded)


def test_forgetting_discounts_old_rows_and_the_prior(start, feed) -> None:
    live = start(Pace(memory=2.0, share=1.0), **LINKS)
    feed = feed.between(0.0, 9.7)
    feed.into(live)
    discounted = live.solve(exactly=True)
    (known,) = (o for o in discounted.found.observations if o.window == 0.161)
    seconds = (feed.messages[-1][0] // 4_000_000_000 * 4) + 1e-9  # whole blocks, then the rest
    kept = np.exp(-(feed.messages[-1][0] + 1) * 1e-9 / 2.0)
    assert known.kept == pytest.approx(kept, rel=1e-9)
    assert known.rows.samples < seconds * 1e9
    # At a constant rate, the sum of all weights is the number of rows in one time constant.
    rate = 2 / 0.161
    assert known.rows.samples == pytest.approx(2.0 * rate, rel=0.7)
    problem = replace(initial(**LINKS).problem, observations=(known,))
    solved = SolvedProblem.of(problem)
    widened = discounted.found.estimate.std / discounted.found.estimate.prior
    assert np.all(np.isfinite(widened))
    assert solved.posterior.prior.std == pytest.approx(2 * problem.prior.std)


def test_a_silent_topic_loses_blocks_and_is_reported(start, feed) -> None:
    live = start(Pace(lag=0.3, share=1.0), **LINKS)
    feed.between(0.0, 2.0).into(live)
    feed.between(2.0, np.inf).without("/left_foot/wrench").into(live)
    live.advance()
    assert live.lost_blocks == (feed.messages[-1][0] * 1e-9 - 0.3) // 4 - 1 > 0
    # A block is looked at with some of its surroundings.
    assert "/left_foot/wrench was silent from 3.900 s to 8.100 s" in live.faults[0]


def values_of(live):
    return live.solve(exactly=True).found.estimate.value


def spoilt(feed, spoil):
    """Return a feed with what ``spoil(topic, payload)`` returns ahead of every 50th message."""
    messages = []
    for number, (stamp, topic, payload) in enumerate(feed.messages):
        if number % 50 == 25:
            messages += [(stamp, topic, junk) for junk in spoil(topic, payload)]
        messages.append((stamp, topic, payload))
    return Feed(feed.selected, tuple(messages))


def with_stamp(payload: bytes, *stamp: int) -> bytes:
    return payload[:4] + struct.pack("<iI", *stamp) + payload[12:]


def with_last(payload: bytes, value: float) -> bytes:
    return payload[:-8] + struct.pack("<d", value)


def renamed(payload: bytes) -> bytes:
    """Return a message of other joints, or of another frame."""
    for name in (b"L_", b"R_", b"imu_link", b"left_sole", b"right_sole"):
        payload = payload.replace(name, name[:-1] + b"#")
    return payload


@pytest.fixture(scope="module")
def undisturbed(feed):
    """What two seconds of the log tell."""
    part = feed.between(0.0, 2.0)
    live = OnlineIdentification(initial(**LINKS), part.selected, UNPACED)
    part.into(live)
    value = values_of(live)
    live.close()
    return part, value


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda topic, payload: some_malformed(payload, 7), "is not a valid"),
        (lambda topic, payload: [renamed(payload)], "none of the model's joints|header.frame_id"),
        (lambda topic, payload: [with_stamp(payload, 2**31 - 1, 0)], "not on the topic's clock"),
        (lambda topic, payload: [with_stamp(payload, -5, 7)], "not on the topic's clock"),
        (lambda topic, payload: [with_stamp(payload, 1, 10**9)], "nanosec"),
        (lambda topic, payload: [with_last(payload, 1e300)] * (topic.name != "/imu/data"), "1e.06"),
    ],
    ids=["malformed", "foreign", "future", "past", "nanosec", "enormous"],
)
def test_invalid_messages_change_nothing(start, undisturbed, spoil, reason) -> None:
    part, expected = undisturbed
    live = start(**LINKS)
    spoilt(part, spoil).into(live)
    np.testing.assert_array_equal(values_of(live), expected)
    counts = {check.dropped for check in live.intake.checks.values() if check.dropped}
    assert sum(counts) > 10
    for check in live.intake.checks.values():
        assert not check.dropped or re.search(reason, check.reason), check.reason
    assert live.intake.clock_jumps == live.lost_blocks == 0


def test_messages_with_spikes_are_dropped_as_those_of_a_bag(bag, tmp_path) -> None:
    def operation(messages: Messages) -> None:
        messages.records["position"][900, 3] += 1.0
        messages.records["effort"][1200, 0] = 1e5

    spoilt_bag = edit_bag(bag, tmp_path / "bag", {"/joint_states": operation})
    feed = feed_of(spoilt_bag)
    live = LiveStreams(feed.selected, "live")
    for stamp, topic, payload in feed.messages:
        live.add(topic, stamp, payload)
    recorded, offline = live.joints.stamps, read_streams([spoilt_bag]).joints
    streams = live.between(int(recorded[0]), int(recorded[-1]) + 1)
    assert len(streams.joints.stamp) == len(recorded) - 2
    np.testing.assert_array_equal(streams.joints.stamp, offline.stamp)


def test_late_and_missing_messages_are_counted(start, feed) -> None:
    live = start()
    some = feed.between(0.0, 6.0)
    dropped = [m for m in some.messages if not 1.0 < m[0] * 1e-9 < 1.0045 or "imu" not in m[1].name]
    replace(some, messages=tuple(dropped)).into(live)
    live.advance()
    by_name = {topic.name: buffer for topic, buffer in live.streams.buffers.items()}
    assert by_name["/imu/data"].missing == 4
    assert by_name["/joint_states"].missing == 0
    _, topic, payload = feed.messages[0]
    live.intake.feed(topic, payload)
    assert live.intake.clock_jumps == 0  # a single stamp may be wrong
    live.intake.feed(topic, payload)  # another 6 s back: a new time, not a late message
    assert live.intake.clock_jumps == 1
    live.intake.feed(topic, payload)
    assert by_name[topic.name].late == 0


@pytest.mark.parametrize("back", [5.0, 5.9])
def test_a_jump_ahead_is_a_pause_and_no_missing_messages(
    start, feed, caplog: pytest.LogCaptureFixture, back: float
) -> None:
    live = start(**LINKS)
    with caplog.at_level(logging.WARNING):
        feed.between(0.0, 2.5).into(live)
        live.advance()
        feed.between(back, 11.0).into(live)
        live.advance()
    buffers = live.streams.buffers.values()
    assert {(buffer.missing, buffer.pauses) for buffer in buffers} == {(0, 1)}
    said = [one.message for one in caplog.records if "jump ahead" in one.message]
    assert len(said) == len(buffers)
    assert f"jump ahead by {back - 2.5:.1f} s" in said[0]
    live.reset()
    assert {(buffer.missing, buffer.pauses) for buffer in buffers} == {(0, 0)}


def test_a_pause_that_was_asked_for_is_no_fault(
    start, feed, caplog: pytest.LogCaptureFixture
) -> None:
    live = start(**LINKS)
    feed.between(0.0, 2.5).into(live)
    live.streams.expect_pause()
    feed.between(5.0, 6.0).into(live)
    assert {buffer.pauses for buffer in live.streams.buffers.values()} == {0}
    assert not any("jump ahead" in one.message for one in caplog.records)


def test_a_first_block_that_is_too_short_is_no_fault(start, feed) -> None:
    live = start(**LINKS)
    feed.between(3.97, 8.5).into(live)
    live.advance()
    assert (live.lost_blocks, list(live.faults)) == (0, [])


def test_forces_that_do_not_match_the_weight_are_refused(feed) -> None:
    gone = feed.selected.wrenches[0]
    halved = replace(feed.selected, wrenches=feed.selected.wrenches[1:])
    other = OnlineIdentification(initial(), halved, UNPACED)
    feed.between(0.0, 3.0).without(gone.name).into(other)
    with pytest.raises(DataError, match=r"by \d+ % of the robot's weight"):
        other.solve()
    other.close()


def test_a_wrong_unit_is_named_as_the_cause_of_a_wrong_weight(start, feed) -> None:
    def in_g(payload: bytes) -> bytes:
        head, values = payload[:-96], np.frombuffer(payload[-96:], "<f8").copy()
        values[:3] /= 9.81  # linear_acceleration, before its covariance
        return head + values.tobytes()

    live = start(**LINKS)
    for _, topic, payload in feed.between(0.0, 3.0).messages:
        live.intake.feed(topic, in_g(payload) if topic.name == "/imu/data" else payload)
    with pytest.raises(DataError, match=r"% of the robot's weight; /imu/data: .* as if in g; use"):
        live.solve()


def test_an_effort_of_the_wrong_sign_contradicts_the_estimate(start, bag, feed, tmp_path) -> None:
    def reverse(messages: Messages) -> None:
        messages.records["effort"][:, messages.joints.index("L_hfe")] *= -1.0

    def estimate(read: Feed) -> OnlineEstimate:
        live = start(**LINKS)
        read.into(live)
        return live.solve(exactly=True)

    assert not estimate(feed).is_contradicted
    found = estimate(feed_of(edit_bag(bag, tmp_path / "bag", {"/joint_states": reverse})))
    assert found.is_contradicted
    assert "unexplained on L_hfe: " in found.alarms[0]


def test_a_floating_base_without_wrenches_is_told_of_contacts_before_any_message(feed) -> None:
    without = OnlineIdentification(initial(), replace(feed.selected, wrenches=()), UNPACED)
    assert "no wrench sensor is in use" in without.setup_fault
    assert "`contact` " in without.setup_fault
    assert not OnlineIdentification(initial(), feed.selected, UNPACED).setup_fault


def test_the_data_of_another_robot_are_named_as_such(tmp_path) -> None:
    write_archive(tmp_path / "information.npz", initial().observations)
    other = load_model(config_file("symbitron.xml"))
    joints = tuple(replace(one, name=f"go2/{one.name}") for one in other.joints)
    with pytest.raises(EstimateError, match=r"information.npz: it is of another robot: ") as error:
        InitialState.of(
            replace(other, joints=joints), options(information=tmp_path / "information.npz")
        )
    assert error.value.code == "E505"


@pytest.mark.parametrize(
    ("chosen", "says"),
    [
        ({"filter": "butterworth"}, "`filter` is not supported online"),
        ({"sensor_errors": ("link_length",)}, "complete log"),
        ({"sensor_errors": ("typical",), "information": "earlier.npz"}, "belong to one run"),
        ({"rank": 3}, "truncates no singular values"),
    ],
    ids=["filter", "kinematics", "resumed sensor errors", "rank"],
)
def test_options_that_need_a_complete_log_are_refused(start, chosen, says) -> None:
    with pytest.raises(EstimateError, match=says):
        start(**chosen)


def test_terms_are_chosen_again_from_the_rows_of_the_present_window_alone(start, feed) -> None:
    live = start()
    feed.into(live)
    live.solve(exactly=True)
    problem = live._problem_with(live._accumulator.blocks)
    terms = LiveTerms(problem.parameters)
    expected = terms.chosen_anew(problem).parameters.names
    for count, one in enumerate(problem.observations, start=2):
        applied = terms.applied(problem, count**2, one.window)
        assert len(applied.observations) == len(problem.observations) == 3
        assert terms._choice is not None
        assert terms._choice.window == one.window
        assert applied.parameters.names == expected


def test_a_memory_set_while_running_applies_to_later_data(start, feed) -> None:
    def known(first, then):
        live = start(Pace(memory=first, share=1.0), window=0.1, **LINKS)
        for begin, stop, memory in ((0.0, 4.5, then), (4.5, 8.2, np.inf)):
            feed.between(begin, stop).into(live)
            live.advance()
            live.set_memory(memory)  # waits for the blocks so far
        return live._accumulator.blocks.observations

    # In the first block there is nothing that could fade: only what is set later counts.
    discounted = known(2.0, 2.0)
    assert_same(known(np.inf, 2.0), discounted)
    lasting = known(2.0, np.inf)
    assert np.trace(gram(discounted[0])[0]) < 0.9 * np.trace(gram(lasting[0])[0])
