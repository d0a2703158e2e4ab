"""The page of a live identification: the robot in 3D, converging masses, alarms and buttons."""

from pathlib import Path

import jinja2
from markupsafe import Markup

from symbid_ros.report.robot_scene import RobotScene
from symbid_ros.report.robot_view import robot_view

_FOLDER = Path(__file__).parent


def live_page(scene: RobotScene, nonce: str) -> str:
    """Return the page as HTML without external resources.

    Parameters
    ----------
    scene : RobotScene
        The robot before the first estimate.
    nonce : str
        Nonce of its scripts, for a Content-Security-Policy.
    """
    view = robot_view(scene)
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("symbid_ros", "report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )

    def own(name: str) -> Markup:
        return Markup((_FOLDER / name).read_text(encoding="utf-8"))

    return environment.get_template("live_page.html").render(
        name=scene.name,
        nonce=nonce,
        style=own("report.css") + Markup(view.style) + own("live_page.css"),
        view=Markup(view.html),
        view_script=Markup(view.script),
        script=own("live_page.js"),
    )
