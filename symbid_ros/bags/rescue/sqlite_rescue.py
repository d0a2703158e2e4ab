"""The messages of an SQLite file into a new bag."""

from dataclasses import dataclass, field, replace
from pathlib import Path

from symbid_ros.bags.container.catalogue import ROS2_TEXT, Catalogue
from symbid_ros.bags.container.sqlite import opened_database, read_catalogue, warn_of_leftovers
from symbid_ros.bags.rescue.account import Account
from symbid_ros.bags.rescue.recovery import LostStretch
from symbid_ros.bags.rescue.rewriting import RewrittenBag
from symbid_ros.bags.rescue.sqlite_salvage import RowGap, SqliteSalvage
from symbid_ros.errors import BagError
from symbid_ros.messages.definitions import find_definition
from symbid_ros.messages.topics import Topic


@dataclass
class SqliteRescue:
    """Copies the messages of one SQLite file that can be read."""

    file: Path
    new: RewrittenBag
    account: Account
    holes: list[LostStretch] = field(default_factory=list)

    def run(self) -> None:
        """Copy what the file holds and keep account of it."""
        if not self.file.stat().st_size:
            self.account.holes.append(LostStretch(self.file.name, 0, 0, "empty"))
            self.account.is_counted = False
            return
        warn_of_leftovers(self.file)
        with opened_database(self.file, is_damaged=True) as database:
            catalogue = read_catalogue(database)
            _complete_definitions(catalogue)
            targets = {
                number: self.new.channel(catalogue, channel)
                for number, channel in catalogue.channels.items()
            }
            topics = {
                number: Topic(channel.topic, catalogue.msgtype(channel))
                for number, channel in catalogue.channels.items()
            }
            for topic in topics.values():
                self.account.told[topic] += 0
            latest: int | None = None
            for piece in SqliteSalvage(database, targets).pieces():
                if isinstance(piece, RowGap):
                    self._lose(piece, latest)
                    continue
                latest = piece.log_time
                self.holes = [h if h.before else replace(h, before=latest) for h in self.holes]
                self.new.write(targets[piece.topic], latest, latest, piece.payload, sequence=0)
                self.account.kept[topics[piece.topic]] += 1
                self.account.told[topics[piece.topic]] += 1
        self.account.holes += self.holes

    def _lose(self, gap: RowGap, after: int | None) -> None:
        """Count lost rows; rosbag2 numbers them from 1 without gaps."""
        first = max(gap.first, 1)
        count = 0 if gap.stop is None else max(gap.stop - first, 0)
        last = "the last" if gap.stop is None else f"{gap.stop - 1}"
        self.holes.append(
            LostStretch(
                self.file.name,
                0,
                0,
                f"rows {first} to {last}: {gap.fault}",
                after=after,
                messages=count,
                is_counted=gap.stop is not None,
            )
        )
        self.account.unassigned += count
        self.account.is_counted &= gap.stop is not None


def _complete_definitions(catalogue: Catalogue) -> None:
    """Add the definitions of known types: before Jazzy, SQLite bags have none."""
    for number, schema in catalogue.schemas.items():
        if schema.data:
            continue
        try:
            definition = find_definition(schema.name)
        except BagError:
            continue
        schema.encoding, schema.data = ROS2_TEXT, definition.text.encode()
        metadata = catalogue.channels[number].metadata
        metadata["topic_type_hash"] = metadata["topic_type_hash"] or definition.type_hash
