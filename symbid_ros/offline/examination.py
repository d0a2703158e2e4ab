"""A record held against its model before anything is believed of it: the doctor's checks."""

import logging

from symbid_ros.bags.container.contents import bag_names, contents
from symbid_ros.bags.streams.selection import Selector, TopicSelection
from symbid_ros.diagnosis.finding import Finding, Severity
from symbid_ros.diagnosis.model_checks import check_model
from symbid_ros.diagnosis.model_watch import ModelWatch
from symbid_ros.errors import DataError
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.record import Record

logger = logging.getLogger(__name__)


def examine(record: Record, parameters: ParameterSet, prior: Prior, topics: TopicSelection) -> None:
    """Warn of what is wrong between a record's sensors and its model.

    Parameters
    ----------
    record : Record
        Its stretches are read once more if they are too long to be kept.
    parameters : ParameterSet
        Of the job.
    prior : Prior
        Whose mean is taken for the robot, to ±25 %.
    topics : TopicSelection
        Which were the robot's sensors.

    Raises
    ------
    DataError
        When a sign, a frame or a mounting is wrong, or a contact is missing.
    """
    source = bag_names(record.bags)
    chosen = Selector(source, topics, contents(record.bags)).selected()
    watch: ModelWatch | None = None
    for segment in record.segments:
        if watch is None:
            robot = parameters.apply(prior.mean)
            watch = ModelWatch(robot, segment.wrench_frames, segment.imu_frames)
        watch.add(segment)
    if watch is None:
        return
    found = check_model(
        watch,
        ", ".join(topic.name for topic in chosen.joints),
        [imu.name for imu in chosen.imus],
        dict(zip(watch.gains.wrench_frames, (one.name for one in chosen.wrenches), strict=True)),
    ).findings
    unusable = [one for one in found if one.severity is Severity.UNUSABLE]
    if unusable:
        raise DataError(_refusal(source, unusable))
    for finding in found:
        logger.warning("%s: %s", source, finding.message)


def _refusal(source: str, unusable: list[Finding]) -> str:
    others = ", ".join(f"{one.kind.value} of {one.stream or 'all'}" for one in unusable[1:])
    also = f"; also {others}" if others else ""
    return f"{source}: {unusable[0].message}{also}; --unchecked goes on all the same"
