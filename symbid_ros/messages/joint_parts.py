"""Joint states of one topic split by the joints that its messages name.

Drivers of arms and legs may share a topic, each publishing its own joints alone.
"""

from collections import Counter

import numpy as np

from symbid_ros.messages.decoder import Piece, TopicDecoder
from symbid_ros.messages.types import read_stamp
from symbid_ros.signals.defects import Defect, Tally

# Without a model, joints count as the robot's if this share as many messages name them.
SIMILAR = 0.5


def joint_parts(
    decoder: TopicDecoder, needed: frozenset[str], tally: Tally
) -> tuple[TopicDecoder, ...]:
    """Return the messages of a topic, one decoder for each group of joints published together.

    Parameters
    ----------
    decoder : TopicDecoder
        Of a JointState topic.
    needed : frozenset of str
        Joints of the model; messages that name none of them are counted and ignored. Where it is
        empty, groups that about as many messages name as the most frequent one are parts.
    tally : Tally
        Of the topic.
    """
    groups = joint_groups(decoder, needed)
    if not groups:
        return (decoder,)
    members: list[list[Piece]] = [[] for _ in groups]
    for piece in decoder.pieces:
        names = _names(piece)
        if needed and names and not names & needed:
            tally.add(
                Defect.OTHER_JOINTS,
                read_stamp(piece.records),
                np.ones(len(piece.index), dtype=bool),
            )
            continue
        shared = [len(group & names) for group in groups]
        members[shared.index(max(shared))].append(piece)
    return tuple(_of_pieces(decoder, pieces) for pieces in members)


def joint_groups(decoder: TopicDecoder, needed: frozenset[str]) -> list[frozenset[str]]:
    """Return which joints of a topic are published together; nothing if all messages agree."""
    counts: Counter[frozenset[str]] = Counter()
    for piece in decoder.pieces:
        counts[_names(piece)] += len(piece.index)
    counts.pop(frozenset(), None)
    return _groups(counts, needed) if len(counts) > 1 else []


def _names(piece: Piece) -> frozenset[str]:
    return frozenset(piece.layout.text["name"])


def _groups(counts: Counter[frozenset[str]], needed: frozenset[str]) -> list[frozenset[str]]:
    """Return the groups of joints; their order depends on their names alone."""
    most = max(counts.values())
    groups: list[frozenset[str]] = []
    covered: set[str] = set()
    for names, count in sorted(counts.items(), key=lambda entry: (-entry[1], sorted(entry[0]))):
        own = names & needed if needed else names
        # Messages that share a joint are of one driver, some of them incomplete.
        if own and not own & covered and (needed or count >= SIMILAR * most):
            groups.append(names)
            covered |= own
    return sorted(groups, key=sorted)


def _of_pieces(decoder: TopicDecoder, pieces: list[Piece]) -> TopicDecoder:
    """Return a decoder of some of the pieces, their messages numbered anew in the same order."""
    index = np.sort(np.concatenate([piece.index for piece in pieces]))
    renumbered = [
        Piece(piece.layout, np.searchsorted(index, piece.index), piece.records) for piece in pieces
    ]
    return TopicDecoder(decoder.source, decoder.topic, renumbered, len(index))
