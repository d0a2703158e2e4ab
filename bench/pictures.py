"""Take the screenshot of the live page for the documentation: docs/images/live.png.

It runs the nodes of `symbid demo --online --web` with a payload after 15 s, and needs Chromium and
Playwright.
"""

import argparse
import sys
import tempfile
from io import BytesIO
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test" / "support"))
from browser import find_chromium, started_browser  # noqa: E402

from symbid_ros.cli.demo import MEMORY, PAYLOAD, draw_demo_prior  # noqa: E402
from symbid_ros.cli.processes import NodeProcess, private_graph  # noqa: E402
from symbid_ros.package_paths import config_file  # noqa: E402

FASTENED = 15.0  # s
WIDTH = 1180  # px


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=40.0, help="until the picture is taken")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images" / "live.png")
    options = parser.parse_args()
    executable = find_chromium()
    if executable is None:
        sys.exit("no Chromium found; install it or set SYMBID_CHROMIUM")
    with tempfile.TemporaryDirectory() as folder:
        picture = photograph(Path(folder), executable, options.seconds)
    image = Image.open(BytesIO(picture)).convert("RGB").quantize(256, Image.Quantize.FASTOCTREE)
    image.save(options.out, optimize=True)
    print(f"{options.out}: {options.out.stat().st_size // 1024} KiB")


def photograph(folder: Path, executable: str, seconds: float) -> bytes:
    """Return a PNG of the page after some seconds of the robot's motion."""
    model = config_file("symbitron.xml")
    draw_demo_prior(folder, model, 25.0, 0)
    common = {"model": str(model), "prior": str(folder / "prior.json")}
    motion = {
        "moves": 60,
        "wait_for_subscribers": True,
        "subscribers": 1,
        "payload_time": FASTENED,
    }
    with private_graph() as graph:

        def node(name: str, parameters: dict[str, object], file: str | None = None) -> NodeProcess:
            return NodeProcess(name, parameters, graph, folder / f"{name}.log", file=file)

        with (
            node("identifier", common | {"memory": MEMORY}, "identifier.yaml"),
            node("web_monitor", common | {"port": 0}) as page,
            node("mujoco_bridge", motion | PAYLOAD, "bridge.yaml"),
            started_browser(executable) as browser,
            browser.page(page.first_line(), WIDTH) as opened,
        ):
            opened.tab.set_viewport_size({"width": WIDTH, "height": 860})
            opened.tab.wait_for_timeout(1000 * seconds)
            return opened.tab.screenshot()


if __name__ == "__main__":
    main()
