"""Damage MCAP files on purpose, reproducibly for a seed."""

import struct
from collections.abc import Callable
from random import Random

RECORD = struct.Struct("<BQ")
EXTREMES = (0, 1, 0x7F, 0xFFFF, 2**31 - 1, 2**31, 2**32 - 1, 2**40, 2**63 - 1, 2**63, 2**64 - 1)
MAGIC = 8
CHUNK, MESSAGE_INDEX, CHANNEL, MESSAGE, FOOTER = 6, 7, 4, 5, 2
SUMMARY = (0x02, 0x08, 0x0A, 0x0B, 0x0D, 0x0E)

Mutation = Callable[[bytearray, Random], None]


def records(image: bytes | bytearray) -> list[tuple[int, int, int]]:
    """Return opcode, start and end of the records outside of chunks, as far as framing is valid."""
    found, position = [], MAGIC
    while position + RECORD.size <= len(image) - MAGIC:
        opcode, length = RECORD.unpack_from(image, position)
        end = position + RECORD.size + length
        if end > len(image) - MAGIC:
            break
        found.append((opcode, position, end))
        position = end
    return found


def _record(image: bytearray, draw: Random, *opcodes: int) -> tuple[int, int]:
    places = [(start, end) for opcode, start, end in records(image) if opcode in opcodes]
    if not places:
        places = [(start, end) for _, start, end in records(image)] or [(0, len(image))]
    return draw.choice(places)


def _any_record(image: bytearray, draw: Random) -> tuple[int, int]:
    return _record(image, draw)


def flip_bits(image: bytearray, draw: Random) -> None:
    for _ in range(draw.choice((1, 1, 1, 2, 8, 64))):
        image[draw.randrange(len(image))] ^= 1 << draw.randrange(8)


def flip_bits_outside_of_chunks(image: bytearray, draw: Random) -> None:
    places = [(a, b) for opcode, a, b in records(image) if opcode != CHUNK] or [(0, len(image))]
    start, end = draw.choice(places)
    image[draw.randrange(start, end)] ^= 1 << draw.randrange(8)


def flip_bits_at_the_head_of_a_record(image: bytearray, draw: Random) -> None:
    start, end = _any_record(image, draw)
    image[draw.randrange(start, min(end, start + 50))] ^= 1 << draw.randrange(8)


def overwrite(image: bytearray, draw: Random) -> None:
    start = draw.randrange(len(image))
    length = min(draw.choice((1, 8, 100, 5000)), len(image) - start)
    image[start : start + length] = draw.choice((bytes(length), draw.randbytes(length)))


def cut_the_end(image: bytearray, draw: Random) -> None:
    del image[draw.randrange(len(image)) :]


def cut_out(image: bytearray, draw: Random) -> None:
    start = draw.randrange(len(image))
    del image[start : start + draw.choice((1, 7, 100, 5000))]


def insert(image: bytearray, draw: Random) -> None:
    start = draw.randrange(len(image))
    image[start:start] = draw.randbytes(draw.choice((1, 8, 300)))


def append(image: bytearray, draw: Random) -> None:
    image += draw.choice((draw.randbytes(100), bytes(5000), bytes(image), bytes(image[-37:])))


def remove_record(image: bytearray, draw: Random) -> None:
    start, end = _any_record(image, draw)
    del image[start:end]


def repeat_record(image: bytearray, draw: Random) -> None:
    start, end = _any_record(image, draw)
    image[end:end] = image[start:end]


def move_record(image: bytearray, draw: Random) -> None:
    start, end = _any_record(image, draw)
    record = bytes(image[start:end])
    del image[start:end]
    place, _ = _any_record(image, draw)
    image[place:place] = record


def swap_records(image: bytearray, draw: Random) -> None:
    (a, b), (c, d) = sorted((_any_record(image, draw), _any_record(image, draw)))
    if b <= c:
        image[a:d] = image[c:d] + image[b:c] + image[a:b]


def copy_record(image: bytearray, draw: Random) -> None:
    start, end = _any_record(image, draw)
    record = bytes(image[start:end])
    place, _ = _any_record(image, draw)
    image[place:place] = record


def overwrite_length(image: bytearray, draw: Random) -> None:
    start, _ = _any_record(image, draw)
    struct.pack_into("<Q", image, start + 1, draw.choice(EXTREMES))


def overwrite_number(image: bytearray, draw: Random) -> None:
    """Overwrite a number: a size, count, string length or time may be anywhere."""
    start, end = _any_record(image, draw)
    form, size = draw.choice((("<Q", 8), ("<I", 4), ("<H", 2)))
    place = draw.randrange(start, max(start + 1, min(end, start + 60) - size))
    if place + size <= len(image):
        struct.pack_into(form, image, place, draw.choice(EXTREMES) % (1 << 8 * size))


def change_index(image: bytearray, draw: Random) -> None:
    start, end = _record(image, draw, MESSAGE_INDEX)
    entries = max(1, (end - start - 15) // 16)
    place = start + 15 + 16 * draw.randrange(entries) + draw.choice((0, 8))
    if place + 8 <= len(image):
        struct.pack_into("<Q", image, place, draw.choice((*EXTREMES, draw.randrange(10_000))))


def change_summary(image: bytearray, draw: Random) -> None:
    start, end = _record(image, draw, *SUMMARY)
    place = draw.randrange(start + RECORD.size, max(start + RECORD.size + 1, end - 8))
    if place + 8 <= len(image):
        number = draw.choice((*EXTREMES, draw.randrange(len(image))))
        struct.pack_into("<Q", image, place, number)


def change_channel(image: bytearray, draw: Random) -> None:
    start, _ = _record(image, draw, CHANNEL, MESSAGE_INDEX, MESSAGE)
    place = start + RECORD.size + draw.choice((0, 0, 2))
    if place + 2 <= len(image):
        struct.pack_into("<H", image, place, draw.choice((0, 1, 2, 3, 4, 9, 65535)))


MUTATIONS: tuple[Mutation, ...] = (
    flip_bits,
    flip_bits_outside_of_chunks,
    flip_bits_at_the_head_of_a_record,
    overwrite,
    cut_the_end,
    cut_out,
    insert,
    append,
    remove_record,
    repeat_record,
    move_record,
    swap_records,
    copy_record,
    overwrite_length,
    overwrite_number,
    change_index,
    change_summary,
    change_channel,
)


def mutated(image: bytes, draw: Random) -> tuple[bytes, list[str]]:
    """Return the image damaged in one to three ways, and their names."""
    spoiled = bytearray(image)
    names = []
    for _ in range(draw.choice((1, 1, 1, 2, 3))):
        if len(spoiled) > 2 * MAGIC:
            mutation = draw.choice(MUTATIONS)
            mutation(spoiled, draw)
            names.append(mutation.__name__)
    return bytes(spoiled), names
