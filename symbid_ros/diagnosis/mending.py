"""What reading had to mend, and what it could not, as findings."""

from collections.abc import Iterable

from symbid_ros.diagnosis.finding import Finding, Kind, Severity
from symbid_ros.signals.defects import Defect, DefectError, Tally

KINDS = {
    Defect.DISORDER: Kind.DISORDER,
    Defect.DUPLICATE: Kind.DUPLICATE,
    Defect.NOT_FINITE: Kind.NOT_FINITE,
    Defect.UNKNOWN_JOINT: Kind.UNKNOWN_JOINT,
    Defect.OTHER_JOINTS: Kind.UNKNOWN_JOINT,
    Defect.REORDERED_JOINTS: Kind.REORDERED_JOINTS,
    Defect.NO_NAMES: Kind.MISSING_JOINT,
    Defect.NO_ORIENTATION: Kind.QUATERNION_NORM,
    Defect.LATE: Kind.DISORDER,
    Defect.OTHER_LAYOUT: Kind.LAYOUT,
    Defect.CLOCK_JUMP: Kind.CLOCK_JUMP,
    Defect.OTHER_FRAME: Kind.UNKNOWN_FRAME,
    Defect.ABSENT: Kind.NOT_FINITE,
    Defect.NAMED_TWICE: Kind.UNKNOWN_JOINT,
}
REMEDIES = {
    Defect.DISORDER: "let one publisher speak for one sensor",
    Defect.DUPLICATE: "let the driver stamp every message anew",
    Defect.NOT_FINITE: "repair the driver",
    Defect.UNKNOWN_JOINT: "let one driver speak for all joints",
    Defect.OTHER_JOINTS: "if the robot has these too, let one driver speak for all joints",
    Defect.REORDERED_JOINTS: "let one driver speak for all joints",
    Defect.NO_ORIENTATION: "let the driver fill it always or mark it absent always",
    Defect.LATE: "stop the clocks from drifting apart, or record the topics together",
    Defect.OTHER_LAYOUT: "none is lost; reading is slow",
}


def mended(tallies: Iterable[Tally]) -> list[Finding]:
    """Return what was mended in each topic."""
    return [
        Finding(
            KINDS[defect],
            tally.topic,
            Severity.WARNING,
            f"{tally.topic}: {count} of {tally.messages} messages {tally.told(defect)}; "
            f"{REMEDIES[defect]}",
            {"messages": count, "share": count / max(tally.messages, 1)},
        )
        for tally in tallies
        for defect, count in tally.counts.items()
    ]


def beyond_mending(error: DefectError) -> Finding:
    """Return the finding that ended the reading of a log."""
    return Finding(KINDS[error.defect], error.topic, Severity.UNUSABLE, str(error))
