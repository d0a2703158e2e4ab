"""How much of a bag is believed before memory is given to it.

Bags come from anywhere. Every size that a file states about itself is held
against one of these before anything is allocated; what reads a file of any
content then stays below 512 MB. Real recordings keep well inside them.
"""

import threading

import zstandard

MIB = 1 << 20

MAX_CHUNK = 96 * MIB
"""Bytes of a chunk, packed and unpacked, and of a message outside of chunks: writers close a
chunk of up to 64 MiB only behind the message that fills it, a point cloud of tens of megabytes."""

MAX_EXPANSION = 1000
"""Unpacked bytes for each packed one, in chunks of more than `UNSUSPICIOUS` bytes: sensor
messages pack 2 to 10 times smaller, blank images some hundred times, a bomb 30 000 times."""

UNSUSPICIOUS = 16 * MIB
"""Bytes that a chunk may unpack to from however few: what one blank image or map may need."""

MAX_WINDOW = 32 * MIB
"""Bytes that a zstd frame may want to look back; level 19 looks back 8 MiB."""

MAX_RECORD = 16 * MIB
"""Bytes of a schema, channel, statistics or chunk index record, strings and maps in them
included; the definition of the largest common message type takes 20 kB."""

MAX_CATALOGUE = 64 * MIB
"""Bytes of all schemas and channels of a file; 500 topics take about 2 MB."""

MAX_CHANNELS = 4096
"""Channels, and schemas, of a file; large robots publish some hundred topics."""

MAX_EXTENTS = 1_000_000
"""Chunks of a file: 64 KiB each, that is 64 GB or most of a day at 4 x 1 kHz."""

MAX_MESSAGE = 256 * 1024
"""Bytes of a sensor message that is read; 1000 joints take 60 kB. Other topics' are skipped."""

MAX_NAMES = 4096
"""Strings of a sensor message that is read, most of them joint names."""

MAX_DEFINITION = 64 * 1024
"""Bytes of the definition of a type that is read; ROS 2's own take 6 kB."""

MAX_METADATA = 8 * MIB
"""Bytes of a metadata.yaml; 500 topics with eight publishers each take about 2 MB."""

MAX_YAML_NODES = 250_000
"""Keys, values and lists of a metadata.yaml or a quality of service, repetitions written out; 500
topics with eight publishers each take 100 000."""

MAX_QOS = 64 * 1024
"""Bytes of a topic's offered_qos_profiles; 100 publishers take 40 kB."""


class OverLimitError(ValueError):
    """A file states a size beyond what is believed."""


def check_limit(what: str, size: int, limit: int) -> int:
    """Return a size that a file states, if it is believed.

    Raises
    ------
    OverLimitError
        With the size and the limit in its message.
    """
    if size > limit:
        raise OverLimitError(f"{what} of {size} exceeds the limit of {limit}")
    return size


ZSTD_FRAME = b"\x28\xb5\x2f\xfd"
MESSAGE = "a message"


class _Zstd(threading.local):
    """A decompressor for each thread, because it has a state that two must not share."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)


_ZSTD = _Zstd()


def decompress_message(payload: bytes, limit: int) -> bytes:
    """Return a message that was compressed by itself, ``limit`` bytes at most; others as they are.

    rosbag2 does so in its compression mode MESSAGE. No encapsulation header begins like a frame.
    """
    if not payload.startswith(ZSTD_FRAME):
        return payload
    size = zstandard.frame_content_size(payload)
    data = decompress_zstd(
        memoryview(payload), limit if size < 0 else check_limit(MESSAGE, size, limit)
    )
    check_limit(MESSAGE, len(data), limit)
    return data


def decompress_zstd(data: memoryview, size: int) -> bytes:
    """Return at most one byte more than the stated size."""
    # The frame's own size wins over max_output_size: only a true one goes the direct way.
    if zstandard.frame_content_size(data) == size:
        return _ZSTD.decompressor.decompress(data, max_output_size=size, allow_extra_data=False)
    with _ZSTD.decompressor.stream_reader(data, read_across_frames=True) as reader:
        return reader.read(size + 1)
