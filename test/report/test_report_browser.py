"""The report in a browser: it fits, also phones, dark screens and paper, and its figures react."""

import re

import pytest
from browser import PHONE
from documented_robots import ur5_urdf
from report_pages import content, content_of_a_log

import symbid_ros as sy
from symbid_ros.report.compose import compose
from symbid_ros.report.page import write_report
from symbid_ros.report.saved_results import load_result

MOST_PAGES = 6
MOST_BYTES = 5_000_000


@pytest.fixture(scope="module")
def arm_page(tmp_path_factory):
    """The report of an identified arm, with the robot in 3D."""
    from arm_log import arm_streams

    arm = sy.load_model(ur5_urdf())
    joints = arm_streams(arm, seconds=24.0, friction=2.0).joints
    log = sy.Log.from_arrays(
        arm, time=joints.stamp * 1e-9, position=joints.position, effort=joints.effort
    )
    folder = tmp_path_factory.mktemp("arm")
    found = sy.identify(arm, log, joint_terms=("none",))
    result = load_result(found.save(folder / "result"))
    write_report(compose({"MAP-LMI": result}, chosen="MAP-LMI", metadata={}), folder / "page.html")
    return folder / "page.html"


@pytest.fixture(scope="module", params=["arm", "truth", "humanoid", "compared"])
def page_file(request, tmp_path_factory):
    if request.param == "arm":
        return request.getfixturevalue("arm_page")
    shown = {
        "truth": lambda: content_of_a_log(10, truth=True),
        "humanoid": lambda: content_of_a_log(29, outlier=1e5),
        "compared": lambda: content(10),
    }[request.param]()
    path = tmp_path_factory.mktemp("page") / f"{request.param}.html"
    write_report(shown, path)
    return path


def require_fit(page):
    assert page.problems == []
    assert page.requests == []
    assert page.overflow == []


def test_the_page_fits_a_screen_and_its_print_is_short_with_figures_first(browser, page_file):
    assert page_file.stat().st_size < MOST_BYTES
    with browser.page(page_file) as page:
        require_fit(page)
        pages = page.printed_pages()
    assert len(pages) <= MOST_PAGES
    if "Error on each joint" in page_file.read_text():
        assert "Error on each joint" in pages[0]
        assert "Measured and predicted forces" in "".join(pages[:2])


@pytest.mark.parametrize("script", [True, False], ids=["script", "no-script"])
def test_the_page_fits_a_dark_phone(browser, page_file, script):
    with browser.page(page_file, PHONE, dark=True, script=script) as page:
        require_fit(page)


@pytest.fixture(scope="module")
def page(browser, arm_page):
    """The arm's page, in which each test clicks and hovers elsewhere."""
    with browser.page(arm_page) as page:
        yield page


class TestFigures:
    def test_live_figures_stand_in_place_of_static_ones(self, page):
        assert page.tab.locator("#forces figure.live").first.is_visible()
        assert not page.tab.locator("#forces .panels.static").first.is_visible()

    def test_a_pair_under_the_pointer_shows_its_correlation(self, page):
        image, output = page.tab.locator("#correlation-image"), "#correlation-value"
        assert page.tab.locator(output).inner_text().startswith("Strongest")
        image.hover(position={"x": 3, "y": 3})
        assert page.tab.locator(output).inner_text() == "base_link/m and base_link/m: 1.00"

    def test_the_legend_shows_values_under_the_pointer_alone(self, page):
        tab = page.tab
        legend, area = tab.locator("#forces-plot .u-legend"), tab.locator("#forces-plot .u-over")
        tab.mouse.move(0, 0)
        assert "–" not in legend.inner_text()
        assert "time [s]" not in legend.inner_text()
        area.hover()
        assert "time [s]" in legend.inner_text()
        assert re.search(r"\d", legend.inner_text().replace("time [s]", ""))

    def test_the_last_label_of_an_axis_is_within_the_figure(self, page):
        """It may stand at the end of the axis after a zoom."""
        measure = """id => {
          const edge = (one) => document.querySelector(id + one).getBoundingClientRect().right;
          const pen = document.createElement("canvas").getContext("2d");
          pen.font = "12px system-ui, sans-serif";
          return [edge(" .u-wrap") - edge(" .u-over"), pen.measureText("19.75").width / 2];
        }"""
        room, half = page.tab.evaluate(measure, "#forces-plot")
        assert room > half

    def test_another_joint_can_be_chosen(self, page):
        tab = page.tab
        shown = tab.locator("#forces .coordinate-name").first
        before = shown.inner_text()
        names = tab.locator("#coordinate option").all_inner_texts()
        assert names == list(sy.load_model(ur5_urdf()).joint_names)
        tab.get_by_label("Next joint").click()
        assert shown.inner_text() == names[names.index(before) + 1]
        tab.locator("[data-coordinate=wrist_3_joint]").click()
        assert shown.inner_text() == "wrist_3_joint"
        assert tab.locator("#forces canvas").count() == 4
        assert page.problems == []

    def test_dragging_zooms_force_and_error_alike_and_the_button_resets(self, page):
        ticks = "id => document.querySelector(id + ' .u-over').getBoundingClientRect().width"
        tab = page.tab
        assert tab.evaluate(ticks, "#forces-plot") == tab.evaluate(ticks, "#errors-plot")
        charts = [tab.locator(f"{place} canvas") for place in ("#forces-plot", "#errors-plot")]
        tab.mouse.move(0, 0)
        whole = [chart.screenshot() for chart in charts]
        area = tab.locator("#forces-plot .u-over")
        area.scroll_into_view_if_needed()
        box = area.bounding_box()
        tab.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"])
        tab.mouse.down()
        tab.mouse.move(box["x"] + 0.6 * box["width"], box["y"] + 0.5 * box["height"], steps=4)
        tab.mouse.up()
        tab.mouse.move(0, 0)
        assert all(chart.screenshot() != old for chart, old in zip(charts, whole, strict=True))
        tab.get_by_text("Reset zoom").click()
        tab.mouse.move(0, 0)
        assert [chart.screenshot() for chart in charts] == whole


def test_without_script_static_figures_are_shown_with_ink_of_the_page(browser, arm_page):
    colour = "e => getComputedStyle(e).fill"
    shades = []
    for dark in (False, True):
        with browser.page(arm_page, dark=dark, script=False) as page:
            assert not page.tab.locator("#forces figure.live").first.is_visible()
            assert page.tab.locator("#forces .panels.static").first.is_visible()
            label = page.tab.locator("#forces svg text").first
            shades.append(label.evaluate(colour))
    assert shades == ["rgb(58, 58, 58)", "rgb(214, 214, 214)"]
