"""Streams without the messages in which a sensor was frozen or at its limit."""

from collections import defaultdict
from dataclasses import fields, replace
from typing import Any, TypeVar

import numpy as np

from symbid_ros.arrays import BoolArray
from symbid_ros.diagnosis.finding import Finding
from symbid_ros.diagnosis.freezing import Freezing
from symbid_ros.diagnosis.saturation import Saturation, channels
from symbid_ros.signals.streams import ImuStream, JointStream, Streams, WrenchStream

S = TypeVar("S", JointStream, ImuStream, WrenchStream)


def masked(streams: Streams) -> tuple[Streams, tuple[Finding, ...]]:
    """Return what is left of a stretch of a log, and why messages were left out.

    A gap is left where they were, across which nothing is interpolated.
    """
    freezing, saturation = Freezing(), Saturation()
    freezing.add(streams)
    saturation.add(streams)
    limits = saturation.limits
    limited = {(topic, name) for topic, name, _ in limits}
    findings = (*saturation.findings(), *freezing.findings(limited))
    if not findings:
        return streams, ()
    wrong: dict[str, list[BoolArray]] = defaultdict(list)
    for topic, names, _, readings in channels(streams):
        for (where, name, _), (value, _) in limits.items():
            if where == topic:
                wrong[topic].append(np.asarray(readings[:, names.index(name)] == value))
    sensors: list[JointStream | ImuStream | WrenchStream] = [
        streams.joints,
        *streams.imus,
        *streams.wrenches,
    ]
    stamps = {sensor.topic: sensor.stamp for sensor in sensors}
    for (topic, name), still in freezing.readings.items():
        if still.is_frozen and (topic, name) not in limited:
            stamp = stamps[topic]
            wrong[topic] += [(stamp >= begin) & (stamp <= end) for begin, end in still.runs]
    return (
        replace(
            streams,
            joints=_without(streams.joints, wrong),
            imus=tuple(_without(imu, wrong) for imu in streams.imus),
            wrenches=tuple(_without(wrench, wrong) for wrench in streams.wrenches),
        ),
        findings,
    )


def _without(stream: S, wrong: dict[str, list[BoolArray]]) -> S:
    if stream.topic not in wrong:
        return stream
    kept = ~np.logical_or.reduce(wrong[stream.topic])
    arrays: dict[str, Any] = {
        entry.name: value[kept]
        for entry in fields(stream)
        if isinstance(value := getattr(stream, entry.name), np.ndarray)
    }
    return replace(stream, **arrays)
