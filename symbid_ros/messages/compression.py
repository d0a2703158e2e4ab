"""Messages that were compressed one by one, unpacked within limits."""

import threading

import zstandard

from symbid_ros.messages.limits import MAX_WINDOW, within

ZSTD_FRAME = b"\x28\xb5\x2f\xfd"
MESSAGE = "a message"


class _Zstd(threading.local):
    """A decompressor for each thread, because it has a state that two must not share."""

    def __init__(self) -> None:
        self.decompressor = zstandard.ZstdDecompressor(max_window_size=MAX_WINDOW)


_ZSTD = _Zstd()


def unpacked_message(payload: bytes, limit: int) -> bytes:
    """Return a message that was compressed by itself, ``limit`` bytes at most; others as they are.

    rosbag2 does so in its compression mode MESSAGE. No encapsulation header begins like a frame.
    """
    if not payload.startswith(ZSTD_FRAME):
        return payload
    size = zstandard.frame_content_size(payload)
    data = unpacked_zstd(memoryview(payload), limit if size < 0 else within(MESSAGE, size, limit))
    within(MESSAGE, len(data), limit)
    return data


def unpacked_zstd(data: memoryview, size: int) -> bytes:
    """Return at most one byte more than the stated size."""
    # The frame's own size wins over max_output_size: only a true one goes the direct way.
    if zstandard.frame_content_size(data) == size:
        return _ZSTD.decompressor.decompress(data, max_output_size=size, allow_extra_data=False)
    with _ZSTD.decompressor.stream_reader(data, read_across_frames=True) as reader:
        return reader.read(size + 1)
