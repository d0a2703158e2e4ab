"""Selection of topics by type, name and user choice."""

import pytest

from symbid_ros.errors import BagError
from symbid_ros.messages.log_options import LogOptions
from symbid_ros.messages.topics import Topic, TopicSelection, TopicSelector
from symbid_ros.messages.types import IMU, JOINT_STATE, ODOMETRY, WRENCH

TOPICS = {
    "/joint_states": JOINT_STATE,
    "/arm/joint_states": JOINT_STATE,
    "/joint_command": JOINT_STATE,
    "/imu/data": IMU,
    "/camera/imu": IMU,
    "/left_foot/wrench": WRENCH,
    "/right_foot/wrench": WRENCH,
    "/left_foot/wrench_raw": WRENCH,
    "/ground_truth/joint_states": JOINT_STATE,
    "/ground_truth/imu": IMU,
    "/ground_truth/wrench": WRENCH,
    "/wrench": "geometry_msgs/msg/Wrench",
    "/tf": "tf2_msgs/msg/TFMessage",
}
BY_DEFAULT = {
    *("/joint_states", "/arm/joint_states", "/imu/data", "/camera/imu"),
    *("/left_foot/wrench", "/right_foot/wrench"),
}


@pytest.mark.parametrize(
    ("selection", "gone", "come"),
    [
        (TopicSelection(), set(), set()),
        (TopicSelection(joints=("joint_states",)), {"/arm/joint_states"}, set()),
        (
            TopicSelection(joints=("/joint_command",)),
            {"/joint_states", "/arm/joint_states"},
            {"/joint_command"},
        ),
        (TopicSelection(imus=("/imu/data",)), {"/camera/imu"}, set()),
        (TopicSelection(imus=()), {"/imu/data", "/camera/imu"}, set()),
        (
            TopicSelection(wrenches=("left_foot/wrench_raw",)),
            {"/left_foot/wrench", "/right_foot/wrench"},
            {"/left_foot/wrench_raw"},
        ),
        # A name does not make up for another type.
        (
            TopicSelection(wrenches=("/wrench", "/tf")),
            {"/left_foot/wrench", "/right_foot/wrench"},
            set(),
        ),
    ],
)
def test_topics_are_selected_by_type_and_name(selection, gone, come) -> None:
    selector = TopicSelector("log", selection)
    wanted = {name for name, msgtype in TOPICS.items() if selector.wants(Topic(name, msgtype))}
    assert wanted == BY_DEFAULT - gone | come


def test_selected_topics_are_those_that_may_be_selected() -> None:
    selector = TopicSelector("log", TopicSelection(joints=("/joint_states",)))
    counts = {Topic(name, msgtype): 1 for name, msgtype in TOPICS.items()}
    selector.counts.update(counts)
    selected = selector.select()
    assert set(selected.all) == {topic for topic in counts if selector.wants(topic)}
    assert selected.clock.name == "/joint_states"
    assert [topic.name for topic in selected.imus] == ["/camera/imu", "/imu/data"]


@pytest.mark.parametrize(
    ("options", "advice"),
    [
        ({"wheel_topic": ("/nosuch",)}, "such as `wheel_topic` /camera/imu$"),
        ({"pose_topic": ("/nosuch",)}, "or leave `pose_topic` out$"),
        (
            {"imu_topic": ("/tf",), "of_robot": ("imu_topic",)},
            r"imu_topic: .*/camera/imu.* in robot.yaml$",
        ),
    ],
)
def test_an_unknown_topic_is_answered_with_its_option(options, advice) -> None:
    selector = TopicSelector("log", TopicSelection.of(LogOptions(**options)))
    counts = {Topic(name, msgtype): 1 for name, msgtype in TOPICS.items()}
    truth = Topic("/ground_truth/odom", ODOMETRY)
    selector.counts.update({**counts, truth: 1})
    del selector.counts[Topic("/arm/joint_states", JOINT_STATE)]
    with pytest.raises(BagError, match=advice):
        selector.select()
