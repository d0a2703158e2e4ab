"""Robots of one type: the one that differs is named, and the common parameters gain from all."""

import json
import re
from dataclasses import replace

import numpy as np
import pytest
from arm_log import arm_streams
from browser import DESKTOP, PHONE
from documented_robots import ur5_urdf
from fleet import HEAVIER, simulate
from json_schemas import require_valid
from typer.testing import CliRunner

import symbid_ros as sy
from symbid_ros.cli.app import app
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.fleet import FleetMember, estimate_fleet
from symbid_ros.estimation.mass_scale import FORCE_SCALE_STD
from symbid_ros.estimation.posterior import Posterior
from symbid_ros.estimation.prior import model_prior
from symbid_ros.estimation.prior_std import body_covariance
from symbid_ros.identification.fleet import (
    fleet_of_results,
    fleet_verdict,
    percent_with_std,
    spread_sizes,
)
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.report.fleet_page import change_table, render_fleet
from symbid_ros.signals.log import Log


@pytest.fixture(scope="module")
def draw():
    return simulate(300, seconds=20.0)


def test_the_heavier_link_is_named(draw) -> None:
    (found,) = draw.estimate.deviations
    assert (found.robot, found.place) == (draw.robot, draw.link)
    assert found.relative == pytest.approx(HEAVIER - 1, abs=0.03)
    assert found.p_value < 1e-6


def test_a_spread_that_the_data_do_not_show_is_a_bound(draw) -> None:
    least = replace(draw.estimate, spread={"links": 0.0043, "load": 1e-4})
    assert spread_sizes(least) == {"links": "0.43", "load": "< 0.01"}


def test_the_fleet_knows_more_than_one_robot(draw) -> None:
    found = draw.estimate
    assert np.all(found.common_std <= found.single_stds.min(axis=0) * (1 + 1e-9))
    inertial = found.parameters.inertial
    ratio = (found.common_std / np.median(found.single_stds, axis=0))[:inertial]
    assert ratio.min() < 0.6  # of six robots, 0.41 at best


@pytest.mark.parametrize(
    ("value", "std", "shown"),
    [
        (0.107, 0.0113, "+10.7 ± 1.1 %"),
        (-0.205, 0.085, "−20.5 ± 8.5 %"),
        (0.00012, 0.0003, "+0.01 ± 0.03 %"),
        (-0.00001, 0.002, "+0.0 ± 0.2 %"),
        (0.0, 0.0, "+0.0 ± 0.0 %"),
    ],
)
def test_a_small_standard_deviation_is_not_rounded_to_zero(value, std, shown) -> None:
    assert percent_with_std(value, std, "+") == shown


def test_the_page_names_the_link_and_holds_no_script(draw) -> None:
    page = render_fleet(draw.estimate)
    assert f"{draw.robot}: {draw.link} is" in page.replace("\N{NO-BREAK SPACE}", " ")
    assert "<script" not in page


def test_the_page_fits_a_phone(draw, browser, tmp_path) -> None:
    page = tmp_path / "fleet.html"
    page.write_text(render_fleet(draw.estimate))
    with browser.page(page, PHONE) as shown:
        assert shown.overflow == []


def test_the_changes_of_all_robots_fit_a_screen_and_read_alike(draw, browser, tmp_path) -> None:
    many = replace(
        draw.estimate,
        robots=tuple(f"robot_{index}" for index in range(18)),
        link_changes=draw.estimate.link_changes * 3,
    )
    zero = replace(draw.estimate.link_changes[0][3], relative=-1e-5)
    some = [list(robot) for robot in draw.estimate.link_changes]
    some[0][3] = zero
    few = replace(draw.estimate, link_changes=tuple(map(tuple, some)))
    assert change_table(few)[0] == ("link", *draw.estimate.robots)
    assert change_table(few)[1][3][1][0].startswith("+0.0 ± ")
    for found in (few, many):
        page = tmp_path / "fleet.html"
        page.write_text(render_fleet(found))
        assert "kg m^2" not in page.read_text()
        with browser.page(page, DESKTOP) as shown:
            wide = shown.tab.evaluate(
                "Array.from(document.querySelectorAll('.scroll'))"
                ".filter(e => e.scrollWidth > e.clientWidth).length"
            )
        assert wide == 0
    titles, rows = change_table(many)
    assert titles == ("robot", *draw.estimate.parameters.link_names)
    assert [name for name, _ in rows] == list(many.robots)
    assert rows[6][1] == rows[0][1]


