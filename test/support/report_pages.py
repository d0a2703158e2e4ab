"""A strict HTML parser for report pages, and small contents to render."""

import html.parser
from dataclasses import replace

import numpy as np

from symbid_ros.estimation.estimate import Estimate, HoldOut
from symbid_ros.estimation.verdict import EstimatedQuantity, Verdict
from symbid_ros.identification.report_data import (
    QUANTILES,
    Coverage,
    ForceSeries,
    ParameterSpread,
    ReportData,
)
from symbid_ros.model.inertia import PARAMETERS, UNITS
from symbid_ros.report.content import (
    METRICS,
    JointLimits,
    LinkErrors,
    MethodResult,
    ParameterCorrelation,
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
    EstimatedQuantity("left_sole/wrench_offset_force_x", "N", -1.875, 0.013, True),
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
        if not {"style", "script"} & set(self.open):
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


def report_data(names: tuple[str, ...], joints: tuple[str, ...], *, outlier: float = 1.0):
    """Return data of a log with a gap, a finding, and errors of 10 % before and 1 % after.

    The first joint's original error is ``outlier`` times as large.
    """
    rng = np.random.default_rng(3)
    base = tuple(f"base/{k}_{a}" for k in ("moment", "force") for a in "xyz")
    coordinates = (*base, *joints)
    count = len(coordinates)
    time = np.arange(20.0, 40.0, 0.04)
    measured = 10 * np.sin(time[:, None] * np.linspace(0.5, 2.0, count))
    before = measured - rng.normal(0, 1.0, measured.shape)
    before[:, 6] -= outlier
    after = measured - rng.normal(0, 0.1, measured.shape)
    measured[5:9, 6] = np.nan
    frequency = np.linspace(0.4, 12.5, 32)
    speed = np.full_like(measured, np.nan)
    speed[:, 6:] = np.cos(time[:, None] * np.linspace(0.5, 2.0, len(joints)))

    def rms(values):
        return np.sqrt(np.nanmean(values**2, axis=0))

    forces = ForceSeries(
        coordinates=coordinates,
        units=("Nm",) * 3 + ("N",) * 3 + ("Nm",) * len(joints),
        time=time,
        measured=measured,
        before=before,
        after=after,
        frequency=frequency,
        power_measured=np.exp(-frequency)[:, None] * np.ones(count),
        power_before=np.full((32, count), 0.1),
        power_after=np.full((32, count), 0.001),
        speed=speed,
        speed_before=measured - before,
        speed_after=measured - after,
        rms_measured=rms(measured),
        rmse_before=rms(measured - before),
        rmse_after=rms(measured - after),
        start=20.0,
        stop=40.0,
        is_held_out=True,
    )
    quantiles = np.linspace(-1.0, 1.0, len(QUANTILES)) * np.ones((len(joints), 1))
    finding = {
        "kind": "gap",
        "stream": "/joint_states",
        "severity": "warning",
        "message": "/joint_states: 50 messages <are> missing in 1 gap",
        "figures": {},
    }
    coverage = Coverage(
        log="walk_bag",
        begin=0,
        used=np.array([[0.0, 12.0], [13.0, 40.0]]),
        faults=({"kind": "gap", "stream": "/joint_states", "start": 12.0, "stop": 13.0},),
        findings=(finding,),
        is_checked=True,
        joints=joints,
        position=quantiles,
        speed=np.abs(quantiles),
        mean_posture=np.zeros(len(joints)),
    )
    spread = ParameterSpread(names, np.full(len(names), 0.2), np.zeros(len(names)))
    return ReportData(forces, coverage, spread)


def content_of_a_log(joints: int, *, outlier: float = 1.0, truth: bool = False) -> ReportContent:
    """Return the content with the data of a log, a verdict and a check on held-out data."""
    base = content(joints, truth=truth)
    shown = base.estimate
    log = report_data(shown.names, base.joint_names, outlier=outlier)
    holdout = HoldOut(20.0, 10.0, 1.0, "better", 0.0, {}, "10 % → 1 % of the measured torque")
    verdict = replace(VERDICT, link_gain=dict.fromkeys(shown.consistent, 3.0))
    estimate = replace(shown, verdict=verdict, holdout=holdout, rank=None)
    rng = np.random.default_rng(4)
    factor = rng.normal(size=(len(shown.names), 40))
    factor /= np.linalg.norm(factor, axis=1)[:, None]
    return replace(
        base,
        methods=tuple(
            replace(one, estimate=estimate, log=log) if one.label == base.chosen else one
            for one in base.methods
            if truth or one.label == base.chosen
        ),
        limits={name: JointLimits(-2.0, 2.0, False) for name in base.joint_names},
        spread=ParameterCorrelation(shown.names, factor @ factor.T, log.spread.prior_std),
    )
