"""What the terminal says of a bag and of its recovery."""

from collections.abc import Iterator
from datetime import UTC, datetime

from rich import box
from rich.console import Console
from rich.table import Table
from rich.text import Text

from symbid_ros.bags.info import BagInfo, FileInfo
from symbid_ros.bags.recovery.report import LostStretch, Recovery
from symbid_ros.messages.topics import OfferedQos

SHOWN = 20  # holes; a list of thousands tells no more, --json has them all


def print_info(info: BagInfo) -> None:
    """Print a bag's files and topics."""
    console = Console(highlight=False)
    distro = f", ROS 2 {info.ros_distro}" if info.ros_distro else ""
    console.print(Text(f"{info.bag}: {_size(info.size)}{distro}"), soft_wrap=True)
    if info.start is not None and info.end is not None:
        console.print(f"{_time(info.start)} to {_time(info.end)}, {info.duration:.3f} s")
    console.print(f"{info.count} messages")
    for file in info.files:
        console.print(Text(f"{file.name}: {', '.join(_traits(file))}"), soft_wrap=True)
        if file.fault:
            console.print(Text(f"{file.name}: {file.fault}", style="red"), soft_wrap=True)
    table = _table("topic", "type", "messages", "Hz", "publishers")
    for topic in info.topics:
        rate = "–" if topic.rate is None else f"{topic.rate:.4g}"
        qos = ", ".join(dict.fromkeys(map(_qos, topic.qos)))
        table.add_row(Text(topic.name), _type(topic.msgtype), str(topic.count), rate, Text(qos))
    console.print(table)


def print_recovery(recovery: Recovery) -> None:
    """Print what was kept of a bag, what is lost and where."""
    console = Console(highlight=False)
    table = _table("topic", "type", "kept", "lost")
    for topic in recovery.topics:
        missing = Text(str(topic.lost), style="red" if topic.lost else "")
        table.add_row(Text(topic.name), _type(topic.msgtype), str(topic.kept), missing)
    console.print(table)
    for hole in recovery.holes[:SHOWN]:
        console.print(Text(_hole(hole)), soft_wrap=True)
    if len(recovery.holes) > SHOWN:
        console.print(f"and {len(recovery.holes) - SHOWN} more holes, see --json")
    if recovery.repeated:
        console.print(f"{recovery.repeated} chunks were there twice")
    for count, name in (
        (recovery.attachments, "attachments"),
        (recovery.metadata, "metadata records"),
    ):
        if count.kept or count.lost:
            console.print(f"{name}: {count.kept} kept, {count.lost} lost")
    verdict = f"{recovery.kept} messages kept, {recovery.lost} lost"
    if not recovery.is_counted:
        verdict += " for certain, and a number that nothing tells"
    console.print(Text(verdict, style="green" if recovery.is_whole else "red"), soft_wrap=True)
    console.print(Text(f"wrote {recovery.out}"), soft_wrap=True)


def _table(first: str, second: str, *others: str) -> Table:
    """Return a table whose names break where the terminal is narrow, and whose numbers do not."""
    table = Table(pad_edge=False, box=box.SIMPLE_HEAD)
    for name in (first, second):
        table.add_column(name, overflow="fold")
    for name in others:
        is_text = name == "publishers"
        table.add_column(
            name,
            justify="left" if is_text else "right",
            no_wrap=not is_text,
            overflow="fold",
        )
    return table


def _traits(file: FileInfo) -> Iterator[str]:
    yield _size(file.size)
    yield " ".join([file.storage, *file.compression])
    yield "finished" if file.is_finished else "not finished"
    yield "indexed" if file.is_indexed else "not indexed"
    if file.recorded_by:
        yield f"written by {file.recorded_by}"
    for count, name in ((file.attachments, "attachment"), (file.metadata, "metadata record")):
        if count:
            yield f"{count} {name}{'s' if count > 1 else ''}"


def _hole(hole: LostStretch) -> str:
    place = f"bytes {hole.offset} to {hole.offset + hole.length}: " if hole.length else ""
    if hole.after is not None and hole.before is not None:
        when = f", between {_time(hole.after)} and {_time(hole.before)}"
    elif hole.after is not None:
        when = f", after {_time(hole.after)}"
    elif hole.before is not None:
        when = f", before {_time(hole.before)}"
    else:
        when = ""
    number = f"{hole.messages}" if hole.is_counted else f"{hole.messages} or more"
    return f"{hole.file}: {place}{hole.fault}, {number} messages{when}"


def _qos(offer: OfferedQos) -> str:
    depth = f"{offer.depth}" if offer.history == "keep_last" else "all"
    latched = ", latched" if offer.durability == "transient_local" else ""
    return f"{offer.reliability.replace('_', ' ')}, {depth}{latched}"


def _type(msgtype: str) -> Text:
    """Return a type as ROS 2's documentation writes it, which is shorter."""
    return Text(msgtype.replace("/msg/", "/"))


def _time(stamp: int) -> str:
    """Return nanoseconds as a date, or as seconds where they count from no date of ours."""
    seconds, nanoseconds = divmod(stamp, 1_000_000_000)
    if seconds < 1_000_000_000 or seconds > 9_000_000_000:
        return f"{seconds}.{nanoseconds // 1_000_000:03} s"
    date = datetime.fromtimestamp(seconds, UTC)
    return f"{date:%Y-%m-%d %H:%M:%S}.{nanoseconds // 1_000_000:03} UTC"


def _size(size: int) -> str:
    number = float(size)
    for unit in ("B", "kB", "MB"):
        if number < 1000:
            return f"{number:.4g} {unit}"
        number /= 1000
    return f"{number:.4g} GB"
