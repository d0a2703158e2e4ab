"""An interrupted or damaged bag into an indexed one, with an account of what is missing."""

from contextlib import suppress
from pathlib import Path

from symbid_ros.bags.container.files import bag_metadata, files_present, listed_names
from symbid_ros.bags.container.framing import (
    damage_named,
    other_kind,
)
from symbid_ros.bags.container.sqlite import SQLITE_SUFFIX
from symbid_ros.bags.rescue.account import Account
from symbid_ros.bags.rescue.mcap_rescue import McapRescue
from symbid_ros.bags.rescue.recovery import LostStretch, Recovery
from symbid_ros.bags.rescue.rewriting import RewrittenBag
from symbid_ros.bags.rescue.sqlite_rescue import SqliteRescue
from symbid_ros.bags.writing.new_folder import new_folder
from symbid_ros.errors import BagError
from symbid_ros.messages.topics import Topic

MESSAGE_MODE = "MESSAGE"


def recover(bag: Path, out: Path | None = None) -> Recovery:
    """Write what can be trusted in a bag into a new one.

    Parameters
    ----------
    bag : Path
        A bag's folder or one of its files, finished or not; it is not touched.
    out : Path, optional
        Folder of the new bag, which must not exist. Default: the bag's name with
        ``_recovered``.

    Raises
    ------
    BagError
        When there is no such bag or nothing in it, or the new one cannot be written.
    """
    files = files_present(bag)
    for file in files:
        if file.suffix == SQLITE_SUFFIX:
            continue
        with damage_named(file):
            kind = other_kind(file)
        if kind and len(files) == 1:
            raise BagError(f"{file}: {kind}")
    place = bag.resolve()
    target = out or place.with_name(f"{place.stem if bag.is_file() else place.name}_recovered")
    mode = _compression_mode(bag)
    with new_folder(target) as folder, RewrittenBag(folder, mode) as new:
        account = Account()
        for file in files:
            rescue = SqliteRescue if file.suffix == SQLITE_SUFFIX else McapRescue
            rescue(file, new, account).run()
            new.end_file()
        _count_what_metadata_tell(bag, files, account)
        if not account.kept.total() and not account.records.total():
            raise BagError(f"{bag}: nothing in it can be recovered; take another copy")
        new.finish()
    return account.recovery(bag, target)


def _compression_mode(bag: Path) -> str:
    """Return how rosbag2 compressed messages, which are taken over as they are."""
    with suppress(BagError):
        mode = str(bag_metadata(bag / "metadata.yaml").get("compression_mode", "")).upper()
        return mode if mode == MESSAGE_MODE else ""
    return ""


def _count_what_metadata_tell(bag: Path, files: list[Path], account: Account) -> None:
    """Add what metadata.yaml, written when the recording was finished, tells beyond the files."""
    try:
        information = bag_metadata(bag / "metadata.yaml")
        told = {
            Topic(str(entry["topic_metadata"]["name"]), str(entry["topic_metadata"]["type"])): int(
                entry["message_count"]
            )
            for entry in information["topics_with_message_count"]
        }
    except (BagError, KeyError, TypeError, ValueError):
        return
    missing = {*listed_names(information)} - {file.name for file in files}
    account.holes += [LostStretch(name, 0, 0, "no such file") for name in sorted(missing)]
    names = {topic.name: topic for topic in account.told}
    for topic, count in told.items():
        known = names.get(topic.name, topic)
        account.told[known] = max(account.told[known], count)
    # Where it counts less than was found it belongs to another state of the bag.
    account.is_counted |= sum(told.values()) >= account.kept.total()
