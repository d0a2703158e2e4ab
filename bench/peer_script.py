"""From bag to model in an afternoon: the plain script that `symbid identify` is compared with.

rosbags reads the messages, SciPy filters them, Pinocchio gives one regressor per sample, NumPy
accumulates and solves the normal equations with a prior of ± 25 %. It shares no code with this
package. Prints one line of JSON: seconds of each stage, peak memory, total mass.

    python bench/peer_script.py BAG URDF
"""

import json
import resource
import sys
import time
from pathlib import Path

import numpy as np
import pinocchio
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore
from scipy.signal import butter, filtfilt

FEET = {"/left_foot/wrench": "left_sole", "/right_foot/wrench": "right_sole"}
CUTOFF = 30.0  # Hz
BLOCK = 256  # samples; their regressors fit the cache
BASE_WEIGHT, JOINT_WEIGHT = 1.0, 4.0
PRIOR = 0.25


def read(bag: str) -> tuple[list[str], dict[str, np.ndarray]]:
    """Return joint names and one array (N, 1 + k) per topic: stamp, s, and values."""
    rows = {topic: [] for topic in ("/joint_states", "/imu/data", *FEET)}
    with AnyReader([Path(bag)], default_typestore=get_typestore(Stores.ROS2_JAZZY)) as reader:
        connections = [c for c in reader.connections if c.topic in rows]
        for connection, _, raw in reader.messages(connections):
            message = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            if connection.topic == "/joint_states":
                names = message.name
                values = (message.position, message.velocity, message.effort)
                row = np.concatenate([[stamp], *values])
            elif connection.topic == "/imu/data":
                a, w = message.linear_acceleration, message.angular_velocity
                row = (stamp, a.x, a.y, a.z, w.x, w.y, w.z)
            else:
                f, m = message.wrench.force, message.wrench.torque
                row = (stamp, f.x, f.y, f.z, m.x, m.y, m.z)
            rows[connection.topic].append(row)
    return names, {topic: np.array(values) for topic, values in rows.items()}


def main(bag: str, urdf: str) -> None:
    start = time.perf_counter()
    names, topics = read(bag)
    was_read = time.perf_counter()

    count = min(map(len, topics.values()))
    period = float(np.median(np.diff(topics["/joint_states"][:, 0])))
    numerator, denominator = butter(2, 2 * CUTOFF * period)
    smooth = {
        topic: filtfilt(numerator, denominator, values[:count, 1:], axis=0)
        for topic, values in topics.items()
    }
    position, velocity, effort = np.split(smooth["/joint_states"], 3, axis=1)
    force, turn = np.split(smooth["/imu/data"], 2, axis=1)
    acceleration = np.gradient(velocity, period, axis=0)
    turn_rate = np.gradient(turn, period, axis=0)
    was_filtered = time.perf_counter()

    model = pinocchio.buildModelFromUrdf(urdf, pinocchio.JointModelFreeFlyer())
    model.gravity.setZero()  # the accelerometer's specific force contains it
    data = model.createData()
    joints = [model.joints[model.getJointId(name)].idx_v for name in names]
    soles = [model.getFrameId(frame) for frame in FEET.values()]
    wrenches = [smooth[topic] for topic in FEET]
    imu = model.frames[model.getFrameId("imu_link")].placement
    turn, turn_rate = turn @ imu.rotation.T, turn_rate @ imu.rotation.T
    arm = imu.translation
    at_base = force @ imu.rotation.T
    at_base -= np.cross(turn_rate, arm) + np.cross(turn, np.cross(turn, arm))

    q = np.zeros((count, model.nq))
    v, a, torque = (np.zeros((count, model.nv)) for _ in range(3))
    q[:, 6] = 1.0
    q[:, [joint + 1 for joint in joints]] = position
    v[:, 3:6], v[:, joints] = turn, velocity
    a[:, :3], a[:, 3:6], a[:, joints] = at_base, turn_rate, acceleration
    torque[:, joints] = effort

    size = 10 * (model.njoints - 1)
    weights = np.r_[np.full(6, BASE_WEIGHT), np.full(model.nv - 6, JOINT_WEIGHT)]
    normal, right = np.zeros((size, size)), np.zeros(size)
    block = np.empty((BLOCK, model.nv, size))
    for first in range(0, count, BLOCK):
        last = min(first + BLOCK, count)
        for k in range(first, last):
            block[k - first] = pinocchio.computeJointTorqueRegressor(model, data, q[k], v[k], a[k])
            pinocchio.computeJointJacobians(model, data, q[k])
            pinocchio.updateFramePlacements(model, data)
            for sole, wrench in zip(soles, wrenches, strict=True):
                jacobian = pinocchio.getFrameJacobian(model, data, sole, pinocchio.LOCAL)
                torque[k] += jacobian.T @ wrench[k]
        rows = (block[: last - first] * weights[:, None]).reshape(-1, size)
        normal += rows.T @ rows
        right += rows.T @ (torque[first:last] * weights).ravel()
    nominal = np.concatenate([inertia.toDynamicParameters() for inertia in model.inertias[1:]])
    prior = np.diag((PRIOR * np.maximum(abs(nominal), 1e-3)) ** -2.0)
    found = np.linalg.solve(normal + prior, right + prior @ nominal)
    seconds = {
        "read": was_read - start,
        "filter": was_filtered - was_read,
        "rows and solution": time.perf_counter() - was_filtered,
    }
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(json.dumps({"seconds": seconds, "peak_mb": peak, "mass": found[::10].sum()}))


if __name__ == "__main__":
    main(*sys.argv[1:])
