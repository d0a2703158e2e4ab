"""Joints without measured effort, as real drivers report them, and their rows."""

from dataclasses import replace

import numpy as np
import pytest
from expected_errors import raises_code
from random_robots import random_robot

from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.alignment import align
from symbid_ros.signals.efforts import SPAN
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import cut_to
from symbid_ros.signals.sensor_samples import build_samples
from symbid_ros.signals.streams import ImuStream, JointStream, Streams
from symbid_ros.signals.weak_form import equation_rows, windowed_rows

SECONDS, RATE = 12, 100
COUNT = SECONDS * RATE
SPAN_ROWS = SPAN * RATE // 1_000_000_000
NAN = np.nan
# As a program computes the torque of a joint without a load.
ROUNDING_ERRORS = 1e-15 * np.sin(np.arange(COUNT))


def robot(*, floating=True, passive=()):
    model = random_robot(3, 4, floating=floating, wrench_frames=0)
    joints = [
        replace(joint, kind="revolute", effort=0.0 if index in passive else 10.0)
        for index, joint in enumerate(model.joints)
    ]
    return replace(model, joints=tuple(joints))


def streams_of(model, extra=0) -> Streams:
    """Return a smooth motion; joints outside the model have missing values."""
    time = np.arange(COUNT) / RATE
    stamp = np.round(time * 1e9).astype(np.int64)
    names = (*model.joint_names, *(f"gripper_{index}" for index in range(extra)))
    phase = np.outer(time, np.linspace(2.0, 4.0, len(names))) + np.arange(len(names))
    joints = JointStream(
        "/joint_states", names, stamp, np.sin(phase), np.cos(phase), 3.0 + np.cos(1.3 * phase)
    )
    sway = np.outer(time, [3.0, 2.0, 2.5])
    force = np.cos(sway) + np.array([0.0, 0.0, 9.81])
    imu = ImuStream("/imu", "imu_link", stamp, None, np.sin(sway), force)
    return Streams("log", joints, (imu,) if model.floating else (), ())


def rows_of(model, streams):
    """Return windowed rows, block by block."""
    build = equation_rows(ParameterSet(model))
    return [
        block
        for segment in align(streams, model)
        for (block,) in windowed_rows(segment, build, (0.321,))
    ]


def assert_alike(blocks, others, lost) -> None:
    """Assert that rows are equal except for the lost coordinate of some blocks."""
    assert len(blocks) == len(others) == 3
    for index, (block, other) in enumerate(zip(blocks, others, strict=True)):
        kept = np.ones(block.valid.shape[1], dtype=bool)
        for coordinate in lost.get(index, ()):
            kept[coordinate] = False
            assert not block.valid[:, coordinate].any()
            assert not block.mean.K[:, coordinate].any()
            assert not block.mean.y[:, coordinate].any()
            assert not block.noise.K[:, coordinate].any()
        assert block.valid[:, kept].all()
        np.testing.assert_array_equal(block.mean.K[:, kept], other.mean.K[:, kept])
        np.testing.assert_array_equal(block.mean.y[:, kept], other.mean.y[:, kept])
        np.testing.assert_array_equal(block.noise.K[:, kept], other.noise.K[:, kept])


@pytest.mark.parametrize(
    ("value", "says"),
    [
        (NAN, "joint_1 is missing or not finite"),
        (np.inf, "or not finite"),
        (0.0, "effort of joint_1 is always zero"),
        (ROUNDING_ERRORS, "joint_1 is always zero"),
        (12.5, "joint_1 never changes while it moves"),
    ],
)
def test_a_driven_joint_without_effort_loses_only_its_own_row(caplog, value, says) -> None:
    model = robot()
    whole = rows_of(model, streams_of(model))
    silent = streams_of(model)
    silent.joints.effort[:, 1] = value
    silent.joints.velocity[:, 1] = value
    assert_alike(rows_of(model, silent), whole, dict.fromkeys(range(3), (7,)))
    assert says in caplog.text
    assert "its row of the equation of motion is dropped" in caplog.text


def test_a_constant_effort_at_rest_is_a_measurement() -> None:
    model = robot()
    still = streams_of(model)
    still.joints.position[:, 1] = 0.3
    still.joints.effort[:, 1] = 12.5
    assert all(block.valid.all() for block in rows_of(model, still))


@pytest.mark.parametrize("start", [0, 5])
def test_a_span_without_effort_loses_the_blocks_in_it(caplog, start) -> None:
    model = robot()
    whole = rows_of(model, streams_of(model))
    silent = streams_of(model)
    silent.joints.effort[SPAN_ROWS + start : 2 * SPAN_ROWS, 2] = NAN
    silent.joints.effort[2 * SPAN_ROWS :, 0] = 0.0
    assert_alike(rows_of(model, silent), whole, {1: (8,), 2: (6,)})
    assert "joint_2 is missing or not finite in part of the log" in caplog.text


def test_one_warning_names_all_joints_without_effort(caplog) -> None:
    silent = streams_of(robot())
    silent.joints.effort[:, :2] = 0.0
    align(silent, robot())
    (told,) = caplog.messages
    assert "the effort of joint_0, joint_1 is always zero: their rows" in told


