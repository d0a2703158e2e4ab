"""Wrench topics of a floating robot's log whose names do not tell what they are."""

import logging

import pytest
from foreign_bags import joint_state, wrench, write_rosbags
from random_robots import CONFIG

from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.types import JOINT_STATE, WRENCH
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import BagRequest, load_bag, with_wrench_topics
from symbid_ros.offline.robot_setup import inspect_robot

MODEL = CONFIG / "symbitron.urdf"
FT = ("/ft/left", "/ft/right")
RESIDUAL = "/identifier/wrench_residual"  # published by an identifier beside the recorder


@pytest.fixture
def bag_of(tmp_path):
    """Write a bag with wrenches on some topics."""

    def write(*topics, empty=()):
        messages = [
            (topic, WRENCH, wrench(stamp, (0.0, 0.0, 200.0)))
            for stamp in range(1_000_000, 20_000_000, 1_000_000)
            for topic in topics
        ]
        names = load_model(MODEL).joint_names
        position = [0.0] * len(names)
        messages += [
            ("/joint_states", JOINT_STATE, joint_state(stamp, names, position, (), position))
            for stamp in range(1_000_000, 20_000_000, 1_000_000)
        ]
        return write_rosbags(tmp_path / "bag", messages, [(name, WRENCH) for name in empty])

    return write


def test_all_wrenches_count_if_none_is_named_wrench(bag_of, caplog):
    bag = bag_of(*FT, RESIDUAL, empty=("/ft/unused",))
    with caplog.at_level(logging.WARNING):
        log = load_bag(bag, load_model(MODEL))
    assert tuple(one.topic for one in log.streams().wrenches) == FT
    assert f"so {', '.join(FT)} count as the forces on the robot" in caplog.text
    assert 'wrench_topic: ["/ft/left", "/ft/right"] in robot.yaml' in caplog.text


def test_a_robot_file_names_no_topic_of_an_identifier(bag_of):
    assert tuple(inspect_robot(MODEL, [bag_of(*FT, RESIDUAL)]).options["wrench_topic"]) == FT


def test_a_result_records_the_topics(bag_of):
    request = BagRequest((bag_of(*FT),), MODEL).completed()
    assert request.log.wrench_topic == FT
    assert request.completed() == request


@pytest.mark.parametrize(
    ("topics", "options", "base", "has_contacts"),
    [
        (("/left_foot/wrench", *FT), LogOptions(), "auto", False),
        (FT, LogOptions(wrench_topic=("/ft/left",)), "auto", False),
        (FT, LogOptions(), "fixed", False),
        (FT, LogOptions(), "auto", True),
        ((), LogOptions(), "auto", False),
    ],
)
def test_names_options_fixed_bases_and_contacts_leave_them_out(
    bag_of, topics, options, base, has_contacts
):
    robot = load_model(MODEL, base)
    found = with_wrench_topics(options, robot, [bag_of(*topics)], has_contacts=has_contacts)
    assert found is options


def test_contacts_of_unknown_wrench_need_no_wrench_topic(bag_of):
    options = IdentifyOptions(contact=("left_sole", "right_sole"))
    assert BagRequest((bag_of(*FT),), MODEL, options).completed().log.wrench_topic == ()


def test_the_topic_of_a_wrist_sensor_is_found_by_its_frame(bag_of):
    """A topic of any other frame stays out, as does a topic beside one named wrench."""
    robot = load_model(MODEL, "fixed")
    frame = "left_sole"  # of all wrenches here
    bag = bag_of(*FT)
    for sensor, expected in ((f"-{frame}:{robot.link_names[-1]}", FT), ("other", ())):
        found = with_wrench_topics(LogOptions(), robot, [bag], wrist_sensors=(sensor,))
        assert found.wrench_topic == expected
    renamed = LogOptions(rename_frame=(f"{frame}:=wrist",))
    assert with_wrench_topics(renamed, robot, [bag], wrist_sensors=("wrist",)).wrench_topic == FT


def test_a_topic_named_wrench_that_has_the_frame_suffices(bag_of):
    frame = "left_sole"  # of all wrenches here
    options, bag = LogOptions(), bag_of("/wrist/wrench", *FT)
    robot = load_model(MODEL, "fixed")
    assert with_wrench_topics(options, robot, [bag], wrist_sensors=(frame,)) is options
