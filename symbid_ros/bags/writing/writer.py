"""Bags as rosbag2 writes them: MCAP files and their metadata.yaml in a folder."""

import shutil
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from symbid_ros.bags.metadata import (
    FileMetadata,
    TopicMetadata,
    describe_bag,
    write_metadata,
)
from symbid_ros.bags.writing.bag_file import BagFile
from symbid_ros.bags.writing.disk import Reserve, sync_folder
from symbid_ros.errors import BagError
from symbid_ros.messages.definitions import find_definition
from symbid_ros.messages.topics import OfferedQos

CHUNK_SIZE = 64 * 1024  # what a killed recorder loses at most: 64 ms of four sensors at 1 kHz
DESCRIPTION = 2048  # bytes, at most, that a file without topics takes in the bag's metadata


class BagWriter:
    """Writes one bag; complete once closed, removed when left by an exception.

    The folder carries no metadata.yaml and the last file no footer until `close`
    succeeds, so that an interrupted bag can be told from a complete one. `flush` and `close` fail
    if the file has been deleted or moved. Room for both
    is held on the disk from the beginning: after a failed write, `salvage` completes
    the bag with all that had been written until then.

    Parameters
    ----------
    path : Path
        The bag's folder, which must not exist.
    chunk_size : int
        Bytes of serialised data collected before they are compressed and written.
    split_size : int
        Bytes after which a file is followed by the next; 0 for never.
    split_duration : int
        Nanoseconds of log time after which a file is followed by the next; 0 for never.
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
            raise BagError(f"{path}: exists already; choose another name or remove it")
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
            raise BagError(f"{path}: cannot create the bag: {error.strerror}") from error

    @property
    def file(self) -> Path:
        """The file that is being written."""
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
        """Announce a topic and return the number that `write` wants.

        Parameters
        ----------
        name : str
            Fully qualified topic name.
        msgtype : str
            For example ``sensor_msgs/msg/Imu``; ROS 2 Jazzy's or an installed package's.
        qos : sequence of OfferedQos
            One entry per publisher.
        """
        if any(topic.name == name for topic in self._topics.values()):
            raise BagError(f"{self.path}: topic {name} is announced twice; record it once")
        try:
            definition = find_definition(msgtype)
        except BagError as error:
            raise BagError(f"{self.path}: topic {name}: {error}") from error
        topic = TopicMetadata(name, msgtype, tuple(qos), definition.type_hash)
        self._require_health()
        try:
            channel = self._current.add_topic(topic)
            self._topics[channel] = topic
            self._described += 2 * len(str(topic))
            self._hold_room()
        except OSError as error:
            raise self._failure(error) from error
        return channel

    def write(
        self, topic: int, log_time: int, payload: bytes, publish_time: int | None = None
    ) -> None:
        """Append one serialised message; times in nanoseconds."""
        published = log_time if publish_time is None else publish_time
        self._require_health()
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
        """Hand everything written so far to the operating system, closing the open chunk."""
        self._require_health()
        try:
            self._require_file()
            self._current.mcap.end_chunk()
            self._hold_room()
        except OSError as error:
            raise self._failure(error) from error

    def sync(self) -> None:
        """Wait until the disk holds what has been flushed; a thread of its own may call it."""
        try:
            while self._unsynced:
                file = self._unsynced.pop()
                file.sync()
                file.close()
            self._current.sync()
        except OSError as error:
            raise self._failure(error) from error

    def close(self) -> None:
        """Write index, footer and metadata.yaml; the bag is complete afterwards.

        Raises
        ------
        BagError
            When it is not, or when an earlier file of it is missing.
        """
        if self._is_closed:
            return
        self._require_health()
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
                "the bag consists of the other files"
            )

    def salvage(self) -> None:
        """Complete the bag after a failed write; `counts` then tells what it holds.

        A file that was deleted or moved is not part of it any more.
        """
        self._reserve.release()
        if self._is_closed:
            return
        if self._is_displaced:
            self._abandon()
            return
        try:
            if not self._current.is_finished:
                self._current.salvage(self._information)
            self._complete()
        except OSError as error:
            raise BagError(
                f"{self.path}: cannot complete the bag: {error.strerror}; "
                f"make room and run symbid bag recover {self.path}"
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

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if kind is None:
            self.close()
        else:
            self.discard()

    def _require_health(self) -> None:
        if self._has_failed:
            raise BagError(f"{self.path}: a write has failed, nothing follows; record anew")

    def _require_file(self) -> None:
        """Raise BagError if the current file has been deleted or moved."""
        if displacement := self._current.displacement:
            self._has_failed = self._is_displaced = True
            raise BagError(
                f"{self.file}: the file or its folder was {displacement} while the bag was being "
                "written; record again and leave the bag in place until the recording has ended"
            )

    def _abandon(self) -> None:
        """End the current file, which is not in the bag's folder, as well as possible."""
        with suppress(OSError):
            self._current.salvage(self._information)
        for file in [*self._unsynced, self._current]:
            with suppress(OSError):
                file.sync()
            file.close()
        self._is_closed = True

    def _failure(self, error: OSError) -> BagError:
        self._has_failed = True
        return BagError(f"{self.file}: cannot write: {error.strerror}; the bag is incomplete")

    def _is_full(self, duration: int) -> bool:
        return (
            0 < self._split_size <= self._current.mcap.size or 0 < self._split_duration <= duration
        )

    def _begin_next(self) -> None:
        """Finish the file and begin another with the same topics."""
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
        self._hold_room()

    def _hold_room(self) -> None:
        # The metadata stand in the last file and in metadata.yaml.
        self._reserve.hold(self._current.mcap.summary_size + 2 * self._described)

    def _complete(self) -> None:
        """Let the disk have the files and then metadata.yaml."""
        self.sync()
        write_metadata(self.path, self._information())
        sync_folder(self.path)
        self._current.close()
        self._is_closed = True

    def _files(self) -> list[FileMetadata]:
        return [*self._earlier, *([] if self._is_displaced else [self._current.metadata])]

    def _information(self) -> dict[str, Any]:
        return describe_bag(self._topics, self._files())
