"""Pages in the system's Chromium, without a window: problems, overflow and print.

The fixture ``browser`` in test/conftest.py starts it once for each test file::

    def test_fits_a_phone(browser, tmp_path):
        with browser.page(tmp_path / "page.html", width=PHONE, dark=True) as page:
            assert page.problems == []
            assert page.overflow == []
"""

import os
import re
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path

DESKTOP, PHONE = 1280, 390  # px
NAMES = "chromium", "chromium-browser", "google-chrome", "google-chrome-stable"
# Chromium's sandbox does not work for root in a container; all pages are the tests' own.
ARGUMENTS = "--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-dev-shm-usage"

# Text of a PDF's page, and parts of the page that are kept elsewhere.
_TEXT = re.compile(rb"\bBT\b.*?\bET\b|/\S+\s+Do\b", re.DOTALL)

# A page that draws in WebGL without a graphics card gets this warning for each screenshot.
_OF_SCREENSHOTS = "GPU stall due to ReadPixels"

# Elements that reach beyond the window, or hide a part of their content at its edge. Hidden
# elements, those inside a closed <details>, and whatever may scroll on purpose (a CSS selector)
# are left out.
_MAY_SCROLL = "[data-may-scroll]"
_OVERFLOW = """(mayScroll) => {
  const found = [], width = document.documentElement.clientWidth;
  const name = (e) => e.tagName.toLowerCase() + (e.id ? "#" + e.id : "")
    + (typeof e.className === "string" && e.className
       ? "." + e.className.trim().split(/\\s+/).join(".") : "");
  if (document.documentElement.scrollWidth > width)
    found.push(`page: ${document.documentElement.scrollWidth} px in ${width} px`);
  for (const e of document.body.querySelectorAll("*")) {
    if (!e.checkVisibility() || e.closest("svg") || e.closest(mayScroll)) continue;
    const style = getComputedStyle(e);
    if (style.overflowX !== "visible" && e.clientWidth > 1 && e.scrollWidth > e.clientWidth + 1)
      found.push(`${name(e)}: ${e.scrollWidth} px in ${e.clientWidth} px`);
    const box = e.getBoundingClientRect();
    if (box.width > 1 && (box.right > width + 1 || box.left < -1))
      found.push(`${name(e)}: from ${box.left} to ${box.right} px`);
  }
  return found;
}"""


def find_chromium() -> str | None:
    """Return the executable, by ``SYMBID_CHROMIUM`` or by its usual names."""
    named = os.environ.get("SYMBID_CHROMIUM")
    return named or next((path for name in NAMES if (path := shutil.which(name))), None)


@dataclass
class OpenPage:
    """A loaded page; ``tab`` is Playwright's, to click, fill in and evaluate."""

    tab: object
    problems: list[str] = field(default_factory=list)  # errors, warnings and failed requests
    requests: list[str] = field(default_factory=list)  # addresses other than the page's own

    @property
    def overflow(self) -> list[str]:
        """Elements that are cut off at the side, one line each; empty if the page fits."""
        return self.overflow_outside(_MAY_SCROLL)

    def overflow_outside(self, may_scroll: str) -> list[str]:
        """Like `overflow`, for pages in which other elements, by a CSS selector, may scroll."""
        return self.tab.evaluate(_OVERFLOW, may_scroll)

    def printed_pages(self, read: int = 2) -> list[str]:
        """Print on A4 and return the text of the first pages, and an empty text for each other."""
        from pypdf import PdfReader

        document = PdfReader(BytesIO(self.tab.pdf(format="A4", print_background=True)))
        return [_text_of(page) if i < read else "" for i, page in enumerate(document.pages)]


def _text_of(page) -> str:
    """Return the text of a page of a PDF without parsing its figures, which takes a second."""
    from pypdf.generic import DecodedStreamObject, NameObject

    stream = DecodedStreamObject()
    stream.set_data(b"\n".join(_TEXT.findall(page.get_contents().get_data())))
    page[NameObject("/Contents")] = stream
    return page.extract_text()


class Browser:
    """The system's Chromium."""

    def __init__(self, chromium) -> None:
        self._chromium = chromium

    @contextmanager
    def page(
        self, address: str | Path, width: int = DESKTOP, *, dark: bool = False, script: bool = True
    ) -> Iterator[OpenPage]:
        """Open a file or an address in a profile of its own."""
        url = address if isinstance(address, str) else address.resolve().as_uri()
        context = self._chromium.new_context(
            viewport={"width": width, "height": 900},
            color_scheme="dark" if dark else "light",
            java_script_enabled=script,
            reduced_motion="reduce",
        )
        try:
            page = OpenPage(context.new_page())
            tab, problems = page.tab, page.problems
            tab.on(
                "console",
                lambda one: (
                    problems.append(f"{one.type}: {one.text}")
                    if one.type in {"error", "warning"} and _OF_SCREENSHOTS not in one.text
                    else None
                ),
            )
            tab.on("pageerror", lambda error: problems.append(f"exception: {error}"))
            tab.on("requestfailed", lambda one: problems.append(f"failed: {one.url}"))
            tab.on(
                "request",
                lambda one: (
                    page.requests.append(one.url)
                    if one.url != url and not one.url.startswith(("data:", "blob:"))
                    else None
                ),
            )
            tab.goto(url)
            yield page
        finally:
            context.close()


@contextmanager
def started_browser(executable: str) -> Iterator[Browser]:
    """Start Chromium and end it together with the block."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        chromium = playwright.chromium.launch(executable_path=executable, args=list(ARGUMENTS))
        try:
            yield Browser(chromium)
        finally:
            chromium.close()
