"""The page shows its content completely and is valid, self-contained HTML."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from report_pages import Page, content, content_of_a_log, estimate, series

from symbid_ros.errors import EstimateError
from symbid_ros.model.inertia import PARAMETERS
from symbid_ros.report.content import LinkErrors, ReportContent
from symbid_ros.report.page import (
    DOCUMENTATION,
    option_text,
    render,
    write_report,
)
from symbid_ros.report.side_by_side import compared_results

ROOT = Path(__file__).resolve().parents[2]


@pytest.fixture(scope="module", params=[2, 29])
def joints(request: pytest.FixtureRequest) -> int:
    count: int = request.param
    return count


@pytest.fixture(scope="module")
def page(joints: int) -> Page:
    return Page(render(content(joints)))


class TestPage:
    def test_has_no_external_resources(self, page: Page) -> None:
        assert all(source.startswith("data:") for source in page.attributes("src"))
        tags = {tag for tag, _ in page.elements}
        assert not tags & {"iframe", "object", "embed"}
        icons = [a["href"] for tag, a in page.elements if tag == "link"]
        assert icons == ["data:,"]

    def test_links_lead_to_the_page_or_to_the_documentation(self, page: Page) -> None:
        documented = {path.stem for path in (ROOT / "docs").glob("*.md")}
        for target in page.attributes("href"):
            if target.startswith(DOCUMENTATION):
                name = target.removeprefix(f"{DOCUMENTATION}/").partition("#")[0]
                assert name.removesuffix(".html") in documented
            else:
                assert target.startswith("#") or target == "data:,"

    def test_styles_load_no_resources(self, page: Page) -> None:
        assert "@import" not in page.source
        assert set(re.findall(r"url\((.)", page.source)) <= {"#"}

    def test_ids_are_unique_and_every_reference_has_its_target(self, page: Page) -> None:
        ids = page.attributes("id")
        assert len(ids) == len(set(ids))
        references = {target[1:] for target in page.attributes("href") if target[0] == "#"}
        clips = {m for a in page.attributes("clip-path") for m in re.findall(r"#([^)]+)", a)}
        assert references | clips <= set(ids)

    def test_every_figure_has_a_label(self, page: Page) -> None:
        figures = [a for tag, a in page.elements if tag == "svg" and "aria-hidden" not in a]
        assert all(a["role"] == "img" and a["aria-label"] for a in figures)
        assert len(figures) == sum(tag == "figure" for tag, _ in page.elements)

    def test_draws_com_torque_momentum_and_links(self, page: Page, joints: int) -> None:
        figures = sum(tag == "figure" for tag, _ in page.elements)
        assert figures == 3 + min(6, joints) + 6 + 1

    def test_axes_have_units(self, page: Page) -> None:
        labels = {text.strip() for text in page.text}
        assert {"time [s]", "position [mm]", "torque [Nm]", "momentum [Ns]"} <= labels
        assert "mean relative parameter error [%]" in labels

    def test_panels_state_the_deviation_of_their_curves(self, page: Page) -> None:
        assert "RMSE: prior 20.0 mm, WLS-RC 2.00 mm" in {text.strip() for text in page.text}

    def test_metrics_are_those_of_the_content(self, page: Page) -> None:
        assert page.row("WLS-RC")[1:] == ["0.500", "1.00", "1.50", "2.00", "2.50"]
        assert page.row("prior")[1:] == ["10.0", "20.0", "30.0", "40.0", "50.0"]

    def test_the_error_against_the_truth_is_a_key_figure(self, page: Page) -> None:
        text = " ".join("".join(page.text).split())
        assert "Error against the truth1.50 mm" in text
        assert "of the centre of mass; original 30.0 mm" in text

    def test_parameters_are_those_of_the_estimate(self, page: Page, joints: int) -> None:
        shown = estimate(("base_link", *(f"link_{i}" for i in range(joints))), ())
        rows = [row for row in page.rows if row[0] in PARAMETERS]
        assert [row[0] for row in rows] == list(PARAMETERS) * (joints + 1)
        for index, row in enumerate(rows):
            for text, vector in zip(row[1:4], (shown.value, shown.std, shown.prior), strict=True):
                assert vector is not None
                # The standard deviation has two digits, and all have its decimals.
                assert float(text) == pytest.approx(vector[index], abs=0.051 * shown.std[index])
            assert row[5] == ("yes" if index % 2 == 0 else "no")

    def test_residuals_have_a_row_for_each_coordinate(self, page: Page, joints: int) -> None:
        assert page.row("base/force_z")[1:] == ["0.250", "0.250"]
        assert page.row(f"joint_{joints - 1}")[1:] == ["0.250", "0.250"]


class TestWithoutTruth:
    page = Page(render(content(2, truth=False)))

    def test_panels_and_their_navigation_are_absent(self) -> None:
        assert not [tag for tag, _ in self.page.elements if tag == "figure"]
        sections = [a["id"] for tag, a in self.page.elements if tag == "section"]
        assert sections == ["compared", "possible", "parameters", "data"]
        own = [target for target in self.page.attributes("href") if target[0] == "#"]
        assert own == [f"#{section}" for section in sections]

    def test_there_is_no_error_against_a_truth(self) -> None:
        assert "against the truth" not in "".join(self.page.text)

    def test_what_an_earlier_result_lacks_and_how_to_get_it_is_said(self) -> None:
        text = " ".join("".join(self.page.text).split())
        assert "does not hold measured forces" in text
        assert "symbid report RESULT --bag BAG" in text


def changed(**fields: object) -> ReportContent:
    """The small report with some fields of the chosen estimate replaced."""
    base = content(2, truth=False)
    return replace(
        base,
        methods=tuple(
            replace(m, estimate=replace(m.estimate, **fields))
            if m.estimate is not None and m.label == base.chosen
            else m
            for m in base.methods
        ),
    )


def test_impossible_links_are_named() -> None:
    page = Page(render(changed(consistent={"base_link": True, "link_0": False, "link_1": True})))
    text = " ".join("".join(page.text).split())
    assert "impossible: link_0" in text


def test_a_missing_value_is_a_dash() -> None:
    page = Page(render(changed(std=None, determined=None)))
    row = page.row("Ixx")
    assert (row[2], row[5]) == ("—", "—")
    assert "determined by the data" not in "".join(page.text)


def test_friction_has_a_group_of_its_own() -> None:
    base = content(2, truth=False).estimate
    page = Page(
        render(
            changed(
                names=(*base.names, "joint_0/viscous"),
                units=(*base.units, "Nm s/rad"),
                value=np.append(base.value, 0.7),
                prior=np.append(base.prior, 1.0),
                std=None,
                determined=None,
            )
        )
    )
    assert page.row("joint_0/viscous")[1:5] == ["0.7000", "—", "1.0000", "Nm s/rad"]
    groups = [text for text in page.text if text in {"base_link", "link_0", "link_1", "Joints"}]
    assert groups == ["base_link", "link_0", "link_1", "Joints"]


def test_names_are_escaped() -> None:
    page = Page(render(replace(content(2), title="<b>$a_b$ & co", joint_names=("a<b", "$c$"))))
    assert "<b>$a_b$ & co" in page.text
    assert "a<b" in page.text


def test_pages_of_equal_content_are_equal(page: Page, joints: int) -> None:
    assert render(content(joints)) == page.source


def test_page_is_written_atomically(tmp_path: Path) -> None:
    path = tmp_path / "new" / "report.html"
    shown = content(2, truth=False)
    write_report(shown, path)
    assert path.read_text(encoding="utf-8") == render(shown)
    assert [p.name for p in path.parent.iterdir()] == ["report.html"]


class TestContentIsChecked:
    def test_chosen_method_must_have_an_estimate(self) -> None:
        with pytest.raises(EstimateError, match="'prior'") as caught:
            replace(content(2), chosen="prior")
        assert caught.value.code == "E752"

    def test_labels_are_unique(self) -> None:
        base = content(2)
        with pytest.raises(EstimateError, match="labels") as caught:
            replace(base, methods=(*base.methods, base.methods[0]))
        assert caught.value.code == "E752"

    def test_torques_match_the_joints(self) -> None:
        with pytest.raises(EstimateError, match="2 torque columns for 1 joint names"):
            replace(content(2), joint_names=("joint_0",))

    def test_predictions_share_their_times(self) -> None:
        with pytest.raises(EstimateError, match="'WLS-RC'"):
            replace(
                content(2), predictions=(series("truth", 2, 0.0), series("WLS-RC", 2, 0.1, 400))
            )

    def test_vectors_have_one_row_for_each_time(self) -> None:
        with pytest.raises(EstimateError, match=r"com has shape \(7, 3\)"):
            replace(series("truth", 2, 0.0), com=np.zeros((7, 3)))

    def test_errors_have_one_value_for_each_link(self) -> None:
        with pytest.raises(EstimateError, match="2 links"):
            LinkErrors(("a", "b"), {"prior": np.ones(3)})


def page_of_two(**part: float) -> str:
    """Two results of one log, of which one predicts another part of it."""
    one = content_of_a_log(2)
    log = one.shown.log
    moved = replace(log, forces=replace(log.forces, **part))
    methods = (replace(one.shown, label="first", log=moved), *one.methods)
    return render(replace(one, methods=methods))


def test_errors_of_each_joint_are_compared_on_the_same_data_only() -> None:
    assert "the smallest is bold" in page_of_two(start=20.08)
    page = page_of_two(start=6.0, stop=8.0)
    assert "the smallest is bold" not in page
    assert "those of different data" in page


def test_the_caption_explains_gaps_between_blocks() -> None:
    base = content_of_a_log(2)
    forces = base.shown.log.forces
    assert "short gaps in the curves are normal" not in render(base)
    time = np.where(forces.time >= 24, forces.time + 0.4, forces.time)
    log = replace(base.shown.log, forces=replace(forces, time=time, stop=40.4))
    used = np.array([[0.0, 41.0]])
    one = replace(base.shown, log=replace(log, coverage=replace(log.coverage, used=used)))
    assert "short gaps in the curves are normal" in render(replace(base, methods=(one,)))


def test_the_caption_explains_curves_that_end_early() -> None:
    base = content_of_a_log(2)
    forces = base.shown.log.forces
    complete = np.nan_to_num(forces.measured)
    early = complete.copy()
    early[-9:, np.flatnonzero(forces.has_rows)[-1]] = np.nan
    for measured, is_explained in ((complete, False), (early, True)):
        log = replace(base.shown.log, forces=replace(forces, measured=measured))
        one = replace(base.shown, log=log)
        page = render(replace(base, methods=(one,)))
        assert ("where a joint rests" in page) == is_explained


@pytest.mark.parametrize(
    ("value", "text"),
    [
        *((absent, "not given") for absent in (None, [], "")),
        *((False, "no"), (True, "yes"), (0.0, "0.0"), (["a", "b"], "a, b")),
    ],
)
def test_options_that_were_not_given_say_so(value: object, text: str) -> None:
    assert option_text(value) == text


def test_errors_that_read_alike_are_marked_alike() -> None:
    one = content_of_a_log(2)
    log = one.shown.log
    slightly = replace(
        log, forces=replace(log.forces, rmse_after=log.forces.rmse_after * (1 + 1e-9))
    )
    compared = compared_results((replace(one.shown, label="first", log=slightly), one.shown))
    assert compared is not None
    assert compared.joints
    assert all(is_best for _, errors in compared.joints for _, is_best in errors)
