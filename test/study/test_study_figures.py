"""Figures are complete and readable, show the given data, and are reproducible."""

import itertools
import re
import struct
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest
from random_robots import random_robot
from report_pages import series
from tree_simulation import TreeSimulation

from symbid_ros.errors import StudyError
from symbid_ros.identification.predictions.realistic_prediction import (
    evaluate_realistic,
    predict_realistic,
)
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_realistic_motion
from symbid_ros.report.content import METRICS, LinkErrors
from symbid_ros.report.formatting import significant
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.simulation.recording import record
from symbid_ros.study.checks import AccelerationCheck
from symbid_ros.study.figures import (
    acceleration_figure,
    closed_loop_figure,
    comparison_figure,
    filter_figure,
    link_figure,
)
from symbid_ros.study.plotting import label_styles
from symbid_ros.study.prediction_figures import (
    COM,
    MOMENTUM,
    TORQUE,
    describe_estimates,
    prediction_figure,
    realistic_series,
    realistic_truth,
)
from symbid_ros.study.scores import Case, Scores
from symbid_ros.study.thesis import table_c1

SVG = "{http://www.w3.org/2000/svg}"
PHONE = 390  # CSS pixels across
JOINTS = tuple(f"joint_{j}" for j in range(10))
LINKS = tuple(f"link_{j}" for j in range(11))
METHODS = ("ref", "ols", "wls_r", "wls_c", "wls_rc", "map", "map_lmi")
LABELS = ("Ref.", "OLS", "WLS-R", "WLS-C", "WLS-RC", "MAP", "MAP-LMI")
ESTIMATES = describe_estimates("smooth", "±25 %", 70.0)
NAN = float("nan")


def predictions():
    offsets = {"truth": 0.0, "Ref.": 1.0, "WLS-RC": 0.1, "MAP-LMI": 0.01}
    return [series(label, len(JOINTS), offset) for label, offset in offsets.items()]


def scores():
    cutoffs = (0.0, 30.0, 50.0, 70.0, 100.0)
    means = {}
    for row, (method, data) in enumerate(itertools.product(METHODS, ("smooth", "vibrating"))):
        filtered = method not in {"ref", "map", "map_lmi"}
        for column, cutoff in enumerate(cutoffs if filtered else (None,)):
            value = 3.0 ** (row - 8) * (1.0 + abs(column - 2))
            means[Case(data, "±25 %", method, cutoff)] = {m.key: value for m in METRICS}
    return Scores(means)


def completed(rmse, share=0.9):
    return BalanceResult(rmse, (0.0, 0.0, 0.0), share, None, "", 20.0)


def failed():
    return BalanceResult(NAN, (NAN, NAN, NAN), NAN, 1.5, "the robot fell", 20.0)


def vibration():
    time = np.arange(2000) * 1e-3
    wave = np.sin(2 * np.pi * 5 * time)[:, None] * np.ones(len(JOINTS))
    rms = np.sqrt(len(JOINTS) / 2)
    return {
        "vibrating": AccelerationCheck(JOINTS, time, 20.0 * wave, 20.0 * rms, 55.0),
        "suspended": AccelerationCheck(JOINTS, time, 2.0 * wave, 2.0 * rms, 4.5),
    }


def predicted(quantity, velocity_cutoff=None):
    return prediction_figure(quantity, predictions(), JOINTS, ESTIMATES, velocity_cutoff)


def link_errors():
    percent = {label: np.geomspace(1.0, 10.0, 11) * 4.0**i for i, label in enumerate(LABELS)}
    return LinkErrors(LINKS, percent)


RUNS = {
    "Ref.": [completed(10.0), completed(14.0), failed()],
    "OLS": [failed(), failed(), failed()],
    "MAP-LMI": [completed(0.5, 0.98)] * 3,
    "truth": [completed(0.4, 0.99)],
}
TIMED = ["truth", "Ref.", "WLS-RC", "MAP-LMI", "time [s]"]
MOMENTA = [f"Linear {a} momentum [Ns]" for a in "xyz"]
MOMENTA += [f"Angular {a} momentum [Nms]" for a in "xyz"]
PANELS = [f"{metric.title} [{metric.unit}]" for metric in METRICS]

