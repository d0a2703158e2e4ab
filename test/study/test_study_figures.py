"""Figures are whole, show what they were given, and come out the same again."""

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
from symbid_ros.identification.realistic_prediction import evaluate_realistic, predict_realistic
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_realistic_motion
from symbid_ros.report.content import METRICS, LinkErrors
from symbid_ros.report.formatting import significant
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.simulation.recording import record
from symbid_ros.study.figures import (
    AccelerationLog,
    acceleration_drawing,
    closed_loop_drawing,
    comparison_drawing,
    grid_drawing,
    link_drawing,
)
from symbid_ros.study.plotting import inline, looks, save
from symbid_ros.study.prediction_figures import (
    Setting,
    com_drawing,
    momentum_drawing,
    realistic_series,
    realistic_truth,
    torque_drawing,
)
from symbid_ros.study.scores import Case, Scores
from symbid_ros.study.thesis import table_c1

SVG = "{http://www.w3.org/2000/svg}"
PHONE = 390  # CSS pixels across
JOINTS = tuple(f"joint_{j}" for j in range(10))
LINKS = tuple(f"link_{j}" for j in range(11))
METHODS = ("ref", "ols", "wls_r", "wls_c", "wls_rc", "map", "map_lmi")
LABELS = ("Ref.", "OLS", "WLS-R", "WLS-C", "WLS-RC", "MAP", "MAP-LMI")
IDEAL = Setting("smooth", "±25 %", 70.0)
REALISTIC = replace(IDEAL, velocity_cutoff=50.0)
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


def lasted(rmse, share=0.9):
    return BalanceResult(rmse, (0.0, 0.0, 0.0), share, None, "", 20.0)


def fallen():
    return BalanceResult(NAN, (NAN, NAN, NAN), NAN, 1.5, "the robot fell", 20.0)


def vibration():
    time = np.arange(2000) * 1e-3
    wave = np.sin(2 * np.pi * 5 * time)[:, None] * np.ones(len(JOINTS))
    return [
        AccelerationLog("with vibrating legs", time, 20.0 * wave, 55.0, 57.0),
        AccelerationLog("floating in space", time, 2.0 * wave, 4.5),
    ]


def link_errors():
    percent = {label: np.geomspace(1.0, 10.0, 11) * 4.0**i for i, label in enumerate(LABELS)}
    return LinkErrors(LINKS, percent)


RUNS = {
    "Ref.": [lasted(10.0), lasted(14.0), fallen()],
    "OLS": [fallen(), fallen(), fallen()],
    "MAP-LMI": [lasted(0.5, 0.98)] * 3,
    "truth": [lasted(0.4, 0.99)],
}
TIMED = ["truth", "Ref.", "WLS-RC", "MAP-LMI", "time [s]"]
MOMENTA = [f"Linear {a} momentum [Ns]" for a in "xyz"]
MOMENTA += [f"Angular {a} momentum [Nms]" for a in "xyz"]
PANELS = [f"{metric.title} [{metric.unit}]" for metric in METRICS]

# What draws it, its file's stem, and what is to be read in it.
FIGURES = {
    "com": (
        lambda: com_drawing(predictions(), IDEAL),
        "fig_3_com",
        [*TIMED, *(f"CoM {a} position [mm]" for a in "xyz")],
    ),
    "torque": (
        lambda: torque_drawing(predictions(), JOINTS, IDEAL),
        "fig_4_torque",
        # The later the joint, the more it carries.
        [*TIMED, *(f"joint_{j} torque [Nm]" for j in (6, 7, 8, 9))],
    ),
    "momentum": (
        lambda: momentum_drawing(predictions(), IDEAL),
        "fig_5_momentum",
        [*TIMED, *MOMENTA],
    ),
    "links": (
        lambda: link_drawing(link_errors(), IDEAL, 20),
        "fig_6_links",
        [*LABELS, "mean relative parameter error [%]", *LINKS],
    ),
    "realistic_com": (lambda: com_drawing(predictions(), REALISTIC), "fig_4_1_com", TIMED),
    "realistic_momentum": (
        lambda: momentum_drawing(predictions(), REALISTIC),
        "fig_4_1_momentum",
        [*TIMED, *MOMENTA],
    ),
    "realistic_torque": (
        lambda: torque_drawing(predictions(), JOINTS, REALISTIC),
        "fig_4_2_torque",
        TIMED,
    ),
    "accelerations": (
        lambda: acceleration_drawing(vibration(), JOINTS, 70.0),
        "fig_4_3_accelerations",
        [
            *JOINTS,
            "time [s]",
            "(a) with vibrating legs: acceleration [rad/s²]",
            "(b) floating in space: acceleration [rad/s²]",
        ],
    ),
    "closed_loop": (
        lambda: closed_loop_drawing(RUNS, "Three priors."),
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
        lambda: comparison_drawing(scores(), ("smooth", "vibrating"), "±25 %", METHODS),
        "comparison_25_percent",
        [*LABELS, *PANELS, "smooth", "vibrating"],
    ),
    "grid": (
        lambda: grid_drawing(scores(), "smooth", "±25 %", METHODS, table_c1()),
        "grid_smooth_25_percent",
        [*LABELS, *PANELS, "thesis", "30", "100", "none", "cutoff of the filter [Hz]"],
    ),
}


