"""A strict HTML parser for report pages, and small contents to render."""

import html.parser

import numpy as np

from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.verdict import EstimatedQuantity, Verdict
from symbid_ros.model.inertia import PARAMETERS, UNITS
from symbid_ros.report.content import (
    METRICS,
    LinkErrors,
    MethodResult,
    PredictionSeries,
    ReportContent,
)

LINK_GAIN = {"base_link": 12.0, "link_0": 3.0, "link_1": 0.0}
VERDICT = Verdict(
    window=0.161,
    prior_scale=1.1,
    whiteness=0.95,
    noise_share=0.03,
    alarms=(),
    effective=14.25,
    gain=61.5,
    link_gain=LINK_GAIN,
    directions=("+0.72 base_link/m -0.37 link_0/mc_x", "+1.00 link_1/m"),
    base=(
        EstimatedQuantity("base_link/m + link_0/m - 0.5·link_1/mc_x", "kg", 41.0474, 0.00093, True),
        EstimatedQuantity("link_1/Ixx", "kg m^2", -0.0182, 0.003, False),
    ),
    sensors=(),
)
SENSORS = (
    EstimatedQuantity("left_sole/plate_offset_force_x", "N", -1.875, 0.013, True),
    EstimatedQuantity("knee/torque_gain", "1", 0.0148, 0.0072, False),
)
VOID = {"meta", "link", "br", "hr", "img", "input"}


class Page(html.parser.HTMLParser):
    """A parsed page; elements that are not closed in order raise an error."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.source = text
        self.open: list[str] = []
        self.elements: list[tuple[str, dict[str, str | None]]] = []
        self.rows: list[list[str]] = []
        self.text: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)
        if tag == "tr":
            self.rows.append([])
        if tag in {"td", "th"}:
            self.rows[-1].append("")

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.elements.append((tag, dict(attrs)))

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag

    def handle_data(self, data: str) -> None:
        if {"td", "th"} & set(self.open):
            self.rows[-1][-1] += data.strip()
        if "style" not in self.open:
            self.text.append(data)

    def attributes(self, name: str) -> list[str]:
        return [a[name] or "" for _, a in self.elements if name in a]

    def row(self, header: str) -> list[str]:
        return next(row for row in self.rows if row[0] == header)


def estimate(links: tuple[str, ...], joints: tuple[str, ...], method: str = "wls_rc") -> Estimate:
    generator = np.random.default_rng(len(links))
    names = tuple(f"{link}/{p}" for link in links for p in PARAMETERS)
    prior = generator.uniform(0.1, 9.0, len(names))
    coordinates = [f"base/{k}_{a}" for k in ("moment", "force") for a in "xyz"]
    return Estimate(
        method=method,
        model="walker",
        names=names,
        units=UNITS * len(links),
        value=1.05 * prior,
        prior=prior,
        std=0.01 * prior,
        determined=np.arange(len(names)) % 2 == 0,
        rank=7,
        condition=1e3,
        samples=4321,
        residual_rmse=dict.fromkeys((*coordinates, *joints), 0.25),
        consistent=dict.fromkeys(links, True),
        inputs=("log", "walker.xml"),
        software="symbid_ros 0.1.0",
    )


def series(label: str, joints: int, offset: float, samples: int = 5000) -> PredictionSeries:
    time = np.linspace(0.0, 50.0, samples)
    wave = np.sin(time)[:, None]
    return PredictionSeries(
        label=label,
        time=time,
        com=0.01 * wave + offset * np.array([0.01, 0.02, 0.03]),
        torque=wave * np.arange(1.0, joints + 1.0) + offset,
        linear_momentum=wave * np.ones(3) + offset,
        angular_momentum=wave * np.ones(3) - offset,
    )


def metrics(scale: float) -> dict[str, float]:
    return {metric.key: scale * (i + 1.0) for i, metric in enumerate(METRICS)}


def content(joints: int, *, truth: bool = True) -> ReportContent:
    joint_names = tuple(f"joint_{i}" for i in range(joints))
    links = ("base_link", *(f"link_{i}" for i in range(joints)))
    rows = [
        MethodResult("prior", None, metrics(10.0) if truth else None),
        MethodResult("OLS", estimate(links, joint_names, "ols"), metrics(2e3) if truth else None),
        MethodResult("WLS-RC", estimate(links, joint_names), metrics(0.5) if truth else None),
    ]
    if truth:
        rows.append(MethodResult("truth", None, metrics(0.0)))
    errors = {"prior": np.full(len(links), 12.0), "OLS": np.linspace(1e2, 1e4, len(links))}
    predictions = (
        series("truth", joints, 0.0),
        series("prior", joints, 1.0),
        series("WLS-RC", joints, 0.1),
    )
    return ReportContent(
        title="Identification of walker",
        model="walker",
        methods=tuple(rows),
        chosen="WLS-RC",
        joint_names=joint_names,
        metadata={"Bag": "log", "Samples": "4321"},
        predictions=predictions if truth else None,
        link_errors=LinkErrors(links, errors) if truth else None,
    )
