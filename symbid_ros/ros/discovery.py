"""Which topics of the graph are recorded, and the watch for them."""

import re
from collections.abc import Callable
from dataclasses import dataclass, field

from rclpy.node import Node

from symbid_ros.errors import SymbidError
from symbid_ros.messages.definitions import find_definition
from symbid_ros.ros.raw_subscription import PolledGroup, RawSubscription, subscribe


@dataclass(frozen=True)
class TopicFilter:
    """Which topics are wanted: those named, or all that match.

    Attributes
    ----------
    names : tuple of str
        Relative to the node's namespace, unless they begin with a slash.
    include : regular expression or None
        Found in the full name of whatever is wanted besides; None for nothing. Hidden topics,
        with a part that begins with an underscore, must be named.
    exclude : regular expression or None
        Found in the full names that are not wanted after all.
    """

    names: tuple[str, ...] = ()
    include: re.Pattern[str] | None = None
    exclude: re.Pattern[str] | None = None

    def matches(self, topic: str) -> bool:
        """Tell whether a topic that is not named is wanted."""
        return (
            self.include is not None
            and "/_" not in topic
            and self.include.search(topic) is not None
            and self.permits(topic)
        )

    def permits(self, topic: str) -> bool:
        """Tell whether a topic is not excluded."""
        return self.exclude is None or self.exclude.search(topic) is None


@dataclass
class TopicDiscovery:
    """Subscribes to wanted topics as soon as the graph shows a publisher.

    Parameters
    ----------
    node : Node
    wanted : TopicFilter
    depth : int
        Messages that each may keep waiting.
    """

    node: Node
    wanted: TopicFilter
    depth: int
    _group: PolledGroup = field(default_factory=PolledGroup)
    _seen: set[str] = field(default_factory=set)

    def __post_init__(self) -> None:
        names = map(self.node.resolve_topic_name, self.wanted.names)
        self._missing = {name for name in names if self.wanted.permits(name)}

    @property
    def missing(self) -> tuple[str, ...]:
        """Topics that were named and have had no publisher so far."""
        return tuple(sorted(self._missing))

    @property
    def is_complete(self) -> bool:
        """Whether nothing more can turn up."""
        return not self._missing and self.wanted.include is None

    def look(
        self,
        announce: Callable[[RawSubscription], None],
        refuse: Callable[[str, SymbidError], None],
    ) -> None:
        """Subscribe to what has appeared and announce each.

        Parameters
        ----------
        announce : callable
            Told of each topic subscribed to.
        refuse : callable
            Told of each topic that merely matches and is of a type that is not installed.

        Raises
        ------
        SymbidError
            When a topic that was named is of such a type.
        """
        for topic in self.missing:
            if self._subscribe(topic, announce):
                self._missing.discard(topic)
        if self.wanted.include is None:
            return
        for topic, _ in self.node.get_topic_names_and_types():
            if topic in self._seen or topic in self._missing or not self.wanted.matches(topic):
                continue
            try:
                self._subscribe(topic, announce)
            except SymbidError as error:
                self._seen.add(topic)
                refuse(topic, error)

    def _subscribe(self, topic: str, announce: Callable[[RawSubscription], None]) -> bool:
        publishers = self.node.get_publishers_info_by_topic(topic)
        if not publishers:
            return False
        find_definition(publishers[0].topic_type)
        subscription = subscribe(self.node, topic, self.depth, self._group)
        if subscription is None:
            return False
        self._seen.add(topic)
        announce(subscription)
        return True