@pytest.fixture(scope="module")
def drawings():
    return {key: make() for key, (make, _, _) in FIGURES.items()}


@pytest.fixture(scope="module", params=FIGURES)
def shown(request, drawings, tmp_path_factory):
    make, stem, texts = FIGURES[request.param]
    drawing = drawings[request.param]
    svg, png = save(drawing, tmp_path_factory.mktemp("figures"))
    return make, stem, texts, drawing, svg, png


class TestFigure:
    def test_files_carry_its_name_and_nothing_else_is_left(self, shown):
        _, stem, _, drawing, svg, png = shown
        assert drawing.name == stem
        assert {path.name for path in svg.parent.iterdir()} == {svg.name, png.name}
        assert (svg.name, png.name) == (f"{stem}.svg", f"{stem}.png")

    def test_svg_is_vectors_and_text(self, shown):
        _, _, texts, drawing, svg, _ = shown
        root = ElementTree.parse(svg).getroot()
        assert root.tag == f"{SVG}svg"
        assert not list(root.iter(f"{SVG}image"))
        assert drawing.title in "".join(root.find(f"{SVG}title").itertext())
        read = [" ".join("".join(t.itertext()).split()) for t in root.iter(f"{SVG}text")]
        for text in texts:
            assert text in read or any(re.fullmatch(rf"\d+ {re.escape(text)}", r) for r in read)

    def test_png_has_200_dots_an_inch(self, shown):
        *_, drawing, _, png = shown
        content = png.read_bytes()
        assert content[:8] == b"\x89PNG\r\n\x1a\n"
        size = struct.unpack(">II", content[16:24])
        np.testing.assert_allclose(size, 200 * drawing.figure.get_size_inches(), atol=1)

    def test_comes_out_the_same_again(self, shown, tmp_path):
        make, _, _, drawing, svg, png = shown
        for again in (drawing, make()):
            second = save(again, tmp_path)
            assert [p.read_bytes() for p in second] == [p.read_bytes() for p in (svg, png)]

    def test_no_text_is_small_on_a_phone(self, shown):
        svg = shown[4]
        root = ElementTree.parse(svg).getroot()
        points_across = PHONE * 72 / 96
        scale = points_across / float(root.attrib["viewBox"].split()[2])
        sizes = [float(s) for s in re.findall(r"font-size: ([\d.]+)px", svg.read_text())]
        assert sizes
        assert scale * min(sizes) >= 8.0

    def test_nothing_sticks_out(self, shown):
        figure = shown[3].figure
        found = figure.get_tightbbox()
        width, height = figure.get_size_inches()
        assert (np.array([found.x0, found.y0]) >= 0).all()
        assert (found.x1, found.y1) <= (width, height)

    def test_speaks(self, shown):
        drawing = shown[3]
        svg = ElementTree.fromstring(inline(drawing))
        assert svg.attrib["role"] == "img"
        assert svg.attrib["aria-label"] == drawing.description
        assert drawing.title in drawing.description


def test_figures_on_one_page_keep_their_ids_apart(drawings):
    assert len({drawing.name for drawing in drawings.values()}) == len(drawings)
    page = [inline(drawing) for drawing in drawings.values()]
    ids = [re.findall(r'\bid="([^"]+)"', svg) for svg in page]
    assert len(set(itertools.chain(*ids))) == sum(map(len, ids))
    for own, svg in zip(ids, page, strict=True):
        assert set(re.findall(r'(?:url\(|href=")#([^)"]+)', svg)) <= set(own)


