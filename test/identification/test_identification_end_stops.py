"""Joints that lean on the ends of their ranges, as MuJoCo simulates them."""

import logging
from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm
from mujoco_joints import driven_joints

import symbid_ros as sy
from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.errors import ModelError
from symbid_ros.identification.conventions.end_stops import find_end_stops
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.end_stops import NEAR, at_end_stops, end_stop_depth
from symbid_ros.signals.weak_form import cut_into_blocks, equation_rows, windowed_rows

END = 0.75  # of the first joint's range; the motion goes to 0.9


def limited(robot, end):
    """Return a robot of which the first joint's range ends at ``end`` above."""
    first, *others = robot.joints
    return replace(robot, joints=(replace(first, lower=-np.pi, upper=end), *others))


def simulated(robot, *, has_stops):
    return driven_joints(robot, 24.0, 100.0, 20.0, seed=3, has_stops=has_stops)


@pytest.fixture(scope="module")
def robot():
    return limited(arm(), END)


@pytest.fixture(scope="module")
def log(robot):
    found, position, of_stops = simulated(robot, has_stops=True)
    pushes = of_stops[:, 0] != 0
    assert 0.005 < pushes.mean() < 0.2
    assert not of_stops[:, 1:].any()
    # Where MuJoCo's stop pushes, the joint counts as leaning on it.
    told = robot.with_end_stops(robot.joint_names[:1])
    assert at_end_stops(position, told.joints)[pushes, 0].all()
    return found


def wrong(robot):
    """Return the robot with inertias that are off by up to 20 %."""
    rng = np.random.default_rng(4)
    return robot.with_phi(robot.phi * rng.uniform(0.8, 1.2, (len(robot.links), 1)))


def test_rows_with_the_force_of_a_stop_are_left_out(robot, log, caplog):
    caplog.set_level(logging.WARNING)
    found = sy.identify(wrong(robot), log)
    blind = sy.identify(wrong(robot), log, end_stops=("none",), unchecked=True)
    first = robot.joint_names[0]
    assert found.estimate.end_stops == (first,)
    assert f"{first} leans on the end of its range at 0.75" in caplog.text
    assert found.estimate.holdout.percent_after < 0.5
    assert not found.alarms
    error, std = error_and_std(found, robot)
    assert np.abs(error / np.maximum(std, 1e-12)).max() < 5.0
    # Forces that another motion needs, of which no stop is a part.
    rng = np.random.default_rng(5)
    position, velocity, acceleration = rng.normal(size=(3, 200, len(robot.joints)))
    K = sy.regressor(robot, position, velocity, acceleration)
    of_truth = np.linalg.norm(K @ ParameterSet(robot).values)
    knowing, ignoring = (
        np.linalg.norm(K @ error_and_std(one, robot)[0]) / of_truth for one in (found, blind)
    )
    assert knowing < 0.001
    assert ignoring > 0.02


def error_and_std(result, robot):
    """Return errors (p,) of the links' parameters, and their standard deviations."""
    names, truth = ParameterSet(robot).names, ParameterSet(robot).values
    found = [result.parameters[name] for name in names]
    return np.array([one.value for one in found]) - truth, np.array([one.std for one in found])


def test_every_end_is_examined():
    """Also those at which joints are less often than at most others."""
    robot = arm(links=20)
    ends = tuple(replace(one, lower=-END, upper=END) for one in robot.joints)
    robot = replace(robot, joints=ends)
    log, position, of_stops = driven_joints(robot, 24.0, 100.0, 20.0, seed=3, has_stops=True)
    depth = end_stop_depth(position, robot.joints)
    share = {1: (depth > 0).mean(axis=0), -1: (depth < 0).mean(axis=0)}
    found = find_end_stops(AlignedLog(log, wrong(robot)), wrong(robot))
    assert len(found) > 3
    for one in found:
        there = depth[:, one.joint] * one.side > 0
        assert (of_stops[there, one.joint] * one.side).sum() < 0  # MuJoCo's stop pushes back
        assert one.share == pytest.approx(share[one.side][one.joint], rel=0.1)
    rarest = min(one.share for one in found)
    assert np.sum(np.concatenate([*share.values()]) > rarest) > 12


