"""From streams to samples, on random robots that move in MuJoCo."""

from dataclasses import fields, replace

import numpy as np
import pytest
from expected_errors import raises_code
from random_robots import random_robot
from scipy.signal import butter, filtfilt
from tree_simulation import TreeSimulation, streams_of

from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.alignment import align, align_checked
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import (
    SensorSamples,
    at_base,
    build_samples,
    probed,
    smoothed,
)

UNFILTERED = LowPass(cutoff=0)


def samples_of(streams, model, smoothing):
    return build_samples(align_checked(streams, model), model, smoothing, "log")


def relative_rmse(value, truth):
    return np.sqrt(np.mean((value - truth) ** 2) / np.mean(truth**2))


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("floating", [True, False])
def test_sensors_of_any_tree_close_its_equation_of_motion(seed, floating):
    model = random_robot(seed, links=3 + seed, floating=floating, wrench_frames=seed)
    streams, _ = streams_of(TreeSimulation(model, 1.0, seed))
    # Differentiation of sampled positions cannot follow the jerk when the servos start.
    samples = samples_of(streams, model, UNFILTERED)[300:]
    rows = equation_of_motion(ParameterSet(model), samples)
    # The remaining error is that of differentiating positions at 1 kHz.
    closure = relative_rmse(rows.K @ ParameterSet(model).values, rows.y)
    assert closure < 5e-3


def test_a_filter_changes_both_sides_of_the_equation_alike():
    model = random_robot(2, links=5)
    streams, _ = streams_of(TreeSimulation(model, 2.0, 2))
    filtered = samples_of(streams, model, LowPass(cutoff=30))
    rows = equation_of_motion(ParameterSet(model), filtered)
    closure = relative_rmse(rows.K @ ParameterSet(model).values, rows.y)
    assert closure < 0.02
    assert len(filtered) < len(streams.joints.stamp) / 5


def test_the_filter_is_matlabs_filtfilt_of_a_second_order_butterworth():
    rng = np.random.default_rng(0)
    signal = rng.normal(size=(2000, 3))
    expected = filtfilt(*butter(2, 30, fs=1000), signal, axis=0)
    middle = slice(300, -300)
    np.testing.assert_allclose(LowPass(30)(signal, 1000.0)[middle], expected[middle], atol=1e-9)


def test_the_thesis_leaves_forces_unfiltered_and_smooths_derivatives_twice():
    model = random_robot(2, links=4)
    streams, _ = streams_of(TreeSimulation(model, 0.8, 2))
    samples = samples_of(streams, model, LowPass(cutoff=30, channels="thesis"))
    rows = np.isin(streams.joints.stamp, samples.stamp)
    np.testing.assert_array_equal(samples.effort, streams.joints.effort[rows])
    low_pass = LowPass(30)
    position = low_pass(streams.joints.position, 1000.0)
    velocity = low_pass(np.gradient(position, 1e-3, axis=0), 1000.0)
    middle = slice(20, -20)
    np.testing.assert_allclose(samples.velocity[middle], velocity[rows][middle], atol=1e-4)


