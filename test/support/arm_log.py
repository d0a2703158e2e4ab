"""An arm that follows sums of sines and pauses in between, with drives that rub as real ones do."""

import numpy as np
from analytic_log import waves

from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.streams import JointStream, Streams

PAUSE = 1.5  # s at rest at the beginning and at the end


def without_load(read: JointStream, joint: int) -> np.ndarray:
    """Return efforts in which one drive overcomes friction alone, as if a hand did the rest."""
    velocity, rng = read.velocity[:, joint], np.random.default_rng(0)
    effort = read.effort.copy()
    effort[:, joint] = np.tanh(velocity / 0.05) + velocity + 0.3 * rng.standard_normal(len(effort))
    return effort


def arm_streams(model, seconds=40.0, seed=0, *, rate=200.0, friction=0.0, resting=()):
    """Return what the joints of a fixed arm read, with noise in proportion to its effort limits.

    ``friction`` is the Coulomb friction of each joint, and its viscous friction at 1 rad/s, as a
    share of its effort limit, so that wrists rub more than they carry.
    Joints in ``resting`` are held where they are.
    """
    rng = np.random.default_rng(seed)
    time = np.arange(round(seconds * rate)) / rate
    size = np.array([_reach(joint) for joint in model.joints])
    phase, phase_rate, phase_acceleration = _phase(time)
    angle, slope, bend = waves(rng, phase, (len(model.joints),), 1.0)
    middle = np.array([_middle(joint) for joint in model.joints])
    held = np.isin(model.joint_names, resting)
    size = np.where(held, 0.0, size)
    position = middle + size * angle
    velocity = size * slope * phase_rate[:, None]
    acceleration = size * (bend * phase_rate[:, None] ** 2 + slope * phase_acceleration[:, None])
    position = model.apply_mimics(position)
    velocity, acceleration = (
        model.apply_mimics(each, rates=True) for each in (velocity, acceleration)
    )
    empty = np.zeros((len(time), 3))
    samples = Samples(
        stamp=np.round(time * 1e9).astype(np.int64),
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        effort=np.zeros_like(position),
        base_angular_velocity=empty,
        base_angular_acceleration=empty,
        base_specific_force=np.broadcast_to(-model.gravity, empty.shape),
        wrenches=np.zeros((len(time), 0, 6)),
        wrench_frames=(),
    )
    parameters = ParameterSet(model)
    effort = equation_of_motion(parameters, samples).K @ parameters.values
    limit = np.array([joint.effort for joint in model.joints])
    rubbing = friction * limit * rng.uniform(0.7, 1.3, len(limit))
    armature = 0.05 * rubbing
    effort = effort + rubbing * (np.tanh(velocity / 2e-3) + velocity) + armature * acceleration
    # A joint that sticks carries what friction leaves of its load: this is not known exactly.
    sticking = friction * limit * 0.3 * rng.uniform(-1, 1, len(limit))
    effort = effort + sticking * (np.abs(velocity) < 1e-6)

    def noise(values, deviation):
        return values + deviation * rng.standard_normal(values.shape)

    joints = JointStream(
        "/joint_states",
        model.joint_names,
        10**18 + samples.stamp,
        noise(position, 2e-5),
        noise(velocity, 2e-3),
        noise(effort, 2e-3 * limit),
    )
    return Streams("arm", joints, (), ())


def _phase(time):
    """Return a phase, s, that starts and stops smoothly, and its first two derivatives."""
    ramp = 1.0
    length = time[-1] - 2 * PAUSE
    at = np.clip(time - PAUSE, 0, length)

    def blend(x):
        x = np.clip(x, 0, 1)
        return x**3 * (10 - 15 * x + 6 * x**2), 30 * x**2 * (1 - x) ** 2

    up, up_rate = blend(at / ramp)
    down, down_rate = blend((length - at) / ramp)
    rate = up * down
    acceleration = (up_rate * down - up * down_rate) / ramp
    step = time[1] - time[0]
    phase = np.concatenate([[0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * step)])
    return phase, rate, acceleration


def _reach(joint):
    span = joint.upper - joint.lower if np.isfinite(joint.upper - joint.lower) else np.inf
    return min(0.45 * span, 1.5 if joint.kind == "revolute" else 0.2)


def _middle(joint):
    if not np.isfinite(joint.upper - joint.lower):
        return 0.0
    return float(np.clip(0.0, joint.lower + _reach(joint), joint.upper - _reach(joint)))
