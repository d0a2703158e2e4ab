"""Logs folded into information, behind each filter of a study."""

from functools import lru_cache
from pathlib import Path

from symbid_ros.bags.streams.reader import bag_log
from symbid_ros.estimation.archive import write_archive
from symbid_ros.identification.aligned_log import AlignedLog
from symbid_ros.identification.dataset import Processing, fold_record
from symbid_ros.signals.alignment import Segment
from symbid_ros.signals.filters import Channels, LowPass
from symbid_ros.study.data_set import Log
from symbid_ros.study.logs import identified
from symbid_ros.study.sensing import Sensing, observe_sensed
from symbid_ros.study.workspace import Workspace


def fold_rows(
    log: Log, space: Workspace, sensing: Sensing, cutoff: float | None, channels: Channels
) -> None:
    """Write a log's rows behind one filter; None: averaged over windows."""
    smoothing = None if cutoff is None else LowPass(cutoff, channels)
    parameters = identified(log)
    bag = space.log(log)
    record = fold_record(_segments(bag, log), str(bag), parameters, Processing(smoothing))
    observations = observe_sensed(record, parameters, sensing)
    write_archive(space.rows(log, sensing, cutoff), observations)


# One log after the other: all filters of one see what was read once.
@lru_cache(maxsize=1)
def _segments(bag: Path, log: Log) -> tuple[Segment, ...]:
    model = identified(log).model
    return AlignedLog(bag_log([bag], model), model).whole_stretches()
