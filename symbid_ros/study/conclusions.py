"""The thesis's conclusions, and ours, in words that follow from the numbers of a study."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.errors import StudyError
from symbid_ros.report.content import TRUTH, LinkErrors
from symbid_ros.report.formatting import significant
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study import claims
from symbid_ros.study.evidence import (
    FOUR,
    TIE,
    Conclusion,
    Evidence,
    compare,
    enumerate_words,
    explain,
    holds_by_order,
    holds_by_share,
)
from symbid_ros.study.plan import Plan
from symbid_ros.study.scores import METRICS, REFERENCE, Scores
from symbid_ros.study.thesis import TITLES

CLAIMS = (
    claims.best_of_four,
    claims.column_scaling,
    claims.row_scaling,
    claims.row_scaling_alone,
    claims.singular_values,
    claims.prior_dependence,
    claims.unfiltered_order,
    claims.worse_than_prior,
    claims.better_than_prior,
    claims.growing_gap,
    claims.absolute_errors,
    claims.map_lmi_is_best,
)
# Errors of one prior differ less than this between links, whatever the draw.
LARGE = 2.0


@dataclass(frozen=True)
class Links:
    """Parameter errors link by link (thesis, Fig. 6).

    Attributes
    ----------
    errors : LinkErrors
        By method, means over the draws.
    depth : tuple of int
        Joints between the base and each link.

    Raises
    ------
    StudyError
        When there is not one depth for each link.
    """

    errors: LinkErrors
    depth: tuple[int, ...]

    def __post_init__(self) -> None:
        if len(self.depth) != len(self.errors.links):
            raise StudyError(
                f"link errors: {len(self.depth)} depths for {len(self.errors.links)} links; "
                "give one for each link",
                "E709",
            )


def conclusions(evidence: Evidence, links: Links | None = None) -> tuple[Conclusion, ...]:
    """Check every claim for which there are numbers on one data set.

    Parameters
    ----------
    evidence : Evidence
        The means on one data set.
    links : Links, optional
        For the claim on single links.
    """
    found = [claim(evidence) for claim in CLAIMS]
    if links is not None:
        found.append(link_accuracy(links))
    return tuple(one for one in found if one is not None)


def link_accuracy(links: Links) -> Conclusion | None:
    """Examine whether links differ greatly, the outer ones being the less accurate."""
    depth = np.array(links.depth)
    outer = 2 * depth > depth.max()
    percent = {
        method: found for method in FOUR if (found := links.errors.percent.get(method)) is not None
    }
    if not percent or outer.all() or not outer.any():
        return None
    ranges = {method: _range(found) for method, found in percent.items()}
    ratios = {
        method: float(np.nanmean(found[outer]) / np.nanmean(found[~outer]))
        for method, found in percent.items()
    }
    as_claimed = [m for m in percent if ranges[m] >= LARGE and ratios[m] > 1 + TIE]
    spans, slopes = (
        enumerate_words(f"{TITLES[method]} {significant(found[method], 2)}" for method in percent)
        for found in (ranges, ratios)
    )
    prior = links.errors.percent.get(REFERENCE)
    holds = holds_by_share(len(as_claimed), len(percent))
    return Conclusion(
        "Estimation accuracy differs greatly over the links, as distal ones are almost stationary "
        "(section VI-A, Fig. 6).",
        holds,
        f"Largest parameter error of a link over the smallest: {spans}; mean of the outer links "
        f"over that of the inner ones: {slopes}.",
        explain(
            holds,
            f"not with {enumerate_words(TITLES[m] for m in percent if m not in as_claimed)}"
            if holds is not True
            else "",
            f"largest over smallest of the prior itself: {significant(_range(prior), 2)}"
            if prior is not None
            else "",
        ),
    )


def realistic_conclusion(
    ideal: Mapping[str, float], realistic: Mapping[str, float]
) -> Conclusion | None:
    """Examine whether torque prediction gains more where signals are realistic.

    Parameters
    ----------
    ideal, realistic : mapping of str to float
        Torque RMSE, Nm, by method, "ref" for the prior and "truth" for the true parameters; from
        ideal signals, and from those that the robot itself would have.

    Returns
    -------
    Conclusion or None
        None without the prior or any method.
    """
    both = [name for name in (*TITLES, TRUTH) if name in ideal and name in realistic]
    methods = [name for name in both if name not in (REFERENCE, TRUTH)]
    if REFERENCE not in both or not methods:
        return None
    before, after = ideal[REFERENCE], realistic[REFERENCE]
    # The thesis compares two drawings, in which a gain may be seen as a difference or a factor.
    by_difference = sum(compare(before - ideal[m], after - realistic[m]) == 1 for m in methods)
    by_factor = sum(compare(before / ideal[m], after / realistic[m]) == 1 for m in methods)
    holds = holds_by_share(by_difference + by_factor, 2 * len(methods))
    told = enumerate_words(
        f"{TITLES.get(name, name)} {significant(ideal[name])} and {significant(realistic[name])} Nm"
        for name in both
    )
    return Conclusion(
        "Torque prediction benefits more from estimation in the realistic situation than in the "
        "ideal one (section 4.2.1).",
        holds,
        "From prior to estimate the torque error falls further with realistic signals in "
        f"{by_difference} of {len(methods)} cases by difference and in {by_factor} by factor "
        f"(ideal and realistic: {told}).",
        explain(
            holds,
            "with realistic signals even the true parameters err by "
            f"{significant(realistic[TRUTH])} Nm, which no estimate takes away"
            if TRUTH in both
            else "",
        ),
    )


def closed_loop_conclusions(runs: Mapping[str, Sequence[BalanceResult]]) -> tuple[Conclusion, ...]:
    """Say of every method how the balance controller does with its estimates.

    Parameters
    ----------
    runs : mapping of str to sequence of BalanceResult
        By method, "ref" for the priors and "truth" for the true parameters; of the methods and
        the prior one run for each draw, in the same order.
    """
    prior, truth = runs.get(REFERENCE, ()), runs.get(TRUTH, ())
    return tuple(
        _balanced(TITLES[method], runs[method], prior, truth)
        for method in TITLES
        if method != REFERENCE and runs.get(method) and prior
    )


def _balanced(
    name: str,
    own: Sequence[BalanceResult],
    prior: Sequence[BalanceResult],
    truth: Sequence[BalanceResult],
) -> Conclusion:
    orders = [compare(_failed(own), _failed(prior))]
    stood = enumerate_words(
        f"{sum(not run.failure for run in found)} of {len(found)} runs with {who}"
        for who, found in ((name, own), ("the prior", prior), ("the truth", truth))
        if found
    )
    text = f"The robot stood in {stood}."
    # Means of those that last would favour whoever fails where it is hard.
    paired = [
        (mine, theirs)
        for mine, theirs in zip(own, prior, strict=False)
        if not mine.failure and not theirs.failure
    ]
    if paired:
        with_own, with_prior = zip(*paired, strict=True)
        orders.append(compare(_com(with_own), _com(with_prior)))
        orders.append(compare(_feedback(with_own), _feedback(with_prior)))
        lasting = [run for run in truth if not run.failure]
        com, forward = (
            ", ".join(
                f"{significant(figure(found))} {unit} with {who}"
                for who, found in ((name, with_own), ("the prior", with_prior), ("truth", lasting))
                if found
            )
            for figure, unit in ((_com, "mm"), (_forward, "%"))
        )
        text += (
            f" Where neither {name} nor the prior failed, the CoM missed its reference by {com}; "
            f"the feed-forward share of the torques was {forward}."
        )
    # To fall more often is no part of serving better.
    holds = False if orders[0] < 0 else holds_by_order(orders)
    causes = sorted({run.failure for run in own if run.failure})
    return Conclusion(
        f"{name} serves centroidal dynamics control better than the prior "
        "(the thesis's third objective, section 1.1).",
        holds,
        text,
        explain(
            holds, f"runs with {name} ended because {enumerate_words(causes)}" if causes else ""
        ),
    )


def _failed(runs: Sequence[BalanceResult]) -> float:
    return float(np.mean([bool(run.failure) for run in runs]))


def _com(runs: Sequence[BalanceResult]) -> float:
    return float(np.mean([run.com_rmse_mm for run in runs]))


def _forward(runs: Sequence[BalanceResult]) -> float:
    return 100 * float(np.mean([run.feed_forward_share for run in runs]))


def _feedback(runs: Sequence[BalanceResult]) -> float:
    return 100 - _forward(runs)


def _range(percent: FloatArray) -> float:
    return float(np.nanmax(percent) / np.nanmin(percent))


SHORT_NOUNS = dict(
    zip(METRICS, ("gen. force", "torque", "CoM", "momentum", "parameters"), strict=True)
)
# What a balance controller needs most.
COM = "com_position_rmse_mm"
# The half-width of priors, %, that the thesis discusses most.
USUAL = 25.0


def headline(scores: Scores, plan: Plan) -> str:
    """Return the outcome for the centre of mass in a sentence for each data set, few together.

    Of the prior nearest to the usual one.
    """
    near = min(plan.priors, key=lambda one: (one.kind != "percent", abs(one.amount - USUAL)))
    prior = str(near)
    if len(plan.data) > 2:
        return _between_data(scores, [*plan.data], prior, plan.methods)
    sentences = [_between_methods(scores, data, prior, plan.methods) for data in plan.data]
    return f"Priors {prior}. " + " ".join(sentences)


def data_sentences(
    scores: Scores, data: Sequence[str], prior: str, methods: Sequence[str]
) -> tuple[str, ...]:
    """Return a sentence for each method: which data set serves it best, which worst."""
    found = []
    for method in methods:
        errors = _com_errors(scores, data, prior, {method})
        if len(errors) < 2:
            continue
        (best, least), (worst, most) = _ends({name: error for (name, _), error in errors.items()})
        metrics = _worse_than_prior(scores, data, prior, method)
        sentence = (
            f"{TITLES[method]}: CoM to {significant(least)} mm with {best} at best, "
            f"{significant(most)} mm with {worst} at worst ({significant(most / least, 2)} times)."
        )
        if metrics:
            sentence += f" Less accurate than the prior: {'; '.join(metrics)}."
        found.append(sentence)
    return tuple(found)


def _between_methods(scores: Scores, data: str, prior: str, methods: Sequence[str]) -> str:
    errors = {
        method: error for (_, method), error in _com_errors(scores, [data], prior, methods).items()
    }
    best, least = min(errors.items(), key=lambda item: item[1])
    sentence = f"On {data} data {TITLES[best]} predicts the CoM best, to {significant(least)} mm"
    reference = scores.best(data, prior, REFERENCE)[COM]
    others = {method: error for method, error in errors.items() if not _same_kind(method, best)}
    if others:
        second, error = min(others.items(), key=lambda item: item[1])
        kind = "truncated method" if best in _GAUSSIAN else "other"
        sentence += (
            f"; the best {kind}, {TITLES[second]}, to {significant(error)} mm "
            f"({significant(error / least, 2)} times)"
        )
    return f"{sentence}; the prior, to {significant(reference)} mm."


def _between_data(scores: Scores, data: Sequence[str], prior: str, methods: Sequence[str]) -> str:
    errors = _com_errors(scores, data, prior, methods)
    per_data = {
        name: min((error, method) for (at, method), error in errors.items() if at == name)
        for name in data
    }
    best, worst = (chosen(per_data, key=lambda name: per_data[name][0]) for chosen in (min, max))
    (least, by), (most, other) = per_data[best], per_data[worst]
    return (
        f"Priors {prior}. The CoM is predicted best with {best}, to {significant(least)} mm by "
        f"{TITLES[by]}, and worst with {worst}, to {significant(most)} mm by {TITLES[other]}, the "
        f"best method there; the prior, to {significant(scores.best(best, prior, REFERENCE)[COM])} "
        "mm."
    )


_GAUSSIAN = ("map", "map_lmi")


def _same_kind(method: str, other: str) -> bool:
    return method == other or (method in _GAUSSIAN and other in _GAUSSIAN)


def _com_errors(
    scores: Scores, data: Sequence[str], prior: str, methods: Sequence[str] | set[str]
) -> dict[tuple[str, str], float]:
    """Return each data set's and method's least error of the centre of mass, mm."""
    means = {
        (name, method): scores.best(name, prior, method) for name in data for method in methods
    }
    return {case: found[COM] for case, found in means.items() if found}


def _ends(errors: Mapping[str, float]) -> tuple[tuple[str, float], tuple[str, float]]:
    ordered = sorted(errors.items(), key=lambda item: item[1])
    return ordered[0], ordered[-1]


def _worse_than_prior(scores: Scores, data: Sequence[str], prior: str, method: str) -> list[str]:
    """Return with which data sets a method has larger errors than the prior, and in what."""
    told = []
    for name in data:
        own, reference = scores.best(name, prior, method), scores.best(name, prior, REFERENCE)
        worse = [
            SHORT_NOUNS[metric] for metric in METRICS if own and own[metric] > reference[metric]
        ]
        if worse:
            told.append(f"{name} ({', '.join(worse)})")
    return told
