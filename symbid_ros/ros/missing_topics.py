"""What an identifier still waits for, in words that name the parameter to correct."""

from collections.abc import Collection, Mapping, Sequence

from symbid_ros.messages.topics import Topic, TopicSelection
from symbid_ros.messages.types import IMU, JOINT_STATE, WRENCH

Graph = Mapping[str, Sequence[str]]


def missing_topics(
    selection: TopicSelection, found: Collection[Topic], graph: Graph, *, floating: bool
) -> dict[str, str]:
    """Return a message for each topic that is missing, by topic or by kind.

    Parameters
    ----------
    selection : TopicSelection
        Which topics are wanted, with names as the graph has them.
    found : collection of Topic
        Topics subscribed to.
    graph : mapping of str to sequence of str
        Types of each topic that has a publisher.
    floating : bool
        Whether the robot's base floats, so that it needs an IMU.
    """
    missing: dict[str, str] = {}
    names = {topic.name for topic in found}
    for parameter, msgtype, wanted in (
        ("joint_topic", JOINT_STATE, selection.joints),
        ("imu_topics", IMU, selection.imus),
        ("wrench_topics", WRENCH, selection.wrenches),
    ):
        for name in wanted or ():
            if f"/{name.lstrip('/')}" not in names:
                missing[name] = _named(name, msgtype, parameter, graph)
    kinds = {topic.msgtype for topic in found}
    if selection.joints is None and JOINT_STATE not in kinds:
        missing["joint states"] = (
            f"waiting for a topic joint_states of type {JOINT_STATE} in this node's namespace; "
            f"{_others(JOINT_STATE, graph)}; start the robot's driver, or name its topic in the "
            "parameter joint_topic"
        )
    if floating and selection.imus is None and IMU not in kinds:
        missing["IMU"] = (
            f"waiting for a topic of type {IMU} in this node's namespace, which a floating base "
            f"needs; {_others(IMU, graph)}; start the IMU's driver, name its topic in the "
            "parameter imu_topics, or give base:=fixed"
        )
    return missing


def _named(name: str, msgtype: str, parameter: str, graph: Graph) -> str:
    types = graph.get(name, ())
    if types and msgtype not in types:
        return (
            f"parameter {parameter}: topic {name} is of type {', '.join(types)}, not {msgtype}; "
            "name another topic"
        )
    if types:
        return (
            f"waiting for the first message on topic {name} (parameter {parameter}); check its "
            "driver"
        )
    return (
        f"waiting for topic {name} (parameter {parameter}), which nobody publishes; "
        f"{_others(msgtype, graph)}; start its driver or correct the parameter"
    )


def _others(msgtype: str, graph: Graph) -> str:
    names = sorted(name for name, types in graph.items() if msgtype in types)
    return f"topics of that type: {', '.join(names) or 'none'}"