# By key: the function that plots it, the stem of its files, and texts in it.
FIGURES = {
    "com": (
        lambda: predicted(COM),
        "fig_3_com",
        [*TIMED, *(f"CoM {a} position [mm]" for a in "xyz")],
    ),
    "torque": (
        lambda: predicted(TORQUE),
        "fig_4_torque",
        # Later joints carry larger loads.
        [*TIMED, *(f"joint_{j} torque [Nm]" for j in (6, 7, 8, 9))],
    ),
    "momentum": (
        lambda: predicted(MOMENTUM),
        "fig_5_momentum",
        [*TIMED, *MOMENTA],
    ),
    "links": (
        lambda: link_figure(link_errors(), ESTIMATES, 20),
        "fig_6_links",
        [*LABELS, "mean relative parameter error [%]", *LINKS],
    ),
    "realistic_com": (lambda: predicted(COM, 50.0), "fig_4_1_com", TIMED),
    "realistic_momentum": (
        lambda: predicted(MOMENTUM, 50.0),
        "fig_4_1_momentum",
        [*TIMED, *MOMENTA],
    ),
    "realistic_torque": (
        lambda: predicted(TORQUE, 50.0),
        "fig_4_2_torque",
        TIMED,
    ),
    "accelerations": (
        lambda: acceleration_figure(vibration(), 70.0),
        "fig_4_3_accelerations",
        [
            *JOINTS,
            "time [s]",
            "(a) vibrating: acceleration [rad/s²]",
            "(b) suspended: acceleration [rad/s²]",
        ],
    ),
    "closed_loop": (
        lambda: closed_loop_figure(RUNS, "Three priors."),
        "closed_loop",
        [
            *RUNS,
            "CoM tracking RMSE [mm]",
            "feed-forward share of the torque [%]",
            "× 1 of 3",
            "× 3 of 3",
        ],
    ),
    "comparison": (
        lambda: comparison_figure(scores(), ("smooth", "vibrating"), "±25 %", METHODS),
        "comparison_25_percent",
        [*LABELS, *PANELS, "smooth", "vibrating"],
    ),
    "grid": (
        lambda: filter_figure(scores(), "smooth", "±25 %", METHODS, table_c1()),
        "grid_smooth_25_percent",
        [*LABELS, *PANELS, "thesis", "30", "100", "none", "cutoff of the filter [Hz]"],
    ),
}


@pytest.fixture(scope="module")
def figures():
    return {key: make() for key, (make, _, _) in FIGURES.items()}


@pytest.fixture(scope="module", params=FIGURES)
def shown(request, figures, tmp_path_factory):
    make, stem, texts = FIGURES[request.param]
    plotted = figures[request.param]
    svg, png = plotted.save(tmp_path_factory.mktemp("figures"))
    return make, stem, texts, plotted, svg, png


