"""IMUs against the joints: mounting and delay, from the rate of turn over a foot that stands."""

from collections.abc import Iterator, Sequence

import numpy as np

from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.diagnosis.standing_rate import Agreement
from symbid_ros.diagnosis.turned import Turned

# Calibration leaves tenths of a degree, a wrong axis ninety.
LARGEST_ANGLE = np.radians(5.0)
# A rotation that is known no better says nothing.
LARGEST_DOUBT = np.radians(2.0)
# More of the joints' rate than this is not followed where the foot does not stand.
MOST_LEFT = 0.3
# Mirrored, a gyroscope must follow so many times better to be called so.
MIRRORED = 3.0
# A point that rolls, and a floor that gives, leave a rate of turn within these of itself.
SCALES = 0.6, 1.6
# Identification's windows see no shift below this, s.
LARGEST_DELAY = 3e-3
DEVIATIONS = 5.0


def is_told(found: Agreement) -> bool:
    """Tell whether a foot stood still while the robot turned."""
    return min(found.left, found.mirrored) < MOST_LEFT


def mounting_findings(topic: str, found: Agreement) -> Iterator[Finding]:
    """Yield what is wrong with an IMU's mounting, or with its unit."""
    if not SCALES[0] < found.scale < SCALES[1]:
        yield Finding(
            Kind.UNIT,
            topic,
            Severity.UNUSABLE,
            f"{topic}: angular_velocity is {found.scale:.3g} times the rate at which the joints "
            "turn the robot above its feet; give rad/s",
            {"rate_ratio": found.scale},
        )
        return
    if found.mirrored * MIRRORED < found.left and found.mirrored < MOST_LEFT:
        yield Finding(
            Kind.IMU_MOUNTING,
            topic,
            Severity.UNUSABLE,
            f"{topic}: angular_velocity follows the joints only if an axis has its sign reversed "
            f"({100 * found.left:.0f} % of the rate is left over as it is, "
            f"{100 * found.mirrored:.1f} % then); repair the driver",
            {"left": found.left, "left_if_mirrored": found.mirrored},
        )
    elif (
        found.left < MOST_LEFT
        and found.angle_std < LARGEST_DOUBT
        and found.angle > LARGEST_ANGLE + DEVIATIONS * found.angle_std
    ):
        angle, doubt = np.degrees([found.angle, found.angle_std]).tolist()
        yield Finding(
            Kind.IMU_MOUNTING,
            topic,
            Severity.UNUSABLE,
            f"{topic}: reports in axes turned by {angle:.1f} ± {doubt:.1g} degrees from its frame "
            "in the model, as the joints show above a standing foot; correct the frame's "
            "orientation in the model, or header.frame_id",
            {"angle_deg": angle, "angle_std_deg": doubt},
        )


def turned_finding(topic: str, turn: Turned, evidence: float) -> Finding:
    """Return that only a turned accelerometer makes forces and efforts agree."""
    angle = float(np.degrees(turn.angle))
    return Finding(
        Kind.IMU_MOUNTING,
        topic,
        Severity.UNUSABLE,
        f"{topic}: linear_acceleration is given in axes turned by {angle:.0f} degrees "
        "from its frame in the model, as wrenches and efforts show together; correct the frame's "
        "orientation in the model, or header.frame_id",
        {"angle_deg": angle, "evidence": evidence},
    )


def reversed_finding(imus: Sequence[str]) -> Finding:
    """Return that gravity is upside down."""
    return Finding(
        Kind.IMU_MOUNTING,
        imus[0] if len(imus) == 1 else "",
        Severity.UNUSABLE,
        f"{', '.join(imus)}: linear_acceleration is reversed, forces and efforts contradict it; "
        "at rest an accelerometer reads +9.81 upwards (REP-145), correct the driver's sign or "
        "the frame's orientation in the model",
        {"gain": -1.0},
    )


def delay_finding(
    topic: str, delay: float, std: float, others: str, what: str = ""
) -> Iterator[Finding]:
    """Yield whether a stream, or what of it is named, is late or early, s."""
    if abs(delay) <= LARGEST_DELAY or abs(delay) <= DEVIATIONS * std:
        return
    which = "late" if delay > 0 else "early"
    yield Finding(
        Kind.DELAY,
        topic,
        Severity.WARNING,
        f"{topic}: {f'{what} are' if what else 'is'} {1e3 * abs(delay):.1f} ± {1e3 * std:.1g} ms "
        f"{which} against {others}; let drivers stamp the time of the measurement",
        {"delay_ms": 1e3 * delay, "delay_std_ms": 1e3 * std},
    )