class TestCaption:
    def test_states_the_errors_that_the_curves_have(self, drawings):
        # Each offset is (10, 20, 30) mm times the label's.
        caption = drawings["com"].caption
        error = 10.0 * np.sqrt(14)
        assert f"RMSE: Ref. {error:.1f} mm, WLS-RC {error / 10:.2f} mm" in caption
        assert "±25 %" in caption
        assert "70 Hz" in caption

    def test_says_what_is_not_filtered(self):
        caption = com_drawing(predictions(), Setting("smooth", "±25 %", 0.0, 0.0)).caption
        assert "rows unfiltered" in caption
        assert "differences of them, unfiltered" in caption

    def test_accelerations_are_root_mean_squares_of_the_vector(self, drawings):
        caption = drawings["accelerations"].caption
        rms = 20.0 * np.sqrt(len(JOINTS) / 2)
        assert f"RMS {rms:.1f} rad/s², e_a 55.0 rad/s² (thesis: 57 rad/s²)" in caption
        assert caption.count("thesis") == 1

    def test_closed_loop_counts_falls_and_averages_the_rest(self, drawings):
        caption = drawings["closed_loop"].caption
        assert "Ref. 12.0 mm (the robot fell in 1 of 3)" in caption
        assert "OLS none lasted (the robot fell in 3 of 3)" in caption
        assert "MAP-LMI 0.500 mm;" in caption


def test_realistic_errors_are_those_of_the_evaluation(tmp_path):
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
    com = com_drawing(found, REALISTIC).caption
    torque = torque_drawing(found, parameters.model.joint_names, REALISTIC).caption
    momentum = momentum_drawing(found, REALISTIC).caption
    assert f"Ref. {significant(judged.com_position_rmse_mm)} mm" in com
    assert f"Ref. {significant(judged.torque_rmse)} Nm" in torque
    assert f"Ref. {significant(judged.com_momentum_rmse)} Ns" in momentum


def lines_of(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour]


class TestGrid:
    def test_draws_the_table_and_the_thesis_hollow_beside_it(self):
        own, theirs = scores(), table_c1()
        figure = grid_drawing(own, "smooth", "±25 %", METHODS, theirs).figure
        cutoffs = (30.0, 50.0, 70.0, 100.0, 0.0)
        for axes, metric in zip(figure.axes, METRICS, strict=True):
            curve, hollow = lines_of(axes, looks(["WLS-C"])["WLS-C"].colour)
            assert hollow.get_markerfacecolor() == "none"
            for line, source, data in ((curve, own, "smooth"), (hollow, theirs, "thesis")):
                expected = [source.at(data, "±25 %", "wls_c", c)[metric.key] for c in cutoffs]
                np.testing.assert_array_equal(line.get_ydata(), expected)

    def test_leaves_the_thesis_out_where_it_has_none(self):
        own = Scores({replace(c, prior="±50 %"): m for c, m in scores().means.items()})
        drawing = grid_drawing(own, "smooth", "±50 %", METHODS, table_c1())
        assert "thesis" not in drawing.caption
        assert "thesis" not in inline(drawing)


class TestComparison:
    @pytest.mark.parametrize("cutoff", [None, 100.0])
    def test_draws_the_best_filter_or_the_one_asked_for(self, cutoff):
        own = scores()
        figure = comparison_drawing(own, ("smooth", "vibrating"), "±25 %", METHODS, cutoff).figure
        expected = [
            min(own.at(d, "±25 %", "ols", c)["torque_rmse"] for c in own.filters(d, "±25 %", "ols"))
            if cutoff is None
            else own.at(d, "±25 %", "ols", cutoff)["torque_rmse"]
            for d in ("smooth", "vibrating")
        ]
        (dots,) = lines_of(figure.axes[1], looks(["OLS"])["OLS"].colour)
        np.testing.assert_array_equal(dots.get_xdata(), expected)
        assert figure.axes[1].get_xscale() == "log"

    def test_leaves_out_what_was_not_tried(self):
        drawing = comparison_drawing(scores(), ("smooth",), "±25 %", ("ref", "ols"), 30.0)
        assert "WLS-C" not in inline(drawing)


def test_a_method_looks_the_same_in_every_figure():
    everywhere = looks([*LABELS, "truth"])
    assert len(set(everywhere.values())) == len(everywhere)
    assert all(looks([label])[label] == everywhere[label] for label in LABELS)


class TestRefuses:
    def test_predictions_without_the_truth(self):
        with pytest.raises(StudyError, match=r"Ref\., WLS-RC, MAP-LMI: no 'truth' among them"):
            com_drawing(predictions()[1:], IDEAL)

    def test_scores_that_are_not_there(self):
        with pytest.raises(StudyError, match=r"no scores of ±12\.5 % for smooth"):
            grid_drawing(scores(), "smooth", "±12.5 %", METHODS)
        with pytest.raises(StudyError, match="no scores of ±25 % for squat"):
            comparison_drawing(scores(), ("squat",), "±25 %", METHODS)

    def test_a_label_without_runs(self):
        with pytest.raises(StudyError, match="closed loop of MAP: no runs"):
            closed_loop_drawing({"MAP": []}, "")
