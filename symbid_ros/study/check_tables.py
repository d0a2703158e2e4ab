"""Tables of what was checked beside the comparison of methods."""

from collections.abc import Mapping, Sequence

import numpy as np

from symbid_ros.report.content import REALISTIC_METRICS, TRUTH
from symbid_ros.simulation.balance import BalanceRun
from symbid_ros.study.checks import AccelerationCheck, Closure
from symbid_ros.study.scores import REFERENCE
from symbid_ros.study.sheet import Cell, Column, Row, Sheet
from symbid_ros.study.thesis import ACCELERATION_ERRORS, CLOSURES, TITLES

LABELS = {**TITLES, TRUTH: "Truth"}


def closure_table(closures: Sequence[Closure]) -> Sheet:
    """Return Appendix B's check of the equation of motion."""
    return Sheet(
        name="appendix_b",
        title="Appendix B: does the equation of motion close?",
        caption=(
            "Root mean square of y − K φ at the true parameters on noise-free logs, norm per "
            "sample; with friction at instants at which no joint may stick. Second the order of "
            "magnitude that the thesis states."
        ),
        headings=(Column("Robot"), Column("Model"), Column("Contact forces")),
        columns=(Column("RMSE", "N, Nm"),),
        rows=tuple(
            Row(
                (Cell(words=one.robot), Cell(words=one.model), Cell(words=one.wrenches)),
                (Cell(one.rmse, CLOSURES.get((one.robot, one.model, one.wrenches))),),
            )
            for one in closures
        ),
        notes=(
            "The thesis reaches 1e-14 with friction in Simscape, whose contact forces are exact; "
            "in MuJoCo it takes recorded contact forces and no friction columns (order 1), then "
            "contact forces rebuilt by Eq. 4.1.",
        ),
    )


def acceleration_table(checks: Mapping[str, AccelerationCheck], cutoff: float) -> Sheet:
    """Return what a filter does to joint accelerations (Eq. 4.2)."""
    return Sheet(
        name="accelerations",
        title="Filtered joint accelerations",
        caption=(
            f"True joint accelerations, and the error e_a of those differentiated from positions "
            f"filtered at {cutoff:g} Hz (thesis, Eq. 4.2); root mean square of the norm."
        ),
        headings=(Column("Log"),),
        columns=(Column("Acceleration", "rad/s²"), Column("e_a", "rad/s²")),
        rows=tuple(
            Row(
                (Cell(words=name),),
                (Cell(one.rms), Cell(one.error, ACCELERATION_ERRORS.get(name))),
            )
            for name, one in checks.items()
        ),
    )


def realistic_table(means: Mapping[str, Mapping[str, float]]) -> Sheet:
    """Return the errors of predictions as a robot could make them, by method."""
    judged = {method: found for method, found in means.items() if method != TRUTH}
    least = {
        metric.key: min(found[metric.key] for found in judged.values())
        for metric in REALISTIC_METRICS
    }
    return Sheet(
        name="realistic",
        title="Errors of realistic predictions",
        caption=(
            "Means over the draws: velocities filtered in real time, accelerations as desired, "
            "contact forces predicted by Eq. 4.1; “by wrenches”: torques from the measured contact "
            "forces instead. Bold: the least."
        ),
        headings=(Column("Method"),),
        columns=tuple(Column(metric.title, metric.unit) for metric in REALISTIC_METRICS),
        rows=tuple(
            Row(
                (Cell(words=LABELS[method]),),
                tuple(
                    Cell(
                        means[method][metric.key],
                        best=method != TRUTH and means[method][metric.key] == least[metric.key],
                    )
                    for metric in REALISTIC_METRICS
                ),
            )
            for method in LABELS
            if method in means
        ),
    )


def balance_table(prior: str, runs: Mapping[str, Sequence[BalanceRun]]) -> Sheet:
    """Return how the balance controller did with each method's models."""
    return Sheet(
        name=f"closed_loop_{prior.replace(' ', '').replace('%', 'percent').replace('±', '')}",
        title=f"Closed loop, priors {prior}",
        caption=(
            "CoM tracking and the feed-forward share of the torques over the runs that lasted; "
            "a run ends with a fall, at a joint’s end stop, or when its model allows no torques."
        ),
        headings=(Column("Model"),),
        columns=(
            Column("Stood"),
            Column("CoM tracking, median", "mm"),
            Column("worst", "mm"),
            Column("Feed-forward", "%"),
            Column("Ended by"),
        ),
        rows=tuple(
            _balanced(LABELS[method], runs[method])
            for method in (*LABELS,)
            if method in runs and (method == REFERENCE or runs[method])
        ),
    )


def _balanced(name: str, runs: Sequence[BalanceRun]) -> Row:
    lasting = [run for run in runs if not run.failure]
    tracking = [run.com_rmse_mm for run in lasting]
    share = [100 * run.feed_forward_share for run in lasting]
    causes = sorted({run.failure for run in runs if run.failure})
    return Row(
        (Cell(words=name),),
        (
            Cell(words=f"{len(lasting)} of {len(runs)}"),
            Cell(float(np.median(tracking)) if tracking else None),
            Cell(max(tracking) if tracking else None),
            Cell(float(np.median(share)) if share else None),
            Cell(words="; ".join(causes) or "—"),
        ),
    )
