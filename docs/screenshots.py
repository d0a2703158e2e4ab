"""Takes the screenshots of a report for the documentation.

``python docs/screenshots.py result/report.html`` writes report_light.png, report_dark.png and
report_phone.png to docs/images/. It needs Chromium and the packages of requirements-dev.txt.
"""

import argparse
import io
import sys
from pathlib import Path

from PIL import Image

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "test" / "support"))

from browser import DESKTOP, PHONE, find_chromium, started_browser  # noqa: E402

COLOURS = 200
# Name, width of the window, dark or light, and height of the picture, px.
SHOTS = (
    ("light", DESKTOP, False, 1350),
    ("dark", DESKTOP, True, 1350),
    ("phone", PHONE, True, 1350),
)


def main() -> None:
    """Take all screenshots."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("report", type=Path, help="HTML file of `symbid report`")
    parser.add_argument("--out", type=Path, default=ROOT / "docs" / "images")
    arguments = parser.parse_args()
    executable = find_chromium()
    if executable is None:
        sys.exit("no Chromium found; install it or set SYMBID_CHROMIUM")
    with started_browser(executable) as browser:
        for name, width, dark, height in SHOTS:
            with browser.page(arguments.report, width, dark=dark) as page:
                page.tab.wait_for_load_state("networkidle")
                clip = {"x": 0, "y": 0, "width": width, "height": height}
                pixels = page.tab.screenshot(clip=clip, full_page=True)
                if page.problems:
                    sys.exit(f"{arguments.report}: {page.problems[0]}")
            picture = Image.open(io.BytesIO(pixels)).convert("RGB")
            path = arguments.out / f"report_{name}.png"
            # A palette takes a third of the space, and figures have few colours.
            picture.quantize(COLOURS, dither=Image.Dither.NONE).save(path, optimize=True)
            print(f"{path}: {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
