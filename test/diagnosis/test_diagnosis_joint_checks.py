"""Joint checks on either side of their limits."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.joint_checks import DEGREES, JointCheck
from symbid_ros.diagnosis.required_readings import list_names
from symbid_ros.signals.streams import JointStream

NAMES = ("hip", "knee", "foot")
PERIOD = 10_000_000  # ns
COUNT = 1001
TIME = np.arange(COUNT) * 1e-2
OMEGA = 2 * np.pi  # whole turns in 10 s: sines and cosines are orthogonal


def stream(position, velocity, effort=1.0):
    """Return the messages of three joints; what is one number or row is repeated."""
    values = [np.broadcast_to(each, (COUNT, 3)).copy() for each in (position, velocity, effort)]
    values[2] += 1e-3 * np.arange(COUNT)[:, None]  # a constant one would be no measurement
    return JointStream("/joints", NAMES, PERIOD * np.arange(COUNT, dtype=np.int64), *values)


def swinging(scale=1.0, orthogonal=0.0, amplitude=0.5):
    """Return joints whose velocity has this scale and an orthogonal part of that size."""
    angle = OMEGA * TIME[:, None] + np.arange(3)
    velocity = scale * np.cos(angle) + orthogonal * np.sin(angle)
    return stream(amplitude * np.sin(angle), amplitude * OMEGA * velocity)


def findings(joints, model=None, during=None):
    check = JointCheck("/joints", NAMES)
    check.add(joints, *([] if during is None else [during]))
    return check.findings(model)


@pytest.mark.parametrize("every", [2, 3])
def test_two_publishers_of_one_topic_are_named_alone(every):
    """The second one publishes zeros between the messages of the first one."""
    joints = swinging(amplitude=0.02)
    joints = replace(joints, position=joints.position + 0.4)
    other = np.arange(COUNT) % every == 0
    zeros = [np.where(other[:, None], 0.0, one) for one in (joints.position, joints.velocity)]
    (found,) = findings(replace(joints, position=zeros[0], velocity=zeros[1]))
    assert (found.kind, found.severity) == (Kind.TWO_PUBLISHERS, Severity.UNUSABLE)
    assert found.figures["jumps"] > 0.8 * COUNT * (1 if every == 2 else 1 / 3)


def test_noise_and_wrapped_angles_are_not_two_publishers():
    rng = np.random.default_rng(0)
    joints = swinging()
    noisy = joints.position + 0.5 * rng.normal(size=joints.position.shape)
    wrapped = np.remainder(joints.position, 2 * np.pi)
    wrapped += np.where(np.arange(COUNT)[:, None] % 2, 2 * np.pi, 0.0)
    for position in (noisy, wrapped):
        kinds = {one.kind for one in findings(replace(joints, position=position))}
        assert Kind.TWO_PUBLISHERS not in kinds


@pytest.mark.parametrize(
    ("scale", "kind", "severity", "says"),
    [
        (1.24, None, None, ""),
        (1.26, Kind.STAMP_RATE, Severity.WARNING, "velocity of all joints is 1.26 times"),
        (0.81, None, None, ""),
        (0.79, Kind.STAMP_RATE, Severity.WARNING, "check the rate of the stamps"),
        (-0.3, Kind.VELOCITY, Severity.UNUSABLE, "opposite signs"),
        (1.29 * DEGREES, Kind.UNIT, Severity.WARNING, "velocities of all joints are 57.3 times"),
        (1.31 * DEGREES, Kind.STAMP_RATE, Severity.WARNING, "times the rate"),
        (DEGREES / 1.29, Kind.UNIT, Severity.WARNING, "velocities of all joints"),
        (DEGREES / 1.31, Kind.STAMP_RATE, Severity.WARNING, "times the rate"),
        (1.29 / DEGREES, Kind.UNIT, Severity.UNUSABLE, "positions of all joints are 57.3 times"),
        (1.31 / DEGREES, Kind.STAMP_RATE, Severity.WARNING, "times the rate"),
        (1 / DEGREES / 1.29, Kind.UNIT, Severity.UNUSABLE, "positions of all joints"),
        (1 / DEGREES / 1.31, Kind.STAMP_RATE, Severity.WARNING, "times the rate"),
    ],
)
def test_the_scale_of_velocities_is_judged(scale, kind, severity, says):
    found = findings(swinging(scale))
    assert [(one.kind, one.severity) for one in found] == [(kind, severity)] * (kind is not None)
    for one in found:
        assert says in one.message
        for name in NAMES:
            assert one.figures[f"{name}/scale"] == pytest.approx(scale, rel=2e-3)


@pytest.mark.parametrize(("correlation", "is_found"), [(0.89, False), (0.91, True)])
@pytest.mark.parametrize("sign", [1, -1])
def test_only_velocities_that_match_are_judged(correlation, is_found, sign):
    scale = 3.0 * sign
    found = findings(swinging(scale, 3.0 * np.sqrt(1 / correlation**2 - 1)))
    kind = Kind.STAMP_RATE if sign > 0 else Kind.VELOCITY
    assert [one.kind for one in found] == [kind] * is_found


@pytest.mark.parametrize(("rms", "is_found"), [(0.0195, False), (0.0205, True)])
def test_slow_joints_are_not_checked(rms, is_found):
    assert len(findings(swinging(-1.0, amplitude=np.sqrt(2) * rms / OMEGA))) == is_found


def test_each_joint_is_judged_by_itself():
    joints = swinging()
    joints.velocity[:, 0] *= -1
    joints.velocity[:, 1] *= 3
    joints.velocity[:, 2] *= DEGREES
    signs, units, scales = findings(joints)
    assert list(signs.figures) == ["hip/scale"]
    assert (units.kind, list(units.figures)) == (Kind.UNIT, ["foot/scale"])
    assert (scales.kind, list(scales.figures)) == (Kind.VELOCITY, ["knee/scale"])
    assert "velocity of knee is 3 times" in scales.message


@pytest.mark.parametrize(
    ("scale", "is_found"), [(1.98, False), (2.02, True), (0.51, False), (0.49, True)]
)
def test_one_joint_has_a_unit_of_its_own(scale, is_found):
    joints = swinging()
    joints.velocity[:, 1] *= scale
    found = findings(joints)
    assert [list(one.figures) for one in found] == [["knee/scale"]] * is_found


def test_slices_add_up_and_messages_of_other_joints_are_ignored():
    joints = swinging(3.0)
    check = JointCheck("/joints", NAMES)

    def part(rows):
        return replace(
            joints,
            stamp=joints.stamp[rows],
            position=joints.position[rows],
            velocity=joints.velocity[rows],
            effort=joints.effort[rows],
        )

    check.add(part(slice(0, 400)))
    check.add(replace(part(slice(0, 400)), names=("a", "b", "c")))
    check.add(part(slice(400, 402)))
    check.add(part(slice(402, None)))
    (found,) = check.findings(None)
    assert found.figures["hip/scale"] == pytest.approx(3, rel=2e-3)
    # Two messages are too few for a slice.
    joints.effort[::2] = np.nan
    joints.velocity[:] = joints.velocity / 3
    check = JointCheck("/joints", NAMES)
    check.add(part(slice(0, 2)))
    assert check.findings(None) == []
    check.add(part(slice(0, 3)))
    assert "2 of 3 messages have no effort of all joints" in check.findings(None)[0].message


def test_missing_values_are_counted_from_the_first_stamp_up_to_the_second():
    joints = swinging()
    joints.position[[9, 10, 19, 20], 0] = np.nan
    (found,) = findings(joints, during=(10 * PERIOD, 20 * PERIOD))
    assert "2 of 10 messages have no position of hip" in found.message
    assert found.figures == {"messages": 2, "share": 0.2}


def robot(lower=-1.0, upper=1.0, kinds=("revolute",) * 3, efforts=(0.5,) * 3):
    model = random_robot(3, 4)
    joints = tuple(
        replace(joint, name=name, kind=kind, effort=effort, lower=lower, upper=upper)
        for joint, name, kind, effort in zip(model.joints, NAMES, kinds, efforts, strict=True)
    )
    return replace(model, joints=joints)


def reaching(*high, low=0.0):
    """Return joints that move slowly from ``low`` to these positions."""
    position = low + (np.array(high) - low) * np.linspace(0, 1, COUNT)[:, None]
    return stream(position, np.nan)


@pytest.mark.parametrize(
    ("high", "low", "is_found"),
    [
        ((50.0, 50.0, 50.0), 0.0, True),
        ((50.0, 50.0, 50.0), -50.0, True),
        ((-50.0, -50.0, -50.0), 0.0, True),
        ((77.0, 50.0, 0.5), 0.0, True),  # 1.344 rad: within 0.35 of the limit of 1
        ((78.0, 50.0, 0.5), 0.0, False),  # 1.361 rad
        ((-77.0, 50.0, 0.5), 0.0, True),
        ((-78.0, 50.0, 0.5), 0.0, False),
        ((50.0, 50.0, 1.3), 0.0, True),  # two of three leave their limits
        ((50.0, 1.3, 1.3), 0.0, False),  # one of three
        ((6.2, 6.2, 6.2), 0.0, False),  # less than a turn
        ((6.4, 6.2, 6.2), 0.0, True),
        ((0.5, 0.5, 0.5), 0.0, False),
    ],
)
def test_positions_within_their_limits_only_in_degrees_are_in_degrees(high, low, is_found):
    found = findings(reaching(*high, low=low), robot())
    assert [one.kind for one in found] == [Kind.UNIT] * is_found
    for one in found:
        assert one.severity is Severity.UNUSABLE
        assert one.figures["largest"] == pytest.approx(max(np.abs(high)))
        outside = sum(abs(each) > 1.35 for each in high)
        assert one.figures["joints"] == outside


@pytest.mark.parametrize(("end", "count"), [(1.34, 2), (1.36, 3)])
def test_a_position_may_leave_its_limits_by_a_third_of_a_radian(end, count):
    (found,) = findings(reaching(50.0, 50.0, end), robot())
    assert found.figures["joints"] == count


@pytest.mark.parametrize(
    "model",
    [
        robot(lower=-np.inf, upper=np.inf),
        robot(kinds=("prismatic",) * 3),
        replace(robot(), joints=tuple(replace(j, name=j.name + "_") for j in robot().joints)),
    ],
    ids=["unlimited", "slides", "others"],
)
def test_only_known_hinges_with_limits_tell_degrees(model):
    assert findings(reaching(50.0, 50.0, 50.0), model) == []


def test_a_slide_beyond_its_limits_does_not_count_as_degrees():
    model = robot(kinds=("revolute", "prismatic", "prismatic"))
    (found,) = findings(reaching(50.0, 400.0, 400.0), model)
    assert found.figures == {"joints": 1, "largest": 50.0}
    model = robot(kinds=("prismatic", "revolute", "revolute"))
    (found,) = findings(reaching(400.0, 50.0, 50.0), model)
    assert found.figures == {"joints": 2, "largest": 50.0}


@pytest.mark.parametrize(
    ("kinds", "high", "is_found"),
    [
        # A joint of a double pendulum that turned 1, 4 or 11 times.
        (("revolute", "revolute", "prismatic"), (1.0, 8.59, 0.0), False),
        (("revolute", "revolute", "prismatic"), (1.0, 25.0, 0.0), False),
        (("revolute", "revolute", "prismatic"), (1.0, 70.0, 0.0), False),
        (("revolute", "revolute", "prismatic"), (20.0, 70.0, 0.0), True),
        # The only joint of a robot.
        (("revolute", "prismatic", "prismatic"), (8.59, 0.0, 0.0), False),
        (("revolute", "prismatic", "prismatic"), (31.0, 0.0, 0.0), False),
        (("revolute", "prismatic", "prismatic"), (32.0, 0.0, 0.0), True),
        (("revolute", "prismatic", "prismatic"), (8.59, 400.0, 0.0), False),
    ],
)
def test_one_joint_that_turns_several_times_is_in_radians(kinds, high, is_found):
    found = findings(reaching(*high), robot(kinds=kinds))
    assert [one.kind for one in found] == [Kind.UNIT] * is_found


@pytest.mark.parametrize(
    ("low", "high", "is_found"),
    [
        (0.82, 5.46, False),  # within the limits, which exclude zero
        (0.0, 6.2, False),  # beyond them, but within a turn
        (0.0, 6.4, True),
        (-6.4, 0.0, True),
    ],
)
def test_limits_that_exclude_zero_are_those_of_radians(low, high, is_found):
    found = findings(reaching(high, high, high, low=low), robot(lower=0.82, upper=5.46))
    assert [one.kind for one in found] == [Kind.UNIT] * is_found


@pytest.mark.parametrize(
    ("high", "is_found"),
    [
        ((4096.0, 4096.0, 4096.0), True),
        ((-78.0, 78.0, 0.5), True),  # beyond the limits of 1 rad in degrees, too, by 0.35 rad
        ((-77.0, 78.0, 0.5), False),
        ((4096.0, 0.5, 0.5), True),  # 410 a second
        ((2900.0, 0.5, 0.5), False),  # 290 a second, of one joint of three
    ],
)
def test_positions_too_far_or_too_fast_for_any_joint_are_not_in_radians(high, is_found):
    found = findings(reaching(*high), robot())
    counts = [one for one in found if "encoder counts" in one.message]
    assert [(one.kind, one.severity) for one in counts] == [
        (Kind.UNIT, Severity.UNUSABLE)
    ] * is_found
    for one in counts:
        assert one.figures["largest"] == max(np.abs(high))
    if is_found and max(high) > 3000:  # a joint without limits shows it by its speed
        (one,) = findings(reaching(*high), robot(lower=-np.inf))
        assert one.figures["hip/speed"] == pytest.approx(409.6)


def test_degrees_that_are_wrapped_to_one_turn_are_not_encoder_counts():
    """A joint that turns in one direction; its position in radians is wrapped, too."""
    turn = reaching(3000.0, 0.5, 0.5)
    for unit, is_found in ((1.0, True), (np.pi / 180, False)):
        wrapped = unit * (np.remainder(turn.position + 180, 360) - 180)
        joints = replace(turn, position=wrapped, velocity=unit * turn.velocity)
        found = findings(joints, robot(lower=-np.inf))
        units = [one for one in found if one.kind is Kind.UNIT]
        assert len(units) == is_found
        for one in units:
            assert "jump by 360 between the ends of one turn, as if in degrees" in one.message
            assert one.figures == {"hip/wraps": 8}


@pytest.mark.parametrize(("missing", "severity"), [(500, "WARNING"), (501, "UNUSABLE")])
def test_a_joint_without_position_in_half_of_the_messages_is_unusable(missing, severity):
    joints = swinging()
    joints.position[:missing, 1] = np.nan
    (found,) = findings(joints, robot(lower=-np.inf))
    assert found.severity is Severity[severity]
    assert found.figures == {"messages": missing, "share": pytest.approx(missing / COUNT)}
    # Without a model the joint may not be needed.
    (found,) = findings(joints)
    assert found.severity is Severity.WARNING


def test_a_joint_that_never_has_a_position_matters_only_to_a_model():
    joints = swinging()
    joints.position[:, 1] = np.nan
    assert findings(joints) == []
    (found,) = findings(joints, robot(lower=-np.inf))
    assert found.figures == {"messages": COUNT, "share": 1.0}


def test_the_effort_of_a_moving_joint_that_never_changes_is_not_measured():
    joints = swinging()
    joints.effort[:, 0] = 12.5
    (found,) = findings(joints, robot(lower=-np.inf))
    assert (found.kind, found.severity) == (Kind.MISSING_JOINT, Severity.WARNING)
    assert "the effort of hip is always 12.5 although it moves, its row" in found.message
    assert findings(joints)[0].message == found.message  # a passive joint would report zero
    joints.position[:, 0], joints.velocity[:, 0] = 0.3, 0.0
    assert findings(joints, robot(lower=-np.inf)) == []


def test_joints_without_effort_are_named_by_what_they_report():
    joints = swinging()
    joints.effort[:, 0], joints.effort[:, 1] = 0.0, np.nan
    zero, absent = findings(joints, robot(lower=-np.inf))
    assert "the effort of hip is always zero, its row" in zero.message
    assert "the effort of knee is in no message, its row" in absent.message
    assert zero.figures == absent.figures == {"joints": 1}
    joints.effort[:, 1] = 0.0
    (both,) = findings(joints, robot(lower=-np.inf))
    assert "the effort of hip, knee is always zero, their rows" in both.message
    assert list_names(NAMES[:2], [0, 1]) == "hip, knee"
    assert (both.figures, both.severity) == ({"joints": 2}, Severity.WARNING)
    assert findings(joints, robot(lower=-np.inf, efforts=(0.0, 0.0, 0.5))) == []
    # All driven joints of a fixed robot are silent.
    fixed = replace(robot(lower=-np.inf, efforts=(0.5, 0.5, 0.0)), floating=False)
    (none,) = findings(joints, fixed)
    assert none.severity is Severity.UNUSABLE


@pytest.mark.parametrize(
    ("count", "shape", "scale", "is_found"),
    [
        (4, np.abs, {}, True),
        (3, np.abs, {}, False),
        (4, np.asarray, {}, False),
        (6, np.abs, {}, True),
        (4, lambda effort: -np.abs(effort), {}, True),
        (4, lambda effort: np.abs(effort) * [-2, 1, 1, 1], {"joint0": -2.0}, True),
    ],
)
def test_efforts_that_are_magnitudes_are_named(count, shape, scale, is_found):
    """Whatever the user's factors, of which one reverses the first joint here."""
    names = tuple(f"joint{index}" for index in range(count))
    angle = OMEGA * TIME[:, None] + np.arange(count)
    position, velocity = 0.5 * np.sin(angle), 0.5 * OMEGA * np.cos(angle)
    effort = shape(np.cos(angle) + 0.5 * np.sign(velocity))
    stamp = PERIOD * np.arange(COUNT, dtype=np.int64)
    check = JointCheck("/joints", names)
    stream = JointStream("/joints", names, stamp, position, velocity, effort, effort_scale=scale)
    check.add(stream)
    found = [one for one in check.findings(None) if one.kind is Kind.UNSIGNED_EFFORT]
    assert [one.severity for one in found] == [Severity.WARNING] * is_found
    if is_found:
        sign = "positive" if effort[:, -1].max() <= 0 else "negative"
        assert f"the effort of all joints is never {sign}" in found[0].message