class TestFigure:
    def test_saves_two_files_with_its_name(self, shown):
        _, stem, _, plotted, svg, png = shown
        assert plotted.name == stem
        assert {path.name for path in svg.parent.iterdir()} == {svg.name, png.name}
        assert (svg.name, png.name) == (f"{stem}.svg", f"{stem}.png")

    def test_svg_is_vectors_and_text(self, shown):
        _, _, texts, plotted, svg, _ = shown
        root = ElementTree.parse(svg).getroot()
        assert root.tag == f"{SVG}svg"
        assert not list(root.iter(f"{SVG}image"))
        assert plotted.title in "".join(root.find(f"{SVG}title").itertext())
        read = [" ".join("".join(t.itertext()).split()) for t in root.iter(f"{SVG}text")]
        for text in texts:
            assert text in read or any(re.fullmatch(rf"\d+ {re.escape(text)}", r) for r in read)

    def test_png_has_200_dots_per_inch(self, shown):
        *_, plotted, _, png = shown
        content = png.read_bytes()
        assert content[:8] == b"\x89PNG\r\n\x1a\n"
        size = struct.unpack(">II", content[16:24])
        np.testing.assert_allclose(size, 200 * plotted.figure.get_size_inches(), atol=1)

    def test_is_reproducible(self, shown, tmp_path):
        make, _, _, plotted, svg, png = shown
        for again in (plotted, make()):
            second = again.save(tmp_path)
            assert [p.read_bytes() for p in second] == [p.read_bytes() for p in (svg, png)]

    def test_text_is_readable_on_a_phone(self, shown):
        svg = shown[4]
        root = ElementTree.parse(svg).getroot()
        points_across = PHONE * 72 / 96
        scale = points_across / float(root.attrib["viewBox"].split()[2])
        sizes = [float(s) for s in re.findall(r"font-size: ([\d.]+)px", svg.read_text())]
        assert sizes
        assert scale * min(sizes) >= 8.0

    def test_everything_is_within_the_figure(self, shown):
        figure = shown[3].figure
        found = figure.get_tightbbox()
        width, height = figure.get_size_inches()
        assert (np.array([found.x0, found.y0]) >= 0).all()
        assert (found.x1, found.y1) <= (width, height)

    def test_has_a_description_for_screen_readers(self, shown):
        plotted = shown[3]
        svg = ElementTree.fromstring(plotted.embedded())
        assert svg.attrib["role"] == "img"
        assert svg.attrib["aria-label"] == plotted.description
        assert plotted.title in plotted.description


def test_ids_of_figures_on_one_page_are_unique(figures):
    assert len({plotted.name for plotted in figures.values()}) == len(figures)
    page = [plotted.embedded() for plotted in figures.values()]
    ids = [re.findall(r'\bid="([^"]+)"', svg) for svg in page]
    assert len(set(itertools.chain(*ids))) == sum(map(len, ids))
    for own, svg in zip(ids, page, strict=True):
        assert set(re.findall(r'(?:url\(|href=")#([^)"]+)', svg)) <= set(own)


class TestCaption:
    def test_states_the_errors_of_the_curves(self, figures):
        # Each offset is (10, 20, 30) mm times the label's.
        caption = figures["com"].caption
        error = 10.0 * np.sqrt(14)
        assert f"RMSE: Ref. {error:.1f} mm, WLS-RC {error / 10:.2f} mm" in caption
        assert "±25 %" in caption
        assert "70 Hz" in caption

    def test_names_unfiltered_rows_and_the_velocity_filter(self):
        assert "rows of truncated methods unfiltered" in describe_estimates("smooth", "±25 %", 0.0)
        assert "causal Butterworth filter at 50 Hz" in predicted(COM, 50.0).caption

    def test_states_rms_accelerations_and_their_errors(self, figures):
        caption = figures["accelerations"].caption
        rms = 20.0 * np.sqrt(len(JOINTS) / 2)
        assert f"RMS {rms:.1f} rad/s², e_a 55.0 rad/s² (thesis: 57 rad/s²)" in caption
        assert caption.count("thesis") == 1

    def test_counts_failed_runs_and_averages_the_others(self, figures):
        caption = figures["closed_loop"].caption
        assert "Ref. 12.0 mm (the robot fell in 1 of 3)" in caption
        assert "OLS all failed (the robot fell in 3 of 3)" in caption
        assert "MAP-LMI 0.500 mm;" in caption


