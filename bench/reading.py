"""Time to read a bag into arrays, compared with rosbags' deserializing reader on the same file.

The bag contains joint states of ten joints, an IMU and two wrenches. Each reader runs in its own
process. The table shows messages per second, peak memory, and the ratio of times. Our arrays are
then compared with rosbags' messages, bit for bit.

    .venv/bin/python bench/reading.py [--seconds 300] [--rate 1000]

Takes about two minutes.
"""

import argparse
import multiprocessing
import tempfile
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

import numpy as np
from process_usage import peak_memory
from rosbags.rosbag2 import Reader

from symbid_ros.bags import BagWriter, read_streams
from symbid_ros.bags.writing.writer import CHUNK_SIZE
from symbid_ros.messages import types as messages
from symbid_ros.messages.layout import typestore
from symbid_ros.signals.streams import Streams

JOINTS = tuple(f"joint_{number}" for number in range(10))
CHUNK_SIZES = {"recorder's": CHUNK_SIZE, "large": 4 << 20}


def write_bag(out: Path, seconds: float, rate: float, chunk_size: int) -> int:
    """Write a smooth motion with sensor noise, and return the number of messages."""
    draw = np.random.default_rng(5).standard_normal
    count = round(seconds * rate)
    stamp = np.rint(np.arange(1, count + 1) * 1e9 / rate).astype(np.int64)
    phase = np.outer(stamp * 1e-9, np.linspace(0.5, 3.0, 10))

    def signal(width: int, noise: float) -> Any:
        return np.sin(phase[:, :width]) + noise * draw((count, width))

    layouts = {
        "/joint_states": messages.joint_state_layout(JOINTS),
        "/imu/data": messages.imu_layout("imu_link"),
        "/left_foot/wrench": messages.wrench_layout("left_sole"),
        "/right_foot/wrench": messages.wrench_layout("right_sole"),
    }
    records = {topic: layout.records(count) for topic, layout in layouts.items()}
    columns = {topic: layouts[topic].columns(rows) for topic, rows in records.items()}
    joints, imu, *wrenches = columns.values()
    messages.fill_message(
        joints,
        stamp,
        position=signal(10, 1e-4),
        velocity=signal(10, 1e-2),
        effort=100 * signal(10, 1e-2),
    )
    messages.fill_message(
        imu,
        stamp,
        orientation=signal(4, 1e-4),
        angular_velocity=signal(3, 1e-2),
        linear_acceleration=10 * signal(3, 1e-2),
    )
    for wrench in wrenches:
        messages.fill_wrench(wrench, stamp, 500 * signal(6, 1e-2))
    with BagWriter(out, chunk_size=chunk_size) as bag:
        channels = [bag.add_topic(topic, layout.msgtype) for topic, layout in layouts.items()]
        for row, time_ns in enumerate(stamp.tolist()):
            for channel, topic in zip(channels, records, strict=True):
                bag.write(channel, time_ns, records[topic][row].tobytes())
    return count * len(layouts)


def load(bag: Path) -> None:
    """Read a bag into arrays."""
    read_streams([bag])


def deserialize(bag: Path) -> None:
    """Read a bag message by message with rosbags, and discard the messages."""
    store = typestore()
    with Reader(bag) as reader:
        for connection, _, payload in reader.messages():
            store.deserialize_cdr(payload, connection.msgtype)


def measured(read: Callable[[Path], None], bag: Path) -> tuple[float, float]:
    """Return duration, s, and peak memory, MB, of one reading in a new process."""
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(1, mp_context=spawn) as pool:
        return pool.submit(_timed, read, bag).result()


def _timed(read: Callable[[Path], None], bag: Path) -> tuple[float, float]:
    start = time.perf_counter()
    read(bag)
    return time.perf_counter() - start, peak_memory()


def differences(bag: Path, streams: Streams) -> int:
    """Return the number of values that differ from rosbags' in any bit."""
    joints, (imu,), wrenches = streams.joints, streams.imus, streams.wrenches
    ours = {
        joints.topic: np.hstack([joints.position, joints.velocity, joints.effort]),
        imu.topic: np.hstack([imu.orientation, imu.angular_velocity, imu.linear_acceleration]),
        **{one.topic: np.hstack([one.force, one.torque]) for one in wrenches},
    }
    stamps = {one.topic: one.stamp for one in (joints, imu, *wrenches)}
    rows = dict.fromkeys(ours, 0)
    different = 0
    store = typestore()
    with Reader(bag) as reader:
        for connection, _, payload in reader.messages():
            topic = connection.topic
            message = store.deserialize_cdr(payload, connection.msgtype)
            row = rows[topic]
            header = message.header.stamp
            different += stamps[topic][row] != header.sec * 1_000_000_000 + header.nanosec
            theirs = np.array(_numbers(message), dtype=np.float64)
            different += int(np.count_nonzero(ours[topic][row].view("u8") != theirs.view("u8")))
            rows[topic] += 1
    different += sum(abs(rows[topic] - len(values)) for topic, values in ours.items())
    return different


def _numbers(message: Any) -> list[float]:
    if hasattr(message, "effort"):
        return [*message.position, *message.velocity, *message.effort]
    if hasattr(message, "orientation"):
        q, w, a = message.orientation, message.angular_velocity, message.linear_acceleration
        return [q.x, q.y, q.z, q.w, w.x, w.y, w.z, a.x, a.y, a.z]
    f, t = message.wrench.force, message.wrench.torque
    return [f.x, f.y, f.z, t.x, t.y, t.z]


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--rate", type=float, default=1000.0)
    arguments = parser.parse_args()
    print("chunks       reader        s   messages/s   peak MB   faster")
    with tempfile.TemporaryDirectory() as folder:
        for name, chunk_size in CHUNK_SIZES.items():
            bag = Path(folder) / f"bag_{chunk_size}"
            count = write_bag(bag, arguments.seconds, arguments.rate, chunk_size)
            peer, peer_memory = measured(deserialize, bag)
            ours, memory = measured(load, bag)
            again, again_memory = measured(load, bag)
            best, peak = min(ours, again), max(memory, again_memory)
            print(f"{name:12} rosbags {peer:8.2f} {count / peer:12.0f} {peer_memory:9.0f}")
            print(
                f"{name:12} symbid  {best:8.2f} {count / best:12.0f} {peak:9.0f}"
                f"   {peer / best:.1f} x",
                flush=True,
            )
        different = differences(bag, read_streams([bag]))
    print(f"values that differ from rosbags' in any bit: {different}")


if __name__ == "__main__":
    main()
