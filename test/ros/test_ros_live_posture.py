"""The posture of the live page: joints by other names, from several topics, and held ones."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from sensor_msgs.msg import JointState

from symbid_ros.cli.live import SHARED_WITH_PAGE
from symbid_ros.errors import OptionError
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.ros import identifier_parameters, web_monitor
from symbid_ros.ros.live_posture import POSTURE_PARAMETERS, LivePosture

MODEL = load_model(config_file("symbitron.xml"))
DEFAULTS = {each.name: each.default for each in POSTURE_PARAMETERS}


@pytest.fixture
def node(domain) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    yield Node("web_monitor", context=context)
    context.try_shutdown()


@pytest.fixture
def say(node: Node) -> Callable[..., None]:
    """Publish positions by name on a topic until a posture has read them."""
    publishers: dict[str, Any] = {}

    def publish(posture: LivePosture, topic: str = "joint_states", **positions: float) -> None:
        publisher = publishers.get(topic)
        if publisher is None:
            publisher = publishers[topic] = node.create_publisher(JointState, topic, 10)
        state = JointState(name=list(positions), position=list(positions.values()))
        publisher.publish(state)
        while not posture.read():
            publisher.publish(state)

    return publish


def at(posture: LivePosture, **expected: float) -> bool:
    """Return whether some joints are where they should be, and all others at zero."""
    wanted = [expected.get(name, 0.0) for name in MODEL.joint_names]
    return posture.newest is not None and np.allclose(posture.newest, wanted)


def test_renamed_joints_move(node, say) -> None:
    posture = LivePosture(node, MODEL, DEFAULTS | {"rename_joint": ["knee_motor:=L_kfe"]})
    say(posture, knee_motor=0.4, R_kfe=0.1, wheel=7.0)
    assert at(posture, L_kfe=0.4, R_kfe=0.1)


def test_flipped_joints_move_the_other_way(node, say) -> None:
    posture = LivePosture(node, MODEL, DEFAULTS | {"flip_joint": ["L_kfe"]})
    say(posture, L_kfe=0.4, R_kfe=0.1)
    assert at(posture, L_kfe=-0.4, R_kfe=0.1)


def test_joints_come_from_several_topics_and_are_kept(node, say) -> None:
    values = DEFAULTS | {"joint_topic": ["left/states", "right/states"]}
    posture = LivePosture(node, MODEL, values)
    say(posture, "left/states", L_kfe=0.4)
    say(posture, "right/states", R_kfe=0.1)
    say(posture, "left/states", L_kfe=0.5)
    assert at(posture, L_kfe=0.5, R_kfe=0.1)


def test_held_joints_and_invalid_positions(node, say) -> None:
    posture = LivePosture(node, MODEL, DEFAULTS | {"hold_joint": ["R_kfe:=0.3"]})
    say(posture, L_kfe=0.4, R_haa=float("nan"))
    assert at(posture, L_kfe=0.4, R_kfe=0.3)


def test_a_wrong_entry_is_an_error(node) -> None:
    with pytest.raises(OptionError, match="rename_joint"):
        LivePosture(node, MODEL, DEFAULTS | {"rename_joint": ["knee_motor"]})


def test_the_page_and_the_identifier_have_the_shared_parameters() -> None:
    for module in (identifier_parameters, web_monitor):
        assert set(SHARED_WITH_PAGE) <= {each.name for each in module.PARAMETERS}
