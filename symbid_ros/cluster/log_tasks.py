"""What workers do with a log: functions of texts and numbers that return plain values and arrays.

A log is divided at multiples of 60 s, where reading cuts it into slices anyway, so that each slice
is the same as in one process. A worker also reads the bag before its part, or the beginning of its
bag, for the data that resampling needs from before the part.
"""

import json
import logging
import tempfile
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, fields, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from symbid_ros.bags import bag_info, bag_log, count_messages
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.errors import BagError, DataError
from symbid_ros.estimation.archive import pack_observations, unpack_observations
from symbid_ros.estimation.group_moments import Grouping
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.provenance import digest, list_inputs
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.conventions.assumed_contacts import assumed_contacts
from symbid_ros.identification.log_checks import check_dataset
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.identification.rows.aligned_log import SPAN, AlignedLog
from symbid_ros.identification.rows.dataset import Processing, fold_dataset
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.fixed_frames import FixedTransform, with_fixed_frames
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel
from symbid_ros.offline.bags import measured_types
from symbid_ros.package_paths import PACKAGE, package_version
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment, cut_to
from symbid_ros.signals.streams import Slice, TimeRange

FIRST_SECOND = TimeRange(0.0, 1.0)
# A part without rows: shorter than a window, or in a gap of the log.
TOO_SHORT = {"E519", "E520", "E521"}
# Filters of warnings are those of the process, so that its threads take turns.
_turn = threading.Lock()


@dataclass(frozen=True)
class Part:
    """A part of a log, which one task reads.

    Attributes
    ----------
    start, stop : int
        The slices that end after ``start`` and not after ``stop``, ns.
    first, last : int
        Numbers of the bags to read.
    begin, end : int
        Instants outside of these stamps are left out, ns.
    """

    start: int
    stop: int
    first: int
    last: int
    begin: int
    end: int


def installed_version() -> str:
    """Return the version of this package on a worker."""
    return package_version()


def sees_file(path: str) -> bool:
    """Return whether a worker sees a file."""
    return Path(path).exists()


def describe_bag(location: str, options: str) -> dict[str, Any]:
    """Return the first stamp and the length of a bag, ns, its topics' types and fixed frames.

    Parameters
    ----------
    location : str
        Path or URL of the bag.
    options : str
        LogOptions as JSON.
    """
    path = local_bag(location)
    topics = TopicSelection.of(_log_options(options))
    log = bag_log([path], topics=topics, part=FIRST_SECOND)
    with _turn:
        info = bag_info(path)
        piece = next(log.slices(SPAN, warn=False), None)
    stamps = [one for one in piece.stamps.values() if len(one)] if piece is not None else []
    return {
        "first": min((int(one.min()) for one in stamps), default=None),
        "length": round(1e9 * info.duration),
        "types": sorted(measured_types(count_messages([path]))),
        "frames": [
            [one.parent, one.child, one.rotation.tolist(), one.translation.tolist()]
            for one in log.fixed_frames()
        ],
    }


def find_contacts(log: str) -> list[str]:
    """Return where the robot of a log without wrench sensors seems to stand, in the first bag."""
    opened = _OpenLog.of(log)
    topics = TopicSelection.of(opened.options)
    with _turn:
        first = bag_log([local_bag(opened.bags[0])], opened.robot, topics)
        return list(assumed_contacts(opened.robot, first))


def digest_bag(location: str) -> list[tuple[str, str | None, int | None]]:
    """Return name, SHA-256 and size of each file of a bag, its name below ``location``."""
    path = local_bag(location)
    files = map(digest, list_inputs([path]))
    return [(location + one.path[len(str(path)) :], one.sha256, one.size_bytes) for one in files]


