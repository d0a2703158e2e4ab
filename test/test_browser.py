"""What the other tests rely on to notice that a page is broken or does not fit."""

import pytest
from browser import DESKTOP, PHONE

PAGE = """<!DOCTYPE html><html lang="en"><meta charset="utf-8"><title>t</title>
<link rel="icon" href="data:,"><style>@media (prefers-color-scheme: dark) {{ p {{ color: red }} }}
@media print {{ p {{ break-after: page }} }}</style><body>{}</body></html>"""


@pytest.fixture
def write(tmp_path):
    def page(body):
        path = tmp_path / "page.html"
        path.write_text(PAGE.format(body), encoding="utf-8")
        return path

    return page


def test_a_sound_page_has_no_problem(browser, write):
    with browser.page(write("<p>one</p><p>two</p>"), PHONE) as page:
        assert page.problems == page.requests == page.overflow == []


@pytest.mark.parametrize(
    "script", ["console.error('wrong')", "undefinedFunction()", "fetch('http://localhost:9/x')"]
)
def test_faults_of_scripts_are_reported(browser, write, script):
    with browser.page(write(f"<p>one</p><script>{script}</script>")) as page:
        page.tab.wait_for_load_state("networkidle")
        assert page.problems


@pytest.mark.parametrize(
    "body",
    [
        "<p style='width: 600px'>wide</p>",
        "<div style='overflow-x: auto'><p style='width: 600px'>cut</p></div>",
        "<div style='overflow: hidden; width: 100px'><p style='width: 200px'>cut</p></div>",
        "<p style='position: absolute; left: -50px'>outside</p>",
    ],
)
def test_what_does_not_fit_is_reported(browser, write, body):
    with browser.page(write(body), PHONE) as page:
        assert page.overflow


def test_what_is_folded_or_may_scroll_is_not_reported(browser, write):
    folded = "<details><summary>more</summary><p style='width: 600px'>wide</p></details>"
    free = "<div data-may-scroll style='overflow-x: auto'><p style='width: 600px'>x</p></div>"
    with browser.page(write(folded + free), PHONE) as page:
        assert page.overflow == []


def test_width_and_colours_are_those_asked_for(browser, write):
    for width, dark in ((DESKTOP, False), (PHONE, True)):
        with browser.page(write("<p>one</p>"), width, dark=dark) as page:
            assert page.tab.evaluate("innerWidth") == width
            colour = page.tab.evaluate("getComputedStyle(document.querySelector('p')).color")
            assert (colour == "rgb(255, 0, 0)") is dark


def test_pages_of_the_print_are_counted(browser, write):
    with browser.page(write("<p>one</p><p>two</p><p>three</p>"), script=False) as page:
        assert [text.strip() for text in page.printed_pages(read=3)] == ["one", "two", "three"]
