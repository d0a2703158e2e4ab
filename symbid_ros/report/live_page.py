"""The page of a live identification: the robot in 3D, converging masses, alarms and buttons."""

from pathlib import Path

from markupsafe import Markup

from symbid_ros.report.robot_scene import RobotScene
from symbid_ros.report.robot_view import robot_view
from symbid_ros.report.templates import page_template, shared_css

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

    def own(name: str) -> Markup:
        return Markup((_FOLDER / name).read_text(encoding="utf-8"))

    return page_template("live_page.html").render(
        title=f"{scene.name}, live",
        name=scene.name,
        nonce=nonce,
        css=Markup(shared_css() + view.style) + own("live_page.css"),
        view=Markup(view.html),
        view_script=Markup(view.script),
        script=own("live_page.js"),
    )