class TestAlignment:
    @pytest.fixture(scope="class")
    @classmethod
    def moving(cls):
        model = random_robot(1, links=4, wrench_frames=1)
        return model, streams_of(TreeSimulation(model, 1.0, 1))[0]

    def test_equal_stamps_pass_untouched(self, moving):
        model, streams = moving
        (segment,) = align(streams, model)
        np.testing.assert_array_equal(segment.stamp, streams.joints.stamp)
        np.testing.assert_array_equal(segment.position, streams.joints.position)
        np.testing.assert_array_equal(segment.wrenches[:, 0, 3:], streams.wrenches[0].force)

    def test_joints_are_matched_by_name(self, moving):
        model, streams = moving
        order = [2, 0, 1]
        joints = streams.joints
        shuffled = replace(
            joints,
            names=(*(joints.names[i] for i in order), "tail"),
            position=np.c_[joints.position[:, order], np.zeros(1000)],
            effort=np.c_[joints.effort[:, order], np.zeros(1000)],
        )
        (segment,) = align(replace(streams, joints=shuffled), model)
        np.testing.assert_array_equal(segment.position, joints.position)

    def test_other_clocks_are_interpolated(self, moving):
        model, streams = moving
        imu, wrench = streams.imus[0], streams.wrenches[0]
        # The plate at 500 Hz, 0.3 ms late on the joint states' clock.
        grid = wrench.stamp[:-2:2] + 300_000
        seconds = streams.joints.stamp * 1e-9
        late = replace(
            wrench,
            stamp=grid,
            force=np.array([np.interp(grid * 1e-9, seconds, c) for c in wrench.force.T]).T,
            torque=np.array([np.interp(grid * 1e-9, seconds, c) for c in wrench.torque.T]).T,
        )
        (segment,) = align(replace(streams, imus=(imu,), wrenches=(late,)), model)
        inside = np.isin(streams.joints.stamp, segment.stamp)
        error = relative_rmse(segment.wrenches[:, 0, 3:], wrench.force[inside])
        assert error < 1e-3

    def test_a_gap_cuts_the_record(self, moving):
        model, streams = moving
        imu = streams.imus[0]
        keep = np.r_[0:400, 450:1000]
        gappy = replace(
            imu,
            stamp=imu.stamp[keep],
            angular_velocity=imu.angular_velocity[keep],
            linear_acceleration=imu.linear_acceleration[keep],
            orientation=None,
        )
        first, second = align(replace(streams, imus=(gappy,)), model)
        assert (len(first.stamp), len(second.stamp)) == (400, 550)

    def test_a_single_lost_message_is_bridged(self, moving):
        model, streams = moving
        joints = streams.joints
        keep = np.delete(np.arange(1000), 500)
        lossy = replace(
            joints,
            stamp=joints.stamp[keep],
            position=joints.position[keep],
            effort=joints.effort[keep],
        )
        (segment,) = align(replace(streams, joints=lossy), model)
        np.testing.assert_allclose(segment.position, joints.position, atol=1e-7)

    def test_messages_without_a_position_are_bridged(self, moving, caplog):
        model, streams = moving
        for value in (np.nan, np.inf):
            broken = streams.joints.position.copy()
            broken[500, 0] = value
            faulty = replace(streams, joints=replace(streams.joints, position=broken))
            (segment,) = align(faulty, model)
            assert len(segment) == 1000
            np.testing.assert_allclose(segment.position, streams.joints.position, atol=1e-6)
            assert f"without a finite position of {model.joint_names[0]} are dropped" in caplog.text

    def test_errors_name_the_cause(self, moving):
        model, streams = moving
        joints = streams.joints
        of_another = replace(streams, joints=replace(joints, names=("a", "b", "c")))
        # A frame of another robot's sensor is missing as well.
        of_another = replace(of_another, imus=(replace(streams.imus[0], frame_id="elsewhere"),))
        for check in (align, align_checked):
            with raises_code("E306", "none of the joints 'joint_"):
                check(of_another, model)
        with raises_code("E306", "no joint 'joint_"):
            align(replace(streams, joints=replace(joints, names=(*joints.names[:2], "c"))), model)
        late = replace(streams.imus[0], stamp=streams.imus[0].stamp + 10**10)
        with raises_code("E302"):
            align(replace(streams, imus=(late,)), model)
        short = replace(
            joints,
            stamp=joints.stamp[:20],
            position=joints.position[:20],
            effort=joints.effort[:20],
        )
        with raises_code("E303"):
            align(replace(streams, joints=short), model)
        lost = replace(joints, position=np.full_like(joints.position, np.nan))
        with raises_code("E304", "joint_"):
            align(replace(streams, joints=lost), model)
        with raises_code("E307", "sensor_msgs/msg/Imu"):
            samples_of(replace(streams, imus=()), model, UNFILTERED)
        lost = replace(streams.imus[0], frame_id="head")
        (imu,) = {one.name for one in model.frames if "imu" in one.name}
        with raises_code("E308", f"rename_frame` head:={imu} if it is mounted as {imu} is"):
            samples_of(replace(streams, imus=(lost, lost)), model, UNFILTERED)
        with raises_code("E317", "600"):
            samples_of(streams, model, LowPass(600))
        with raises_code("E317", "-1"):
            LowPass(-1)


def test_the_only_imu_has_the_only_imu_frame_of_the_model(caplog):
    model = random_robot(3, links=4, floating=True, wrench_frames=1)
    streams, _ = streams_of(TreeSimulation(model, 1.0, 3))
    (imu,) = streams.imus
    foreign = replace(streams, imus=(replace(imu, frame_id="head"),))
    (expected,), (found,) = align_checked(streams, model), align_checked(foreign, model)
    assert found.imu_frames == expected.imu_frames == (imu.frame_id,)
    np.testing.assert_array_equal(found.linear_acceleration, expected.linear_acceleration)
    assert f"give `rename_frame` head:={imu.frame_id} if that is right" in caplog.text
    with raises_code("E308", "'head'"):
        align_checked(replace(foreign, is_arrays=True), model)
    another = replace(model.frame(imu.frame_id), name="second_imu")
    with raises_code("E308", "head:=NAME"):
        align_checked(foreign, replace(model, frames=(*model.frames, another)))


