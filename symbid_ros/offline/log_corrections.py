"""Corrects how a log is read until the equation of motion holds for it.

The equation of motion, with the model's inertias within ±25 %, tells wrong signs and units, as in
`symbid bag doctor`.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from statistics import median

from symbid_ros.arrays import concatenated
from symbid_ros.bags import bag_log
from symbid_ros.diagnosis.common_scale import (
    MILLI,
    common_unit,
    joints_in_milli,
    masses_fault,
    unit_name,
)
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.diagnosis.effort_findings import GAINS, within_limit
from symbid_ros.diagnosis.findings import Diagnosis, Finding, Kind, Severity, has_unsigned_efforts
from symbid_ros.diagnosis.forces import EXPLAINED
from symbid_ros.diagnosis.joint_checks import DEGREES
from symbid_ros.diagnosis.missing_body import EXPLAINED_AS_WELL
from symbid_ros.diagnosis.stream_checks import StreamChecks
from symbid_ros.diagnosis.wrist_evidence import unnamed_sensors
from symbid_ros.errors import SymbidError
from symbid_ros.identification.contacts import with_robot_options
from symbid_ros.identification.conventions.base_gravity import (
    FoundGravity,
    find_gravity,
    searches_gravity,
)
from symbid_ros.identification.conventions.joint_readings import JointReadings, find_readings
from symbid_ros.identification.conventions.position_units import find_degrees
from symbid_ros.identification.log_reading import MINUTE, first_segments
from symbid_ros.identification.robot_options import RobotOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.messages.topics import TopicSelection
from symbid_ros.model.tree import RobotModel
from symbid_ros.offline.robot_setup_file import RobotSetup
from symbid_ros.signals.log import Log
from symbid_ros.signals.segments import Segment
from symbid_ros.signals.sensor_samples import probed

# A gain is corrected if it is known to this share.
KNOWN = 0.25
# Factors beyond these are no errors of a model if two joints or more have them.
FAR = 0.1, 10.0
ANGLES = "roll", "pitch", "yaw"
ROUNDS = 3  # of corrections, since one wrong sign can hide another
CORRECTABLE = {
    Kind.IMU_MOUNTING,
    Kind.WRENCH_SIGN,
    Kind.TORQUE_SIGN,
    Kind.TORQUE_GAIN,
    Kind.CONTRADICTION,
    Kind.WEIGHT,
}


@dataclass
class LogCorrections:
    """Adds to a setup what the motion and the efforts of its log show.

    Attributes
    ----------
    bags : tuple of Path
    robot : RobotModel
        As the model file has it.
    setup : RobotSetup
        Names the topics; options and notes are added.
    frames : dict
        Frame of the sensor of each topic.
    """

    bags: tuple[Path, ...]
    robot: RobotModel
    setup: RobotSetup
    frames: dict[str, str]
    _has_new_unit: bool = field(default=False, init=False)

    def find(self) -> None:
        """Look for all of them, each with those before it in effect."""
        self._name_wrist_sensors()
        self._convert_degrees()
        if self.setup.has_open_question:  # if the base moves, efforts seem to have wrong units
            return
        self.setup.diagnosis = self._diagnosed()
        if not has_unsigned_efforts(self.setup.diagnosis.findings):
            self._correct_joints_and_gravity()
            self._correct_signs_and_units()
            if self._reverse_single_efforts():
                self._correct_signs_and_units()
        self._note_findings()

    def _log(self, robot: RobotModel) -> Log:
        """Return the log, read with the options so far."""
        return bag_log(self.bags, robot, TopicSelection.of(self.setup.log_options))

    def _name_wrist_sensors(self) -> None:
        """Name the wrench sensors whose force is that of a body fixed to them."""
        if self.robot.floating or not self.setup.options.get("wrench_topic"):
            return
        log = self._log(self.robot)
        try:
            samples = [probed(segment, self.robot) for segment in AlignedLog(log, self.robot)]
        except SymbidError:
            return  # which the diagnosis states
        for evidence in unnamed_sensors(self.robot, concatenated(samples)):
            mass, share = abs(evidence.mass()[0]), evidence.share
            self.setup.add(
                "wrist_sensor",
                evidence.sensor,
                f"{100 * share:.0f} % of the force is that of a body of {mass:.3g} kg.",
            )

    def _convert_degrees(self) -> None:
        """Convert positions that their velocities, limits or the efforts show to be in degrees."""
        robot = with_robot_options(self.robot, self._given)
        log = self._log(robot)
        checks = StreamChecks(robot)
        try:
            for piece in islice(log.slices(MINUTE, warn=False), 1):
                checks.take(piece)
        except SymbidError:
            return  # which the diagnosis states
        hinges = {joint.name for joint in robot.joints if joint.kind == "revolute"}
        names = [name for name in robot.measured_joint_names if name in hinges]
        in_degrees = [one for one in checks.unit_findings() if _is_of_degrees(one, checks)]
        if in_degrees:
            single = [name for name in names if f"{name}/scale" in in_degrees[0].figures]
            names = single or names
        elif find_degrees(first_segments(log, robot), robot) is None:
            return
        for name in names:
            self.setup.add("position_scale", f"{name}:={1 / DEGREES:.9g}")
        self.setup.note("position_scale", "CHECK: positions are taken to be in degrees.")

    def _correct_joints_and_gravity(self) -> None:
        """Correct joints of the log and gravity on a fixed base if the efforts are then explained.

        Either looks like the other: the one that leaves less of the efforts comes first, and the
        other is looked for with it in effect. Scales and signs of efforts would otherwise explain a
        part of them.
        """
        robot = with_robot_options(self.robot, self._given)
        segments = first_segments(self._log(robot), robot)
        readings, gravity = find_readings(segments, robot), self._gravity(segments, robot)
        if gravity is not None and (
            readings is None
            or readings.are_positions_right
            or gravity.after <= readings.unexplained
        ):
            self._set_gravity(gravity)
            self._set_readings(find_readings(segments, robot.with_gravity(gravity.direction)))
        elif readings is not None:
            self._set_readings(readings)
            self._set_gravity(self._gravity(first_segments(self._log(robot), robot), robot))

    def _set_readings(self, readings: JointReadings | None) -> None:
        """Exchange and reverse joints of the log."""
        if readings is None:
            return
        options = self.setup.options
        if owners := readings.exchanged:
            renamed = dict(entry.split(":=", 1) for entry in options.get("rename_joint", []))
            renamed = {name: name for name in owners if name not in renamed.values()} | renamed
            new = {recorded: owners.get(name, name) for recorded, name in renamed.items()}
            options["rename_joint"] = [f"{one}:={name}" for one, name in new.items() if one != name]
            self.setup.note(
                "rename_joint",
                f"CHECK: found from the efforts: the log exchanges {', '.join(owners)}.",
            )
        for name, has_effort in readings.reversed_joints.items():
            self.setup.add("flip_joint", name, "CHECK: found from the efforts.")
            if has_effort:
                self._multiply_efforts({name: -1.0})
                reason = "CHECK: the log reverses these joints together with their motion."
                self.setup.note("effort_scale", reason)

    def _gravity(self, segments: Sequence[Segment], robot: RobotModel) -> FoundGravity | None:
        """Return how gravity acts on a fixed base if the efforts contradict the model."""
        return find_gravity(segments, robot) if searches_gravity(self._given, robot) else None

    def _set_gravity(self, found: FoundGravity | None) -> None:
        """Say how gravity acts."""
        if found is not None:
            self.setup.note("gravity", "CHECK: found from the efforts.")
            for one in found.value.split():
                self.setup.add("gravity", one)

    @property
    def _given(self) -> RobotOptions:
        """What the options so far say of the robot."""
        given = self.setup.options
        direction = None
        if "gravity" in given:
            x, y, z = map(float, given["gravity"])
            direction = (x, y, z)
        contacts, sensors = (tuple(given.get(name, ())) for name in ("contact", "wrist_sensor"))
        return RobotOptions(contact=contacts, wrist_sensor=sensors, gravity=direction)

    def _correct_signs_and_units(self) -> None:
        """Correct wrong signs and units until the doctor finds none."""
        found = self._diagnosed()
        for _ in range(ROUNDS):
            if not _is_correctable(found) or not self._correct(found):
                break
            if self._has_new_unit:  # it hid what the efforts say of the positions
                self._has_new_unit = False
                if "position_scale" not in self.setup.options:
                    self._convert_degrees()
                self._correct_joints_and_gravity()
            found = self._diagnosed()
        self.setup.diagnosis = found

    def _reverse_single_efforts(self) -> bool:
        """Reverse efforts whose sign the doctor's gains do not show; return whether there are any.

        The gains come first, because they show signs that are wrong together.
        """
        robot = with_robot_options(self.robot, self._given)
        if robot.floating:
            return False
        readings = find_readings(first_segments(self._log(robot), robot), robot)
        if readings is None or not readings.are_positions_right:
            return False
        self._multiply_efforts(dict.fromkeys(readings.reversed_efforts, -1.0))
        self.setup.note(
            "effort_scale",
            f"CHECK: efforts of {', '.join(readings.reversed_efforts)} had the wrong sign.",
        )
        return True

    def _note_findings(self) -> None:
        """Write the doctor's findings as comments."""
        found = self.setup.diagnosis
        if found is None:
            return
        identified = set(self.setup.options.get("drive_gain", []))
        for one in found.findings:
            named = {name.removesuffix("/reads") for name in one.figures if "/reads" in name}
            if one.kind is Kind.TORQUE_GAIN and named and named <= identified:
                continue  # the factors are identified, as the finding advises
            if one.kind in CORRECTABLE:
                self.setup.has_open_question = True
            start = "CHECK" if one.severity is Severity.UNUSABLE else "Doctor"
            self.setup.note("", f"{start}: {one.message}")

    def _diagnosed(self) -> Diagnosis:
        """Return what the doctor says of the log, read with the options so far."""
        log = self._log(self.robot)
        return diagnose(log, with_robot_options(self.robot, self._given))

    def _correct(self, found: Diagnosis) -> bool:
        """Change signs and units as the diagnosis implies; return whether any changed."""
        common = found.figures.get("gain", 1.0) or 1.0
        before = {name: list(values) for name, values in self.setup.options.items()}
        for frame in self.frames.values():
            if found.figures.get(f"{frame}/gain", 1.0) < 0:
                self._flip(frame)
        factors, unknown = {}, []
        for name in self.robot.joint_names:
            gain = found.figures.get(f"{name}/effort_gain")
            std = found.figures.get(f"{name}/effort_gain_std", 0.0)
            if gain is None:
                continue
            if std > KNOWN * max(abs(gain), 1.0) or f"{name}/load_share" in found.figures:
                unknown.append(name)
            else:
                factors[name] = gain / common
        figures = _figures(found)
        if any(one.kind is Kind.MISSING_WRENCH for one in found.findings):
            return self.setup.options != before  # efforts contain forces that were not measured
        # Masses of the model are wrong instead if the doctor says so and gives no joint's factor.
        if "masses_times" not in figures or any("/reads" in name for name in figures):
            self._correct_factors(factors, unknown, {**found.figures, **figures})
        if "effort_scale" not in self.setup.options:
            self._reverse_efforts(found)
        for one in found.findings:
            place = self.frames.get(one.stream, "")
            if one.kind is Kind.IMU_MOUNTING and place and "roll_deg" in one.figures:
                self._rotate(place, [one.figures[f"{angle}_deg"] for angle in ANGLES])
        return self.setup.options != before

    def _correct_factors(
        self, factors: Mapping[str, float], unknown: Sequence[str], figures: Mapping[str, float]
    ) -> None:
        """Scale efforts by the factors of joints whose load shows them.

        Parameters
        ----------
        factors : mapping of str to float
            Those that the log determines.
        unknown : sequence of str
            The other driven joints.
        figures : mapping of str to float
            Of the diagnosis and its findings: RMS efforts as ``<joint>/effort_rms``, those over the
            limits of the model relative to these as ``<joint>/times_limit``, ``masses_times`` if
            the masses of the model may be wrong, and ``EXPLAINED_AS_WELL`` if a body is missing.
        """
        scaled = {name: one for name, one in factors.items() if not GAINS[0] < one < GAINS[1]}
        if scaled and EXPLAINED_AS_WELL in figures:
            self._doubt_factors(scaled, figures[EXPLAINED_AS_WELL])
            return
        driven = [name for name in self.robot.joint_names if name in factors or name in unknown]
        # No joint has the unit of the model, so those without a visible load have not either.
        are_all = bool(scaled) and len(scaled) == len(factors)
        if are_all and (unit := common_unit(scaled.values())) is not None:
            self._scale(dict.fromkeys(driven, unit), unit)
            if "masses_times" in figures:
                doubt = f"CHECK: or the masses in the model are {masses_fault(unit)}."
                self.setup.note("effort_scale", doubt)
            return
        limits = {name: figures.get(f"{name}/times_limit", 0.0) for name in driven}
        in_milli = joints_in_milli(limits, driven)
        if len(in_milli) == len(driven):
            self._scale(dict.fromkeys(driven, MILLI), MILLI)
            return
        if are_all:
            if all(EXPLAINED[0] < one < EXPLAINED[1] for one in scaled.values()):
                self._doubt_load(scaled)
                return
            is_far = all(not FAR[0] < abs(one) < FAR[1] for one in scaled.values())
            if len(unknown) > len(scaled) and not (is_far and len(scaled) > 1):
                return  # so few joints do not tell units from errors of the model
            usual = median(map(abs, scaled.values()))
            for joint in self.robot.joints:
                if joint.name in unknown:
                    rms = figures.get(f"{joint.name}/effort_rms", 0.0)
                    scaled[joint.name] = within_limit(usual, rms, joint.effort)
            if unknown:
                self.setup.note(
                    "effort_scale",
                    f"CHECK: no load shows the factors of {', '.join(unknown)}, so these are "
                    "those of the other joints, or less where the model's effort limit says so.",
                )
            unknown = ()
        self._scale(scaled)
        self._scale({name: MILLI for name in in_milli if name in unknown}, MILLI)

    def _doubt_load(self, factors: Mapping[str, float]) -> None:
        """Say that efforts differ from the model's by as much as those of a load do."""
        reads = median(1 / one for one in factors.values())
        cause = (
            "the model lacks a tool or payload" if reads > 1 else "the model has a load too many"
        )
        self.setup.note(
            "effort_scale",
            f"CHECK: efforts of {', '.join(factors)} read {reads:.3g} times what the model "
            f"implies. No factor is written: it is more likely that {cause}. Correct the model "
            "file, or give the factors if the efforts are not in Nm (N).",
        )

    def _doubt_factors(self, factors: Mapping[str, float], mass: float) -> None:
        """Say that the log does not tell wrong factors from a body that the model lacks."""
        each = ", ".join(f"{name}:={one:.3g}" for name, one in factors.items())
        self.setup.note(
            "effort_scale",
            f"CHECK: {each} would explain the efforts, and so would a body of about {mass:.2g} kg "
            "that the model lacks. No factor is written: add the body to the model file, or write "
            "these factors here and the joints into drive_gain.",
        )

    def _rotate(self, frame: str, angles: Sequence[float]) -> None:
        rotated = self.setup.options.get("rotate_imu", [])
        if not any(entry.startswith(f"{frame}:=") for entry in rotated):
            value = ",".join(f"{angle:.1f}" for angle in angles)
            self.setup.add("rotate_imu", f"{frame}:={value}", "CHECK: found from the motion.")

    def _flip(self, frame: str) -> None:
        flipped = self.setup.options.setdefault("flip_wrench", [])
        if frame in flipped:
            flipped.remove(frame)
        else:
            self.setup.add("flip_wrench", frame, "Found from the equation of motion.")

    def _reverse_efforts(self, found: Diagnosis) -> None:
        """Change the signs of efforts that are wrong together, whose size is not known well."""
        for one in found.findings:
            if one.kind is Kind.TORQUE_SIGN:
                joints = [name.removesuffix("/gain") for name in one.figures]
                self.setup.options["effort_scale"] = [f"{name}:=-1.0" for name in joints]
                self.setup.note("effort_scale", "CHECK: all joints together show this sign.")

    def _multiply_efforts(self, factors: Mapping[str, float]) -> None:
        entries = dict(entry.split(":=", 1) for entry in self.setup.options.get("effort_scale", []))
        for joint, factor in factors.items():
            entries[joint] = f"{factor * float(entries.get(joint, 1.0)):.3g}"
        self.setup.options["effort_scale"] = [f"{name}:={at}" for name, at in entries.items()]

    def _scale(self, factors: Mapping[str, float], unit: float | None = None) -> None:
        """Multiply efforts of joints by factors, or by that of their unit, which is exact."""
        if not factors:
            return
        self._multiply_efforts(factors)
        if unit is not None:
            self._has_new_unit = True
            text = f"CHECK: efforts of {', '.join(factors)} are in {unit_name(unit)}."
            self.setup.note("effort_scale", text)
            return
        drives = self.setup.options.get("drive_gain", [])
        self.setup.options["drive_gain"] = list(dict.fromkeys([*drives, *factors]))
        self.setup.note(
            "effort_scale",
            "CHECK: found from the model's inertias; better give gear ratio times torque constant.",
        )


def _is_of_degrees(finding: Finding, checks: StreamChecks) -> bool:
    """Return whether a finding says that positions of joints are in degrees."""
    is_unit = finding.kind is Kind.UNIT and finding.severity is Severity.UNUSABLE
    return is_unit and finding.stream == checks.joint_topic


def _figures(found: Diagnosis) -> dict[str, float]:
    """Return the figures of all findings about gains of efforts."""
    gains = (one.figures for one in found.findings if one.kind is Kind.TORQUE_GAIN)
    return {name: value for figures in gains for name, value in figures.items()}


def _is_correctable(found: Diagnosis) -> bool:
    return any(one.kind in CORRECTABLE for one in found.findings)
