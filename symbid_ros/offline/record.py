"""From bags to information: everything that happens before a method is chosen."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from symbid_ros.bags.reader import read_streams
from symbid_ros.bags.selection import TopicSelection
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.dynamics.samples import Samples
from symbid_ros.errors import DataError
from symbid_ros.estimation.information import Information
from symbid_ros.estimation.prior import Prior
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.samples import build_samples

# Share of the expected weight by which forces may miss it before a plate is thought missing.
WEIGHT_TOLERANCE = 0.35


@dataclass(frozen=True)
class Processing:
    """How bags become rows.

    Attributes
    ----------
    low_pass : LowPass
        Filter of the measured channels.
    topics : TopicSelection
        Which topics are the robot's sensors.
    """

    low_pass: LowPass = field(default_factory=LowPass)
    topics: TopicSelection = field(default_factory=TopicSelection)


@dataclass(frozen=True)
class Record:
    """One recording, read and folded.

    Attributes
    ----------
    bags : tuple of Path
        Where it came from.
    samples : Samples
        Motion and forces after filtering.
    information : Information
        The rows of those samples, folded.
    """

    bags: tuple[Path, ...]
    samples: Samples
    information: Information


def read_record(
    bags: Sequence[Path], parameters: ParameterSet, processing: Processing | None = None
) -> Record:
    """Read bags, build samples and fold their rows.

    Raises
    ------
    BagError, DataError, ModelError
        When a bag, its data or the model does not serve; the message says which.
    """
    processing = processing or Processing()
    streams = read_streams(bags, processing.topics)
    samples = build_samples(streams, parameters.model, processing.low_pass)
    return Record(tuple(bags), samples, Information.of(parameters, samples))


def check_weight(record: Record, parameters: ParameterSet, prior: Prior) -> None:
    """Refuse a floating robot whose measured forces do not carry it.

    A forgotten plate leaves an equation of motion that is wrong by tens of percent, which no
    method notices by itself. Nothing is checked when the wrench topics were named
    by hand.

    Raises
    ------
    DataError
        When the base's force rows miss what the prior expects by more than
        ``WEIGHT_TOLERANCE`` times its weight.
    """
    model = parameters.model
    if not model.floating:
        return
    probe = record.samples[:: max(1, len(record.samples) // 1000)]
    rows = equation_of_motion(parameters, probe)
    residual = rows.y[:, 3:6] - rows.K[:, 3:6] @ prior.mean
    weight = np.linalg.norm(model.gravity) * parameters.link_phi(prior.mean)[:, 0].sum()
    missing = np.sqrt(np.mean(np.sum(residual**2, axis=1))) / weight
    if missing > WEIGHT_TOLERANCE:
        bags = ", ".join(map(str, record.bags))
        frames = ", ".join(record.samples.wrench_frames) or "none"
        raise DataError(
            f"{bags}: the wrenches measured (frames: {frames}) differ by {100 * missing:.0f} % of "
            "the prior's weight from what the motion needs; record the wrench of every contact, or "
            "name the wrench topics yourself to go on with these"
        )
