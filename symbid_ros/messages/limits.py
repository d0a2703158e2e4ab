"""Limits on the sizes that files state about themselves, and decompression within them.

Bags may come from untrusted sources. Each stated size is checked against one of these limits before
memory is allocated, so that reading a file of any content takes less than 512 MB. Real recordings
stay far below the limits.
"""

import threading

import zstandard

MIB = 1 << 20

MAX_CHUNK = 96 * MIB
"""Bytes of a chunk, compressed and decompressed, and of a message outside of chunks. Writers close
a chunk of up to 64 MiB after the message that fills it, which may have tens of megabytes."""

MAX_EXPANSION = 1000
"""Compression ratio of chunks larger than `ANY_RATIO_SIZE`. Sensor messages reach 2 to 10, blank
images some hundred, and decompression bombs 30 000."""

ANY_RATIO_SIZE = 16 * MIB
"""Bytes that a chunk may decompress to at any ratio: one blank image or map may need as many."""

MAX_WINDOW = 32 * MIB
"""Bytes of a zstd frame's window; level 19 uses 8 MiB."""

MAX_RECORD = 16 * MIB
"""Bytes of a schema, channel, statistics or chunk index record, including its strings and maps.
The definition of the largest common message type takes 20 kB."""

MAX_REGISTRY = 64 * MIB
"""Bytes of all schemas and channels of a file; 500 topics take about 2 MB."""

MAX_CHANNELS = 4096
"""Channels, and schemas, of a file; large robots publish some hundred topics."""

MAX_EXTENTS = 1_000_000
"""Chunks of a file. At 64 KiB each they make 64 GB, most of a day of four sensors at 1 kHz."""

MAX_MESSAGE = 256 * 1024
"""Bytes of a decoded sensor message; 1000 joints take 60 kB. Other topics are not decoded."""

MAX_NAMES = 4096
"""Strings of a decoded sensor message, most of them joint names."""

MAX_DEFINITION = 64 * 1024
"""Bytes of the definition of a decoded type; those of ROS 2 take 6 kB."""

MAX_METADATA = 8 * MIB
"""Bytes of a metadata.yaml; 500 topics with eight publishers each take about 2 MB."""

MAX_YAML_NODES = 250_000
"""Keys, values and lists of a metadata.yaml or a quality of service, with YAML aliases expanded.
500 topics with eight publishers each take 100 000."""

MAX_QOS = 64 * 1024
"""Bytes of a topic's offered_qos_profiles; 100 publishers take 40 kB."""


ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
MESSAGE = "a message"


class OverLimitError(ValueError):
    """A size stated by a file exceeds its limit."""


def check_limit(what: str, size: int, limit: int) -> int:
    """Return a size that a file states, checked against its limit.

    Raises
    ------
    OverLimitError
        With the size and the limit in its message.
    """
    if size > limit:
        raise OverLimitError(f"{what} of {size} exceeds the limit of {limit}")
    return size


class _Zstd(threading.local):
    """One decompressor for each thread: its state must not be shared."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)


_ZSTD = _Zstd()


def decompress_message(payload: bytes, limit: int) -> bytes:
    """Decompress a message of at most ``limit`` bytes; return one that is not compressed as it is.

    In its compression mode MESSAGE, rosbag2 compresses each message by itself. No encapsulation
    header equals the first bytes of a zstd frame.
    """
    if not payload.startswith(ZSTD_MAGIC):
        return payload
    size = zstandard.frame_content_size(payload)
    data = decompress_zstd(
        memoryview(payload), limit if size < 0 else check_limit(MESSAGE, size, limit)
    )
    check_limit(MESSAGE, len(data), limit)
    return data


def decompress_zstd(data: memoryview, size: int) -> bytes:
    """Decompress, and stop one byte after the stated size."""
    # zstandard obeys the frame's own size rather than max_output_size, so they must agree.
    if zstandard.frame_content_size(data) == size:
        return _ZSTD.decompressor.decompress(data, max_output_size=size, allow_extra_data=False)
    with _ZSTD.decompressor.stream_reader(data, read_across_frames=True) as reader:
        return reader.read(size + 1)
