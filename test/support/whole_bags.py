"""What other readers find in a bag that claims to be complete."""

from pathlib import Path

import yaml
from mcap.reader import make_reader
from rosbags.rosbag2 import Reader


def whole_messages(bag: Path) -> list[tuple[str, int, bytes]]:
    """Return topic, log time and payload as they lie in the files, every index and sum checked."""
    content = yaml.safe_load((bag / "metadata.yaml").read_text())["rosbag2_bagfile_information"]
    assert content["relative_file_paths"] == [entry["path"] for entry in content["files"]]
    messages = []
    for entry in content["files"]:
        found = _file_messages(bag / entry["path"])
        times = [time for _, time, _ in found]
        assert entry["message_count"] == len(found)
        if found:
            assert entry["starting_time"]["nanoseconds_since_epoch"] == min(times)
            assert entry["duration"]["nanoseconds"] == max(times) - min(times)
        messages += found
    with Reader(bag) as reader:
        assert reader.message_count == len(messages)
        for connection in reader.connections:
            count = sum(topic == connection.topic for topic, _, _ in messages)
            assert connection.msgcount == count
        by_index = sorted((c.topic, time, bytes(data)) for c, time, data in reader.messages())
        assert by_index == sorted(messages)
    return messages


def _file_messages(file: Path) -> list[tuple[str, int, bytes]]:
    with file.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        summary = reader.get_summary()
        assert [record.name for record in reader.iter_metadata()] == ["rosbag2", "rosbag2"]
        messages = [
            (channel.topic, message.log_time, message.data)
            for _, channel, message in reader.iter_messages(log_time_order=False)
        ]
    assert summary.statistics.message_count == len(messages)
    for number, channel in summary.channels.items():
        count = sum(topic == channel.topic for topic, _, _ in messages)
        assert summary.statistics.channel_message_counts[number] == count
    return messages
