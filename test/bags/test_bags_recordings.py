"""Several bags are recordings of their own, or parts of one, in any order."""

from pathlib import Path
from shutil import copytree

import numpy as np
import pytest
from expected_errors import raises_code
from foreign_bags import IMU, JOINT_STATE, imu, joint_state, write_rosbags

from symbid_ros.bags import bag_log, count_messages
from symbid_ros.bags.recordings import separate_recordings
from symbid_ros.bags.slices import iterate_slices
from symbid_ros.diagnosis.doctor import diagnose
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.rows.aligned_log import AlignedLog
from symbid_ros.model.load import load_model
from symbid_ros.offline.bags import BagRequest
from symbid_ros.package_paths import config_file
from symbid_ros.signals.segments import MINUTE, SECOND, WALL_CLOCK, fingerprint
from symbid_ros.signals.weak_form import BLOCK

YEAR_2026 = 1_767_225_600.0  # s
TICKS = np.arange(0.0, 3.0, 0.05)


@pytest.fixture
def write(tmp_path: Path):
    """Write a bag of joint states, an IMU or both, from a time on, s."""

    def written(name: str, begin: float, topics: str = "both") -> Path:
        messages, times = [], []
        for tick in (begin + TICKS).tolist():
            stamp = round(tick * 1e9)
            if topics != "imu":
                message = joint_state(stamp, ["hip"], [tick - begin])
                messages.append(("/joint_states", JOINT_STATE, message))
            if topics != "joints":
                messages.append(("/imu/data", IMU, imu(stamp)))
            if topics == "events too":
                messages.append(("/log", "std_msgs/msg/String", b"\0\1\0\0\5\0\0\0text\0"))
            times += [stamp] * (len(messages) - len(times))
        return write_rosbags(tmp_path / name, messages, times=times)

    return written


@pytest.mark.parametrize("pause", [3600.0, 2.0])
def test_recordings_with_a_pause_are_separate_and_ordered_by_time(write, pause: float) -> None:
    first, later = write("b", YEAR_2026), write("a", YEAR_2026 + 3.0 + pause)
    assert separate_recordings([later, first]) == [(first,), (later,)]
    assert separate_recordings([later]) == [(later,)]


def test_a_split_recording_and_topics_recorded_side_by_side_are_one(write) -> None:
    first, next_one = write("a", YEAR_2026), write("b", YEAR_2026 + 3.0)
    assert separate_recordings([next_one, first]) == [(first, next_one)]
    joints, gyro = write("c", YEAR_2026, "joints"), write("d", YEAR_2026, "imu")
    assert separate_recordings([joints, gyro]) == [(joints, gyro)]


def test_recordings_of_equal_clocks_may_differ_in_topics_of_no_sensor(write) -> None:
    first, other = write("a", 0.0), write("b", 0.0, "events too")
    assert separate_recordings([first, other]) == [(first,), (other,)]


def test_a_log_that_is_given_twice_is_refused(write, tmp_path: Path) -> None:
    bag, other = write("a", 0.0), write("b", 0.0, "joints")
    (tmp_path / "link").symlink_to(bag)
    (file,) = bag.glob("*.mcap")
    renamed = tmp_path / "renamed.mcap"
    renamed.write_bytes(file.read_bytes())
    for twice, reason in [
        (bag, "named twice"),
        (tmp_path / "link", "named twice"),
        (file, "both hold"),
        (renamed, "renamed.mcap: a copy of"),
        (copytree(bag, tmp_path / "copy"), "leave .*copy out"),
    ]:
        with raises_code("E202", reason):
            count_messages([bag, other, twice])
    assert sum(count_messages([bag, other]).values()) == 3 * len(TICKS)


def test_nothing_is_missing_between_recordings(write) -> None:
    bags = [write("a", YEAR_2026), write("b", YEAR_2026 + 3600.0)]
    diagnosis = diagnose(bag_log(bags))
    assert "gap" not in {one.kind.value for one in diagnosis.findings}
    joints = next(one for one in diagnosis.streams if one.topic == "/joint_states")
    assert joints.gaps == joints.missing == 0
    assert joints.messages == 2 * len(TICKS)
    assert joints.duration_s == pytest.approx(2 * (TICKS[-1] - TICKS[0]))


def test_a_second_recording_in_the_same_minute_loses_nothing(write) -> None:
    bags = [write("a", YEAR_2026), write("b", YEAR_2026 + 5.0)]
    pieces = list(iterate_slices(bags, span=MINUTE))
    assert [one.recording for one in pieces] == [0, 1]
    assert [len(one.streams.joints.stamp) for one in pieces] == [len(TICKS)] * 2


def test_a_bag_that_adds_nothing_is_named(write, tmp_path: Path, caplog) -> None:
    empty = write_rosbags(tmp_path / "other", [], topics=[("/chatter", JOINT_STATE)])
    list(iterate_slices([write("a", YEAR_2026), empty], span=MINUTE))
    assert f"{empty}: none of its topics is used, /chatter" in caplog.text


def test_equal_wall_clocks_are_those_of_copies(write) -> None:
    bags = [write("a", YEAR_2026), write("b", YEAR_2026 + 1.0)]
    assert YEAR_2026 * 1e9 > WALL_CLOCK
    with raises_code("E530", "begin 1.950 s before"):
        list(iterate_slices(bags, span=MINUTE))


def test_runs_whose_clocks_start_at_zero_equal_each_alone(simulated) -> None:
    model = load_model(config_file("symbitron.xml"))
    bags = [simulated("smooth", moves=2, motion_seed=21, noise_seed=seed) for seed in (5, 6)]
    alone = [one for bag in bags for one in AlignedLog(bag_log([bag], model), model, span=MINUTE)]
    together = list(AlignedLog(bag_log(bags, model), model, span=MINUTE))
    for one, expected in zip(together, alone, strict=True):
        shift = one.stamp - expected.stamp
        assert np.all(shift == shift[0])
        assert shift[0] % MINUTE == 0
        for name in ("position", "effort", "wrenches", "angular_velocity"):
            np.testing.assert_array_equal(getattr(one, name), getattr(expected, name))
        assert fingerprint(one) == fingerprint(expected)
    second = len(alone) // 2
    assert together[second].stamp[0] >= together[second - 1].stamp[-1] + 10 * SECOND
    assert MINUTE % BLOCK == 0


def test_bags_with_a_known_payload_may_be_named_among_the_others(write, tmp_path: Path) -> None:
    bag, loaded, link = write("a", 0.0), write("b", 10.0), tmp_path / "link"
    link.symlink_to(loaded)
    model, text = config_file("symbitron.xml"), "pelvis,1,0,0,0"
    options = IdentifyOptions(payload=(f"{link}:{text}",))
    request = BagRequest((bag, loaded), model, options).completed()
    assert (request.bags, request.options) == ((bag,), options)
    alone = BagRequest((loaded,), model, options).completed()
    assert (alone.bags, alone.options.payload) == ((loaded,), (text,))
    assert alone.completed() == alone
