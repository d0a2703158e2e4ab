"""Write bags in the format of rosbag2: MCAP files and a metadata.yaml in a folder."""

import errno
import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, Self

from symbid_ros.bags.metadata import FileMetadata, TopicMetadata, describe_bag, write_metadata
from symbid_ros.bags.writing.bag_file import BagFile, Reserve, sync_folder
from symbid_ros.errors import BagError
from symbid_ros.messages.definitions import find_definition
from symbid_ros.messages.topics import OfferedQos

CHUNK_SIZE = 64 * 1024  # the most that a killed recorder loses: 64 ms of four sensors at 1 kHz
DISK_FULL = errno.ENOSPC, errno.EDQUOT
DESCRIPTION = 2048  # upper bound for a file without topics in the bag's metadata, bytes


class BagWriter:
    """Writes one bag: complete once closed, and removed if the context is left by an exception.

    Until `close` succeeds, the folder has no metadata.yaml and the last file no footer, which marks
    an interrupted bag. Disk space for both is reserved from the beginning, so that
    `close_after_failure` can complete the bag after a failed write. `flush` and `close` fail if the
    file was deleted or moved.

    Parameters
    ----------
    path : Path
        The bag's folder, which must not exist.
    chunk_size : int
        Bytes of serialised data to collect before they are compressed and written.
    split_size : int
        Bytes after which the next file begins; 0 for never.
    split_duration : int
        Nanoseconds of log time after which the next file begins; 0 for never.
    """

    def __init__(
        self,
        path: Path,
        *,
        chunk_size: int = CHUNK_SIZE,
        split_size: int = 0,
        split_duration: int = 0,
    ) -> None:
        self.path = path
        self._chunk_size = chunk_size
        self._split_size = split_size
        self._split_duration = split_duration
        self._topics: dict[int, TopicMetadata] = {}
        self._earlier: list[FileMetadata] = []
        self._earlier_size = 0
        self._unsynced: list[BagFile] = []
        self._first: int | None = None  # log time of the file's first message
        self._described = DESCRIPTION
        self._has_failed = self._is_closed = self._is_displaced = False
        if path.exists() or path.is_symlink():
            raise BagError(f"{path}: exists already; choose another name or remove it", "E218")
        try:
            path.mkdir(parents=True)
            try:
                self._reserve = Reserve(path)
                self._current = self._new_file(0)
                self._begin()
            except OSError:
                shutil.rmtree(path, ignore_errors=True)
                raise
        except OSError as error:
            advice = "free disk space" if error.errno in DISK_FULL else "check its permissions"
            raise BagError(
                f"{path}: cannot create the bag: {error.strerror}; {advice} or choose another "
                "folder",
                "E219",
            ) from error

    @property
    def file(self) -> Path:
        """The current file."""
        return self._current.path

    @property
    def files(self) -> tuple[str, ...]:
        """Names of the files so far, in order."""
        return tuple(file.name for file in self._files())

    @property
    def size(self) -> int:
        """Bytes in the files so far."""
        return self._earlier_size + (0 if self._is_displaced else self._current.mcap.size)

    @property
    def counts(self) -> dict[str, int]:
        """Messages written so far, by topic."""
        files = self._files()
        return {
            topic.name: sum(file.counts.get(channel, 0) for file in files)
            for channel, topic in self._topics.items()
        }

    @property
    def end(self) -> int:
        """Largest log time in the files so far, nanoseconds; 0 without a message."""
        return max((file.end for file in self._files()), default=0)

    def add_topic(
        self, name: str, msgtype: str, qos: Sequence[OfferedQos] = (OfferedQos(),)
    ) -> int:
        """Announce a topic and return its number for `write`.

        Parameters
        ----------
        name : str
            Fully qualified topic name.
        msgtype : str
            For example ``sensor_msgs/msg/Imu``; part of ROS 2 Jazzy or of an installed package.
        qos : sequence of OfferedQos
            One entry for each publisher.
        """
        if any(topic.name == name for topic in self._topics.values()):
            raise BagError(f"{self.path}: topic {name} is announced twice; record it once", "E222")
        try:
            definition = find_definition(msgtype)
        except BagError as error:
            raise BagError(f"{self.path}: topic {name}: {error}", error.code) from error
        topic = TopicMetadata(name, msgtype, tuple(qos), definition.type_hash)
        self._require_no_failure()
        try:
            channel = self._current.add_topic(topic)
            self._topics[channel] = topic
            self._described += 2 * len(str(topic))
            self._reserve_space()
        except OSError as error:
            raise self._failure(error) from error
        return channel

    def write(
        self, topic: int, log_time: int, payload: bytes, publish_time: int | None = None
    ) -> None:
        """Append a serialised message; times in nanoseconds."""
        published = log_time if publish_time is None else publish_time
        self._require_no_failure()
        try:
            if self._first is None:
                self._first = log_time
            elif self._is_full(log_time - self._first):
                self._begin_next()
                self._first = log_time
            self._current.mcap.add_message(topic, log_time, published, payload)
        except OSError as error:
            raise self._failure(error) from error

    def flush(self) -> None:
        """Write the open chunk to the operating system."""
        self._require_no_failure()
        try:
            self._require_file()
            self._current.mcap.end_chunk()
            self._reserve_space()
        except OSError as error:
            raise self._failure(error) from error

    def sync(self) -> None:
        """Wait until the flushed data are on the disk; safe to call from another thread."""
        try:
            while self._unsynced:
                file = self._unsynced.pop()
                file.sync()
                file.close()
            self._current.sync()
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Write index, footer and metadata.yaml, which complete the bag.

        Raises
        ------
        BagError
            When this fails, or when an earlier file of the bag is missing.
        """
        if self._is_closed:
            return
        self._require_no_failure()
        try:
            self._require_file()
            self._reserve.release()
            self._current.finish(self._information)
            missing = [file for file in self._earlier if not (self.path / file.name).is_file()]
            self._earlier = [file for file in self._earlier if file not in missing]
            self._complete()
        except OSError as error:
            raise self._failure(error) from error
        if missing:
            names = ", ".join(file.name for file in missing)
            raise BagError(
                f"{self.path}: {names} was deleted or moved while the bag was being written; "
                "the bag consists of the other files",
                "E220",
            )

    def close_after_failure(self) -> None:
        """Complete the bag after a failed write; `counts` are then the messages in it.

        A file that was deleted or moved is no longer part of it.
        """
        self._reserve.release()
        if self._is_closed:
            return
        if self._is_displaced:
            self._abandon()
            return
        try:
            if not self._current.is_finished:
                self._current.finish_after_failure(self._information)
            self._complete()
        except OSError as error:
            raise BagError(
                f"{self.path}: cannot complete the bag: {error.strerror}; "
                f"free disk space and run `symbid bag recover {self.path}`",
                "E219",
            ) from error

    def discard(self) -> None:
        """Remove the unfinished bag."""
        for file in [*self._unsynced, self._current]:
            with suppress(OSError):
                file.close()
        self._reserve.release()
        shutil.rmtree(self.path, ignore_errors=True)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def _require_no_failure(self) -> None:
        if self._has_failed:
            raise BagError(
                f"{self.path}: an earlier write failed, so the bag takes no more messages; record "
                "again",
                "E219",
            )

    def _require_file(self) -> None:
        """Raise BagError if the current file has been deleted or moved."""
        if displacement := self._current.displacement:
            self._has_failed = self._is_displaced = True
            raise BagError(
                f"{self.file}: the file or its folder was {displacement} while the bag was being "
                "written; record again and leave the bag in place until the recording has ended",
                "E220",
            )

    def _abandon(self) -> None:
        """Finish the current file, which is no longer in the bag's folder, if possible."""
        with suppress(OSError):
            self._current.finish_after_failure(self._information)
        for file in [*self._unsynced, self._current]:
            with suppress(OSError):
                file.sync()
            file.close()
        self._is_closed = True

    def _failure(self, error: OSError) -> BagError:
        self._has_failed = True
        return BagError(
            f"{self.file}: cannot write: {error.strerror}; the bag is incomplete", "E219"
        )

    def _is_full(self, duration: int) -> bool:
        return (
            0 < self._split_size <= self._current.mcap.size or 0 < self._split_duration <= duration
        )

    def _begin_next(self) -> None:
        """Finish the file and begin the next with the same topics."""
        self._require_file()
        finished = self._current
        finished.finish(self._information)
        self._current = self._new_file(len(self._earlier) + 1)
        self._earlier.append(finished.metadata)
        self._earlier_size += finished.mcap.size
        self._unsynced.append(finished)
        self._begin()

    def _new_file(self, number: int) -> BagFile:
        return BagFile(self.path / f"{self.path.name}_{number}.mcap", self._chunk_size)

    def _begin(self) -> None:
        self._current.record(self._information())
        for topic in self._topics.values():
            self._current.add_topic(topic)
        self._described += DESCRIPTION
        self._reserve_space()

    def _reserve_space(self) -> None:
        # The metadata is written to the last file and to metadata.yaml.
        self._reserve.extend(self._current.mcap.summary.size + 2 * self._described)

    def _complete(self) -> None:
        """Sync the files, then write and sync metadata.yaml."""
        self.sync()
        write_metadata(self.path, self._information())
        sync_folder(self.path)
        self._current.close()
        self._is_closed = True

    def _files(self) -> list[FileMetadata]:
        return [*self._earlier, *([] if self._is_displaced else [self._current.metadata])]

    def _information(self) -> dict[str, Any]:
        return describe_bag(self._topics, self._files())
