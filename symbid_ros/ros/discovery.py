"""Discovery of the topics to record."""

import re
from collections.abc import Callable
from dataclasses import dataclass

from rclpy.node import Node

from symbid_ros.errors import SymbidError
from symbid_ros.messages.definitions import find_definition
from symbid_ros.ros.raw_subscription import PolledGroup, RawSubscription, subscribe


@dataclass(frozen=True)
class TopicFilter:
    """Selects topics by name or by regular expression.

    Attributes
    ----------
    names : tuple of str
        Topic names, relative to the node's namespace unless they begin with a slash.
    include : regular expression or None
        Also selects topics whose full name contains a match; None selects none. Hidden topics,
        which have a part that begins with an underscore, must be named.
    exclude : regular expression or None
        Excludes topics whose full name contains a match.
    """

    names: tuple[str, ...] = ()
    include: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None

    def matches(self, topic: str) -> bool:
        """Return whether ``include`` selects a topic."""
        return (
            self.include is not None
            and "/_" not in topic
            and self.include.search(topic) is not None
            and self.permits(topic)
        )

    def permits(self, topic: str) -> bool:
        """Return whether ``exclude`` leaves a topic in."""
        return self.exclude is None or self.exclude.search(topic) is None


class TopicDiscovery:
    """Subscribes to each wanted topic as soon as it has a publisher, with queues of ``depth``."""

    def __init__(self, node: Node, wanted: TopicFilter, depth: int) -> None:
        self.wanted = wanted
        self._node, self._depth = node, depth
        self._group = PolledGroup()
        self._seen: set[str] = set()
        names = map(node.resolve_topic_name, wanted.names)
        self._missing = {name for name in names if wanted.permits(name)}

    @property
    def missing(self) -> tuple[str, ...]:
        """Named topics that have had no publisher yet."""
        return tuple(sorted(self._missing))

    @property
    def is_complete(self) -> bool:
        """Whether all wanted topics have been found."""
        return not self._missing and self.wanted.include is None

    def update(
        self,
        on_found: Callable[[RawSubscription], None],
        on_skip: Callable[[str, SymbidError], None],
    ) -> None:
        """Subscribe to topics that have appeared and report each new subscription.

        A type that is not installed raises a SymbidError for a named topic. For a topic that only
        matches a pattern, the error is reported as the reason why it is skipped.
        """
        for topic in self.missing:
            if self._subscribe(topic, on_found):
                self._missing.discard(topic)
        if self.wanted.include is None:
            return
        for topic, _ in self._node.get_topic_names_and_types():
            if topic in self._seen or topic in self._missing or not self.wanted.matches(topic):
                continue
            try:
                self._subscribe(topic, on_found)
            except SymbidError as error:
                self._seen.add(topic)
                on_skip(topic, error)

    def _subscribe(self, topic: str, on_found: Callable[[RawSubscription], None]) -> bool:
        publishers = self._node.get_publishers_info_by_topic(topic)
        if not publishers:
            return False
        find_definition(publishers[0].topic_type)
        subscription = subscribe(self._node, topic, self._depth, self._group)
        if subscription is None:
            return False
        self._seen.add(topic)
        on_found(subscription)
        return True
