"""The page of a plan in the system's Chromium."""

from dataclasses import replace

import numpy as np
import pytest
from browser import DESKTOP, PHONE
from documented_robots import ur5_urdf

from symbid_ros.excitation.optimizer import TrajectoryOptimizer
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.excitation.page import BOTTOM, HEIGHT, render_page
from symbid_ros.excitation.plan import ExcitationPlan, excitation_problem
from symbid_ros.model.load import load_model
from symbid_ros.report.formatting import significant
from symbid_ros.simulation.joint_sensors import JointSensorOptions


@pytest.fixture(scope="module")
def plan():
    arm = load_model(ur5_urdf(), "fixed")
    options = ExciteOptions(period=5.0, seconds=10.0, harmonics=2)
    problem = excitation_problem(arm, options, JointSensorOptions())
    optimizer = TrajectoryOptimizer(problem.design, seed=0)
    optimizer.run(starts=1, iterations=2)
    return ExcitationPlan(problem, optimizer.best, optimizer.random)


@pytest.fixture(scope="module")
def page_file(plan, tmp_path_factory):
    path = tmp_path_factory.mktemp("page") / "plan.html"
    path.write_text(render_page(plan))
    return path


def test_a_joint_that_only_follows_is_not_listed(tmp_path):
    text = ur5_urdf().read_text()
    wrist = text.index('<joint name="wrist_3_joint"')
    end = text.index("</joint>", wrist)
    path = tmp_path / "ur5.urdf"
    path.write_text(f'{text[:end]}<mimic joint="wrist_2_joint"/>{text[end:]}')
    problem = excitation_problem(
        load_model(path, "fixed"),
        ExciteOptions(period=5.0, seconds=10.0, harmonics=2),
        JointSensorOptions(),
    )
    optimizer = TrajectoryOptimizer(problem.design, seed=0)
    optimizer.run(starts=1, iterations=1)
    followed = ExcitationPlan(problem, optimizer.best, optimizer.random)
    listed = [name for _, name in followed.independent]
    assert "wrist_2_joint" in listed
    assert "wrist_3_joint" not in listed


def test_joints_whose_assumed_noise_exceeds_their_efforts_are_named(plan):
    """The noise is a share of effort limits, which are placeholders in some files."""
    assert plan.noisy == []
    placeholders = replace(plan.problem, capacity=np.full_like(plan.problem.capacity, 1e6))
    assert replace(plan, problem=placeholders).noisy == list(plan.joints.names)


@pytest.mark.parametrize(("width", "dark"), [(DESKTOP, False), (DESKTOP, True), (PHONE, True)])
def test_it_fits_and_loads_nothing(browser, page_file, width, dark):
    with browser.page(page_file, width=width, dark=dark) as page:
        page.tab.evaluate("document.querySelectorAll('details').forEach(e => e.open = true)")
        assert (page.problems, page.overflow, page.requests) == ([], [], [])
        colours = page.tab.evaluate(
            "(s => [s.color, s.backgroundColor])(getComputedStyle(document.body))"
        )
        lightness = [int(each[4:].split(",")[0]) for each in colours]
        assert (lightness[0] > lightness[1]) == dark


def test_print_is_short_and_shows_the_motion_first(browser, page_file):
    with browser.page(page_file) as page:
        pages = page.printed_pages()
    assert len(pages) <= 6
    assert "Motion and limits" in pages[0]


def test_it_draws_every_limited_quantity_with_its_share_and_names_it(browser, page_file, plan):
    kinds = [*plan.usage()]
    with browser.page(page_file) as page:
        assert page.tab.locator(".legend li").all_inner_texts() == kinds
        panel = page.tab.locator("figure").first
        for kind in kinds:
            assert panel.locator(f"path.curve.{kind}").count() == 1
            assert panel.locator(f"path.share.{kind}").count() == 2
        curve = panel.locator("path.curve.acceleration").get_attribute("d")
        heights = np.array([float(point.split()[1]) for point in curve[1:].split("L")])
        middle = (HEIGHT - BOTTOM) / 2
        used = np.abs(1 - heights / middle).max() / 0.94
        assert used == pytest.approx(plan.usage()["acceleration"][0], abs=0.01)
        grey = page.tab.locator("tr.unknown").count()
        assert grey == np.count_nonzero(~plan.determined)
        assert "Rows of other parameters are grey" in page.tab.inner_text("main")


def test_it_shows_each_joint_and_each_parameter(browser, page_file, plan):
    with browser.page(page_file) as page:
        assert page.tab.locator("figure").count() == len(plan.joints.names)
        rows = page.tab.locator("details tbody tr")
        assert rows.count() == len(plan.std)
        place = plan.problem.parameters.names.index("wrist_3_link/m")
        group = page.tab.locator("details", has_text="wrist_3_link")
        group.evaluate("e => e.open = true")
        cells = group.locator("tbody tr").first.locator("td").all_inner_texts()
        assert cells[2] == significant(plan.std[place], 2)
