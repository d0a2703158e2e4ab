"""The recorder under load and under kill -9: lost messages and processor time.

A separate process publishes four sensor topics, as the bridge does: 60 s at 1 kHz, then 20 s at
4 kHz. Printed are the lost messages, the recorder's processor time as a share of one core, and the
time from stamp to receipt.

With ``--kills`` a recorder of a 1 kHz and a 5 Hz topic is killed at random times instead, and the
unfinished bag is read. Printed is the age of the oldest missing message at the time of the kill.

With ``--images`` 5 MB images at 30 Hz are recorded together with the four topics at 1 kHz, with a
queue of 64 MB. Printed are the lost messages of each topic. Meanwhile run another program that
keeps all cores busy.

4 kHz needs two idle cores: messages published late are not the recorder's fault.

    .venv/bin/python bench/recorder.py [--seconds 60] [--burst 20] [--kills 100] [--seed 0]
    .venv/bin/python bench/recorder.py --images [--seconds 60]
"""

import argparse
import multiprocessing
import os
import random
import sys
import tempfile
import time
from array import array
from multiprocessing.connection import Connection
from pathlib import Path
from threading import Event

import numpy as np
import rclpy
from mcap.reader import make_reader
from process_usage import processor_seconds
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

sys.path.append(str(Path(__file__).resolve().parents[1] / "test" / "support"))

from paced_feed import SENSORS, Feed, await_subscribers, feed, kill_recorder

from symbid_ros.bags import recover
from symbid_ros.cli.processes import NodeProcess, private_graph
from symbid_ros.messages.types import read_leading_stamp
from symbid_ros.ros.endpoints import reliable_qos

BOUND = 0.1  # s


def main() -> None:
    """Run the chosen measurement and print the results."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seconds", type=float, default=60.0)
    parser.add_argument("--burst", type=float, default=20.0)
    parser.add_argument("--kills", type=int, default=0)
    parser.add_argument("--images", action="store_true")
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    print(f"{os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
    with tempfile.TemporaryDirectory() as folder, private_graph() as graph:
        os.environ.update(graph)
        if arguments.kills:
            kill(Path(folder), arguments.kills, arguments.seed)
            return
        if arguments.images:
            record_images(Path(folder) / "bag", graph, arguments.seconds)
            return
        for rate, seconds in ((1000.0, arguments.seconds), (4000.0, arguments.burst)):
            record(Path(folder) / f"bag_{rate:.0f}", graph, rate, seconds)


def record(bag: Path, graph: dict[str, str], rate: float, seconds: float) -> None:
    """Record four topics at one rate and print the results."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    parameters = {"bag": str(bag), "topics": list(SENSORS)}
    with NodeProcess("recorder", parameters, graph, bag.with_suffix(".log")) as recorder:
        publisher = context.Process(target=publish, args=(rate, seconds, theirs))
        publisher.start()
        ours.recv()
        start, used = time.monotonic(), processor_seconds(recorder.pid)
        published, late = ours.recv()
        share = (processor_seconds(recorder.pid) - used) / (time.monotonic() - start)
        publisher.join()
        summary = recorder.finish(stop=True)
    recorded = sum(summary["recorded"].values())
    print(
        f"4 topics at {rate:.0f} Hz, {seconds:.0f} s: {published} published "
        f"({published / seconds / 4:.0f} Hz, {late * 1e3:.0f} ms late at most), "
        f"{published - recorded} lost; {100 * share:.0f} % of a core; "
        f"{summary['bytes'] / 1e6:.1f} MB; load {os.getloadavg()[0]:.1f}"
    )
    middle, high = np.percentile(latencies(bag), [50, 99]) / 1e6
    print(f"    stamp to receipt: median {middle:.2f} ms, p99 {high:.2f} ms")


