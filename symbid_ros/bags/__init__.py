"""Bags in MCAP and SQLite: read, write, replay and recover them.

Everything outside of this subpackage imports these names alone. Each is loaded when it is first
used (PEP 562), so that reading a bag loads no writer.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from symbid_ros.bags.container.file_index import RecordedTopic as RecordedTopic
    from symbid_ros.bags.container.files import count_messages as count_messages
    from symbid_ros.bags.container.files import join_names as join_names
    from symbid_ros.bags.info import BagInfo as BagInfo
    from symbid_ros.bags.info import FileInfo as FileInfo
    from symbid_ros.bags.info import bag_info as bag_info
    from symbid_ros.bags.reader import bag_log as bag_log
    from symbid_ros.bags.reader import read_streams as read_streams
    from symbid_ros.bags.reader import read_truth as read_truth
    from symbid_ros.bags.reader import read_wrench_frames as read_wrench_frames
    from symbid_ros.bags.recovery.recover import recover as recover
    from symbid_ros.bags.recovery.report import LostRange as LostRange
    from symbid_ros.bags.recovery.report import RecoveryReport as RecoveryReport
    from symbid_ros.bags.replay import RecordedMessage as RecordedMessage
    from symbid_ros.bags.replay import Recording as Recording
    from symbid_ros.bags.writing.background import BackgroundWriter as BackgroundWriter
    from symbid_ros.bags.writing.background import QueuedMessage as QueuedMessage
    from symbid_ros.bags.writing.background import WriterState as WriterState
    from symbid_ros.bags.writing.bag_file import create_folder as create_folder
    from symbid_ros.bags.writing.writer import BagWriter as BagWriter

# Where each name is defined.
MODULES = {
    "container.file_index": ("RecordedTopic",),
    "container.files": ("count_messages", "join_names"),
    "info": ("BagInfo", "FileInfo", "bag_info"),
    "recovery.recover": ("recover",),
    "recovery.report": ("LostRange", "RecoveryReport"),
    "replay": ("RecordedMessage", "Recording"),
    "reader": ("bag_log", "read_streams", "read_truth", "read_wrench_frames"),
    "writing.background": ("BackgroundWriter", "QueuedMessage", "WriterState"),
    "writing.bag_file": ("create_folder",),
    "writing.writer": ("BagWriter",),
}

__all__ = sorted(name for names in MODULES.values() for name in names)  # noqa: PLE0605


def __getattr__(name: str) -> Any:
    for module, names in MODULES.items():
        if name in names:
            return getattr(import_module(f"{__name__}.{module}"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
