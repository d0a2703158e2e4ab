"""Recording of a simulation into a bag, faster or slower than real time."""

from collections.abc import Callable, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from symbid_ros.bags import BagWriter, create_folder
from symbid_ros.simulation.sensors import Instant
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.topics import sensor_topics, truth_topics

BLOCK = 500  # instants encoded together: large enough to be efficient, small enough for progress


def record(
    simulator: Simulator,
    out: Path,
    *,
    progress: Callable[[int, int], None] | None = None,
) -> dict[str, int]:
    """Simulate the motion and write its sensor and ground-truth topics to a bag.

    The log time of a message is its stamp, so equal seeds give equal message payloads.

    Parameters
    ----------
    simulator : Simulator
        A simulator that has not been stepped.
    out : Path
        Folder of the bag, which must not exist; it appears when the bag is complete.
    progress : callable, optional
        Called with the number of written instants and the total number.

    Returns
    -------
    dict of str to int
        Number of messages by topic.
    """
    topics = [*sensor_topics(simulator), *truth_topics(simulator)]
    with create_folder(out) as folder, BagWriter(folder) as bag:
        channels = [bag.add_topic(f"/{topic.name}", topic.layout.msgtype) for topic in topics]
        done = 0
        while done < simulator.steps:
            instants = [simulator.step() for _ in range(min(BLOCK, simulator.steps - done))]
            stamps = np.array([instant.stamp for instant in instants])
            block = _stack(instants)
            payloads = []
            for topic in topics:
                records = topic.layout.records(len(instants))
                topic.fill(topic.layout.columns(records), stamps, block)
                payloads.append(records)
            for row, instant in enumerate(instants):
                for channel, topic, records in zip(channels, topics, payloads, strict=True):
                    if (done + row) % topic.every == 0:
                        bag.write(channel, instant.stamp, records[row].tobytes())
            done += len(instants)
            if progress is not None:
                progress(done, simulator.steps)
    return bag.counts


def _stack(instants: Sequence[Instant]) -> Instant:
    """Return one instant whose arrays have the instants along their first axis."""
    arrays: dict[str, Any] = {
        field.name: np.stack([getattr(instant, field.name) for instant in instants])
        for field in fields(Instant)
        if field.name != "stamp"
    }
    return replace(instants[0], **arrays)
