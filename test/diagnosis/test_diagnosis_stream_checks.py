"""Checks of streams slice by slice, and findings about names and repaired messages."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.diagnosis.findings import Kind, Severity
from symbid_ros.diagnosis.stream_checks import (
    KINDS,
    REMEDIES,
    StreamChecks,
    check_names,
    fatal_finding,
    repair_findings,
    unusable,
)
from symbid_ros.signals.defects import Defect, DefectCounts, DefectError
from symbid_ros.signals.streams import ImuStream, JointStream, Slice, Streams, WrenchStream

PERIOD = 5_000_000
MODEL = random_robot(0, links=3, wrench_frames=1)
MODEL = replace(MODEL, joints=tuple(replace(joint, effort=5.0) for joint in MODEL.joints))


def streams(start=0, count=400, names=MODEL.joint_names, imu="imu_link", wrench="wrench_0"):
    rng = np.random.default_rng(start)
    stamp = (start + np.arange(count, dtype=np.int64)) * PERIOD

    def noise(width):
        return rng.normal(size=(count, width))

    position, velocity, effort = (noise(len(names)) for _ in range(3))
    joints = JointStream("/joints", names, stamp, position, velocity, 5.0 + effort)
    force = noise(3) + np.array([0, 0, 9.81])
    quaternion = np.tile([0.0, 0, 0, 1], (count, 1))
    imus = (ImuStream("/imu", imu, stamp, quaternion, noise(3), force),) if imu else ()
    return Streams(
        "log", joints, imus, (WrenchStream("/wrench", wrench, stamp, noise(3), noise(3)),)
    )


def piece(given, tallies=(), fault=""):
    stamp = given.joints.stamp
    topics = (given.joints, *given.imus, *given.wrenches)
    recorded = {each.topic: each.stamp for each in topics}
    kept = None if fault else given
    return Slice(int(stamp[0]), int(stamp[-1]) + 1, kept, recorded, tuple(tallies), fault)


def test_a_log_without_faults_has_no_findings():
    checks = StreamChecks(MODEL)
    for start in (0, 400):
        checks.take(piece(streams(start)))
    assert checks.findings("log") == []
    assert checks.has_streams
    assert (checks.joint_topic, checks.imu_topics, checks.wrench_topics) == (
        "/joints",
        ("/imu",),
        {"wrench_0": "/wrench"},
    )
    assert {topic: timing.messages for topic, timing in checks.timings.items()} == {
        "/joints": 800,
        "/imu": 800,
        "/wrench": 800,
    }
    assert StreamChecks(None).findings("log") == []


@pytest.mark.parametrize("has_streams", [True, False])
def test_silent_slices_are_counted(has_streams):
    checks = StreamChecks(MODEL)
    for start in (0, 400):
        checks.take(piece(streams(start), fault=f"silent {start}"))
    if has_streams:
        checks.take(piece(streams(800)))
    finding = checks.findings("log")[0]
    assert (finding.kind, finding.stream, finding.figures) == (Kind.SILENT, "", {"slices": 2})
    assert finding.severity is (Severity.WARNING if has_streams else Severity.UNUSABLE)
    assert finding.message.startswith("silent 0; 2 slices")
    assert checks.timings["/imu"].messages == 800 + 400 * has_streams


def test_each_check_hears_of_each_slice():
    checks = StreamChecks(MODEL)
    for start in (0, 400):
        spoilt = streams(start)
        spoilt.imus[0].orientation[:10] *= 1.5
        spoilt.imus[0].linear_acceleration[:] /= 9.81
        spoilt.joints.effort[:5, 0] = np.nan
        spoilt.wrenches[0].force[100:200] = spoilt.wrenches[0].torque[100:200] = 1.0
        counts = DefectCounts("log", "/imu", messages=8, counts={Defect.DUPLICATE: 2})
        checks.take(piece(spoilt, [counts]))
    found = {one.kind: one for one in checks.findings("log")}
    assert found[Kind.QUATERNION_NORM].figures["messages"] == 20
    assert found[Kind.MISSING_JOINT].figures["messages"] == 10
    assert found[Kind.FROZEN].stream == "/wrench"
    assert found[Kind.DUPLICATE].figures == {"messages": 2, "share": 0.25}
    assert Kind.UNIT in found
    assert {one.kind for one in unusable(found.values())} == {Kind.UNIT}


def test_topics_are_compared_with_the_whole_recording():
    checks = StreamChecks(None)
    given = streams(0, 1000)
    imu = given.imus[0]
    late = replace(
        imu,
        stamp=imu.stamp[400:],
        orientation=imu.orientation[400:],
        angular_velocity=imu.angular_velocity[400:],
        linear_acceleration=imu.linear_acceleration[400:],
    )
    checks.take(piece(replace(given, imus=(late,))))
    (finding,) = checks.findings("log")
    assert (finding.kind, finding.stream) == (Kind.GAP, "/imu")
    assert finding.figures == {"late_s": pytest.approx(2.0), "early_s": 0.0}


@pytest.mark.parametrize(
    ("change", "model", "expected"),
    [
        ({}, MODEL, []),
        (
            {"names": MODEL.joint_names[:1]},
            MODEL,
            [(Kind.MISSING_JOINT, "/joints", 2, {"joints": 1})],
        ),
        (
            {"names": (*MODEL.joint_names, "x", "y")},
            MODEL,
            [(Kind.UNKNOWN_JOINT, "/joints", 1, {"joints": 2})],
        ),
        # A second robot of the same model, beside which one joint is left.
        (
            {"names": (*MODEL.joint_names, *(f"right_{name}" for name in MODEL.joint_names), "x")},
            MODEL,
            [(Kind.UNKNOWN_JOINT, "/joints", 1, {"joints": 1})],
        ),
        # The model has a single frame of an IMU.
        ({"imu": "head"}, MODEL, [(Kind.UNKNOWN_FRAME, "/imu", 1, {})]),
        ({"wrench": "hand"}, MODEL, [(Kind.UNKNOWN_FRAME, "/wrench", 2, {})]),
        ({"imu": ""}, MODEL, [(Kind.SILENT, "", 2, {})]),
        ({"imu": "head"}, replace(MODEL, floating=False), []),
        ({"imu": ""}, replace(MODEL, floating=False), []),
    ],
)
def test_names_are_compared_with_the_model(change, model, expected):
    found = check_names(streams(**change), model)
    assert [(one.kind, one.stream, one.severity.value, one.figures) for one in found] == expected
    checks = StreamChecks(model)
    checks.take(piece(streams(**change)))
    assert list(checks.named) == found


def test_each_defect_has_a_kind_and_each_repair_a_remedy():
    assert set(KINDS) == set(Defect)
    counts = DefectCounts("log", "/imu", messages=0)
    counts.counts.update(dict.fromkeys(REMEDIES, 3))
    found = repair_findings([counts])
    assert [one.kind for one in found] == [KINDS[defect] for defect in REMEDIES]
    for one, remedy in zip(found, REMEDIES.values(), strict=True):
        assert one.message.startswith("/imu: 3 of 0 messages")
        assert one.message.endswith(f"; {remedy}")
        assert one.figures == {"messages": 3, "share": 3.0}
        assert one.severity is Severity.WARNING
    error = DefectError("/imu", Defect.CLOCK_JUMP, "stamps jump back", "E314")
    fatal = fatal_finding(error)
    assert (fatal.kind, fatal.stream, fatal.severity) == (
        Kind.CLOCK_JUMP,
        "/imu",
        Severity.UNUSABLE,
    )
    assert "stamps jump back" in fatal.message
