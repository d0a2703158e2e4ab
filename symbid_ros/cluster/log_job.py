"""Identification of a log whose bags are read by the workers of a cluster.

Workers fold the rows of parts of the log into information, which is merged in pairs on the workers.
The bags stay there: the check on the end of the log folds its parts on the workers again, and what
still needs the measurements themselves, such as sensor errors, reads them from the workers.
"""

import json
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import asdict, astuple, dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from symbid_ros.arrays import FloatArray, concatenated
from symbid_ros.cluster.connection import Cluster
from symbid_ros.cluster.log_tasks import (
    Part,
    apply_to_part,
    describe_bag,
    describe_columns,
    describe_log,
    digest_bag,
    find_contacts,
    fixed_frames,
    fold_part,
    merge_parts,
    read_part,
)
from symbid_ros.diagnosis.findings import FaultSpan, Finding, Kind, Severity
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError, OptionError
from symbid_ros.estimation.archive import unpack_observations
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.provenance import InputFile
from symbid_ros.identification.conventions.assumed_contacts import naming_contacts
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.loaded_problem import LoadedProblem, load_problem
from symbid_ros.identification.log_checks import BIASING, NO_CHECKS, LogChecks
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.aligned_log import SPAN
from symbid_ros.identification.rows.dataset import Dataset, DistributedSegments, Processing
from symbid_ros.model.load import load_model, model_files
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest, with_likely_base
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment

if TYPE_CHECKING:
    from distributed import Future

logger = logging.getLogger(__name__)

SLICES = 4  # of 60 s at most in one part
# Messages of one time may lie this far apart in a log: the margins of resampling, and disorder.
NEAR = 3_000_000_000
AHEAD = 2  # parts that are read while another one is used
ALL_TIME = -(2**62), 2**62