def test_short_gaps_in_efforts_are_interpolated(caplog) -> None:
    model = robot()
    clean = streams_of(model)
    holes = streams_of(model)
    for joint in range(3):  # the last message among them
        holes.joints.effort[10 + joint :: 9, joint] = NAN
    holes.joints.effort[300:304, 0] = holes.joints.effort[:2, 0] = np.inf
    (segment,), (expected,) = align(holes, model), align(clean, model)
    inside = slice(2, -1)  # there the nearest value is held
    np.testing.assert_allclose(segment.effort[inside], expected.effort[inside], atol=1e-3)
    np.testing.assert_allclose(segment.effort, expected.effort, atol=0.1)
    np.testing.assert_array_equal(segment.position, expected.position)
    assert len(segment) == COUNT
    assert caplog.messages == []


@pytest.mark.parametrize("field", ["position", "velocity", "effort"])
def test_joints_outside_the_model_are_ignored(caplog, field) -> None:
    model = robot()
    whole = rows_of(model, streams_of(model))
    odd = streams_of(model, extra=2)
    values = {name: getattr(odd.joints, name).copy() for name in ("position", "velocity", "effort")}
    plain = streams_of(model).joints
    for name, columns in values.items():
        columns[:, : len(plain.names)] = getattr(plain, name)
    values[field][:, -2:] = [NAN, np.inf]
    odd = replace(odd, joints=replace(odd.joints, **values))
    assert_alike(rows_of(model, odd), whole, {})
    assert caplog.messages == []


@pytest.mark.parametrize("value", [NAN, 0.0])
def test_a_passive_joint_needs_no_effort(caplog, value) -> None:
    model = robot(passive=(1,))
    quiet = streams_of(model)
    quiet.joints.effort[:, 1] = 0.0
    whole = rows_of(model, quiet)
    silent = streams_of(model)
    silent.joints.effort[:, 1] = 0.0
    silent.joints.effort[::3, 1] = value
    silent.joints.velocity[:, 1] = value
    assert_alike(rows_of(model, silent), whole, {})
    assert caplog.messages == []


def test_a_fixed_robot_without_any_effort_is_rejected() -> None:
    model = robot(floating=False)
    silent = streams_of(model)
    silent.joints.effort[:] = NAN
    with raises_code("E305", "name the topic that has the efforts as well .`joint_topic`"):
        align(silent, model)


def test_a_floating_robot_without_any_effort_keeps_its_base_rows() -> None:
    model = robot()
    whole = rows_of(model, streams_of(model))
    silent = streams_of(model)
    silent.joints.effort[:] = NAN
    assert_alike(rows_of(model, silent), whole, dict.fromkeys(range(3), (6, 7, 8)))


def test_filtered_instants_lose_the_joints_row_only_where_it_has_no_effort() -> None:
    model = robot()
    silent = streams_of(model)
    silent.joints.effort[SPAN_ROWS : 2 * SPAN_ROWS, 1] = NAN
    samples = build_samples(align(silent, model), model, LowPass(10.0), "log")
    is_lost = np.isnan(samples.effort)
    assert not is_lost[:, [0, 2]].any()
    inside = (samples.stamp >= SPAN) & (samples.stamp < 2 * SPAN)
    np.testing.assert_array_equal(is_lost[:, 1], inside)
    assert np.count_nonzero(inside) > 100
    assert np.count_nonzero(~inside) > 250


def part_of(streams: Streams, start: int, stop: int) -> Streams:
    """Return the messages stamped from ``start`` up to ``stop``, ns."""

    def cut(stream):
        inside = (stream.stamp >= start) & (stream.stamp < stop)
        arrays = {
            name: value[inside]
            for name, value in vars(stream).items()
            if isinstance(value, np.ndarray)
        }
        return replace(stream, **arrays)

    return replace(streams, joints=cut(streams.joints), imus=tuple(map(cut, streams.imus)))


def test_dropped_rows_do_not_depend_on_how_a_log_is_cut() -> None:
    """Online runs see one block and a margin at a time, bags are read by the minute."""
    model = robot()
    holes = streams_of(model)
    effort = holes.joints.effort
    effort[SPAN_ROWS + 50 : SPAN_ROWS + 60, 0] = NAN  # too long a gap, inside a block
    effort[2 * SPAN_ROWS - 2 : 2 * SPAN_ROWS + 2, 1] = NAN  # a short one, across two
    effort[:SPAN_ROWS, 2] = 0.0
    effort[7::10, 2] = np.where(effort[7::10, 2] == 0.0, 0.0, NAN)
    (whole,) = align(holes, model)
    lost = np.isnan(whole.effort)
    assert lost[SPAN_ROWS : 2 * SPAN_ROWS, 0].all()
    assert lost[:SPAN_ROWS, 2].all()
    assert np.count_nonzero(lost) == 2 * SPAN_ROWS
    margin = 100_000_000
    for block in range(3):
        start, stop = block * SPAN, (block + 1) * SPAN
        (live,) = cut_to(align(part_of(holes, start - margin, stop + margin), model), start, stop)
        (read,) = cut_to([whole], start, stop)
        np.testing.assert_array_equal(live.stamp, read.stamp)
        np.testing.assert_allclose(live.effort, read.effort, atol=1e-3)