def fold_part(
    log: str,
    columns: str,
    rows: tuple[Sequence[float], bool, int, Sequence[int]],
    part: tuple[int, ...],
    mean: Sequence[float],
) -> dict[str, Any]:
    """Return the information of a part of a log, and what its checks found.

    Parameters
    ----------
    log : str
        The log, from :func:`describe_log`.
    columns : str
        The parameters, from :func:`describe_columns`.
    rows : (sequence of float, bool, int, sequence of int)
        Lengths of the windows, s, whether every sample has a row before averaging, the first stamp
        of the log, ns, and the borders of the grouping, ns.
    part : tuple of int
        Fields of :class:`Part`.
    mean : sequence of float
        Prior parameters, against which the log is checked; empty for no checks.
    """
    opened, parameters = _OpenLog.of(log), _parameters(log, columns)
    source, found = opened.source(Part(*part)), None
    windows, full_rate, first, borders = rows
    processing = Processing(
        windows=tuple(windows),
        full_rate=full_rate,
        first=first,
        grouping=Grouping(tuple(borders)),
    )
    with _turn, _warnings() as messages:
        checks = StreamChecks(parameters.model) if len(mean) else None
        segments = opened.segments(Part(*part), checks)
        try:
            dataset = fold_dataset(segments, source, parameters, processing)
        except DataError as error:
            if error.code not in TOO_SHORT:
                raise
            return {"warnings": [*messages, str(error)]}
        if checks is not None:
            robot = parameters.apply(np.asarray(mean))
            found = check_dataset(dataset, checks, robot, estimated=())
        spans = [(int(one.stamp[0]), int(one.stamp[-1])) for one in segments]
    samples = {one.name: getattr(dataset.samples, one.name) for one in fields(dataset.samples)}
    findings, faults = [], []
    if found is not None:
        findings = [
            (one.kind.value, one.stream, int(one.severity), one.message, dict(one.figures))
            for one in found.findings
        ]
        faults = [(one.kind.value, one.stream, one.start, one.stop) for one in found.spans]
        messages = [one for one in messages if not any(each[3] in one for each in findings)]
    return {
        "observations": pack_observations(dataset.observations),
        "samples": [samples],
        "spans": spans,
        "findings": findings,
        "faults": faults,
        "warnings": messages,
    }


def merge_parts(one: dict[str, Any], two: dict[str, Any]) -> dict[str, Any]:
    """Return the information of two parts together, the earlier one first."""
    merged = {
        key: [*one.get(key, ()), *two.get(key, ())]
        for key in ("samples", "spans", "findings", "faults", "warnings")
    }
    packed = [each["observations"] for each in (one, two) if "observations" in each]
    if not packed:
        return merged
    by_window: dict[float, Observations] = {}
    for each in (found for part in packed for found in unpack_observations(part)):
        known = by_window.get(each.window)
        by_window[each.window] = each if known is None else known.merge(each)
    total = tuple(by_window[window] for window in sorted(by_window))
    return {**merged, "observations": pack_observations(total)}


def read_part(log: str, part: tuple[int, ...]) -> list[dict[str, Any]]:
    """Return the aligned segments of a part of a log, each as its fields."""
    with _turn, _warnings():
        found = list(_OpenLog.of(log).segments(Part(*part)))
    return [{one.name: getattr(segment, one.name) for one in fields(segment)} for segment in found]


def apply_to_part(
    log: str, part: tuple[int, ...], function: Callable[[Iterable[Segment]], list[NDArray[Any]]]
) -> list[NDArray[Any]]:
    """Return the arrays that a function computes from the segments of a part of a log."""
    with _turn, _warnings():
        return function(_OpenLog.of(log).segments(Part(*part)))


def describe_log(
    bags: Sequence[str],
    model: RobotModel,
    files: dict[str, str],
    frames: Sequence[Any],
    *,
    given: RobotOptions,
    options: LogOptions,
) -> str:
    """Return a log and the robot's model as JSON, for the workers.

    Parameters
    ----------
    bags : sequence of str
        Paths or URLs in order of recording.
    model : RobotModel
        As read from its file.
    files : dict of str to str
        Texts of the model's file, which comes first, and of the files that it includes.
    frames : sequence
        Fixed frames that the bags state, as :func:`describe_bag` returns them.
    given : RobotOptions
    options : LogOptions
    """
    content = {
        "bags": list(bags),
        "files": files,
        "source": model.source,
        "base": "floating" if model.floating else "fixed",
        "frames": list(frames),
        "given": {one.name: getattr(given, one.name) for one in fields(RobotOptions)},
        "options": asdict(options),
    }
    return json.dumps(content)


def describe_columns(parameters: ParameterSet) -> str:
    """Return the columns of a robot's parameters as JSON, for the workers."""
    return json.dumps(
        {
            "names": parameters.names,
            "candidates": parameters.candidates,
            "link_side": parameters.link_side,
            "reference": parameters.load_reference.tolist(),
            "signed_drives": parameters.signed_drives,
            "courses": parameters.courses,
        }
    )


def fixed_frames(frames: Iterable[Any]) -> tuple[FixedTransform, ...]:
    """Return the fixed frames that :func:`describe_bag` describes."""
    return tuple(
        FixedTransform(parent, child, np.array(rotation), np.array(translation))
        for parent, child, rotation, translation in frames
    )