def test_a_load_that_always_pulls_down_is_no_magnitude():
    """Joints that move one way only, or one with the other sign, are no evidence."""
    names = tuple(f"joint{index}" for index in range(4))
    angle = OMEGA * TIME[:, None] + np.arange(4)
    effort = np.full((COUNT, 4), 2.0) + 1e-3 * np.arange(COUNT)[:, None]
    effort[:, 3] *= -1
    stamp = PERIOD * np.arange(COUNT, dtype=np.int64)
    swings = 0.5 * np.sin(angle), 0.5 * OMEGA * np.cos(angle)
    creeps = 0.1 * TIME[:, None] * np.ones(4), np.full((COUNT, 4), 0.1)
    for motion, load in ((swings, effort), (creeps, np.abs(effort))):
        check = JointCheck("/joints", names)
        check.add(JointStream("/joints", names, stamp, *motion, load))
        assert Kind.UNSIGNED_EFFORT not in [one.kind for one in check.findings(None)]


@pytest.mark.parametrize(("ratio", "is_found"), [(0.1, True), (0.5, False)])
@pytest.mark.parametrize("load", ["carried", "moved"])
def test_efforts_that_are_almost_only_noise_are_named_with_their_ratio(ratio, is_found, load):
    signal = ratio * (np.ones(COUNT) if load == "carried" else np.sqrt(2) * np.sin(OMEGA * TIME))
    effort = np.random.default_rng(0).normal(size=(COUNT, 3)) + signal[:, None]
    effort[:, 0] += 3.0
    joints = replace(swinging(), effort=effort)
    found = [one for one in findings(joints) if one.kind is Kind.EFFORT_NOISE]
    assert len(found) == is_found
    for one in found:
        assert one.severity is Severity.WARNING
        assert "the effort of knee, foot is almost only noise" in one.message
        for name in NAMES[1:]:
            assert one.figures[f"{name}/signal_to_noise"] == pytest.approx(ratio, abs=0.15)
    # A joint at rest need not show any load, and a vibration is a signal.
    resting = replace(stream(1.0, 0.0), effort=effort)
    vibrating = replace(
        swinging(), effort=signal[:, None] + np.cos(np.pi * np.arange(COUNT))[:, None]
    )
    for other in (resting, vibrating):
        assert Kind.EFFORT_NOISE not in {one.kind for one in findings(other)}
