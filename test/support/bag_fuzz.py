"""Read and recover thousands of damaged bags: no wrong number, and no error but SymbidError.

    python test/support/bag_fuzz.py [--cases 10000] [--first 0] [--processes 2]

Every case follows from its number. A failure is printed with the command that repeats it.
"""

import json
import logging
import shutil
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from random import Random
from types import FrameType

import numpy as np
from foreign_bags import Messages, imu, joint_state, wrench
from fuzz_runner import run_cases
from mcap.writer import CompressionType, IndexType
from mcap.writer import Writer as McapWriter
from mutations import mutated

from symbid_ros.bags import BagWriter, Recording, bag_info, read_streams, recover
from symbid_ros.bags.container.mcap_records import report_damage
from symbid_ros.bags.container.mcap_summary import read_summary
from symbid_ros.errors import SymbidError
from symbid_ros.messages.layout import typestore
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH
from symbid_ros.signals.streams import Streams

STEPS = 40
STRING = "std_msgs/msg/String"
MAX_MEMORY = 512 << 20
MAX_SECONDS = 30
BATCH = 100

Arrays = dict[str, tuple[np.ndarray, np.ndarray]]  # by topic: stamps (N,) and values (N, width)


@dataclass(frozen=True)
class Kind:
    """A kind of bag: how it is written, and which of its content has checksums."""

    name: str
    write: Callable[[Path], None]
    has_checksums: bool = True
    has_summary: bool = True


def messages() -> Messages:
    draw = np.random.default_rng(3).standard_normal
    found = []
    for n in range(1, STEPS + 1):
        stamp = n * 1_000_000
        names = ["hip", "knee"] if n % 10 else ["knee", "hip"]
        state = joint_state(stamp, names, draw(2), draw(2), draw(2))
        found += [
            ("/joint_states", JOINT_STATE, state),
            ("/imu/data", IMU, imu(stamp, draw(3))),
            ("/left_foot/wrench", WRENCH, wrench(stamp, draw(3))),
            ("/right_foot/wrench", WRENCH, wrench(stamp, draw(3))),
            ("/log", STRING, b"\0\1\0\0\5\0\0\0text\0"),
        ]
    return found


def write_ours(file: Path) -> None:
    with BagWriter(file.parent / "ours", chunk_size=4096) as bag:
        channels: dict[str, int] = {}
        for index, (topic, msgtype, payload) in enumerate(messages()):
            if topic not in channels:
                channels[topic] = bag.add_topic(topic, msgtype)
            bag.write(channels[topic], index, payload)
    shutil.move(file.parent / "ours" / "ours_0.mcap", file)


def write_mcap(file: Path, **options: object) -> None:
    with file.open("wb") as stream:
        writer = McapWriter(stream, chunk_size=4096, **options)  # type: ignore[arg-type]
        writer.start("ros2")
        channels: dict[str, int] = {}
        for index, (topic, msgtype, payload) in enumerate(messages()):
            if topic not in channels:
                text = typestore().generate_msgdef(msgtype, ros_version=2)[0].encode()
                schema = writer.register_schema(msgtype, "ros2msg", text)
                channels[topic] = writer.register_channel(topic, "cdr", schema)
            writer.add_message(channels[topic], index, payload, index)
        writer.finish()


BARE = {
    "index_types": IndexType.NONE,
    "use_statistics": False,
    "repeat_channels": False,
    "repeat_schemas": False,
    "use_summary_offsets": False,
}
KINDS = (
    Kind("ours", write_ours),
    Kind("zstd", write_mcap),
    Kind("lz4", partial(write_mcap, compression=CompressionType.LZ4)),
    Kind("plain", partial(write_mcap, compression=CompressionType.NONE)),
    Kind("unindexed", partial(write_mcap, index_types=IndexType.NONE)),
    Kind("bare-zstd", partial(write_mcap, **BARE), has_summary=False),
    Kind(
        "bare-plain",
        partial(write_mcap, compression=CompressionType.NONE, **BARE),
        has_summary=False,
    ),
    Kind("data-checksum", partial(write_mcap, enable_data_crcs=True)),
    Kind("unchecked", partial(write_mcap, enable_crcs=False), has_checksums=False),
    Kind("unchunked", partial(write_mcap, use_chunking=False), has_checksums=False),
)


def arrays(streams: Streams) -> Arrays:
    joints = streams.joints
    order = np.argsort(joints.names)
    found = {
        joints.topic: (
            joints.stamp,
            np.hstack([joints.position, joints.velocity, joints.effort]).reshape(
                len(joints.stamp), 3, -1
            )[:, :, order],
        )
    }
    for sensor in streams.imus:
        found[sensor.topic] = (sensor.stamp, sensor.angular_velocity)
    for plate in streams.wrenches:
        found[plate.topic] = (plate.stamp, np.hstack([plate.force, plate.torque]))
    return found


