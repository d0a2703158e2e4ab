"""One MCAP file of a bag that is being written."""

import os
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

from symbid_ros.bags.metadata import FileMetadata, TopicMetadata, encode_metadata_record
from symbid_ros.bags.writing.disk import sync_folder
from symbid_ros.bags.writing.mcap_writer import McapWriter
from symbid_ros.messages.definitions import find_definition

RECORD = "rosbag2"


class BagFile:
    """A file that is complete once finished; all errors are OSError.

    Parameters
    ----------
    path : Path
        The file, which must not exist.
    chunk_size : int
        Bytes of serialised data collected before they are compressed and written.
    """

    def __init__(self, path: Path, chunk_size: int) -> None:
        self.path = path
        self.is_finished = False
        self._is_in_folder = False
        # A buffer would hide from the writer how much of a chunk has reached a full disk.
        self._stream = path.open("xb", buffering=0)
        try:
            self.mcap = McapWriter(self._stream, chunk_size)
        except OSError:
            self.remove()
            raise

    @property
    def metadata(self) -> FileMetadata:
        """What lies in whole chunks."""
        mcap = self.mcap
        return FileMetadata(self.path.name, mcap.start, mcap.end, mcap.counts)

    def add_topic(self, topic: TopicMetadata) -> int:
        """Announce a topic and return its channel: in all files of a bag the same."""
        definition = find_definition(topic.msgtype).text
        schema = self.mcap.add_schema(topic.msgtype, definition.encode())
        return self.mcap.add_channel(topic.name, schema, topic.channel())

    def record(self, information: Mapping[str, Any]) -> None:
        """Write rosbag2's metadata record."""
        self.mcap.add_metadata(RECORD, encode_metadata_record(information))

    def finish(self, information: Callable[[], Mapping[str, Any]]) -> None:
        """Write the last chunk, the metadata record, summary and footer.

        Parameters
        ----------
        information : callable
            Returns the bag's metadata; called once this file's last chunk is written.
        """
        self.mcap.end_chunk()
        self.record(information())
        self.mcap.finish()
        self.is_finished = True

    def salvage(self, information: Callable[[], Mapping[str, Any]]) -> None:
        """Finish after a failed write, without whatever does not fit."""
        self.mcap.abandon()
        while True:
            try:
                return self.finish(information)
            except OSError:
                self.mcap.abandon()
                room = self.mcap.summary_size + 2 * len(str(information()))
                if not self.mcap.remove_last_chunks(room):
                    raise

    @property
    def displacement(self) -> str:
        """Why the file is no longer at its path; empty if it still is.

        Writing to a file that was deleted or moved succeeds all the same.
        """
        own = os.fstat(self._stream.fileno())
        with suppress(FileNotFoundError, NotADirectoryError):
            if os.path.samestat(own, self.path.stat()):
                return ""
        return "moved" if own.st_nlink else "deleted"

    def sync(self) -> None:
        """Wait until the disk holds what has been written."""
        os.fdatasync(self._stream.fileno())
        if not self._is_in_folder:
            # A file whose name is not on the disk is lost with all that it holds.
            sync_folder(self.path.parent)
            sync_folder(self.path.parent.parent)
            self._is_in_folder = True

    def close(self) -> None:
        """Let go of the file."""
        self._stream.close()

    def remove(self) -> None:
        """Remove the file."""
        with suppress(OSError):
            self._stream.close()
        self.path.unlink(missing_ok=True)
