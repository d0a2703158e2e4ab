"""The facts at the head of a report: which data, how much, what was done."""

from collections.abc import Sequence
from pathlib import Path

from symbid_ros.bags.streams.reader import read_streams
from symbid_ros.estimation.estimate import Estimate


def bag_facts(bags: Sequence[Path]) -> dict[str, str]:
    """Return what a bag holds, read from its sensor topics."""
    streams = read_streams(bags)
    stamp = streams.joints.stamp
    seconds = (stamp[-1] - stamp[0]) * 1e-9
    sensors = [streams.joints.topic]
    sensors += [imu.topic for imu in streams.imus] + [w.topic for w in streams.wrenches]
    return {
        "Bag": ", ".join(str(bag) for bag in bags),
        "Duration": f"{seconds:.1f} s, {len(stamp)} joint states",
        "Sensors": ", ".join(sensors),
    }


def estimate_facts(estimate: Estimate) -> dict[str, str]:
    """Return what an identification used."""
    cut = "" if estimate.rank is None else f"{estimate.rank} singular values, "
    return {
        "Rows": f"{estimate.samples} of each coordinate, {cut}condition {estimate.condition:.3g}",
        "Inputs": ", ".join(estimate.inputs),
        "Software": estimate.software,
    }
