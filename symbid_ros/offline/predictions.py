"""Measured and predicted efforts as a bag, for plots beside the log."""

from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.bags import BagWriter, create_folder
from symbid_ros.identification.predictions.validation_result import PredictedEfforts
from symbid_ros.messages.layout import Records
from symbid_ros.messages.types import fill_message, fill_wrench, joint_state_layout, wrench_layout


def write_predictions(efforts: PredictedEfforts, out: Path) -> None:
    """Write a bag with the stamps of the rows; values that are not used are NaN.

    The topics are ``/measured/joint_states``, ``/original/joint_states`` and
    ``/identified/joint_states`` (sensor_msgs/JointState with efforts alone); for a floating base
    also ``base_wrench`` of each (geometry_msgs/WrenchStamped in base axes).

    Parameters
    ----------
    efforts : PredictedEfforts
    out : Path
        Folder of the bag, which must not exist.

    Raises
    ------
    BagError
        When the folder exists or cannot be written.
    """
    stamp = efforts.stamp
    joints = joint_state_layout(efforts.joints, has_motion=False)
    wrenches = wrench_layout(efforts.base)

    def efforts_of(values: FloatArray) -> Records:
        records = joints.records(len(stamp))
        fill_message(joints.columns(records), stamp, effort=values)
        return records

    def wrenches_of(values: FloatArray) -> Records:
        records = wrenches.records(len(stamp))
        fill_wrench(wrenches.columns(records), stamp, values[:, [3, 4, 5, 0, 1, 2]])
        return records

    topics = []
    for name, effort, wrench in (
        ("measured", efforts.measured, efforts.wrench_measured),
        ("original", efforts.before, efforts.wrench_before),
        ("identified", efforts.after, efforts.wrench_after),
    ):
        topics.append((f"/{name}/joint_states", joints.msgtype, efforts_of(effort)))
        if efforts.base:
            topics.append((f"/{name}/base_wrench", wrenches.msgtype, wrenches_of(wrench)))
    with create_folder(out) as folder, BagWriter(folder) as bag:
        channels = [bag.add_topic(name, msgtype) for name, msgtype, _ in topics]
        for row, time in enumerate(np.maximum(stamp, 0).tolist()):
            for channel, (_, _, records) in zip(channels, topics, strict=True):
                bag.write(channel, time, records[row].tobytes())
