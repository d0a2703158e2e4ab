"""The files and the folder of a bag on the disk, safe against a full disk and power cuts."""

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

from symbid_ros.bags.metadata import FileMetadata, TopicMetadata, encode_metadata_record
from symbid_ros.bags.writing.mcap_writer import McapWriter
from symbid_ros.errors import BagError
from symbid_ros.messages.definitions import find_definition
from symbid_ros.shutdown import deferred

ROSBAG2 = "rosbag2"  # name of rosbag2's metadata record


class BagFile:
    """A file that is complete once `finish` succeeds; all errors are OSError.

    Parameters
    ----------
    path : Path
        The file, which must not exist.
    chunk_size : int
        Bytes of serialised data to collect before they are compressed and written.
    """

    def __init__(self, path: Path, chunk_size: int) -> None:
        self.path = path
        self.is_finished = False
        self._is_in_folder = False
        # Unbuffered, so that the writer knows how much of a chunk has reached a full disk.
        self._stream = path.open("xb", buffering=0)
        try:
            self.mcap = McapWriter(self._stream, chunk_size)
        except OSError:
            self._stream.close()
            path.unlink()
            raise

    @property
    def metadata(self) -> FileMetadata:
        """Times and counts of the messages in complete chunks."""
        summary = self.mcap.summary
        return FileMetadata(self.path.name, summary.start, summary.end, self.mcap.counts)

    def add_topic(self, topic: TopicMetadata) -> int:
        """Announce a topic and return its channel, the same in all files of a bag."""
        definition = find_definition(topic.msgtype).text
        schema = self.mcap.add_schema(topic.msgtype, definition.encode())
        return self.mcap.add_channel(topic.name, schema, topic.channel_metadata())

    def record(self, information: Mapping[str, Any]) -> None:
        """Write rosbag2's metadata record."""
        self.mcap.add_metadata(ROSBAG2, encode_metadata_record(information))

    def finish(self, information: Callable[[], Mapping[str, Any]]) -> None:
        """Write the last chunk, the metadata record, summary and footer.

        Parameters
        ----------
        information : callable
            Function that returns the bag's metadata; called after the last chunk is written.
        """
        self.mcap.end_chunk()
        self.record(information())
        self.mcap.finish()
        self.is_finished = True

    def finish_after_failure(self, information: Callable[[], Mapping[str, Any]]) -> None:
        """Finish after a failed write, without the messages that do not fit on the disk."""
        self.mcap.abandon()
        while True:
            try:
                return self.finish(information)
            except OSError:
                self.mcap.abandon()
                needed = self.mcap.summary.size + 2 * len(str(information()))
                if not self.mcap.remove_last_chunks(needed):
                    raise

    @property
    def displacement(self) -> str:
        """``moved`` or ``deleted`` if the file is no longer at its path, else empty.

        Writing to such a file still succeeds.
        """
        descriptor = self._stream.fileno()
        with suppress(FileNotFoundError, NotADirectoryError):
            if os.path.samestat(os.fstat(descriptor), self.path.stat()):
                return ""
        # Links are counted only now: the file may have been deleted since the first look.
        return "moved" if os.fstat(descriptor).st_nlink else "deleted"

    def sync(self) -> None:
        """Wait until all written data are on the disk."""
        os.fdatasync(self._stream.fileno())
        if not self._is_in_folder:
            # A file is lost if its name is not on the disk.
            sync_folder(self.path.parent)
            sync_folder(self.path.parent.parent)
            self._is_in_folder = True

    def close(self) -> None:
        """Close the file."""
        self._stream.close()


STEP = 64 * 1024


class Reserve:
    """Reserves disk space in an unnamed file, which disappears even if the process is killed.

    Parameters
    ----------
    folder : Path
        Folder on the file system to reserve space on.
    """

    def __init__(self, folder: Path) -> None:
        self._file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115
        self._reserved = 0

    def extend(self, size: int) -> None:
        """Reserve at least ``size`` bytes; raise OSError if the disk is too full."""
        if size > self._reserved:
            reserved = size + size // 2 + STEP
            os.posix_fallocate(self._file.fileno(), 0, reserved)
            self._reserved = reserved

    def release(self) -> None:
        """Release the space permanently."""
        self._file.close()


@contextmanager
def create_folder(path: Path, *, replace: bool = False) -> Iterator[Path]:
    """Yield a temporary path at which to create a folder; at the end, move it to ``path``.

    An exception leaves nothing behind. A process killed by SIGKILL leaves a hidden folder
    ``.<name>.<random>`` beside ``path``, which does not prevent another attempt.

    Parameters
    ----------
    path : Path
    replace : bool
        Whether the new folder replaces one at ``path``, which stays until the new one is complete.

    Raises
    ------
    BagError
        When ``path`` exists and is not to be replaced, or its parent is not writable.
    """
    hidden = None
    try:
        if not replace and os.path.lexists(path):
            raise BagError(f"{path}: exists already; choose another name or remove it", "E218")
        path.parent.mkdir(parents=True, exist_ok=True)
        # Two levels: mkdtemp makes a private folder, and a bag's files are named after its folder.
        hidden = Path(tempfile.mkdtemp(dir=path.parent, prefix=f".{path.name[:32]}."))
        yield hidden / path.name
        _move(hidden / path.name, path, hidden / f"{path.name}.replaced")
        sync_folder(path.parent)
    except OSError as error:
        raise BagError(
            f"{path}: cannot write: {error.strerror}; choose another folder", "E219"
        ) from None
    finally:
        if hidden is not None:
            shutil.rmtree(hidden, ignore_errors=True)


def _move(new: Path, path: Path, aside: Path) -> None:
    """Rename ``new`` to ``path``, after renaming what is there to ``aside``."""
    with deferred():
        is_replaced = os.path.lexists(path)
        if is_replaced:
            path.rename(aside)
        try:
            new.rename(path)
        except OSError:
            if is_replaced:
                aside.rename(path)
            raise


def sync_folder(folder: Path) -> None:
    """Wait until the names in a folder are on the disk."""
    handle = os.open(folder, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