def readings(count, joints=2, imus=1, wrenches=1):
    rng = np.random.default_rng(count)

    def noise(*shape):
        return rng.normal(size=(count, *shape))

    return SensorSamples(
        stamp=1_790_000_000_000_000_000 + 1_000_000 * np.arange(count, dtype=np.int64),
        position=noise(joints),
        velocity=noise(joints),
        acceleration=noise(joints),
        effort=noise(joints),
        angular_velocity=noise(imus, 3),
        angular_acceleration=noise(imus, 3),
        specific_force=noise(imus, 3),
        wrenches=noise(wrenches, 6),
        imu_frames=("imu",) * imus,
        wrench_frames=("sole",) * wrenches,
        touching=rng.random((count, 2)) < 0.3,
    )


def test_groups_are_averaged_in_every_channel():
    whole = readings(10)
    means = whole.averaged(np.array([0, 3, 4]))
    for field in fields(SensorSamples):
        values = getattr(whole, field.name)
        if field.name in ("imu_frames", "wrench_frames", "recorded"):
            assert getattr(means, field.name) == values
            continue
        groups = [values[0:3], values[3:4], values[4:10]]
        if field.name == "stamp":
            assert means.stamp.tolist() == [int(x[0]) + 500_000 * (len(x) - 1) for x in groups]
        elif field.name == "touching":
            assert means.touching is not None
            assert means.touching.dtype == bool
            assert means.touching.tolist() == [group.any(axis=0).tolist() for group in groups]
        else:
            expected = [group.mean(axis=0) for group in groups]
            np.testing.assert_allclose(getattr(means, field.name), expected, rtol=1e-12)


@pytest.mark.parametrize(("length", "edge", "left"), [(20, 3, 14), (7, 3, 1), (6, 3, 0), (5, 0, 5)])
@pytest.mark.parametrize("frames", [("imu_link",), ()])
def test_edges_are_removed_and_short_segments_are_empty(length, edge, left, frames):
    stamp = np.arange(length, dtype=np.int64) * 1_000_000
    rng = np.random.default_rng(0)
    count = len(frames)
    segment = Segment(
        stamp,
        1000.0,
        rng.normal(size=(length, 2)),
        rng.normal(size=(length, 2)),
        rng.normal(size=(length, count, 3)),
        rng.normal(size=(length, count, 3)),
        rng.normal(size=(length, 1, 6)),
        frames,
        ("sole",),
    )
    found = smoothed(segment, UNFILTERED, edge)
    inside = slice(edge, length - edge) if left else slice(0, 0)
    assert len(found) == left
    np.testing.assert_array_equal(found.stamp, stamp[inside])
    np.testing.assert_array_equal(found.position, segment.position[inside])
    np.testing.assert_array_equal(found.effort, segment.effort[inside])
    np.testing.assert_array_equal(found.wrenches, segment.wrenches[inside])
    np.testing.assert_array_equal(found.specific_force, segment.linear_acceleration[inside])
    np.testing.assert_array_equal(found.angular_velocity, segment.angular_velocity[inside])
    slope = np.gradient(segment.angular_velocity, 1e-3, axis=0, edge_order=2)[inside]
    np.testing.assert_allclose(found.angular_acceleration, slope)
    assert found.velocity.shape == found.acceleration.shape == (left, 2)
    assert (found.imu_frames, found.wrench_frames) == (frames, ("sole",))


@pytest.mark.parametrize(("length", "count"), [(1000, 20), (5, 1), (4, 0)])
def test_probes_are_some_of_all_unfiltered_samples(length, count):
    model = random_robot(1, links=4, wrench_frames=1)
    streams, _ = streams_of(TreeSimulation(model, 1.0, 1))
    segment = align_checked(streams, model)[0].cut(0, length)
    every = at_base(smoothed(segment, UNFILTERED), model)
    probes = probed(segment, model, 0.05)
    assert len(probes) == count
    for name in ("stamp", "velocity", "acceleration", "base_specific_force", "wrenches"):
        np.testing.assert_array_equal(getattr(probes, name), getattr(every, name)[::50])
