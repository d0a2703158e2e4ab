"""The page summarises what the data determine, with alarms at the top."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from report_pages import LINK_GAIN, SENSORS, VERDICT, Page, content

from symbid_ros.estimation.alarms import (
    SUSPICIOUS_NOISE,
    SUSPICIOUS_SCALE,
    SUSPICIOUS_WHITENESS,
)
from symbid_ros.estimation.unexplained import UnexplainedForce
from symbid_ros.estimation.verdict import EstimatedQuantity
from symbid_ros.identification.predictions.intervals import IntervalSummary
from symbid_ros.report.content import (
    METRICS,
    REALISTIC_METRICS,
    MethodResult,
    ReportContent,
    TruncationChoice,
)
from symbid_ros.report.data_summary import identified_base, parameter_groups, verdict_entries
from symbid_ros.report.formatting import ABSENT, with_std
from symbid_ros.report.page import render


def content_with_verdict(*, truth: bool = False, **fields: object) -> ReportContent:
    """The small report with a verdict on its chosen estimate, some fields changed."""
    base = content(2, truth=truth)
    estimate = replace(base.estimate, rank=None, verdict=replace(VERDICT, **fields))
    methods = tuple(
        MethodResult(m.label, estimate, m.metrics) if m.label == base.chosen else m
        for m in base.methods
    )
    return replace(base, methods=methods)


def text_of(page: Page) -> str:
    return " ".join("".join(page.text).split())


LARGE, SMALL = (UnexplainedForce("knee", "Nm", 80 * share, 80.0, share) for share in (0.04, 0.004))


class TestAlarms:
    alarms = ("the data would have the prior 9.0 times wider", "residuals last longer <than> noise")

    def test_alarms_come_before_everything_else(self) -> None:
        page = Page(render(content_with_verdict(alarms=self.alarms)))
        text = text_of(page)
        assert "Do not use this model yet: 2 alarms." in text
        assert "no alarm" not in text
        first_section = page.source.index("<section")
        assert all(
            text.index(alarm) < text.index("What the data determine") for alarm in self.alarms
        )
        assert page.source.index('class="alarms"') < page.source.index("<nav") < first_section

    def test_one_alarm_is_singular(self) -> None:
        assert "not use this model yet: 1 alarm." in text_of(
            Page(render(content_with_verdict(alarms=self.alarms[:1])))
        )

    def test_alarms_name_options_as_flags(self) -> None:
        alarm = "1 < 2 Nm unexplained; give `sensor_errors` torque_gain"
        page = render(content_with_verdict(alarms=(alarm,)))
        assert "1 &lt; 2 Nm unexplained; give <code>--sensor-errors</code> torque_gain" in page

    def test_a_page_without_alarms_says_so(self) -> None:
        page = Page(render(content_with_verdict()))
        text = text_of(page)
        assert "no data were held out; no alarm." in text
        assert "The data determine 2 of 30 parameter combinations" in text
        assert "alarms" not in page.attributes("class")

    def test_a_method_without_verdict_has_no_summary(self) -> None:
        text = text_of(Page(render(content(2, truth=False))))
        assert "o alarm" not in text
        assert "What the data determine" not in text

    @pytest.mark.parametrize(
        ("fields", "marked"),
        [
            ({}, set()),
            ({"prior_scale": 1.01 * SUSPICIOUS_SCALE}, {"Prior scale"}),
            ({"prior_scale": 0.01}, set()),
            ({"whiteness": 1.01 * SUSPICIOUS_WHITENESS}, {"Whiteness"}),
            ({"noise_share": 1.01 * SUSPICIOUS_NOISE}, {"Noise in the motion"}),
            ({"whiteness": 2.0, "unexplained": (LARGE,)}, {"Whiteness", "Unexplained force"}),
            ({"whiteness": 2.0, "unexplained": (SMALL,)}, set()),
        ],
    )
    def test_the_number_behind_an_alarm_is_marked(
        self, fields: dict[str, object], marked: set[str]
    ) -> None:
        entries = verdict_entries(content_with_verdict(**fields).estimate)
        assert {entry.name for entry in entries if entry.is_alarm} == marked


@pytest.mark.parametrize(
    ("gravity", "shown"),
    [
        (None, None),
        ((0.0, 0.0, -9.81), None),
        ((0.0, 0.0, 0.0), None),
        ((9.81, 0.0, 0.0), "along (1.000, 0.000, 0.000)"),
    ],
)
def test_only_a_base_that_does_not_stand_upright_shows_gravity(gravity, shown) -> None:
    entries = verdict_entries(replace(content_with_verdict().estimate, gravity=gravity))
    found = {entry.name: entry.value for entry in entries}
    assert found.get("Gravity") == shown


class TestDataSummary:
    page = Page(render(content_with_verdict(sensors=SENSORS)))

    def test_numbers_are_those_of_the_verdict(self) -> None:
        text = text_of(self.page)
        assert "4321 rows of each coordinate, averaged over windows of 161 ms" in text
        assert "14.2 of 30 sum, over all combinations," in text
        assert "61.5 bits gained in total" in text
        assert "3.00 % of the apparent information about the combination with most noise" in text

    def test_rows_at_single_instants_are_described(self) -> None:
        entries = verdict_entries(content_with_verdict(window=0.0, whiteness=0.0).estimate)
        values = {entry.name: entry.value for entry in entries}
        assert values["Rows"] == "4321 rows of each coordinate, at single instants"
        assert values["Whiteness"] == ABSENT

    def test_each_link_shows_its_information_gain(self) -> None:
        estimate = content_with_verdict().estimate
        rows = [row for row in self.page.rows if row[0] in LINK_GAIN and len(row) == 5]
        assert [row[0] for row in rows] == list(LINK_GAIN)
        for index, row in enumerate(rows):
            mass, std = estimate.value[10 * index], 0.01 * estimate.prior[10 * index]
            assert row[1:4] == ["5 of 10", with_std(mass, std), f"{LINK_GAIN[row[0]]:.1f}"]
        bars = [style for style in self.page.attributes("style") if "width" in style]
        assert bars == ["width: 100.0%", "width: 25.0%", "width: 0.0%"]

    def test_quantities_show_their_standard_deviation(self) -> None:
        base = self.page.row("base_link/m + link_0/m − 0.5·link_1/mc_x")
        assert base[1:] == ["41.04740 ± 0.00093", "kg", "yes"]
        assert self.page.row("link_1/Ixx")[1:] == ["−0.0182 ± 0.0030", "kg m²", "no"]
        offset = self.page.row("left_sole/wrench_offset_force_x")
        assert offset[1:] == ["−1.875 ± 0.013", "N", "yes"]
        assert self.page.row("knee/torque_gain")[1:] == ["0.0148 ± 0.0072", "relative", "no"]
        text = text_of(self.page)
        assert "Base parameters the 2 combinations that all forces depend on" in text
        assert "Sensor errors 1 of 2 determined" in text

    def test_without_sensor_errors_their_table_is_absent(self) -> None:
        assert "Sensor errors" not in text_of(Page(render(content_with_verdict())))

    def test_directions_keep_coefficient_and_parameter_on_one_line(self) -> None:
        directions = [text for text in self.page.text if "base_link/m" in text and "0.72" in text]
        assert directions == ["+0.72\xa0base_link/m −0.37\xa0link_0/mc_x"]
        assert "Determined combinations 2 of 30, best first" in text_of(self.page)


@pytest.fixture(scope="class")
def evaluated_page() -> Page:
    realistic = {
        label: {metric.key: scale * (i + 1.0) for i, metric in enumerate(REALISTIC_METRICS)}
        for label, scale in (("truth", 0.1), ("prior", 2.0), ("WLS-RC", 0.5))
    }
    truncations = tuple(
        TruncationChoice("OLS", chosen_by, rank, {m.key: float(rank) for m in METRICS})
        for chosen_by, rank in (("the log itself", 34), ("the ideal bag", 19))
    )
    intervals = IntervalSummary(0.2, 0.0152, 0.93, 0.805)
    shown = replace(content_with_verdict(truth=True), predictions=None, link_errors=None)
    return Page(
        render(replace(shown, intervals=intervals, realistic=realistic, truncations=truncations))
    )


class TestEvaluation:
    def test_intervals_show_deviation_and_coverage(self, evaluated_page: Page) -> None:
        assert evaluated_page.row("Centre of mass")[1:] == ["0.200 mm", "93 %"]
        assert evaluated_page.row("Joint torques")[1:] == ["0.0152 Nm", "80 %"]

    def test_realistic_predictions_show_the_given_errors(self, evaluated_page: Page) -> None:
        rows = [row for row in evaluated_page.rows if len(row) == 1 + len(REALISTIC_METRICS)]
        assert [row[0] for row in rows] == ["Method", "truth", "prior", "WLS-RC"]
        assert rows[3][1:] == ["0.500", "1.00", "1.50", "2.00", "2.50", "3.00"]

    def test_the_truth_is_never_the_best_method(self, evaluated_page: Page) -> None:
        start = evaluated_page.source.index('<section id="realistic">')
        section = evaluated_page.source[start : evaluated_page.source.index("</section>", start)]
        assert section.count("<strong>") == len(REALISTIC_METRICS)
        assert "<strong>0.100" not in section

    def test_z_from_the_log_is_next_to_z_from_the_ideal_bag(self, evaluated_page: Page) -> None:
        rows = [row for row in evaluated_page.rows if row[0] == "OLS" and len(row) == 8]
        assert [row[1:4] for row in rows] == [
            ["the log itself", "34", "34.0"],
            ["the ideal bag", "19", "19.0"],
        ]

    def test_navigation_lists_the_sections_in_order(self, evaluated_page: Page) -> None:
        sections = [a["id"] for tag, a in evaluated_page.elements if tag == "section"]
        assert sections == [
            *("methods", "realistic", "truncation", "data-summary"),
            *("possible", "parameters", "data"),
        ]
        links = [a["href"] for tag, a in evaluated_page.elements if tag == "a"]
        own = [link for link in links if link.startswith("#")]
        assert own == [f"#{section}" for section in sections]


@given(
    st.floats(-1e4, 1e4).filter(lambda v: abs(v) > 1e-6),
    st.floats(1e-6, 1e3),
)
def test_a_deviation_has_two_digits_and_its_value_the_same_decimals(
    value: float, std: float
) -> None:
    numbers, _, exponent = with_std(value, std).replace("−", "-").partition("e")
    shown, _, deviation = numbers.strip("()").partition(" ± ")
    scale = 10.0 ** int(exponent or 0)
    assert scale * float(deviation) == pytest.approx(std, rel=0.051)
    assert abs(scale * float(shown) - value) <= 0.051 * std
    if "." in deviation:
        assert len(shown.partition(".")[2]) == len(deviation.partition(".")[2])
    else:
        assert float(shown) != 0  # one digit of the value remains


@pytest.mark.parametrize("std", [0.0, np.inf, np.nan])
def test_without_a_deviation_the_value_stands_alone(std: float) -> None:
    assert with_std(-0.25, std) == "-0.250"


def test_joint_terms_that_were_not_identified_are_not_listed() -> None:
    base = content_with_verdict().estimate
    terms = "knee/viscous", "knee/coulomb"
    quantities = tuple(EstimatedQuantity(name, "Nm", 0.0, 1e-9, False) for name in terms)
    estimate = replace(
        base,
        names=(*base.names, *terms),
        units=(*base.units, "Nm s/rad", "Nm"),
        **{
            name: None if (one := getattr(base, name)) is None else np.append(one, [0, 0])
            for name in ("value", "std", "prior")
        },
        determined=None,
        joint_terms={"knee": ("coulomb",)},
        verdict=replace(base.verdict, base=quantities),
    )
    assert [one.name for one in identified_base(estimate)] == ["knee/coulomb"]
    *_, joints = parameter_groups(estimate)
    assert [row.name for row in joints.rows] == ["knee/coulomb"]
