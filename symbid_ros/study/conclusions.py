"""Conclusions in words: the thesis's and ours, computed from the numbers of a study."""

from collections import Counter
from collections.abc import Mapping, Sequence

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.choices import GAUSSIAN
from symbid_ros.identification.predictions.error_changes import enumerate_words
from symbid_ros.report.content import TRUTH, LinkErrors
from symbid_ros.report.formatting import significant
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study import claims
from symbid_ros.study.evidence import (
    COM,
    FOUR,
    NOUNS,
    TIE,
    Conclusion,
    Evidence,
    compare,
    conclude,
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
# Ratio of the largest to the smallest link error from which links differ greatly. The errors of
# the prior alone differ less.
LARGE = 2.0
# Data sets that are listed one by one.
LISTED = 2
# Half-width of the priors that the thesis discusses most, %.
USUAL = 25.0


def claim_conclusions(evidence: Evidence) -> list[Conclusion]:
    """Check every claim for which one data set has the numbers."""
    found = (claim(evidence) for claim in CLAIMS)
    return [one for one in found if one is not None]


def link_accuracy(errors: LinkErrors, depths: Sequence[int]) -> Conclusion | None:
    """Check whether the links' errors differ greatly and the outer links are less accurate.

    Parameters
    ----------
    errors : LinkErrors
        By method, means over the draws (thesis, Fig. 6).
    depths : sequence of int
        Number of joints between the base and each link.

    Returns
    -------
    Conclusion or None
        None without methods of the thesis, or if all links are equally far from the base.
    """
    depth = np.array(depths)
    outer = 2 * depth > depth.max()
    percent = {method: errors.percent[method] for method in FOUR if method in errors.percent}
    if not percent or outer.all() or not outer.any():
        return None
    ranges = {method: _range(found) for method, found in percent.items()}
    ratios = {
        method: float(np.nanmean(found[outer]) / np.nanmean(found[~outer]))
        for method, found in percent.items()
    }
    contrary = [m for m in percent if ranges[m] < LARGE or ratios[m] <= 1 + TIE]
    spans, slopes = (
        enumerate_words(f"{TITLES[method]} {significant(found[method], 2)}" for method in percent)
        for found in (ranges, ratios)
    )
    prior = errors.percent.get(REFERENCE)
    holds = holds_by_share(len(percent) - len(contrary), len(percent))
    return conclude(
        "Estimation accuracy differs greatly over the links, as distal ones are almost stationary "
        "(section VI-A, Fig. 6).",
        holds,
        f"Ratio of the largest to the smallest parameter error of a link: {spans}; ratio of the "
        f"mean of the outer links to that of the inner ones: {slopes}.",
        f"not with {enumerate_words(TITLES[m] for m in contrary)}" if contrary else "",
        f"ratio of largest to smallest for the prior itself: {significant(_range(prior), 2)}"
        if prior is not None
        else "",
    )


def _range(percent: FloatArray) -> float:
    return float(np.nanmax(percent) / np.nanmin(percent))


def realistic_conclusion(
    ideal: Mapping[str, float], realistic: Mapping[str, float]
) -> Conclusion | None:
    """Check whether estimation improves torque prediction more with realistic signals.

    Parameters
    ----------
    ideal, realistic : mapping of str to float
        Torque RMSE, Nm, with ideal signals and with those of the robot's own sensors; by method,
        "ref" for the prior and "truth" for the true parameters.

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
    # The thesis compares two figures, in which a gain may be read as a difference or a factor.
    by_difference = sum(compare(before - ideal[m], after - realistic[m]) == 1 for m in methods)
    by_factor = sum(compare(before / ideal[m], after / realistic[m]) == 1 for m in methods)
    holds = holds_by_share(by_difference + by_factor, 2 * len(methods))
    errors = enumerate_words(
        f"{TITLES.get(name, name)} {significant(ideal[name])} and {significant(realistic[name])} Nm"
        for name in both
    )
    return conclude(
        "Torque prediction benefits more from estimation in the realistic situation than in the "
        "ideal one (section 4.2.1).",
        holds,
        "From prior to estimate, realistic signals reduce the torque error more than ideal ones in "
        f"{by_difference} of {len(methods)} cases by difference and in {by_factor} by factor "
        f"(ideal and realistic: {errors}).",
        "with realistic signals even the true parameters have an error of "
        f"{significant(realistic[TRUTH])} Nm, which no estimate can reduce"
        if TRUTH in both
        else "",
    )


def closed_loop_conclusions(runs: Mapping[str, Sequence[BalanceResult]]) -> tuple[Conclusion, ...]:
    """Check for each method whether the balance controller performs better than with the prior.

    Parameters
    ----------
    runs : mapping of str to sequence of BalanceResult
        By method, "ref" for the priors and "truth" for the true parameters. The methods and the
        prior have one run for each draw, in equal order.
    """
    prior, truth = runs.get(REFERENCE, ()), runs.get(TRUTH, ())
    return tuple(
        _closed_loop_conclusion(TITLES[method], runs[method], prior, truth)
        for method in TITLES
        if method != REFERENCE and runs.get(method) and prior
    )


def _closed_loop_conclusion(
    name: str,
    own: Sequence[BalanceResult],
    prior: Sequence[BalanceResult],
    truth: Sequence[BalanceResult],
) -> Conclusion:
    orders = [compare(_failed_share(own), _failed_share(prior))]
    stood = enumerate_words(
        f"{sum(not run.failure for run in found)} of {len(found)} runs with {model}"
        for model, found in ((name, own), ("the prior", prior), ("the truth", truth))
        if found
    )
    text = f"The robot stood in {stood}."
    # Means over all completed runs would favour a model that fails in the difficult ones.
    paired = [
        (mine, theirs)
        for mine, theirs in zip(own, prior, strict=False)
        if not mine.failure and not theirs.failure
    ]
    if paired:
        with_own, with_prior = zip(*paired, strict=True)
        orders.append(compare(_com_error(with_own), _com_error(with_prior)))
        orders.append(compare(100 - _feed_forward(with_own), 100 - _feed_forward(with_prior)))
        completed = [run for run in truth if not run.failure]
        com, feed_forward = (
            ", ".join(
                f"{significant(mean(found))} {unit} with {model}"
                for model, found in (
                    (name, with_own),
                    ("the prior", with_prior),
                    (TRUTH, completed),
                )
                if found
            )
            for mean, unit in ((_com_error, "mm"), (_feed_forward, "%"))
        )
        text += (
            f" Over the draws with which both {name} and the prior stood, the CoM error was {com}; "
            f"the feed-forward share of the torques was {feed_forward}."
        )
    # A method that fails more often is not better, whatever the errors of its other runs.
    holds = False if orders[0] < 0 else holds_by_order(orders)
    causes = sorted({run.failure for run in own if run.failure})
    return conclude(
        f"{name} improves centroidal dynamics control compared with the prior "
        "(the thesis's third objective, section 1.1).",
        holds,
        text,
        f"runs with {name} ended because {enumerate_words(causes)}" if causes else "",
    )


def _failed_share(runs: Sequence[BalanceResult]) -> float:
    return float(np.mean([bool(run.failure) for run in runs]))


def _com_error(runs: Sequence[BalanceResult]) -> float:
    """Return the mean tracking error, mm."""
    return float(np.mean([run.com_rmse_mm for run in runs]))


def _feed_forward(runs: Sequence[BalanceResult]) -> float:
    """Return the mean feed-forward share of the torques, %."""
    return 100 * float(np.mean([run.feed_forward_share for run in runs]))


def headline(scores: Scores, plan: Plan) -> str:
    """Summarise the CoM errors, with the plan's prior closest to the usual one.

    Up to two data sets get a sentence each; more are summarised by the best and the worst.
    """
    closest = min(plan.priors, key=lambda one: (one.kind != "percent", abs(one.amount - USUAL)))
    prior = str(closest)
    if len(plan.data) > 2:
        return _compare_data(scores, [*plan.data], prior, plan.methods)
    sentences = [_compare_methods(scores, data, prior, plan.methods) for data in plan.data]
    return f"Priors {prior}. " + " ".join(sentences)


def data_sentences(
    scores: Scores, data: Sequence[str], prior: str, methods: Sequence[str]
) -> tuple[str, ...]:
    """Return a sentence for each method: its best and its worst data set."""
    sentences = []
    for method in methods:
        found = _com_errors(scores, data, prior, [method])
        errors = {name: error for (name, _), error in found.items()}
        if len(errors) < 2:
            continue
        best, worst = min(errors, key=errors.__getitem__), max(errors, key=errors.__getitem__)
        worse = _worse_than_prior(scores, data, prior, method)
        sentence = (
            f"{TITLES[method]}: CoM error {significant(errors[best])} mm with {best} (smallest), "
            f"{significant(errors[worst])} mm with {worst} (largest, "
            f"{significant(errors[worst] / errors[best], 2)} times as much)."
        )
        if worse:
            sentence += f" Less accurate than the prior: {'; '.join(worse)}."
        sentences.append(sentence)
    return tuple(sentences)


def _compare_methods(scores: Scores, data: str, prior: str, methods: Sequence[str]) -> str:
    found = _com_errors(scores, [data], prior, methods)
    errors = {method: error for (_, method), error in found.items()}
    best = min(errors, key=errors.__getitem__)
    sentence = (
        f"On {data} data {TITLES[best]} has the smallest CoM error, {significant(errors[best])} mm"
    )
    others = [m for m in errors if m != best and not (m in GAUSSIAN and best in GAUSSIAN)]
    if others:
        second = min(others, key=errors.__getitem__)
        kind = "truncated" if best in GAUSSIAN else "other"
        sentence += (
            f"; the best {kind} method, {TITLES[second]}, has {significant(errors[second])} mm "
            f"({significant(errors[second] / errors[best], 2)} times)"
        )
    return f"{sentence}; the prior has {_prior_error(scores, data, prior)} mm."


def _compare_data(scores: Scores, data: Sequence[str], prior: str, methods: Sequence[str]) -> str:
    errors = _com_errors(scores, data, prior, methods)
    smallest = {
        name: min((error, method) for (at, method), error in errors.items() if at == name)
        for name in data
    }
    best, worst = min(data, key=smallest.__getitem__), max(data, key=smallest.__getitem__)
    (least, least_method), (most, most_method) = smallest[best], smallest[worst]
    return (
        f"Priors {prior}. The CoM error is smallest with {best}, {significant(least)} mm by "
        f"{TITLES[least_method]}, and largest with {worst}, {significant(most)} mm by "
        f"{TITLES[most_method]}, the best method there; the prior has "
        f"{_prior_error(scores, best, prior)} mm."
    )


def _prior_error(scores: Scores, data: str, prior: str) -> str:
    return significant(scores.best(data, prior, REFERENCE)[COM])


def _com_errors(
    scores: Scores, data: Sequence[str], prior: str, methods: Sequence[str]
) -> dict[tuple[str, str], float]:
    """Return the smallest CoM error over the filters, mm, by data set and method."""
    means = {
        (name, method): scores.best(name, prior, method) for name in data for method in methods
    }
    return {case: found[COM] for case, found in means.items() if found}


def _worse_than_prior(scores: Scores, data: Sequence[str], prior: str, method: str) -> list[str]:
    """Return the data sets with which a method has larger errors than the prior, and which.

    Of many data sets, it returns their number for each error.
    """
    found: dict[str, list[str]] = {}
    for name in data:
        own, reference = scores.best(name, prior, method), scores.best(name, prior, REFERENCE)
        worse = [NOUNS[metric] for metric in METRICS if own and own[metric] > reference[metric]]
        if worse:
            found[name] = worse
    if len(found) <= LISTED:
        return [f"{name} ({', '.join(worse)})" for name, worse in found.items()]
    counts = Counter(noun for worse in found.values() for noun in worse)
    return [f"{noun} with {count} of {len(data)}" for noun, count in counts.most_common()]
