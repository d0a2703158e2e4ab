"""Counts of a recovery: what is kept, what is lost, and where."""

import json
from pathlib import Path

import pytest
from json_schemas import require_valid
from mcap.opcode import Opcode

from symbid_ros.bags.recovery.report import LostRange, RecoveryCounts
from symbid_ros.messages.topics import Topic

IMU, JOINTS = Topic("/imu", "Imu"), Topic("/joints", "JointState")


def hole(name):
    return LostRange(name, 10, 20, "overwritten")


def reported(counts):
    return counts.report(Path("bag"), Path("out"))


def test_lost_ranges_lie_between_the_messages_of_their_file():
    counts = RecoveryCounts()
    counts.begin_file()
    counts.add_hole(hole("a"))
    counts.add_kept_times(5, 9)
    counts.add_kept_times(11, 14)
    counts.add_hole(hole("b"))
    counts.add_hole(hole("c"))
    counts.add_kept_times(20, 30)
    counts.add_hole(hole("d"))
    counts.begin_file()
    counts.add_hole(hole("e"))
    counts.add_kept_times(40, 41)
    found = reported(counts).holes
    assert [(one.file, one.after, one.before) for one in found] == [
        ("a", None, 5),
        ("b", 14, 20),
        ("c", 14, 20),
        ("d", 30, None),
        ("e", None, 40),
    ]
    assert {(one.offset, one.length, one.fault) for one in found} == {(10, 20, "overwritten")}


@pytest.mark.parametrize(("unassigned", "unknown"), [(0, 0), (3, 0), (4, 1), (9, 6)])
def test_messages_of_unknown_topics_are_those_that_no_topic_misses(unassigned, unknown):
    counts = RecoveryCounts(unassigned=unassigned, repeated=2)
    counts.kept.update({IMU: 7, JOINTS: 10})
    counts.stated.update({IMU: 10, JOINTS: 8})
    counts.records[Opcode.ATTACHMENT], counts.records_lost[Opcode.METADATA] = 1, 2
    report = reported(counts)
    found = {one.name: (one.msgtype, one.kept, one.lost) for one in report.topics}
    expected = {"/imu": ("Imu", 7, 3), "/joints": ("JointState", 10, 0)}
    if unknown:
        expected["(unknown topic)"] = ("", 0, unknown)
    assert found == expected
    assert list(found) == sorted(found)
    assert (report.kept, report.lost) == (17, 3 + unknown)
    assert (report.attachments.kept, report.attachments.lost) == (1, 0)
    assert (report.metadata.kept, report.metadata.lost) == (0, 2)
    assert report.repeated == 2


@pytest.mark.parametrize(
    ("change", "is_whole"),
    [
        ({}, True),
        ({"is_counted": False}, False),
        ({"unassigned": 1}, False),
        ({"records_lost": {Opcode.ATTACHMENT: 1}}, False),
        ({"records_lost": {Opcode.METADATA: 1}}, False),
        ({"stated": {IMU: 2}}, False),
    ],
)
def test_a_recovery_is_whole_if_nothing_is_lost(change, is_whole):
    counts = RecoveryCounts()
    counts.kept[IMU] = counts.stated[IMU] = 1
    for name, value in change.items():
        if isinstance(value, dict):
            getattr(counts, name).update(value)
        else:
            setattr(counts, name, value)
    report = reported(counts)
    assert report.is_whole is is_whole
    document = report.as_dict()
    require_valid("bag_recovery", json.loads(json.dumps(document)))
    assert (document["source"], document["out"]) == ("bag", "out")
    assert (document["kept"], document["lost"]) == (1, report.lost)
    assert document["is_whole"] is is_whole