def gaussian_fleet(
    rng, shift: float, *, hides_base: bool = False
) -> tuple[list[FleetMember], ParameterSet]:
    """Return robots whose posteriors are drawn from the model that the estimate assumes."""
    parameters = ParameterSet(load_model(ur5_urdf(), "fixed"))
    prior = model_prior(parameters, 25.0)
    p = len(parameters)
    members = []
    for index in range(6):
        truth = prior.mean.copy()
        for link in np.split(np.arange(p), p // 10):
            covariance = body_covariance(truth[link], 0.2)
            truth[link] = rng.multivariate_normal(truth[link], covariance)
        truth *= 1 + FORCE_SCALE_STD * rng.standard_normal()
        truth[20:30] *= 1 + shift * (index == 0)
        # Measurements of every parameter to a hundredth of its prior deviation.
        precision = np.full(p, 1 / (0.01 * prior.std) ** 2)
        precision[: 10 * hides_base] *= 1e-12
        measured = truth + rng.standard_normal(p) / np.sqrt(precision)
        total = precision + prior.std**-2
        mean = (precision * measured + prior.mean / prior.std**2) / total
        found = Posterior(mean, np.diag(np.sqrt(total)), prior, np.eye(6), 1.0, 0.0)
        members.append(FleetMember(f"robot_{index}", found))
    return members, parameters


def test_equal_robots_give_no_alarm_and_a_mean_within_its_deviation() -> None:
    alarms, scores = 0, []
    for seed in range(8):
        members, parameters = gaussian_fleet(np.random.default_rng(seed), 0.0)
        found = estimate_fleet(members, parameters)
        alarms += bool(found.deviations)
        error = found.common - parameters.values
        scores.append(np.mean((error / found.common_std) ** 2))
    assert alarms == 0
    assert np.mean(scores) == pytest.approx(1.0, abs=0.3)


def test_only_links_that_the_data_show_are_tested() -> None:
    for hides_base in (False, True):
        members, parameters = gaussian_fleet(np.random.default_rng(1), 0.0, hides_base=hides_base)
        found = estimate_fleet(members, parameters)
        assert found.tests == len(members) * (len(parameters.link_names) - hides_base)
        assert (found.link_changes[0][0] is None) == hides_base


def test_a_shifted_link_is_found_with_its_size() -> None:
    members, parameters = gaussian_fleet(np.random.default_rng(1), 0.1)
    (found,) = estimate_fleet(members, parameters).deviations
    assert (found.robot, found.place) == ("robot_0", parameters.link_names[2])
    assert abs(found.relative - 0.1) < 4 * found.relative_std


def test_changes_of_links_have_their_deviation_and_the_detectable_ones_are_named() -> None:
    members, parameters = gaussian_fleet(np.random.default_rng(2), 0.0)
    equal = estimate_fleet(members, parameters)
    scores = [one.relative / one.std for robot in equal.link_changes for one in robot]
    assert np.mean(np.square(scores)) == pytest.approx(1.0, abs=0.5)
    smallest = equal.link_changes[0][2].detectable
    for factor, is_named in ((1.3, True), (0.4, False)):
        members, _ = gaussian_fleet(np.random.default_rng(2), factor * smallest)
        found = estimate_fleet(members, parameters)
        assert bool(found.deviations) == is_named
        change = found.link_changes[0][2]
        assert change.relative == pytest.approx(factor * smallest, abs=4 * change.std)
    verdict = fleet_verdict(found)
    assert re.search(r"a link would be named if it alone were .* % \(.*\) to .* heavier", verdict)


@pytest.fixture(scope="module")
def results(tmp_path_factory):
    folder, arm = tmp_path_factory.mktemp("fleet"), load_model(ur5_urdf(), "fixed")
    options = sy.IdentifyOptions(joint_terms=("viscous",), unchecked=True, no_holdout=True)
    for index in range(3):
        log = Log.from_streams(arm_streams(arm, 8.0, index, rate=100.0))
        sy.identify(arm, log, options).save(folder / f"robot_{index}")
    other = arm.with_phi(1.1 * arm.phi)
    sy.identify(other, log, options).save(folder / "other")
    return folder


def test_the_command_compares_saved_results(results, tmp_path) -> None:
    folders = [str(results / f"robot_{index}") for index in range(3)]
    ran = CliRunner().invoke(app, ["fleet", *folders, "--json", "--out", str(tmp_path / "f.html")])
    assert ran.exit_code in (0, 1), ran.output
    document = json.loads(ran.stdout)
    require_valid("fleet", document)
    assert ran.exit_code == bool(document["deviations"])
    assert list(document["parameters"]["forearm_link/m"]["robots"]) == [
        "robot_0",
        "robot_1",
        "robot_2",
    ]
    assert "Spread between robots" in (tmp_path / "f.html").read_text()
    shown = CliRunner().invoke(app, ["fleet", *folders])
    assert document["verdict"] in shown.stdout.replace("\n", " ")
    assert set(document["link_changes"]["forearm_link"]) == {"robot_0", "robot_1", "robot_2"}
    assert "detectable" in shown.stdout
    assert "±" in shown.stdout


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"drive_gain": ("all",)}, "odd: factors of efforts were identified"),
        ({"joint_terms": ("none",)}, "odd, unlike robot_0: it lacks shoulder_pan_joint/viscous"),
        ({"window": 0.1}, "odd, unlike robot_0, has windows of 100 ms"),
    ],
    ids=str,
)
def test_a_result_that_was_identified_otherwise_is_named(results, tmp_path, options, said) -> None:
    arm = load_model(ur5_urdf(), "fixed")
    log = Log.from_streams(arm_streams(arm, 8.0, 4, rate=100.0))
    given = {"joint_terms": ("viscous",), "unchecked": True, "no_holdout": True} | options
    sy.identify(arm, log, **given).save(tmp_path / "odd")
    folders = [results / "robot_0", results / "robot_1", tmp_path / "odd"]
    with pytest.raises(EstimateError, match=re.escape(said)) as raised:
        fleet_of_results(folders)
    assert raised.value.code == "E961"


def test_other_models_and_pairs_of_robots_are_refused(results) -> None:
    differing = r"another model than .*: base_link/m is \S+ instead of \S+ kg"
    with pytest.raises(EstimateError, match=differing) as raised:
        fleet_of_results([results / "robot_0", results / "robot_1", results / "other"])
    assert raised.value.code == "E961"
    with pytest.raises(EstimateError, match="at least 3") as raised:
        fleet_of_results([results / "robot_0", results / "robot_1"])
    assert raised.value.code == "E960"
