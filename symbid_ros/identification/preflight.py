"""The doctor's checks of a record, made before it is used."""

import logging
from collections.abc import Sequence

from symbid_ros.diagnosis.findings import Finding, Kind
from symbid_ros.diagnosis.model_checks import check_model
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stream_checks import StreamChecks, unusable
from symbid_ros.errors import DataError
from symbid_ros.estimation.prior import Prior
from symbid_ros.identification.dataset import Dataset
from symbid_ros.model.parameters import ParameterSet

logger = logging.getLogger(__name__)


def examine(
    record: Dataset,
    checks: StreamChecks,
    parameters: ParameterSet,
    prior: Prior,
) -> None:
    """Warn of what is wrong with a record's streams, and between them and its model.

    Parameters
    ----------
    record : Dataset
        Its stretches are read once more if they are too long to be kept.
    checks : StreamChecks
        Of its streams.
    parameters : ParameterSet
        Of the job.
    prior : Prior
        Whose mean is taken for the robot, to ±25 %.

    Raises
    ------
    DataError
        When the record is unusable: a unit, sign, frame or mounting is wrong, a contact is
        missing, or a topic says next to nothing.
    """
    source = record.source
    of_streams = checks.findings(source)
    _refuse(source, of_streams)
    watch: ModelStatistics | None = None
    for segment in record.segments:
        if watch is None:
            robot = parameters.apply(prior.mean)
            watch = ModelStatistics(robot, segment.wrench_frames, segment.imu_frames)
        watch.add(segment)
    if watch is None:
        return
    found = check_model(
        watch,
        checks.joint_topic,
        checks.imu_topics,
        dict(zip(watch.gains.wrench_frames, checks.wrench_topics, strict=True)),
    ).findings
    _refuse(source, found)
    for finding in sorted([*of_streams, *found], key=lambda one: -one.severity):
        left_out = finding.kind in (Kind.FROZEN, Kind.SATURATED)
        also = "; those messages are left out" if left_out else ""
        logger.warning("%s: %s%s", source, finding.message, also)


def _refuse(source: str, findings: Sequence[Finding]) -> None:
    if wrong := unusable(findings):
        raise DataError(_refusal(source, wrong))


def _refusal(source: str, wrong: Sequence[Finding]) -> str:
    others = ", ".join(f"{one.kind.value} of {one.stream or 'all'}" for one in wrong[1:])
    also = f"; also {others}" if others else ""
    return f"{source}: {wrong[0].message}{also}; give `unchecked` to use the log anyway"