def divided(spans: Sequence[tuple[int, int]]) -> list[Part]:
    """Divide a log into parts of whole slices, together without gap or overlap.

    Parameters
    ----------
    spans : sequence of (int, int)
        First stamp and approximate last stamp of each bag, in order of recording, ns.
    """
    starts: list[int] = []
    owned = ALL_TIME[0] // SPAN
    for first, last in spans:
        begin, end = max(first // SPAN, owned), last // SPAN + 1
        starts += [SPAN * one for one in range(begin, end, SLICES)]
        owned = max(owned, end)
    starts[0] = ALL_TIME[0]
    parts = []
    for start, stop in zip(starts, [*starts[1:], ALL_TIME[1]], strict=True):
        before = [index for index, (first, _) in enumerate(spans) if first <= start - NEAR]
        until = [index for index, (first, _) in enumerate(spans) if first < stop + NEAR]
        parts.append(Part(start, stop, max(before, default=0), max(until), *ALL_TIME))
    return parts


@dataclass(frozen=True)
class ClusterSegments(DistributedSegments):
    """The segments of a log that workers read.

    Attributes
    ----------
    cluster : Cluster
    log : str
        The log, as workers get it.
    parts : tuple of Part
    first : int
        First stamp of the log, ns.
    known : list of (int, int)
        First and last stamp of each segment, ns, once a fold has told them.
    """

    cluster: Cluster
    log: str
    parts: tuple[Part, ...]
    first: int
    known: list[tuple[int, int]] = field(default_factory=list)

    def __iter__(self) -> Iterator[Segment]:
        waiting: deque[Future[list[dict[str, Any]]]] = deque()
        for part in [*self.parts, *(None,) * AHEAD]:
            if part is not None:
                waiting.append(self.cluster.submit(read_part, self.log, astuple(part)))
            if len(waiting) > AHEAD or part is None:
                for segment in waiting.popleft().result() if waiting else ():
                    yield Segment(**segment)

    def spans(self) -> list[tuple[int, int]]:
        """Return the first and the last stamp of each segment, ns."""
        if not self.known:
            self.known.extend((int(one.stamp[0]), int(one.stamp[-1])) for one in self)
        return self.known

    def between(self, start: int, stop: int) -> "ClusterSegments":
        """Return the segments from ``start`` up to ``stop``, ns."""
        # A slice's last instants may come a little after its end.
        parts = tuple(
            replace(part, begin=max(part.begin, start), end=min(part.end, stop))
            for part in self.parts
            if part.start < stop + NEAR and start - NEAR < part.stop
        )
        inside = [(max(a, start), min(b, stop - 1)) for a, b in self.spans()]
        return replace(self, parts=parts, known=[(a, b) for a, b in inside if a <= b])

    def apply(
        self, function: Callable[[Iterable[Segment]], list[NDArray[np.float64]]]
    ) -> list[FloatArray]:
        """Return the arrays that a function of a module computes from parts of the segments."""
        tasks = [
            self.cluster.submit(apply_to_part, self.log, astuple(part), function)
            for part in self.parts
        ]
        return [
            array for found in self.cluster.results(tasks, "comparing motions") for array in found
        ]

    def fold(self, source: str, parameters: ParameterSet, processing: Processing) -> Dataset:
        """Return what :func:`symbid_ros.identification.rows.dataset.fold_dataset` does."""
        return self.folded(source, parameters, processing)[0]

    def folded(
        self,
        source: str,
        parameters: ParameterSet,
        processing: Processing,
        mean: Sequence[float] = (),
    ) -> tuple[Dataset, LogChecks]:
        """Fold the rows, and check the log against prior parameters ``mean`` if there are any.

        Raises
        ------
        DataError
            When the log is unusable.
        """
        columns = describe_columns(parameters)
        borders = processing.grouping.borders
        rows = processing.windows, processing.full_rate, self.first, borders
        tasks = [
            self.cluster.submit(fold_part, self.log, columns, rows, astuple(part), tuple(mean))
            for part in self.parts
        ]
        total = self.cluster.reduced(merge_parts, tasks)
        self.cluster.results(tasks, f"folding {len(tasks)} parts on the cluster")
        found = total.result()
        for message in dict.fromkeys(found["warnings"]):
            logger.warning("%s", message)
        if "observations" not in found:
            raise DataError(f"{source}: no part of it is long enough; record longer", "E521")
        self.known[:] = found["spans"]
        dataset = Dataset(
            source,
            self,
            concatenated([Samples(**each) for each in found["samples"]]),
            unpack_observations(found["observations"]),
        )
        checks = (
            LogChecks(tuple(_findings(found)), {}, tuple(_faults(found))) if mean else NO_CHECKS
        )
        return dataset, checks


def _findings(found: dict[str, Any]) -> Iterator[Finding]:
    """Yield the worst finding of each kind and stream, worst first; log those without an alarm."""
    every = [
        Finding(Kind(kind), stream, Severity(severity), message, figures)
        for kind, stream, severity, message, figures in found["findings"]
    ]
    every.sort(key=lambda one: -one.severity)
    first: dict[tuple[Kind, str], list[Finding]] = {}
    for one in every:
        first.setdefault((one.kind, one.stream), []).append(one)
    for same in first.values():
        others = f"; likewise in {len(same) - 1} other parts of the log" if len(same) > 1 else ""
        one = replace(same[0], message=same[0].message + others)
        if one.kind not in BIASING:
            logger.warning("%s", one.message)
        yield one


def _faults(found: dict[str, Any]) -> list[FaultSpan]:
    return [FaultSpan(Kind(kind), stream, *span) for kind, stream, *span in found["faults"]]


@dataclass(frozen=True)
class ClusterRequest:
    """Bags that workers read, a robot model and options: `symbid identify --dask`.

    Attributes
    ----------
    bags : tuple of str
        Absolute paths, as workers see them, or URLs.
    request : BagRequest
        The model and the options.
    """

    bags: tuple[str, ...]
    request: BagRequest

    def load(self, cluster: Cluster, out: Path) -> LoadedProblem:
        """Read all inputs, the bags by the workers.

        Raises
        ------
        SymbidError
            When a file, the data or an option is invalid.
        """
        request = self.request
        _require_supported(request)
        robot = load_model(request.model, request.base)
        of_log = json.dumps(asdict(request.log))
        described = cluster.results(
            [cluster.submit(describe_bag, one, of_log) for one in self.bags], "opening the bags"
        )
        kept = [
            (bag, one)
            for bag, one in zip(self.bags, described, strict=True)
            if one["first"] is not None
        ]
        if not kept:
            raise DataError(f"{', '.join(self.bags)}: no joint states; record them as well", "E519")
        bags = [bag for bag, _ in kept]
        spans = [(one["first"], one["first"] + one["length"]) for _, one in kept]
        _require_order(bags, spans)
        types = {name for _, one in kept for name in one["types"]}
        robot = with_likely_base(robot, request.model, request.base, lambda: types)
        frames = [frame for _, one in kept for frame in one["frames"]]
        parts = divided(spans)
        if request.log.contact_flag:  # the last flag may be from long before
            parts = [replace(part, first=0) for part in parts]
        files = _texts(request.model)

        def read(
            options: IdentifyOptions, parameters: ParameterSet, prior: Prior
        ) -> tuple[Dataset, LogChecks]:
            log = describe_log(bags, robot, files, frames, given=options, options=request.log)
            segments = ClusterSegments(cluster, log, tuple(parts), spans[0][0])
            mean = () if options.unchecked else prior.mean[: len(parameters)].tolist()
            return segments.folded(", ".join(bags), parameters, Processing.of(options), mean)

        log = Log(
            ", ".join(bags),
            _read=_not_here,
            _open=lambda _: _not_here(None, False),  # type: ignore[arg-type,return-value]
            _frames=lambda: fixed_frames(frames),
        )
        contacts = request.options
        if robot.floating and not contacts.contacts and not contacts.wrist_sensors:
            text = describe_log(bags, robot, files, frames, given=contacts, options=request.log)
            (found,) = cluster.results([cluster.submit(find_contacts, text)], "finding contacts")
            contacts = naming_contacts(contacts, tuple(found), ", ".join(bags))
        return load_problem(robot, log, contacts, out, read)

    def attributed(self, cluster: Cluster, found: Identification) -> Identification:
        """Return an identification that names the bags, with checksums by the workers."""
        tasks = [cluster.submit(digest_bag, one) for one in self.bags]
        digests = cluster.results(tasks, "computing checksums")
        files = tuple(InputFile(*one) for each in digests for one in each)
        estimate = found.estimate
        provenance = estimate.provenance
        if provenance is not None:
            provenance = replace(provenance, inputs=(*files, *provenance.inputs))
        inputs = (*self.bags, *estimate.inputs)
        return replace(found, estimate=replace(estimate, provenance=provenance, inputs=inputs))


def _not_here(_: int | None, __: bool) -> Iterator[Any]:
    raise OptionError("`dask`: the bags are on the workers; identify without `dask`", "E956")


def _require_supported(request: BagRequest) -> None:
    """Refuse options that need the log as a whole, or other logs.

    Raises
    ------
    OptionError
        When there is one.
    """
    options, log = request.options, request.log
    asked = {
        "start": log.start > 0,
        "stop": log.stop is not None,
        "payload": bool(options.payload),
        "tare": bool(options.tare),
        "choose_truncation": options.choose_truncation is not None,
        "filter": options.row_filter != "weak",
        "drive_gain": bool(options.drive_gains) and not options.unchecked,
        "imu_mounting": "imu_mounting" in options.sensor_error_kinds,
        "sensor_delay": "sensor_delay" in options.sensor_error_kinds,
    }
    for name, is_asked in asked.items():
        if is_asked:
            raise OptionError(
                f"`dask`: `{name}` needs the log in one piece; leave it out, or identify without "
                "`dask`",
                "E956",
            )


def _require_order(bags: Sequence[str], spans: Sequence[tuple[int, int]]) -> None:
    """Refuse bags whose stamps overlap: parts are of stamps, so rows of one bag would be lost."""
    for index in range(1, len(bags)):
        first, last = spans[index - 1]
        if spans[index][0] < max(first, last - NEAR):  # lengths are approximate
            raise DataError(
                f"{bags[index]}: its stamps begin before those of {bags[index - 1]} end; give bags "
                "in the order of recording, and runs with equal clocks one by one, each with the "
                "`information` of the one before",
                "E958",
            )


def _texts(model: Path) -> dict[str, str]:
    """Return the texts of a model's file, which comes first, and of those that it includes."""
    files = model_files(model)
    home = model.parent
    return {str(file.relative_to(home)): file.read_text(encoding="utf-8") for file in files}
