"""How far below its frame the force on a foot acts whose sensor reads no moments.

Contact sensors of simulators often report forces alone. If the frame is at the centre of a ball,
the force acts at the ball's lowest point, and friction of the ground has a moment about the frame.
"""

import logging
from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain

import numpy as np

from symbid_ros.identification.conventions.loose_fit import loose_rows, some_blocks
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.model.tree import RobotModel
from symbid_ros.signals.ball_moments import frames_without_moments, with_moments_of_balls
from symbid_ros.signals.segments import Segment

logger = logging.getLogger(__name__)

# The forces have to be likelier below their frames by this many nats, and by this many for each
# row. Quadrupeds that trot in MuJoCo give 2400 to 5600 nats within 40 s, 0.7 to 1.6 for each row.
EVIDENCE, LEAST_GAIN = 50.0, 0.1
# Where the forces are not explained as well as this (RMS), something else is wrong, such as units.
MOST_LEFT = 0.1
LARGEST = 1.5  # times the ball's radius; soft ground makes the distance smaller


@dataclass(frozen=True)
class FootMoments:
    """Feet whose sensors leave out the moments of forces at their lowest points.

    Attributes
    ----------
    frames : tuple of str
        Of the sensors, at the centres of balls.
    radii : tuple of float
        How far below each frame its force acts, m.
    before, after : float
        Share of the generalised forces (RMS) that a fit leaves if the forces act at the frames'
        origins, and below them.
    """

    frames: tuple[str, ...]
    radii: tuple[float, ...]
    before: float
    after: float

    @property
    def sensors(self) -> tuple[str, ...]:
        """The feet as values of the option `force_only`."""
        pairs = zip(self.frames, self.radii, strict=True)
        return tuple(f"{frame}:{radius:.4g}" for frame, radius in pairs)

    @property
    def message(self) -> str:
        """What the log shows, and what to do."""
        low, high = 1e3 * min(self.radii), 1e3 * max(self.radii)
        span = f"{low:.1f}" if high - low < 0.05 else f"{low:.1f} to {high:.1f}"
        return (
            f"moments of {', '.join(self.frames)} are zero, but the forces act {span} mm below "
            f"these frames: at the frames, {100 * self.before:.2g} % of all forces would be "
            f"unexplained, and not {100 * self.after:.2g} %. Their moments are computed; give "
            f"`force_only` {','.join(self.sensors)} if that is right, otherwise none"
        )


def find_foot_moments(segments: Iterable[Segment], robot: RobotModel) -> FootMoments | None:
    """Return which feet of a floating robot lack moments; None if the log does not show it.

    The distance of the forces below the frames is a common share of the balls' radii, and is
    fitted together with inertias and friction. The first segment decides whether any foot reads
    forces and no moments.
    """
    if not robot.floating:
        return None
    rest = iter(segments)
    first = next(rest, None)
    if first is None or not (frames := frames_without_moments(first, robot)):
        return None
    blocks = list(some_blocks(chain([first], rest)))
    for block in blocks:
        moments = zip(block.wrench_frames, np.swapaxes(block.wrenches[..., :3], 0, 1), strict=True)
        frames &= {name for name, moment in moments if not moment.any()}
    if not frames:
        return None
    names = tuple(sorted(frames))
    lowest = robot.with_force_only(names)
    at_frames = loose_rows(blocks, robot)
    at_lowest = loose_rows((with_moments_of_balls(one, lowest) for one in blocks), robot)
    if at_frames is None or at_lowest is None:
        return None
    before, after = at_frames.fit(), at_frames.fit((at_frames.y - at_lowest.y)[..., None])
    share = float(after.theta[-1])
    least = max(EVIDENCE, LEAST_GAIN * int(at_frames.valid.sum()))
    is_likelier = before.cost - after.cost >= least and after.unexplained <= MOST_LEFT
    if not is_likelier or not 0.0 < share <= LARGEST:
        return None
    radii = tuple(share * robot.frame(name).radius for name in names)
    return FootMoments(names, radii, before.unexplained, after.unexplained)


def with_found_moments(
    options: IdentifyOptions, robot: RobotModel, segments: Iterable[Segment], source: str
) -> IdentifyOptions:
    """Return options with the feet whose moments a log leaves out, and log a warning."""
    if options.force_only:
        return options
    found = find_foot_moments(segments, robot)
    if found is None:
        return options
    logger.warning("%s: %s", source, found.message)
    return replace(options, force_only=found.sensors)
