"""The sensor messages of a bag in the order of live arrival."""

from dataclasses import dataclass
from pathlib import Path

from symbid_ros.bags.container.blocks import read_mcap_blocks
from symbid_ros.bags.container.files import list_files
from symbid_ros.messages.topics import SelectedTopics, Topic, TopicSelection, TopicSelector
from symbid_ros.messages.types import BOOL, read_leading_stamp


@dataclass(frozen=True)
class Feed:
    """Messages in the order of their stamps, as stamp (ns), topic and bytes."""

    selected: SelectedTopics
    messages: tuple[tuple[int, Topic, bytes], ...]

    def between(self, start, stop):
        """Return the messages from ``start`` up to ``stop``, s."""
        inside = [message for message in self.messages if start <= message[0] * 1e-9 < stop]
        return Feed(self.selected, tuple(inside))

    def without(self, name):
        """Return the messages of all topics but one."""
        left = [message for message in self.messages if message[1].name != name]
        return Feed(self.selected, tuple(left))

    def into(self, live, *, solving=0.0):
        """Feed the messages, solve every ``solving`` seconds unless 0, and return the estimates."""
        outcomes = []
        due = self.messages[0][0] + round(solving * 1e9)
        for stamp, topic, payload in self.messages:
            live.intake.feed(topic, payload)
            if solving and stamp >= due:
                outcomes.append(live.solve())
                due = stamp + round(solving * 1e9)
        return outcomes


def feed_of(bag: Path, selection: TopicSelection | None = None) -> Feed:
    """Return the sensor messages of a bag."""
    selector = TopicSelector(str(bag), selection or TopicSelection())
    messages = []
    newest = 0
    for file in list_files(bag):
        for block in read_mcap_blocks(file):
            places = []
            for topic, spans in block.spans.items():
                selector.counts[topic] = selector.counts.get(topic, 0) + len(spans)
                if selector.wants(topic):
                    places += [(at, size, topic) for at, size in spans.tolist()]
            for at, size, topic in sorted(places, key=lambda place: place[0]):
                payload = block.data[at : at + size].tobytes()
                # A flag has no stamp, and arrives after the message that was recorded before it.
                stamp = newest if topic.msgtype == BOOL else read_leading_stamp(payload)
                newest = max(newest, stamp)
                messages.append((stamp, topic, payload))
    messages.sort(key=lambda one: (one[0], one[1].msgtype == BOOL, one[1].name))
    return Feed(selector.select(), tuple(messages))
