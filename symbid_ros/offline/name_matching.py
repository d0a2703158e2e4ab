"""Matches names of joints and frames in a log to those of a model."""

import re
from collections.abc import Collection, Mapping, Sequence

# Words that tell nothing about which joint or frame is meant.
EMPTY = frozenset({"joint", "link", "frame", "sensor", "data", "motor", "actuator", "jnt"})
ALIASES = {
    "l": "left",
    "r": "right",
    "lf": "left front",
    "rf": "right front",
    "lh": "left hind",
    "rh": "right hind",
    "fl": "left front",
    "fr": "right front",
    "hl": "left hind",
    "rl": "left hind",
    "hr": "right hind",
    "rr": "right hind",
    "rear": "hind",
    "sole": "foot",
}
LEAST = 0.5  # smallest similarity of a match
ANY = 1e-9  # of a guess


def match_names(
    recorded: Sequence[str], wanted: Sequence[str]
) -> tuple[dict[str, str], tuple[str, ...]]:
    """Match names one to one.

    Equal names match first, then names whose words agree, such as ``arm_elbow`` and
    ``elbow_joint``. What remains is guessed if the counts are equal: names that share any word
    first, such as ``wrist_pitch`` and ``wrist_flex``, then the rest in its order, such as ``j1`` to
    ``j6`` and the six joints of an arm. Names that differ by their numbers alone have the order of
    these, others that of the log, as drivers usually list joints from the base to the tip.

    Parameters
    ----------
    recorded, wanted : sequence of str
        Names in a log and in a model, each in its order.

    Returns
    -------
    matches : dict of str to str
        Names in the model by names in the log.
    guessed : tuple of str
        Names in the log whose match is a guess.
    """
    found = {name: name for name in recorded if name in wanted}
    found |= _similar(*_unmatched(recorded, wanted, found))
    left, open_ = _unmatched(recorded, wanted, found)
    if len(left) != len(open_):
        return found, ()
    found |= _similar(left, open_, least=ANY)
    rest, open_ = _unmatched(recorded, wanted, found)
    if len({re.sub(r"\d+", "0", name) for name in rest}) == 1:
        rest.sort(key=_natural)
    return found | dict(zip(rest, open_, strict=True)), tuple(left)


def joints_by_robot(recorded: Sequence[str], wanted: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return the joints of each robot in a log whose names are a prefix and those of a model.

    Parameters
    ----------
    recorded, wanted : sequence of str
        Names in a log and in a model.

    Returns
    -------
    dict of str to dict of str to str
        Names in the model by names in the log, by prefix, such as ``left_``.
    """
    if not wanted:
        return {}
    first, *_ = wanted
    prefixes = [name.removesuffix(first) for name in recorded if name.endswith(first)]
    groups = {one: {f"{one}{name}": name for name in wanted} for one in prefixes}
    return {one: pairs for one, pairs in groups.items() if pairs.keys() <= set(recorded)}


def _unmatched(
    recorded: Sequence[str], wanted: Sequence[str], found: Mapping[str, str]
) -> tuple[list[str], list[str]]:
    taken = set(found.values())
    return [one for one in recorded if one not in found], [
        one for one in wanted if one not in taken
    ]


def most_similar(name: str, context: str, wanted: Sequence[str]) -> str | None:
    """Return the wanted name that is most similar to a name or its context, such as its topic."""
    others = {one: _words(one) for one in wanted}
    return _best(_words(name), others) or _best(_words(f"{context} {name}"), others)


def _similar(
    recorded: Sequence[str], wanted: Sequence[str], least: float = LEAST
) -> dict[str, str]:
    """Return pairs of names that are each other's only best match."""
    first, second = _distinctive(recorded), _distinctive(wanted)
    pairs = ((name, _best(words, second, least)) for name, words in first.items())
    return {
        name: match
        for name, match in pairs
        if match is not None and _best(second[match], first, least) == name
    }


def _best(
    words: frozenset[str], others: Mapping[str, frozenset[str]], least: float = LEAST
) -> str | None:
    """Return the name with the most similar words; None if there is none or several."""
    scores = sorted((_similarity(words, its), name) for name, its in others.items())
    if not scores or scores[-1][0] < least:
        return None
    return None if len(scores) > 1 and scores[-1][0] == scores[-2][0] else scores[-1][1]


def _similarity(words: frozenset[str], others: frozenset[str]) -> float:
    """Return the share of words that both have; numbers alone must all be equal."""
    both = words & others
    is_number = all(word.isdigit() for word in both)
    return 0.0 if is_number and words != others else len(both) / max(len(words | others), 1)


def _distinctive(names: Collection[str]) -> dict[str, frozenset[str]]:
    """Return the words of each name, without those that all names begin or end with."""
    words = {name: _word_list(name) for name in names}
    if len(words) > 1:
        for end in (0, -1):
            while all(words.values()) and len({its[end] for its in words.values()}) == 1:
                for its in words.values():
                    del its[end]
    return {name: frozenset(its) - EMPTY for name, its in words.items()}


def _words(name: str) -> frozenset[str]:
    return frozenset(_word_list(name)) - EMPTY


def _word_list(name: str) -> list[str]:
    spaced = re.sub(r"([a-z])([A-Z])", r"\1 \2", name)
    parts = re.findall(r"[a-z]+|[0-9]+", spaced.lower())
    full = " ".join(ALIASES.get(part, part) for part in parts).split()
    return [part.lstrip("0") or "0" for part in full]


def _natural(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts j2 before j10."""
    return [(int(part or 0), word) for word, part in re.findall(r"(\D*)(\d*)", name)]
