"""Counts of defective messages and their warnings."""

import logging

import numpy as np

from symbid_ros.signals.defects import Defect, DefectCounts


def test_messages_are_counted_from_the_first_stamp_up_to_the_second() -> None:
    counts = DefectCounts("log", "/imu", during=(10, 20))
    stamps = np.array([9, 10, 15, 19, 20, 21])
    counts.count_messages(stamps)
    counts.count_messages(stamps[:2])
    assert counts.messages == 4
    counts.add(Defect.ABSENT, stamps, np.array([True, True, False, True, True, True]))
    counts.add(Defect.ABSENT, stamps, np.ones(6, dtype=bool))
    counts.add(Defect.LATE, stamps, np.array([True, False, False, False, True, True]))
    assert counts.counts == {Defect.ABSENT: 5}


def test_a_warning_names_each_field_once(caplog) -> None:
    counts = DefectCounts("log", "/imu")
    stamps, wrong = np.arange(4), np.array([True, False, True, False])
    counts.count_messages(stamps)
    counts.add(Defect.NOT_FINITE, stamps, wrong, ["force", "torque"])
    counts.add(Defect.NOT_FINITE, stamps, ~wrong & (stamps > 2), ["torque", "effort"])
    counts.add(Defect.NOT_FINITE, stamps, np.zeros(4, dtype=bool), ["unused"])
    with caplog.at_level(logging.WARNING):
        counts.report()
    (record,) = caplog.records
    text = "log: /imu: 3 of 4 messages have no usable force, torque, effort and were dropped"
    assert record.getMessage() == text
