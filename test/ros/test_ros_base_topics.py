"""Live contact flags, poses of the base, and the odometry or IMU of a wheeled base."""

import json
import signal
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from geometry_msgs.msg import PoseStamped, WrenchStamped
from nav_msgs.msg import Odometry
from quadruped_log import (
    FEET,
    inaccurate,
    load_quadruped,
    quadruped_urdf,
    record_log,
    standing_log,
)
from random_logs import LogPlan, random_streams, write_bag
from random_robots import random_robot
from rcl_interfaces.msg import Log
from sensor_msgs.msg import Imu, JointState
from std_msgs.msg import Bool
from std_srvs.srv import Trigger

from symbid_ros.dynamics.unmeasured_contacts import with_contacts
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.identification.api import identify
from symbid_ros.messages.types import (
    IMU,
    ODOMETRY,
    fill_message,
    fill_stamp,
    imu_layout,
    odometry_layout,
)
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import load_bag
from symbid_ros.signals.driving import SETTLING

QUICK = {"joint_terms": "none", "window": 0.321}
SECOND = 10**9
POINTS = tuple(f"{foot}:point" for foot in FEET)


def played(
    graph,
    bag: Path,
    out: Path,
    topics: dict[str, type],
    is_complete: Callable[[], bool] = lambda: True,
    **parameters: object,
) -> dict[str, Any]:
    """Play a bag to an identifier at full speed and return its last line.

    Its result is saved until it is complete: messages may still wait to be read.
    """
    with published(graph, topics):
        live = graph.start(
            "identifier", out=out, lag=30.0, settle=0.0, queue_depth=10_000, **QUICK, **parameters
        )
        play(graph, bag)
        save_until(graph, is_complete)
    live.send(signal.SIGINT)
    ended = live.ended()
    assert ended.status == 0, ended.err
    found: dict[str, Any] = json.loads(ended.out.splitlines()[-1])
    return found


@contextmanager
def published(graph, topics: dict[str, type]) -> Iterator[None]:
    """Keep topics on the graph when a player ends before the identifier has found them."""
    publishers = [graph.node.create_publisher(kind, name, 10) for name, kind in topics.items()]
    yield
    for one in publishers:
        graph.node.destroy_publisher(one)


def play(graph, bag: Path) -> None:
    player = graph.start("player", bag=f"['{bag}']", rate=0.0, wait_for_subscribers=True)
    assert player.ended().status == 0


def save_until(graph, is_complete: Callable[[], bool]) -> None:
    client = graph.node.create_client(Trigger, "/identifier/save")
    graph.wait_until(client.service_is_ready)

    def is_saved() -> bool:
        answer = client.call_async(Trigger.Request())
        graph.wait_until(answer.done)
        return answer.result().success and is_complete()

    graph.wait_until(is_saved)


def informations(folder: Path) -> list[np.ndarray]:
    return [one.rows.factor.T @ one.rows.factor for one in load_archive(folder / "information.npz")]


def are_same(live: Path, offline: Path) -> bool:
    for found, expected in zip(informations(live), informations(offline), strict=True):
        scale = np.sqrt(np.diag(expected))
        if not np.all(np.abs(found - expected) <= 1e-9 * np.outer(scale, scale)):
            return False
    return True


def test_contact_flags_and_the_pose_of_the_base(graph, tmp_path: Path) -> None:
    urdf = tmp_path / "quadruped.urdf"
    urdf.write_text(quadruped_urdf())
    robot = load_model(urdf)
    log = standing_log(robot, 6.0, 3, friction=0.0, steps=True, captured=True)
    kept = {"/joint_states", "/base/pose", *(f"/{foot}/contact" for foot in FEET)}
    bag = record_log(
        {name: one for name, one in log.items() if name in kept}, robot, tmp_path / "b"
    )
    flags = [f"/{foot}/contact:={foot}" for foot in FEET]
    topics = {"/joint_states": JointState, "/base/pose": PoseStamped}
    topics |= {f"/{foot}/contact": Bool for foot in FEET}
    options = {"pose_topic": "/base/pose", "pose_frame": "base", "contact": ",".join(POINTS)}
    ended = played(
        graph, bag, tmp_path / "live", topics, model=urdf, contact_flag=json.dumps(flags), **options
    )
    assert set(ended["received"]) == {"/joint_states", "/base/pose"}
    (found,) = load_archive(tmp_path / "live" / "information.npz")
    # Without flags, all four contacts are eliminated at all times, which leaves few joints a row.
    all_touch = with_contacts(robot, POINTS)
    assert all_touch.contacts is not None
    names = found.layout.coordinates
    has_rows = {name for name, count in zip(names, found.counts.diagonal(), strict=True) if count}
    assert has_rows > {names[index] for index in all_touch.contacts.coordinates}