def test_an_end_without_a_force_is_no_stop(robot):
    log, position, _ = simulated(robot, has_stops=False)
    assert np.mean(position[:, 0] > END) > 0.005
    assert find_end_stops(AlignedLog(log, wrong(robot)), wrong(robot)) == ()


def test_a_joint_beyond_its_range_for_most_of_the_log_has_other_limits(robot, log):
    everywhere = limited(wrong(robot), -0.4)
    assert find_end_stops(AlignedLog(log, everywhere), everywhere) == ()


def test_windows_that_touch_a_stop_have_no_row_of_its_joint(robot, log):
    told = robot.with_end_stops(robot.joint_names[:1])
    free, leaning = (next(iter(AlignedLog(log, one))) for one in (robot, told))
    assert free.stopped is None
    length = 0.161
    for free_block, block in zip(cut_into_blocks(free), cut_into_blocks(leaning), strict=True):
        ((every,),) = windowed_rows(free_block, equation_rows(ParameterSet(robot)), [length], ())
        ((some,),) = windowed_rows(block, equation_rows(ParameterSet(told)), [length], ())
        near = np.abs(block.stamp[:, None] - some.stamp) <= 0.5e9 * length
        touches = (near & block.stopped[:, :1]).any(axis=0)
        assert not some.valid[touches, 0].any()
        np.testing.assert_array_equal(some.valid[:, 1:], every.valid[:, 1:])
        kept = some.valid[:, 0]
        np.testing.assert_array_equal(some.mean.K[kept], every.mean.K[kept])
        # The filter of 100 Hz feels the force a little longer than the stop is touched.
        near = np.abs(block.stamp[:, None] - some.stamp) <= 0.5e9 * length + 11e6
        assert kept[~(near & block.stopped[:, :1]).any(axis=0)].all()


def test_combined_rows_need_all_joints_free_of_stops():
    """Rows without the wrench of a contact contain the efforts of all joints that carry it."""
    robot = limited(arm(links=6), END)
    carried = robot.link_names[int(np.flatnonzero(robot.ancestors[0])[-1])]
    told = with_contacts(robot.with_end_stops(robot.joint_names[:1]), [f"{carried}:0"])
    log, _, of_stops = simulated(robot, has_stops=True)
    assert of_stops[:, 0].any()
    segment = next(iter(AlignedLog(log, told)))
    loaded = np.asarray(told.contacts.loads.any(axis=0))
    assert loaded[0]
    for block in cut_into_blocks(segment):
        ((rows,),) = windowed_rows(block, equation_rows(ParameterSet(told)), [0.161], ())
        near = np.abs(block.stamp[:, None] - rows.stamp) <= 0.5e9 * 0.161
        touches = (near & block.stopped[:, :1]).any(axis=0)
        assert not rows.valid[np.ix_(touches, loaded)].any()


def test_depth_beyond_the_ends():
    for kind, near in zip(("revolute", "prismatic"), NEAR, strict=True):
        joints = [replace(arm().joints[0], kind=kind, lower=-1.0, upper=END)]
        position = np.array([[-1.1], [-1.0 + 0.5 * near], [0.0], [END - 0.25 * near]])
        expected = [[-0.1 - near], [-0.5 * near], [0.0], [0.75 * near]]
        np.testing.assert_allclose(end_stop_depth(position, joints), expected, atol=1e-12)
    assert not at_end_stops(position, joints).any()


def test_a_joint_without_limits_has_no_end(robot):
    free = replace(robot, joints=tuple(replace(one, upper=np.inf) for one in robot.joints))
    free = replace(free, joints=tuple(replace(one, lower=-np.inf) for one in free.joints))
    for name in (free.joint_names[0], "elsewhere"):
        with pytest.raises(ModelError, match="no joint with a limited range"):
            free.with_end_stops([name])
    assert IdentifyOptions(end_stops=("none",)).end_stop_joints == ()
