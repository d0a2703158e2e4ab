"""Bags in MCAP and SQLite: read, write, replay and recover them.

Everything outside of this subpackage imports these names alone. Each is loaded when it is first
used (PEP 562), so that reading a bag loads no writer.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from symbid_ros.bags.container.file_index import RecordedTopic
    from symbid_ros.bags.container.files import count_messages
    from symbid_ros.bags.info import BagInfo, FileInfo, bag_info
    from symbid_ros.bags.reader import bag_log, read_streams, read_truth
    from symbid_ros.bags.recovery.recover import recover
    from symbid_ros.bags.recovery.report import LostRange, RecoveryReport
    from symbid_ros.bags.replay import RecordedMessage, Recording
    from symbid_ros.bags.writing.background import BackgroundWriter, QueuedMessage, WriterState
    from symbid_ros.bags.writing.bag_file import create_folder
    from symbid_ros.bags.writing.writer import BagWriter

__all__ = [
    "BackgroundWriter",
    "BagInfo",
    "BagWriter",
    "FileInfo",
    "LostRange",
    "QueuedMessage",
    "RecordedMessage",
    "RecordedTopic",
    "Recording",
    "RecoveryReport",
    "WriterState",
    "bag_info",
    "bag_log",
    "count_messages",
    "create_folder",
    "read_streams",
    "read_truth",
    "recover",
]

MODULES = {
    "container.file_index": ("RecordedTopic",),
    "container.files": ("count_messages",),
    "info": ("BagInfo", "FileInfo", "bag_info"),
    "recovery.recover": ("recover",),
    "recovery.report": ("LostRange", "RecoveryReport"),
    "replay": ("RecordedMessage", "Recording"),
    "reader": ("bag_log", "read_streams", "read_truth"),
    "writing.background": ("BackgroundWriter", "QueuedMessage", "WriterState"),
    "writing.bag_file": ("create_folder",),
    "writing.writer": ("BagWriter",),
}


def __getattr__(name: str) -> Any:
    for module, names in MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