def test_realistic_errors_equal_the_evaluation(tmp_path):
    robot = random_robot(4, links=6, floating=True, wrench_frames=1)
    (tmp_path / "robot.xml").write_text(mjcf_text(robot))
    parameters = ParameterSet(load_model(tmp_path / "robot.xml"))
    record(TreeSimulation(robot, 0.4, 4), tmp_path / "log")
    motion = read_realistic_motion([tmp_path / "log"], parameters.model)
    true, guess = parameters.values, 1.1 * parameters.values + 1e-3
    judged = evaluate_realistic(parameters, {"Ref.": guess}, true, motion)["Ref."]
    found = [
        realistic_truth(parameters, true, motion),
        realistic_series("Ref.", motion, predict_realistic(parameters, guess, motion)),
    ]
    joints = parameters.model.joint_names
    com, torque, momentum = (
        prediction_figure(quantity, found, joints, ESTIMATES, 50.0).caption
        for quantity in (COM, TORQUE, MOMENTUM)
    )
    assert f"Ref. {significant(judged.com_position_rmse_mm)} mm" in com
    assert f"Ref. {significant(judged.torque_rmse)} Nm" in torque
    assert f"Ref. {significant(judged.com_momentum_rmse)} Ns" in momentum


def lines_of(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour]


class TestFilters:
    def test_plots_the_scores_and_the_thesis_with_hollow_markers(self):
        own, theirs = scores(), table_c1()
        figure = filter_figure(own, "smooth", "±25 %", METHODS, theirs).figure
        cutoffs = (30.0, 50.0, 70.0, 100.0, 0.0)
        for axes, metric in zip(figure.axes, METRICS, strict=True):
            curve, hollow = lines_of(axes, label_styles(["WLS-C"])["WLS-C"].colour)
            assert hollow.get_markerfacecolor() == "none"
            for line, source, data in ((curve, own, "smooth"), (hollow, theirs, "thesis")):
                expected = [source.at(data, "±25 %", "wls_c", c)[metric.key] for c in cutoffs]
                np.testing.assert_array_equal(line.get_ydata(), expected)

    def test_omits_the_thesis_for_other_priors(self):
        own = Scores({replace(c, prior="±50 %"): m for c, m in scores().means.items()})
        plotted = filter_figure(own, "smooth", "±50 %", METHODS, table_c1())
        assert "thesis" not in plotted.caption
        assert "thesis" not in plotted.embedded()


class TestComparison:
    @pytest.mark.parametrize("cutoff", [None, 100.0])
    def test_plots_the_best_filter_or_the_given_one(self, cutoff):
        own = scores()
        figure = comparison_figure(own, ("smooth", "vibrating"), "±25 %", METHODS, cutoff).figure
        expected = [
            min(own.at(d, "±25 %", "ols", c)["torque_rmse"] for c in own.filters(d, "±25 %", "ols"))
            if cutoff is None
            else own.at(d, "±25 %", "ols", cutoff)["torque_rmse"]
            for d in ("smooth", "vibrating")
        ]
        (dots,) = lines_of(figure.axes[1], label_styles(["OLS"])["OLS"].colour)
        np.testing.assert_array_equal(dots.get_xdata(), expected)
        assert figure.axes[1].get_xscale() == "log"

    def test_omits_methods_without_scores(self):
        plotted = comparison_figure(scores(), ("smooth",), "±25 %", ("ref", "ols"), 30.0)
        assert "WLS-C" not in plotted.embedded()


def test_method_has_the_same_style_in_every_figure():
    everywhere = label_styles([*LABELS, "truth"])
    assert len(set(everywhere.values())) == len(everywhere)
    assert all(label_styles([label])[label] == everywhere[label] for label in LABELS)


class TestRejects:
    def test_predictions_without_the_truth(self):
        with pytest.raises(StudyError, match=r"Ref\., WLS-RC, MAP-LMI: 'truth' is missing"):
            prediction_figure(COM, predictions()[1:], JOINTS, ESTIMATES)

    def test_missing_scores(self):
        with pytest.raises(StudyError, match=r"no scores of ±12\.5 % for smooth"):
            filter_figure(scores(), "smooth", "±12.5 %", METHODS)
        with pytest.raises(StudyError, match="no scores of ±25 % for squat"):
            comparison_figure(scores(), ("squat",), "±25 %", METHODS)

    def test_a_label_without_runs(self):
        with pytest.raises(StudyError, match="closed loop of MAP: no runs"):
            closed_loop_figure({"MAP": []}, "")
