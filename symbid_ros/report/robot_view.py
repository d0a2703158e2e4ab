"""A turnable 3D view of an identified robot as a fragment of an HTML page."""

import json
from dataclasses import dataclass
from pathlib import Path

from markupsafe import Markup

from symbid_ros.report.palette import BEFORE_COLOUR, DETERMINED_COLOURS, UNKNOWN_COLOUR
from symbid_ros.report.robot_scene import SHOWN_DEVIATIONS, RobotScene
from symbid_ros.report.still_picture import camera_direction, still_picture
from symbid_ros.report.templates import page_template

_FOLDER = Path(__file__).parent


@dataclass(frozen=True)
class RobotView:
    """The parts of a page that show a robot; each is safe to insert into HTML.

    Attributes
    ----------
    html : str
        A ``<figure>`` with the turnable view, its legend and its data. A browser without scripts or
        WebGL 2, and print, show the still picture instead.
    style : str
        CSS, once for each page.
    script : str
        JavaScript with three.js, once for each page, behind all figures.
    still_svg : str
        The picture alone.
    """

    html: str
    style: str
    script: str
    still_svg: str


def robot_view(scene: RobotScene) -> RobotView:
    """Return the view of a scene, see :func:`symbid_ros.report.robot_scene.robot_scene`."""
    still = still_picture(scene)
    has_determined = any(link.determined is not None for link in scene.links)
    document = scene.document() | {"camera": camera_direction(scene.up).tolist()}
    html = page_template("robot_view.html").render(
        name=scene.name,
        still=Markup(still),
        has_determined=has_determined,
        colours=DETERMINED_COLOURS if has_determined else (UNKNOWN_COLOUR,),
        before=BEFORE_COLOUR,
        deviations=f"{SHOWN_DEVIATIONS:g}",
        remarks=scene.remarks,
        scene=Markup(script_json(document)),
    )
    return RobotView(html, view_style(), view_script(), still)


def view_style() -> str:
    """Return the CSS of all views of a page."""
    return (_FOLDER / "robot_view.css").read_text(encoding="utf-8")


def view_script() -> str:
    """Return the JavaScript of all views of a page, with three.js."""
    parts = (_FOLDER / "vendored" / "three.min.js", _FOLDER / "robot_view.js")
    return "\n".join(part.read_text(encoding="utf-8") for part in parts)


def script_json(document: object) -> str:
    """Return JSON that cannot end the ``<script>`` element around it."""
    return json.dumps(document, separators=(",", ":")).replace("<", "\\u003c")