@cache
def original(kind: Kind) -> tuple[bytes, Arrays]:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "bag.mcap"
        kind.write(file)
        return file.read_bytes(), arrays(read_streams([file]))


def differences(read: Arrays, truth: Arrays) -> Iterator[str]:
    """Return the samples read that are not in the original."""
    for topic, (stamp, values) in read.items():
        if topic not in truth:
            yield f"topic {topic} is not in the original"
            continue
        true_stamp, true_values = truth[topic]
        place = np.searchsorted(true_stamp, stamp).clip(max=len(true_stamp) - 1)
        if not np.array_equal(true_stamp[place], stamp):
            yield f"{topic}: stamps that are not in the original"
        elif not np.array_equal(true_values[place], values):
            yield f"{topic}: values that are not in the original"


def count(read: Arrays) -> int:
    return sum(len(stamp) for stamp, _ in read.values())


class TooSlow(BaseException):
    """Not an Exception, so that no ``except Exception`` catches it."""


@contextmanager
def time_limit(seconds: int = MAX_SECONDS) -> Iterator[None]:
    def stop(_number: int, _frame: FrameType | None) -> None:
        raise TooSlow

    before = signal.signal(signal.SIGALRM, stop)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


class Warnings(logging.Handler):
    """Keeps logged warnings."""

    def __init__(self) -> None:
        super().__init__(logging.WARNING)
        self.lines: list[str] = []

    def emit(self, record: logging.LogRecord) -> None:
        self.lines.append(record.getMessage())


def faults(number: int, folder: Path) -> list[str]:
    """Return everything that went wrong with one case."""
    draw = Random(number)
    kind = draw.choice(KINDS)
    image, truth = original(kind)
    spoiled, names = mutated(image, draw)
    file = folder / "bag.mcap"
    file.write_bytes(spoiled)
    found: list[str] = []
    try:
        with time_limit():
            for job in (_read, _replay, _describe, _recover):
                try:
                    found += job(kind, file, truth)
                except SymbidError as error:
                    if "\n" in str(error) or len(str(error)) > 1000:
                        found.append(f"no single line: {error!r}")
    except TooSlow:
        found.append(f"took more than {MAX_SECONDS} s")
    except BaseException as error:
        found.append(f"{type(error).__name__}: {error}")
    # getrusage starts from the peak of the parent.
    status = Path("/proc/self/status").read_text()
    memory = int(status.split("VmHWM:")[1].split()[0]) << 10
    if memory > MAX_MEMORY:
        found.append(f"{memory >> 20} MB of memory")
    return [f"case {number}: {kind.name}, {'+'.join(names)}: {text}" for text in found]


def _read(kind: Kind, file: Path, truth: Arrays) -> list[str]:
    logger = logging.getLogger("symbid_ros")
    said = Warnings()
    logger.addHandler(said)
    try:
        read = arrays(read_streams([file]))
    finally:
        logger.removeHandler(said)
    if not kind.has_checksums:
        return []
    found = list(differences(read, truth))
    if kind.has_summary and count(read) < count(truth) and not said.lines:
        found.append(f"{count(truth) - count(read)} samples missing without a word")
    return found


def _replay(kind: Kind, file: Path, _truth: Arrays) -> list[str]:
    recording = Recording.of([file])
    times = [
        message.log_time
        for message in recording.messages(recording.topics, recording.start, recording.end + 1)
    ]
    if kind.has_checksums and times != sorted(times):
        return ["replayed out of order"]
    return []


def _describe(_kind: Kind, file: Path, _truth: Arrays) -> list[str]:
    json.dumps(bag_info(file).as_dict())
    return []


def _recover(kind: Kind, file: Path, truth: Arrays) -> list[str]:
    out = file.with_name("out")
    shutil.rmtree(out, ignore_errors=True)
    recovery = recover(file, out)
    recovered = arrays(read_streams([out]))
    if not kind.has_checksums:
        return []
    found = [f"recovered {text}" for text in differences(recovered, truth)]
    if not recovery.is_whole:  # without summary and first chunk, names have no checksum
        found = [text for text in found if not text.startswith("recovered topic")]
    if recovery.is_whole and count(recovered) < count(truth) and _tells_counts(file):
        found.append("recovered less than there was, as if it were all")
    return found


def _tells_counts(file: Path) -> bool:
    try:
        with report_damage(file):
            summary = read_summary(file)
    except SymbidError:
        return False
    return summary.statistics is not None


def run(cases: range) -> list[str]:
    """Run cases one after the other and return the failures."""
    logging.getLogger("symbid_ros").addHandler(logging.NullHandler())
    found = []
    with tempfile.TemporaryDirectory() as folder:
        for number in cases:
            found += faults(number, Path(folder))
    return found


if __name__ == "__main__":
    sys.exit(run_cases(run, "spoiled bags", cases=10_000, batch=BATCH))
