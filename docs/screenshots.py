"""Makes the pictures of the documentation: screenshots, docs/images/*.png, and learning.svg.

    python docs/screenshots.py report result/report.html
    python docs/screenshots.py plan plan/plan.html
    python docs/screenshots.py live
    python docs/screenshots.py learning

The last one draws two robots of `symbid demo --learn` as an animation. The others need Chromium and
the packages of requirements-dev.txt. `live` runs the nodes of `symbid demo --online --web`, with a
payload after 15 s.
"""

import argparse
import io
import sys
import tempfile
from contextlib import ExitStack
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test" / "support"))

from browser import DESKTOP, PHONE, Browser, find_chromium, started_browser  # noqa: E402

from symbid_ros.cli.demo import MEMORY, PAYLOAD, draw_demo_prior  # noqa: E402
from symbid_ros.cli.learning_demo import SEED, write_wrong_model  # noqa: E402
from symbid_ros.cli.processes import NodeProcess, private_graph  # noqa: E402
from symbid_ros.learning.figures import ALONE, LEARNING  # noqa: E402
from symbid_ros.learning.lockstep import LearningRun, LearningTask  # noqa: E402
from symbid_ros.learning.page import robot_animation  # noqa: E402
from symbid_ros.model.load import load_model  # noqa: E402
from symbid_ros.package_paths import config_file  # noqa: E402

COLOURS = 256
# s; when the payload is attached, and the picture taken, while the page still states the change.
PAYLOAD_TIME, SECONDS = 15.0, 28.0
LEARNING_SECONDS = 20.0
# Of each kind of page: name of the picture, width of the window, dark or light, height, px.
SHOTS = {
    "report": (
        ("report_light", DESKTOP, False, 1350),
        ("report_dark", DESKTOP, True, 1350),
        ("report_phone", PHONE, True, 1350),
    ),
    "plan": (("plan", 1100, False, 880),),
    "live": (("live", 1180, False, 860),),
}


def main() -> None:
    """Take the pictures of one page."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("kind", choices=(*SHOTS, "learning"))
    parser.add_argument("page", type=Path, nargs="?", help="HTML file of a report or plan")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images")
    arguments = parser.parse_args()
    if (arguments.page is None) != (arguments.kind in ("live", "learning")):
        parser.error("give the HTML file of a report or plan, and none otherwise")
    if arguments.kind == "learning":
        draw_learning(arguments.out / "learning.svg")
        return
    executable = find_chromium()
    if executable is None:
        sys.exit("no Chromium found; install it or set SYMBID_CHROMIUM")
    with ExitStack() as stack:
        address: Path | str | None = arguments.page
        if address is None:
            address = live_address(stack)
        browser = stack.enter_context(started_browser(executable))
        seconds = SECONDS if arguments.kind == "live" else 0.0
        for name, width, dark, height in SHOTS[arguments.kind]:
            picture = photograph(browser, address, (width, height), dark=dark, seconds=seconds)
            path = arguments.out / f"{name}.png"
            # A palette takes a third of the space, and figures have few colours. An octree would
            # merge the pale background of the key figures with white.
            picture.quantize(COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE).save(
                path, optimize=True
            )
            print(f"{path}: {path.stat().st_size // 1000} kB")


def draw_learning(path: Path) -> None:
    """Draw the robots of `symbid demo --learn`: one falls, one learns its model and stands."""
    model = config_file("symbitron.xml")
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        draw_demo_prior(folder, model, 25.0, SEED)
        task = LearningTask(
            write_wrong_model(folder, model), LEARNING_SECONDS, moves=20, noise_seed=SEED
        )
        records = {
            label: LearningRun(task, learns=learns).run()
            for label, learns in ((ALONE, False), (LEARNING, True))
        }
    path.write_text(robot_animation(load_model(model), records))
    print(f"{path}: {path.stat().st_size // 1000} kB")


def photograph(
    browser: Browser, address: str | Path, size: tuple[int, int], *, dark: bool, seconds: float
) -> Image.Image:
    """Return the top of a page, some seconds after it was opened."""
    width, height = size
    with browser.page(address, width, dark=dark) as page:
        page.tab.set_viewport_size({"width": width, "height": height})
        page.tab.wait_for_timeout(1000 * seconds + 500)
        pixels = page.tab.screenshot()
        if page.problems:
            sys.exit(f"{address}: {page.problems[0]}")
    return Image.open(io.BytesIO(pixels)).convert("RGB")


def live_address(stack: ExitStack) -> str:
    """Start a simulated robot, its identifier and the page, and return the page's address."""
    folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
    model = config_file("symbitron.xml")
    draw_demo_prior(folder, model, 25.0, 0)
    common = {"model": str(model), "prior": str(folder / "prior.json")}
    motion = {"moves": 60, "wait_for_subscribers": True, "subscribers": 1}
    motion |= {"payload_time": PAYLOAD_TIME} | PAYLOAD
    graph = stack.enter_context(private_graph())

    def start(name: str, parameters: dict[str, object], file: str | None = None) -> NodeProcess:
        node = NodeProcess(name, parameters, graph, folder / f"{name}.log", file=file)
        return stack.enter_context(node)

    start("identifier", common | {"memory": MEMORY}, "identifier.yaml")
    page = start("web_monitor", common | {"port": 0})
    start("mujoco_bridge", motion, "bridge.yaml")
    return page.first_line()


if __name__ == "__main__":
    main()
