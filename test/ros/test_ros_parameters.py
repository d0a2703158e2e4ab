"""Parameters that can be set while a node runs, and values that are refused."""

from collections.abc import Iterator

import pytest
import rclpy
from rclpy.context import Context
from rclpy.node import Node
from rclpy.parameter import Parameter as Given

from symbid_ros.errors import DataError
from symbid_ros.ros.parameters import Parameter, ParameterError, declare, watch

PARAMETERS = (
    Parameter("depth", 10, "Fixed.", minimum=1),
    Parameter("count", 3, "Whole.", minimum=1, maximum=5, live=True),
    Parameter("mass", 0.0, "Bounded.", minimum=0.0, maximum=100.0, live=True),
    Parameter("offset", 0.0, "Of any size.", live=True),
    Parameter("place", [0.0, 0.0, 0.0], "Vector.", minimum=-1.0, maximum=1.0, live=True),
    Parameter("mode", "slow", "One of two.", choices=("slow", "fast"), live=True),
    Parameter("on", False, "Switch.", live=True),
    Parameter("links", [""], "Texts.", live=True),
)


@pytest.fixture
def node(domain: int) -> Iterator[Node]:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("subject", context=context)
    yield node
    node.destroy_node()
    context.try_shutdown()


def test_an_accepted_change_is_reported_once_with_all_live_values(node: Node) -> None:
    changes: list[dict] = []
    values = declare(node, PARAMETERS)
    watch(node, PARAMETERS, changes.append)
    assert node.set_parameters([Given("mass", value=2.5)])[0].successful
    assert node.set_parameters([Given("mass", value=2.5)])[0].successful
    together = [Given("place", value=[0.0, 0.5, -1.0]), Given("mode", value="fast")]
    assert node.set_parameters_atomically(together).successful
    del values["depth"]
    first = values | {"mass": 2.5}
    assert changes == [first, first | {"place": [0.0, 0.5, -1.0], "mode": "fast"}]


@pytest.mark.parametrize(
    ("name", "value", "reason"),
    [
        ("depth", 11, "read-only"),
        ("count", 2.0, "Wrong parameter type"),
        ("count", 6, "out of range"),
        ("mass", 2, "Wrong parameter type"),
        ("mass", "heavy", "Wrong parameter type"),
        ("mass", -0.5, "out of range"),
        ("mass", float("nan"), "out of range"),
        ("offset", float("inf"), "out of range"),
        (
            "place",
            [0.0, 0.0],
            "parameter place: [0.0, 0.0] is not valid; give a list of 3 num",
        ),
        ("place", [0.0, 0.0, 1.5], "with decimal points at least -1 and at most 1"),
        ("place", [0.0, float("nan"), 0.0], "parameter place: "),
        ("place", ["a", "b", "c"], "Wrong parameter type"),
        ("mode", "idle", "parameter mode: 'idle' is not valid; give one of slow, fast"),
        ("on", 1, "Wrong parameter type"),
        ("links", 5, "parameter links: [5] is not valid; give a text or a list of texts"),
        ("links", [1, 2], "parameter links: [1, 2] is not valid"),
    ],
)
def test_a_refused_set_says_why_and_changes_nothing(node: Node, name, value, reason) -> None:
    changes: list[dict] = []
    values = declare(node, PARAMETERS)
    watch(node, PARAMETERS, changes.append)
    result = node.set_parameters([Given(name, value=value)])[0]
    assert not result.successful
    assert reason in result.reason
    assert "\n" not in result.reason
    together = [Given("offset", value=1.0), Given(name, value=value)]
    assert not node.set_parameters_atomically(together).successful
    assert changes == []
    held = node.get_parameter(name).value
    assert (list(held) if isinstance(values[name], list) else held) == values[name]
    assert node.get_parameter("offset").value == 0.0


def test_a_single_text_stands_for_a_list_of_one(domain: int) -> None:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    node = Node("subject", context=context, parameter_overrides=[Given("links", value="thigh")])
    changes: list[dict] = []
    assert declare(node, PARAMETERS)["links"] == ["thigh"]
    watch(node, PARAMETERS, changes.append)
    for value in (["shank", "foot"], "foot"):
        assert node.set_parameters([Given("links", value=value)])[0].successful
    assert [values["links"] for values in changes] == [["shank", "foot"], ["foot"]]
    node.destroy_node()
    context.try_shutdown()


def test_no_parameter_can_be_set_before_it_is_watched(node: Node) -> None:
    declare(node, PARAMETERS)
    early = node.set_parameters([Given("mass", value=2.5)])[0]
    assert not early.successful
    assert "still starting" in early.reason
    watch(node, PARAMETERS, lambda values: None)
    assert node.set_parameters([Given("mass", value=2.5)])[0].successful


def test_values_that_contradict_each_other_are_refused(node: Node) -> None:
    def check(values: dict) -> None:
        if values["count"] > 3 and values["mode"] == "fast":
            raise DataError("four are never fast; give count 3 or mode slow", "E501")

    changes: list[dict] = []
    declare(node, PARAMETERS)
    watch(node, PARAMETERS, changes.append, check)
    assert node.set_parameters([Given("count", value=4)])[0].successful
    refused = node.set_parameters([Given("mode", value="fast")])[0]
    assert refused.reason == "four are never fast; give count 3 or mode slow"
    both = [Given("mode", value="fast"), Given("count", value=2)]
    assert node.set_parameters_atomically(both).successful
    assert [values["count"] for values in changes] == [4, 2]


def test_descriptors_tell_type_range_and_choices(node: Node) -> None:
    declare(node, PARAMETERS)
    found = {each.name: node.describe_parameter(each.name) for each in PARAMETERS}
    assert [name for name, each in found.items() if each.read_only] == ["depth"]
    assert all(each.description for each in found.values())
    (depth,) = found["depth"].integer_range
    assert (depth.from_value, depth.to_value, depth.step) == (1, 2**31 - 1, 1)
    for name, low, high in (("mass", 0.0, 100.0), ("place", -1.0, 1.0), ("offset", -1e9, 1e9)):
        (bounds,) = found[name].floating_point_range
        assert (bounds.from_value, bounds.to_value) == (low, high)
    assert found["mode"].additional_constraints == "one of slow, fast"
    assert "a list of 3 numbers" in found["place"].additional_constraints
    assert not found["on"].integer_range


@pytest.mark.parametrize(
    ("name", "value"),
    [("place", [0.0, 2.0, 0.0]), ("place", [0.0]), ("mode", "idle"), ("mass", float("nan"))],
)
def test_a_start_with_a_bad_value_is_refused(domain: int, name, value) -> None:
    context = Context()
    rclpy.init(context=context, domain_id=domain)
    given = [Given(name, value=value)]
    node = Node("subject", context=context, parameter_overrides=given)
    with pytest.raises(ParameterError, match=f"parameter {name}: "):
        declare(node, PARAMETERS)
    node.destroy_node()
    context.try_shutdown()