@dataclass(frozen=True)
class _OpenLog:
    """A log on a worker.

    Attributes
    ----------
    robot : RobotModel
        With what the options say of it, and the fixed frames of the log.
    bags : tuple of str
        Paths or URLs.
    options : LogOptions
    """

    robot: RobotModel
    bags: tuple[str, ...]
    options: LogOptions

    @classmethod
    @lru_cache(maxsize=4)
    def of(cls, text: str) -> "_OpenLog":
        """Return the log that :func:`describe_log` describes."""
        content = json.loads(text)
        with tempfile.TemporaryDirectory(prefix="symbid_") as folder:
            for name, file in content["files"].items():
                path = Path(folder) / name
                path.parent.mkdir(parents=True, exist_ok=True)
                path.write_text(file, encoding="utf-8")
            robot = load_model(Path(folder) / next(iter(content["files"])), content["base"])
        robot = with_fixed_frames(
            replace(robot, source=content["source"]), fixed_frames(content["frames"])
        )
        robot = with_robot_options(robot, RobotOptions(**content["given"]))
        return cls(robot, tuple(content["bags"]), _log_options(json.dumps(content["options"])))

    def source(self, part: Part) -> str:
        """Return the name of a part's bags, for messages."""
        return ", ".join(self.bags[part.first : part.last + 1])

    def segments(self, part: Part, checks: StreamChecks | None = None) -> "_PartSegments":
        """Return the aligned segments of a part; ``checks`` receives its slices."""
        paths = [local_bag(one) for one in self.bags[part.first : part.last + 1]]
        complete = bag_log(paths, self.robot, TopicSelection.of(self.options))

        def read(span: int | None, warn: bool) -> Iterator[Slice]:
            for piece in complete.slices(span, warn=warn):
                if piece.stop > part.stop:
                    break
                if piece.stop > part.start:
                    yield piece

        log = Log(self.source(part), tuple(paths), _read=read)
        return _PartSegments(AlignedLog(log, self.robot, checks=checks), part.begin, part.end)


@dataclass(frozen=True)
class _PartSegments:
    """Segments between two stamps, ns."""

    segments: Iterable[Segment]
    begin: int
    end: int

    def __iter__(self) -> Iterator[Segment]:
        for segment in self.segments:
            yield from cut_to([segment], self.begin, self.end)


@lru_cache(maxsize=64)
def local_bag(location: str) -> Path:
    """Return the path of a bag; one at a URL is first copied to the worker's own folder.

    Raises
    ------
    BagError
        When there is no such bag, or the URL cannot be read.
    """
    if "://" not in location:
        path = Path(location)
        if not path.exists():
            raise BagError(
                f"{location}: a worker finds no such bag; give a path that all workers can read, "
                "or a URL",
                "E955",
            )
        return path
    import distributed  # noqa: PLC0415 - optional libraries
    import fsspec  # noqa: PLC0415

    # Dask deletes the folders of workers that have ended.
    folder = tempfile.mkdtemp(prefix="bag_", dir=distributed.get_worker().local_directory)
    try:
        system, place = fsspec.core.url_to_fs(location)
        target = Path(folder) / Path(place).name
        system.get(place, str(target), recursive=system.isdir(place))
    except Exception as error:  # each kind of storage raises errors of its own
        reason = " ".join(str(error).split()) or type(error).__name__
        raise BagError(
            f"{location}: a worker cannot fetch it ({reason}); check the URL, and that its library "
            "and credentials are on each worker",
            "E955",
        ) from None
    return target


@contextmanager
def _warnings() -> Iterator[list[str]]:
    """Collect the package's warnings, which the client logs, and do not print them here."""
    found: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            found.append(record.getMessage())

    logger, handler = logging.getLogger(PACKAGE), Collector(logging.WARNING)
    before = logger.propagate
    logger.propagate = False
    logger.addHandler(handler)
    try:
        yield found
    finally:
        logger.removeHandler(handler)
        logger.propagate = before


def _log_options(text: str) -> LogOptions:
    """Return options of a log; a part of it may lack names of the whole."""
    values = json.loads(text)
    lists = {name: tuple(value) for name, value in values.items() if isinstance(value, list)}
    return LogOptions(**(values | lists)).of_any_log()


@lru_cache(maxsize=4)
def _parameters(log: str, columns: str) -> ParameterSet:
    """Return the columns that :func:`describe_columns` describes, of a log's robot."""
    content = json.loads(columns)
    return replace(
        ParameterSet.of_names(
            _OpenLog.of(log).robot, content["names"], [tuple(one) for one in content["courses"]]
        ),
        candidates=content["candidates"],
        link_side=tuple(content["link_side"]),
        reference=np.array(content["reference"]),
        signed_drives=content["signed_drives"],
    )
