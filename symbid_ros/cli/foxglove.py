"""Layouts for Foxglove that plot and show the estimate of one robot."""

import json
from collections.abc import Iterable
from typing import Any

from symbid_ros.messages.topics import topic_token
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel

Layout = dict[str, Any]

# More curves cannot be told apart.
MOST_LINKS, MOST_JOINTS = 8, 12
_NODE = "/identifier"
_COLOURS = (
    *("#0072b2", "#d55e00", "#009e73", "#cc79a7", "#e69f00", "#56b4e9"),
    *("#7f7f7f", "#bcbd22", "#8c564b", "#9467bd", "#17becf", "#1f77b4"),
)
_AGE = f'/diagnostics.status[:]{{name=="{_NODE}: estimate"}}.values[:]{{key=="age"}}.value'


def layout_text(model: RobotModel) -> str:
    """Return the layout as the JSON that Foxglove imports."""
    return json.dumps(foxglove_layout(model), indent=2, ensure_ascii=False) + "\n"


def foxglove_layout(model: RobotModel) -> Layout:
    """Return a layout with the robot in 3D, and masses, residuals and statuses.

    Plotted are the heaviest links and the first joints.
    """
    parameters = ParameterSet(model)
    phi = model.phi[parameters.links]
    heaviest = sorted(range(len(phi)), key=lambda index: -phi[index, 0])[:MOST_LINKS]
    links = [parameters.link_names[index] for index in sorted(heaviest)]
    moving = [(index, model.joint_names[index]) for index in model.moving_joints[:MOST_JOINTS]]
    panels = {
        "3D!robot": _robot_panel(model),
        "Plot!mass": _plot("Mass, kg", ((_inertia("inertia", link), link) for link in links)),
        "Plot!mass_stddev": _plot(
            "Standard deviation of the mass, kg",
            ((_inertia("inertia_stddev", link), link) for link in links),
            least=0,
        ),
        "Plot!effort_residual": _plot(
            "Residual effort of the joints, rms",
            ((f"{_NODE}/effort_residual.effort[{index}]", joint) for index, joint in moving),
            least=0,
        ),
        "Plot!age": _plot("Age of the estimate, s", [(_AGE, "age")], least=0),
        "DiagnosticSummary!nodes": {
            "topicToRender": "/diagnostics",
            "minLevel": 0,
            "pinnedIds": [],
            "hardwareIdFilter": "",
            "sortByLevel": True,
        },
        "RawMessages!estimate": {
            "topicPath": f"{_NODE}/estimate",
            "diffEnabled": False,
            "diffMethod": "custom",
            "diffTopicPath": "",
            "showFullMessageForDiff": False,
        },
    }
    residuals = ["Plot!effort_residual"]
    if model.floating:
        for kind, field, unit in (("force", "force", "N"), ("moment", "torque", "Nm")):
            name = f"Plot!{kind}_residual"
            residuals.append(name)
            panels[name] = _plot(
                f"Residual {kind} on the base, rms, {unit}",
                ((f"{_NODE}/wrench_residual.wrench.{field}.{axis}", axis) for axis in "xyz"),
                least=0,
            )
    return {
        "configById": panels,
        "globalVariables": {},
        "userNodes": {},
        "playbackConfig": {"speed": 1},
        "layout": _split(
            "row",
            _stack(["3D!robot", "DiagnosticSummary!nodes"], 65),
            _split(
                "row",
                _stack(["Plot!mass", "Plot!mass_stddev", "Plot!age"]),
                _stack([*residuals, "RawMessages!estimate"]),
                50,
            ),
            40,
        ),
    }


def _inertia(topic: str, link: str) -> str:
    return f"{_NODE}/{topic}/{topic_token(link)}.inertia.m"


def _robot_panel(model: RobotModel) -> Layout:
    description = f"{_NODE}/robot_description"
    return {
        "followMode": "follow-pose",
        "followTf": model.links[0].name,
        "cameraState": {
            "distance": 3,
            "perspective": True,
            "phi": 70,
            "thetaOffset": 40,
            "target": [0, 0, 0],
            "targetOffset": [0, 0, 0],
            "targetOrientation": [0, 0, 0, 1],
            "fovy": 45,
            "near": 0.01,
            "far": 5000,
        },
        "scene": {},
        "transforms": {},
        "topics": {f"{_NODE}/markers": {"visible": True}},
        "layers": {
            "grid": {
                "layerId": "foxglove.Grid",
                "instanceId": "grid",
                "label": "Grid",
                "visible": True,
                "frameLocked": True,
                "order": 1,
            },
            "robot": {
                "layerId": "foxglove.Urdf",
                "instanceId": "robot",
                "label": model.name,
                "visible": True,
                "frameLocked": True,
                "sourceType": "topic",
                "topic": description,
                "framePrefix": "",
                "displayMode": "auto",
                "order": 2,
            },
        },
    }


def _plot(title: str, paths: Iterable[tuple[str, str]], least: float | None = None) -> Layout:
    """Return a panel of message paths with their labels."""
    curves = [
        {
            "value": value,
            "label": label,
            "enabled": True,
            "timestampMethod": "receiveTime",
            "color": _COLOURS[number % len(_COLOURS)],
        }
        for number, (value, label) in enumerate(paths)
    ]
    panel: Layout = {
        "title": title,
        "paths": curves,
        "showXAxisLabels": True,
        "showYAxisLabels": True,
        "showLegend": True,
        "legendDisplay": "floating",
        "showPlotValuesInLegend": True,
        "isSynced": True,
        "xAxisVal": "timestamp",
        "followingViewWidth": 120,
    }
    if least is not None:
        panel["minYValue"] = least
    return panel


def _split(direction: str, first: Any, second: Any, percent: float) -> Layout:
    return {
        "direction": direction,
        "first": first,
        "second": second,
        "splitPercentage": percent,
    }


def _stack(panels: list[str], percent: float | None = None) -> Any:
    """Return panels below each other, of equal height unless the first one's is given."""
    first, *others = panels
    if not others:
        return first
    share = 100 / len(panels) if percent is None else percent
    return _split("column", first, _stack(others), share)
