"""The shipped layouts of Foxglove and PlotJuggler plot fields that an identifier publishes."""

import json
import re
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree

import pytest
from rclpy.node import Node

from symbid_ros.cli.foxglove import layout_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.ros.estimate_topics import EstimateTopics
from symbid_ros.ros.inertia_markers import (
    BOX,
    CHANGE,
    COM,
    PRIOR_BOX,
    TOTAL_COM,
    UNCERTAINTY,
    InertiaMarkers,
)
from symbid_ros.user_files import load_yaml

AGE = "/identifier: estimate", "age"


@pytest.fixture
def parameters() -> ParameterSet:
    return ParameterSet(load_model(config_file("symbitron.xml")))


@pytest.fixture
def published(graph, parameters: ParameterSet) -> Iterator[dict[str, Any]]:
    """Return an empty message of each topic that an identifier of the Symbitron publishes."""
    node = Node("identifier", context=graph.node.context)
    topics = EstimateTopics(node, parameters), InertiaMarkers(node, parameters)
    yield {publisher.topic_name: publisher.msg_type() for publisher in node.publishers}
    del topics
    node.destroy_node()


def is_number(message: Any, fields: list[str]) -> bool:
    for field in fields:
        message = getattr(message, field)
    return isinstance(message, float)


class TestFoxglove:
    layout = json.loads(config_file("foxglove_layout.json").read_text())
    panels = layout["configById"]

    def paths(self) -> Iterator[tuple[str, str]]:
        for panel in self.panels.values():
            yield from ((path["value"], path["label"]) for path in panel.get("paths", ()))

    def test_shows_each_panel_once(self) -> None:
        def leaves(tree: Any) -> list[str]:
            return (
                [tree]
                if isinstance(tree, str)
                else [*leaves(tree["first"]), *leaves(tree["second"])]
            )

        shown = leaves(self.layout["layout"])
        assert sorted(shown) == sorted(self.panels)
        kinds = {name.split("!")[0] for name in shown}
        assert kinds == {"3D", "Plot", "DiagnosticSummary", "RawMessages"}

    def test_plots_what_is_published(self, published, parameters: ParameterSet) -> None:
        joints = parameters.model.joint_names
        for path, label in self.paths():
            topic, *fields = path.split(".")
            if topic == "/diagnostics":
                assert re.findall(r'"([^"]*)"', path) == list(AGE)
            elif match := re.fullmatch(r"effort\[(\d+)\]", fields[0]):
                assert topic == "/identifier/effort_residual"
                assert label == joints[int(match[1])]
            else:
                assert is_number(published[topic], fields)
                assert topic.endswith((f"/{label}", "wrench_residual"))

    def test_other_panels_show_topics_that_are_published(self, published) -> None:
        topics = {
            panel[key]
            for panel in self.panels.values()
            for key in ("topicToRender", "topicPath")
            if key in panel
        }
        assert topics == {"/diagnostics", "/identifier/estimate"}
        assert "/identifier/estimate" in published

    def test_is_the_one_generated_for_this_robot(self, parameters: ParameterSet) -> None:
        text = config_file("foxglove_layout.json").read_text(encoding="utf-8")
        assert text == layout_text(parameters.model)

    def test_shows_the_robot_and_its_markers(self, published, parameters: ParameterSet) -> None:
        panel = self.panels["3D!robot"]
        assert panel["followTf"] == parameters.model.links[0].name
        assert panel["layers"]["robot"]["topic"] in published
        assert list(panel["topics"]) == ["/identifier/markers"]


class TestRviz:
    root = load_yaml(config_file("symbid.rviz"))
    displays = root["Visualization Manager"]["Displays"]

    def test_shows_what_is_published(self, published) -> None:
        topics = {
            value["Value"]: value
            for display in self.displays
            for value in display.values()
            if isinstance(value, dict) and "Durability Policy" in value
        }
        assert topics.keys() == {"/identifier/robot_description", "/identifier/markers"}
        assert topics.keys() <= published.keys()
        # Only such a subscriber receives the last message of a latched topic.
        assert {one["Durability Policy"] for one in topics.values()} == {"Transient Local"}

    def test_names_each_namespace_of_the_markers(self) -> None:
        (markers,) = [one for one in self.displays if one["Class"].endswith("MarkerArray")]
        assert set(markers["Namespaces"]) == {
            *(BOX, PRIOR_BOX, COM, UNCERTAINTY, TOTAL_COM, CHANGE),
        }

    def test_starts_in_a_frame_of_the_robot(self, parameters: ParameterSet) -> None:
        frame = self.root["Visualization Manager"]["Global Options"]["Fixed Frame"]
        assert frame == parameters.model.links[0].name


class TestPlotJuggler:
    root = ElementTree.parse(config_file("plotjuggler_layout.xml")).getroot()

    def test_plots_what_is_published(self, published, parameters: ParameterSet) -> None:
        made = {snippet.get("name") for snippet in self.root.iter("snippet")}
        curves = {curve.get("name") or "" for curve in self.root.iter("curve")}
        sources = {e.text or "" for tag in ("linked_source", "v1") for e in self.root.iter(tag)}
        assert made <= curves
        for series in (curves | sources) - made:
            if series.startswith("/diagnostics/"):
                # <topic>/<status>/<key>; the statuses have no hardware_id.
                status, _, _ = series.removeprefix("/diagnostics/").rpartition("/")
                assert status == AGE[0]
                continue
            (topic,) = [topic for topic in published if series.startswith(f"{topic}/")]
            fields = series.removeprefix(f"{topic}/").split("/")
            if topic == "/identifier/effort_residual":
                assert fields[0] in parameters.model.joint_names
                assert fields[1:] == ["effort"]
            else:
                assert is_number(published[topic], fields)

    def test_subscribes_to_what_it_plots(self, published) -> None:
        subscribed = {topic.get("name") for topic in self.root.iter("topic")}
        assert subscribed <= published.keys() | {"/diagnostics"}
        curves = [curve.get("name") or "" for curve in self.root.iter("curve")]
        sources = [e.text or "" for tag in ("linked_source", "v1") for e in self.root.iter(tag)]
        for series in (*curves, *sources):
            if series.startswith("/"):
                assert any(series.startswith(f"{topic}/") for topic in subscribed)

    def test_the_bands_are_one_deviation_wide(self) -> None:
        for snippet in self.root.iter("snippet"):
            link, _, side, _ = (snippet.get("name") or "").split()
            sign = {"plus": "+", "minus": "-"}[side]
            assert snippet.findtext("function") == f"return value {sign} v1"
            mass = snippet.findtext("linked_source")
            assert mass == f"/identifier/inertia/{link}/inertia/m"
            deviation = snippet.findtext("additional_sources/v1")
            assert deviation == f"/identifier/inertia_stddev/{link}/inertia/m"