def publish(rate: float, seconds: float, pipe: Connection) -> None:
    """Publish once all topics have a subscriber; report start and end through the pipe."""
    rclpy.init()
    node = rclpy.create_node("robot")
    feeds = [Feed(node, topic, layout, rate) for topic, layout in SENSORS.items()]
    await_subscribers(feeds)
    pipe.send("started")
    late = feed(feeds, Event(), seconds)
    for each in feeds:
        each.publisher.wait_for_all_acked()
    pipe.send((sum(len(each.stamps) for each in feeds), late))
    node.destroy_node()
    rclpy.try_shutdown()


def record_images(bag: Path, graph: dict[str, str], seconds: float) -> None:
    """Record images together with the four topics and print the lost messages of each."""
    context = multiprocessing.get_context("spawn")
    topics = [*SENSORS, Camera.topic]
    parameters = {"bag": str(bag), "topics": topics, "queue_size": 64}
    with NodeProcess("recorder", parameters, graph, bag.with_suffix(".log")) as recorder:
        ends, publishers = [], []
        for task in (publish, publish_images):
            ours, theirs = context.Pipe()
            arguments = (1000.0, seconds, theirs) if task is publish else (seconds, theirs)
            publishers.append(context.Process(target=task, args=arguments))
            publishers[-1].start()
            ends.append(ours)
        for end in ends:
            end.recv()
        (published, late), (images, _) = (end.recv() for end in ends)
        for publisher in publishers:
            publisher.join()
        summary = recorder.finish(stop=True)
    sensors = sum(summary["recorded"][f"/{topic}"] for topic in SENSORS)
    print(
        f"{published} sensor messages ({late * 1e3:.0f} ms late at most), {published - sensors} "
        f"lost; {images} images, {images - summary['recorded'][f'/{Camera.topic}']} lost; "
        f"load {os.getloadavg()[0]:.1f}"
    )


class Camera:
    """A feed of incompressible 5 MB images."""

    topic, rate = "camera", 30.0

    def __init__(self, node: Node) -> None:
        image = Image(data=np.random.default_rng(0).bytes(5_000_000))
        self.stamps = array("q")
        self.publisher = node.create_publisher(Image, self.topic, reliable_qos(5))
        self._payload = serialize_message(image)

    def publish(self) -> None:
        """Publish the next image."""
        self.publisher.publish(self._payload)
        self.stamps.append(time.time_ns())


def publish_images(seconds: float, pipe: Connection) -> None:
    """Publish images once the topic has a subscriber; report start and end through the pipe."""
    rclpy.init()
    node = rclpy.create_node("camera")
    camera = Camera(node)
    await_subscribers([camera])
    pipe.send("started")
    late = feed([camera], Event(), seconds)
    camera.publisher.wait_for_all_acked(Duration(seconds=10))
    pipe.send((len(camera.stamps), late))
    node.destroy_node()
    rclpy.try_shutdown()


def kill(folder: Path, kills: int, seed: int) -> None:
    """Kill recorders at random times and print the losses."""
    draw = random.Random(seed)
    losses, standstills = [], []
    recovered = 0
    for number in range(kills):
        within = folder / str(number)
        within.mkdir()
        cost = kill_recorder(draw.uniform(0.3, 2.0), within)
        recovered += recover(within / "bag").kept == sum(cost.kept.values())
        losses.append(max(cost.lost.values()))
        standstills.append(cost.standstill)
        if losses[-1] > BOUND:
            print(f"kill {number}: {cost}")
    middle, most = np.percentile(losses, [50, 100]) * 1e3
    print(
        f"{kills} kills, {recovered} bags recovered: "
        f"median loss {middle:.0f} ms, maximum {most:.0f} ms; "
        f"machine {max(standstills) * 1e3:.0f} ms late at most; load {os.getloadavg()[0]:.1f}"
    )


def latencies(bag: Path) -> np.ndarray:
    """Return receipt minus stamp of every message, ns."""
    (file,) = bag.glob("*.mcap")
    with file.open("rb") as stream:
        messages = make_reader(stream).iter_messages(log_time_order=False)
        return np.array(
            [message.log_time - read_leading_stamp(message.data) for _, _, message in messages]
        )


if __name__ == "__main__":
    main()
