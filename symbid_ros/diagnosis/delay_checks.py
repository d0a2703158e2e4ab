"""Checks whether streams of a log, or efforts of single joints, are late or early."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from symbid_ros.diagnosis.findings import Finding, Kind, ModelChecks, Severity
from symbid_ros.diagnosis.gains import estimate_delays, find_late_streams
from symbid_ros.diagnosis.joint_efforts import (
    FARTHEST,
    LARGEST_DELAY,
    effort_delay_error,
    late_efforts,
)
from symbid_ros.diagnosis.model_statistics import ModelStatistics
from symbid_ros.diagnosis.stance_gyro_check import DEVIATIONS

# Share of the time in which a joint moves from which its delay is looked for. The motion of those
# that stick explains static friction by any delay: joints of a real quadruped that stuck moved for
# up to .13 of a log, the others for .31 and more.
LEAST_MOVING = 0.2
# Delays that differ by less than this share of their mean count as equal.
ALIKE = 0.5


def check_delays(
    checks: ModelChecks,
    statistics: ModelStatistics,
    joints: str,
    imus: Sequence[str],
    wrenches: Mapping[str, str],
) -> None:
    """Check the delays of efforts, IMUs, wrist sensors and loaded wrench sensors."""
    delays, gains = estimate_delays(statistics.problem), statistics.gains
    late = find_late_streams(delays)
    streams = {joints: ("the efforts", gains.effort_delay)} if gains.driven else {}
    for index in range(len(gains.imu_frames)):
        # Above a standing foot the angular velocity gives a better delay.
        if f"{imus[index]}/delay_ms" not in checks.figures:
            streams[imus[index]] = ("", gains.imu(index).stop)
    found, _ = late.get(gains.effort_delay, (0.0, 0.0))
    problem = statistics.problem.with_later_efforts(found)
    error = effort_delay_error(problem) if gains.driven else 0.0
    for topic, (what, place) in streams.items():
        delay, std = delays.delay(place)
        name = f"{topic}/effort_delay" if what else f"{topic}/delay"
        checks.figures |= {f"{name}_ms": 1e3 * delay, f"{name}_std_ms": 1e3 * std}
        if place in late:
            delay, std = late[place]
            std = float(np.hypot(std, error)) if what else std
            checks.findings += delay_finding(topic, delay, std, "motion and forces", what)
    places = dict(
        zip(gains.wrist_sensors, range(gains.wrist_delays.start, gains.encoders.start), strict=True)
    )
    for index, frame in enumerate(gains.wrench_frames):
        if not statistics.is_loaded[index]:
            checks.left_out.append(
                f"wrench_sign, wrench_frame, delay of {wrenches[frame]}: it carries "
                f"{statistics.loads[index]:.2g} N of {statistics.weight:.0f} N"
            )
            continue
        places[frame] = gains.wrench(index).stop
    for frame, place in places.items():
        delay, std = delays.delay(place)
        checks.figures |= {f"{frame}/delay_ms": 1e3 * delay, f"{frame}/delay_std_ms": 1e3 * std}
        if place in late:
            checks.findings += delay_finding(wrenches[frame], *late[place], "efforts and motion")
    late_topics = {one.stream for one in checks.findings if one.kind is Kind.DELAY}
    _attribute_to_joints(checks, joints, {*imus, *wrenches.values()})
    if late_topics <= {joints}:  # late wrenches or IMUs would make efforts look early
        common = found if late_topics else 0.0
        moves = statistics.moving_shares > LEAST_MOVING
        checks.findings += _late_joints(joints, late_efforts(statistics.problem, common, moves))


def _attribute_to_joints(checks: ModelChecks, joints: str, others: set[str]) -> None:
    """Replace delay findings that are all due to late or early joint states.

    These are equal delays of all other streams, or of the IMU against positions and of efforts
    against forces.
    """
    found = {
        one.stream: one.figures["delay_ms"] * (1 if one.stream == joints else -1)
        for one in checks.findings
        if one.kind is Kind.DELAY
    }
    if len(found) < 2 or not (joints in found or set(found) == others):
        return
    delays = np.array(list(found.values()))
    if np.ptp(delays) > ALIKE * abs(delays.mean()):
        return
    mean, std = 1e-3 * float(delays.mean()), 1e-3 * float(delays.std())
    # Delays that scatter too much for one finding keep their own.
    if replacing := list(delay_finding(joints, mean, std, "the other streams")):
        kept = [one for one in checks.findings if one.kind is not Kind.DELAY]
        checks.findings = kept + replacing


def _late_joints(topic: str, late: Mapping[str, tuple[float, float]]) -> Iterator[Finding]:
    """Yield the finding of joints whose efforts alone are late or early."""
    if not late:
        return
    each = ", ".join(f"{name} {_delay_text(*found)}" for name, found in late.items())
    figures: dict[str, float] = {}
    for name, (delay, std) in late.items():
        figures |= {f"{name}/delay_ms": 1e3 * delay, f"{name}/delay_std_ms": 1e3 * std}
    yield Finding(
        Kind.EFFORT_DELAY,
        topic,
        Severity.WARNING,
        f"{topic}: single efforts are not of the instant of the positions: {each}; remove the "
        "delay or filter of these drives' readings, or give `sensor_errors` compliance if the "
        "joints are elastic, which looks alike",
        figures,
    )


def _delay_text(delay: float, std: float) -> str:
    side = "late" if delay > 0 else "early"
    if abs(delay) == FARTHEST:
        return f"at least {1e3 * FARTHEST:.0f} ms {side}"
    return f"{1e3 * abs(delay):.1f} ± {1e3 * std:.1g} ms {side}"


def delay_finding(
    topic: str, delay: float, std: float, others: str, what: str = ""
) -> Iterator[Finding]:
    """Yield a finding if a stream or a part of it is late or early."""
    if abs(delay) <= LARGEST_DELAY or abs(delay) <= DEVIATIONS * std:
        return
    which = "late" if delay > 0 else "early"
    is_commanded = bool(what) and delay < 0
    hint = "; efforts that are computed from commands look early" if is_commanded else ""
    yield Finding(
        Kind.DELAY,
        topic,
        Severity.WARNING,
        f"{topic}: {f'{what} are' if what else 'is'} {1e3 * abs(delay):.1f} ± {1e3 * std:.1g} ms "
        f"{which} relative to {others}{hint}; set stamps to the time of the measurement, or add "
        "sensor_delay to `sensor_errors`, which estimates it",
        {"delay_ms": 1e3 * delay, "delay_std_ms": 1e3 * std},
    )
