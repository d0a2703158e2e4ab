"""MCAP files with each combination of the optional features of the format.

The features, their abbreviations and valid combinations are those of MCAP's conformance suite.
"""

import zlib
from collections import Counter
from collections.abc import Iterator, Sequence
from itertools import chain, combinations

from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    Chunk,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Message,
    MessageIndex,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

MAGIC = b"\x89MCAP0\r\n"
PADDING = b"\x01\xff\xff"
CHUNKS, MESSAGE_INDEX, STATISTICS, SCHEMAS, CHANNELS = "ch", "mx", "st", "rsh", "rch"
ATTACHMENT_INDEX, METADATA_INDEX, CHUNK_INDEX = "ax", "mdx", "chx"
SUMMARY_OFFSETS, PADDED = "sum", "pad"
ALL = (
    CHUNKS,
    MESSAGE_INDEX,
    STATISTICS,
    SCHEMAS,
    CHANNELS,
    ATTACHMENT_INDEX,
    METADATA_INDEX,
    CHUNK_INDEX,
    SUMMARY_OFFSETS,
    PADDED,
)
NEEDS = {
    ATTACHMENT_INDEX: Attachment,
    METADATA_INDEX: Metadata,
    SCHEMAS: Schema,
    CHANNELS: Channel,
    CHUNKS: Channel,
}
SUMMARY = {STATISTICS, SCHEMAS, CHANNELS, ATTACHMENT_INDEX, METADATA_INDEX, CHUNK_INDEX}


def feature_sets(records: Sequence[McapRecord]) -> Iterator[frozenset[str]]:
    """Return all valid combinations for some records."""
    kinds = {type(record) for record in records}
    for chosen in chain.from_iterable(combinations(ALL, n) for n in range(len(ALL) + 1)):
        features = frozenset(chosen)
        if any(kind not in kinds for feature, kind in NEEDS.items() if feature in features):
            continue
        if features & {MESSAGE_INDEX, CHUNK_INDEX} and CHUNKS not in features:
            continue
        if SUMMARY_OFFSETS in features and not features & SUMMARY:
            continue
        yield features


def encoded(record: McapRecord, *, padded: bool = False) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data = bytes(builder.end())
    if not padded or isinstance(record, Message | Footer):
        return data
    length = int.from_bytes(data[1:9], "little") + len(PADDING)
    return data[:1] + length.to_bytes(8, "little") + data[9:] + PADDING


def mcap_image(
    records: Sequence[McapRecord], features: frozenset[str], *, backwards: bool = False
) -> bytes:
    """Return the bytes of a file, with all messages in one chunk if chunks are a feature.

    ``backwards`` reverses the groups of the summary, whose order the format does not define.
    """
    padded = PADDED in features

    def bytes_of(record: McapRecord) -> bytes:
        return encoded(record, padded=padded)

    data = bytearray(MAGIC + bytes_of(Header(profile="", library="")))
    inner = bytearray()
    metadata: list[McapRecord] = []
    attachments: list[McapRecord] = []
    places: dict[int, list[tuple[int, int]]] = {}
    times = [record.log_time for record in records if isinstance(record, Message)]
    for record in records:
        block = bytes_of(record)
        if isinstance(record, Attachment):
            attachments.append(
                AttachmentIndex(
                    offset=len(data),
                    length=len(block),
                    log_time=record.log_time,
                    create_time=record.create_time,
                    data_size=len(record.data),
                    name=record.name,
                    media_type=record.media_type,
                )
            )
            data += block
        elif isinstance(record, Metadata):
            metadata.append(MetadataIndex(offset=len(data), length=len(block), name=record.name))
            data += block
        elif CHUNKS in features:
            if isinstance(record, Message):
                places.setdefault(record.channel_id, []).append((record.log_time, len(inner)))
            inner += block
        else:
            data += block
    start, end = min(times, default=0), max(times, default=0)
    chunks: list[McapRecord] = []
    if CHUNKS in features:
        at = len(data)
        chunk = Chunk(
            compression="",
            data=bytes(inner),
            message_start_time=start,
            message_end_time=end,
            uncompressed_crc=zlib.crc32(inner),
            uncompressed_size=len(inner),
        )
        data += bytes_of(chunk)
        length = len(data) - at
        offsets = {}
        for channel, entries in places.items() if MESSAGE_INDEX in features else ():
            offsets[channel] = len(data)
            data += bytes_of(MessageIndex(channel_id=channel, records=entries))
        chunks.append(
            ChunkIndex(
                chunk_length=length,
                chunk_start_offset=at,
                compression="",
                compressed_size=len(inner),
                message_end_time=end,
                message_index_length=len(data) - at - length,
                message_index_offsets=offsets,
                message_start_time=start,
                uncompressed_size=len(inner),
            )
        )
    data += bytes_of(DataEnd(data_section_crc=zlib.crc32(data)))
    counts = Counter(type(record) for record in records)
    by_channel = Counter(record.channel_id for record in records if isinstance(record, Message))
    statistics = Statistics(
        attachment_count=counts[Attachment],
        channel_count=counts[Channel],
        channel_message_counts=dict(by_channel),
        chunk_count=len(chunks),
        message_count=counts[Message],
        message_end_time=end,
        message_start_time=start,
        metadata_count=counts[Metadata],
        schema_count=counts[Schema],
    )
    groups: list[tuple[str, int, Sequence[McapRecord]]] = [
        (SCHEMAS, Opcode.SCHEMA, [r for r in records if isinstance(r, Schema)]),
        (CHANNELS, Opcode.CHANNEL, [r for r in records if isinstance(r, Channel)]),
        (STATISTICS, Opcode.STATISTICS, [statistics]),
        (METADATA_INDEX, Opcode.METADATA_INDEX, metadata),
        (ATTACHMENT_INDEX, Opcode.ATTACHMENT_INDEX, attachments),
        (CHUNK_INDEX, Opcode.CHUNK_INDEX, chunks),
    ]
    if backwards:
        groups.reverse()
    return bytes(data) + _summary(len(data), groups, features, padded=padded)


def _summary(
    start: int,
    groups: Sequence[tuple[str, int, Sequence[McapRecord]]],
    features: frozenset[str],
    *,
    padded: bool,
) -> bytes:
    summary, offsets = bytearray(), bytearray()
    for feature, opcode, group in groups:
        body = b"".join(encoded(record, padded=padded) for record in group)
        if feature in features and body:
            place = SummaryOffset(opcode, start + len(summary), len(body))
            offsets += encoded(place, padded=padded)
            summary += body
    has_offsets = SUMMARY_OFFSETS in features
    footer = Footer(
        summary_start=start if summary else 0,
        summary_offset_start=start + len(summary) if has_offsets else 0,
        summary_crc=0,
    )
    whole = summary + (offsets if has_offsets else b"")
    footer.summary_crc = zlib.crc32(whole + encoded(footer)[:-4])
    return bytes(whole) + encoded(footer) + MAGIC