def test_a_robot_without_foot_sensors_stands_on_its_feet_until_these_appear(
    graph, tmp_path: Path
) -> None:
    robot = load_quadruped(tmp_path)
    urdf = tmp_path / "wrong.urdf"
    wrong = inaccurate(robot)
    urdf.write_text(urdf_text(wrong))
    weight = robot.phi[:, 0].sum()
    assert wrong.phi[:, 0].sum() != pytest.approx(weight, rel=0.03)
    log = standing_log(robot, 30.0, 3, friction=0.0)
    motion = {"/joint_states": JointState, "/imu": Imu}
    everything = motion | {f"/{foot}/wrench": WrenchStamped for foot in FEET}

    def part(start: float, stop: float, names: Iterable[str], name: str) -> Path:
        rows = (log["/imu"]["time"] >= start) & (log["/imu"]["time"] < stop)
        some = {name: {key: one[rows] for key, one in log[name].items()} for name in names}
        return record_log(some, robot, tmp_path / name)

    def contacts() -> tuple[str, ...]:
        return load_estimate(out / "estimate.json").contacts

    def mass() -> float:
        value: float = load_estimate(out / "estimate.json").value[: robot.phi.size : 10].sum()
        return value

    out = tmp_path / "live"
    said: list[str] = []
    graph.node.create_subscription(Log, "/rosout", lambda one: said.append(one.msg), 1000)
    with published(graph, motion):
        live = graph.start(
            "identifier", model=urdf, out=out, lag=30.0, settle=0.0, queue_depth=10_000, **QUICK
        )
        play(graph, part(0.0, 15.0, motion, "without"))
        save_until(graph, lambda: contacts() == POINTS)
        assert mass() == pytest.approx(weight, rel=0.02)
        with published(graph, everything):
            play(graph, part(15.0, 16.0, everything, "first"))
            graph.wait_until(lambda: any("new topics appeared; restarting" in one for one in said))
            play(graph, part(16.0, 30.0, everything, "with"))
            save_until(graph, lambda: not contacts())
    assert mass() == pytest.approx(weight, rel=0.005)
    live.send(signal.SIGINT)
    ended = live.ended()
    assert ended.status == 0, ended.err
    assert "live topics: no wrench sensor" in ended.err


@pytest.mark.parametrize("kind", [ODOMETRY, IMU])
def test_a_wheeled_base_is_left_out_while_it_drives(graph, tmp_path: Path, kind: str) -> None:
    arm = random_robot(3, links=3, floating=False, wrench_frames=0)
    urdf = tmp_path / "arm.urdf"
    urdf.write_text(urdf_text(arm))
    streams = random_streams(arm, LogPlan(rate=200.0, count=2400, start=10 * SECOND), 1)
    stamp = streams.joints.stamp
    drives = (stamp >= 14 * SECOND) & (stamp < 16 * SECOND)
    if kind == ODOMETRY:
        records = odometry_layout("odom", "base_link").records(len(stamp))
        fill_stamp(records, stamp)
        records["twist.twist.linear"][...] = 0.2 * drives[:, None] * [1, 0, 0]
    else:
        records = imu_layout("base_imu").records(len(stamp))
        force = np.tile([0.0, 0.0, 9.81], (len(stamp), 1))
        fill_message(
            records,
            stamp,
            angular_velocity=0.1 * drives[:, None] * [0, 0, 1],
            linear_acceleration=force,
        )
    bag = write_bag(streams, tmp_path / "bag", [("/base/motion", kind, stamp, records)])
    topics = {"/joint_states": JointState, "/base/motion": Odometry if kind == ODOMETRY else Imu}
    robot = load_model(urdf, "fixed")
    log = load_bag(bag, robot, wheel_topic=("/base/motion",))
    found = identify(robot, log, joint_terms=("none",), window=0.321, no_holdout=True)
    found.save(tmp_path / "offline")
    live = tmp_path / "live"
    ended = played(
        graph,
        bag,
        live,
        topics,
        lambda: are_same(live, tmp_path / "offline"),
        model=urdf,
        base="fixed",
        wheel_topic="/base/motion",
    )
    assert set(ended["received"]) == {"/joint_states", "/base/motion"}
    ((begin, end),) = log.streams().driving
    assert begin == pytest.approx(14 * SECOND - SETTLING, abs=0.2 * SECOND)
    assert end == pytest.approx(16 * SECOND + SETTLING, abs=0.2 * SECOND)
