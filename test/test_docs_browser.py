"""The built documentation in a browser: pages fit desktops and phones, light and dark."""

import subprocess
import sys
import warnings
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest
from browser import DESKTOP, PHONE

DOCS = Path(__file__).resolve().parents[1] / "docs"
# One for each kind of content: pictures, generated tables, formulas, long code, long tables.
PAGES = "index", "options", "theory", "quickstart-arm", "ros", "udp"
# Wide code, tables and formulas scroll; the two drawers wait beside the page.
MAY_SCROLL = "pre, .table-wrapper, .math-wrapper, .sidebar-drawer, .toc-drawer"


@pytest.fixture(scope="module")
def site(browser, tmp_path_factory) -> Iterator[Path]:
    """The built pages, if there is a browser; the others would take most of the time."""
    if find_spec("sphinx") is None or find_spec("furo") is None:
        reason = "no Sphinx with Furo found: the documentation's pages are not tested"
        warnings.warn(reason, stacklevel=1)
        pytest.skip(reason)
    out = tmp_path_factory.mktemp("site")
    others = [page.name for page in DOCS.glob("*.md") if page.stem not in PAGES]
    options = ("-D", f"exclude_patterns={','.join(others)}", "-D", "suppress_warnings=myst,toc")
    command = [sys.executable, "-m", "sphinx", "--quiet", *options, DOCS, out]
    subprocess.run(command, check=True)
    return out


@pytest.mark.parametrize("name", PAGES)
def test_a_page_fits_has_no_problem_and_is_dark_if_asked(browser, site: Path, name: str) -> None:
    for width, dark in ((DESKTOP, False), (PHONE, True)):
        with browser.page(site / f"{name}.html", width, dark=dark) as page:
            assert page.problems == []
            assert page.overflow_outside(MAY_SCROLL) == []
            assert all(one.startswith(site.as_uri()) for one in page.requests)
            colour = page.tab.evaluate("getComputedStyle(document.body).backgroundColor")
            lightness = int(colour[4:].split(",")[0])
            assert lightness < 60 if dark else lightness > 200
