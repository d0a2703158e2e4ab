"""The thesis's claims on methods and priors, each checked on the means of one data set.

Each function returns None if a method, prior or filter that its claim needs is missing.
"""

from symbid_ros.identification.predictions.error_changes import enumerate_words
from symbid_ros.report.formatting import significant
from symbid_ros.study.evidence import (
    COM,
    FOUR,
    MARGIN,
    NOUNS,
    PARAMETERS,
    TIE,
    Comparison,
    ComparisonSet,
    Conclusion,
    Evidence,
    compare,
    conclude,
    describe_lead,
    enumerate_errors,
    format_error,
    format_range,
    geometric_mean,
    holds_by_order,
    holds_by_share,
    middle,
)
from symbid_ros.study.scores import METRICS, RANK, REFERENCE
from symbid_ros.study.thesis import TITLES

# Methods that differ only in whether columns, or rows, are scaled.
COLUMN_PAIRS = (("ols", "wls_c"), ("wls_r", "wls_rc"))
ROW_PAIRS = (("ols", "wls_r"), ("wls_c", "wls_rc"))
# Largest relative difference at which a parameter error is "only a little" below the prior's.
LITTLE = 0.25


def best_of_four(evidence: Evidence) -> Conclusion | None:
    """Check whether scaling rows and columns together is better than scaling either alone."""
    priors = evidence.priors_with(False, *FOUR)
    if not priors:
        return None
    compared = evidence.compare("wls_rc", FOUR[:3], priors)
    example = middle(priors)
    return conclude(
        "Scaling rows and columns together (WLS-RC) is the best of the four methods "
        "(sections VI-A and VII, Table II).",
        compared.holds,
        f"{describe_lead('WLS-RC', 'best of the four', compared)} "
        f"({evidence.describe_errors(example, FOUR)}).",
        evidence.describe_ranks(example, FOUR),
        evidence.describe_row_errors(),
    )


def column_scaling(evidence: Evidence) -> Conclusion | None:
    """Check whether scaling columns lowers every error, that of the parameters most."""
    priors = evidence.priors_with(False, *FOUR)
    if not priors:
        return None
    compared = ComparisonSet(
        tuple(
            one
            for plain, scaled in COLUMN_PAIRS
            for one in evidence.compare(scaled, (plain,), priors).comparisons
        )
    )
    gains = {
        metric: [one.other / one.own for one in compared.comparisons if one.metric == metric]
        for metric in METRICS
    }
    most = max(gains, key=lambda metric: geometric_mean(gains[metric]))
    holds = compared.holds
    if holds and most != PARAMETERS:
        holds = None
    others = [gain for metric, found in gains.items() if metric != most for gain in found]
    return conclude(
        "Scaling the columns improves all attributes, estimation accuracy most "
        "(section VI-A, Table II).",
        holds,
        f"Scaled columns lower {len(compared.with_order(1))} of {len(compared)} errors (OLS to "
        f"WLS-C and WLS-R to WLS-RC at {enumerate_words(priors)}); the ratio of unscaled to scaled "
        f"is largest in {NOUNS[most]}, {format_range(gains[most])}, and {format_range(others)} in "
        "the others.",
        evidence.describe_ranks(middle(priors), FOUR),
    )


def row_scaling(evidence: Evidence) -> Conclusion | None:
    """Check whether scaling rows lowers the prediction errors."""
    priors = evidence.priors_with(False, *FOUR)
    if not priors:
        return None
    alone, combined = (
        evidence.compare(scaled, (plain,), priors, metrics=METRICS[:4])
        for plain, scaled in ROW_PAIRS
    )
    holds = ComparisonSet(alone.comparisons + combined.comparisons).holds
    return conclude(
        "Scaling the rows decreases the prediction errors (section VI-A, Table II).",
        holds,
        f"Scaling the rows lowers {len(combined.with_order(1))} of {len(combined)} prediction "
        "errors where the columns are scaled too (WLS-C to WLS-RC) and "
        f"{len(alone.with_order(1))} of {len(alone)} where they are not (OLS to WLS-R).",
        evidence.describe_rank_effect(middle(priors), ROW_PAIRS[0]),
    )


def row_scaling_alone(evidence: Evidence) -> Conclusion | None:
    """Check whether scaling rows but not columns increases some errors."""
    priors = evidence.priors_with(False, "ols", "wls_r")
    if not priors:
        return None
    compared = evidence.compare("wls_r", ("ols",), priors)
    effects = [
        f"{verb} {enumerate_errors(compared.with_order(order))}"
        for verb, order in (("raises", -1), ("lowers", 1), ("hardly changes", 0))
        if compared.with_order(order)
    ]
    holds = bool(compared.with_order(-1))
    methods = ("ols", "wls_r")
    return conclude(
        "Scaling the rows alone lowers performance in some attributes (section VII, Table II).",
        holds,
        f"Scaling the rows alone {'; it '.join(effects)} "
        f"({evidence.describe_errors(middle(priors), methods)}).",
        evidence.describe_ranks(middle(priors), methods),
    )


def singular_values(evidence: Evidence) -> Conclusion | None:
    """Check whether scaling rows allows more singular values to be used, filter by filter."""
    scores, data = evidence.scores, evidence.data
    ratios: dict[str, list[float]] = {}
    unfiltered: list[int] = []
    for prior in evidence.priors_with(False):
        for plain, scaled in ROW_PAIRS:
            for cutoff in scores.filters(data, prior, scaled):
                few, many = (scores.at(data, prior, method, cutoff) for method in (plain, scaled))
                if few.get(RANK) and many.get(RANK):
                    if cutoff == 0:
                        unfiltered.append(compare(few[RANK], many[RANK]))
                    else:
                        ratios.setdefault(scaled, []).append(many[RANK] / few[RANK])
    if not ratios:
        return None
    orders = [compare(1.0, ratio) for found in ratios.values() for ratio in found]
    more = holds_by_order(orders)
    fourfold = max(ratios.get("wls_rc", [1.0])) >= 4 * (1 - TIE)
    holds = None if more and not fourfold else more
    comparisons = enumerate_words(
        f"{TITLES[scaled]} {format_range(ratios[scaled])} times as many as {TITLES[plain]}"
        for plain, scaled in ROW_PAIRS
        if scaled in ratios
    )
    without = f"; unfiltered in {unfiltered.count(1)} of {len(unfiltered)}" if unfiltered else ""
    return conclude(
        "Row-scaled methods use more singular values, WLS-RC up to four times as many as WLS-C "
        "(section VI-A).",
        holds,
        f"With filtered rows the row-scaled methods use more singular values in "
        f"{orders.count(1)} of {len(orders)} comparisons: {comparisons}{without}.",
        "" if fourfold else "WLS-RC never uses four times as many as WLS-C",
        "" if more else evidence.describe_row_errors(),
    )


def unfiltered_order(evidence: Evidence) -> Conclusion | None:
    """Check whether scaling columns alone is best without a filter."""
    priors = [
        prior
        for prior in evidence.priors_with(False)
        if evidence.at(prior, "wls_c", 0.0) and evidence.at(prior, "wls_rc", 0.0)
    ]
    if not priors:
        return None
    compared = evidence.compare(
        "wls_c", ("wls_rc",), priors, errors=lambda prior, method: evidence.at(prior, method, 0.0)
    )
    best = evidence.compare("wls_rc", ("wls_c",), priors)
    # If WLS-C is also ahead with filters, the order does not reverse.
    holds = None if compared.holds and best.holds is False else compared.holds
    prior = middle(priors)
    errors = enumerate_words(
        f"{TITLES[method]} {format_error(COM, evidence.at(prior, method, 0.0)[COM])}"
        for method in ("wls_c", "wls_rc")
    )
    return conclude(
        "Without a filter the order reverses: WLS-C is better than WLS-RC (Table C.1, 0 Hz).",
        holds,
        f"Unfiltered, {describe_lead('WLS-C', 'ahead of WLS-RC', compared)} "
        f"({NOUNS[COM]} at {prior}: {errors}); with the best filter WLS-RC is ahead in "
        f"{len(best.with_order(1))} of {len(best)}.",
        evidence.describe_row_errors(),
    )


def absolute_errors(evidence: Evidence) -> Conclusion | None:
    """Check which method is best if priors are off by an absolute amount."""
    priors = evidence.priors_with(True, *FOUR)
    if not priors:
        return None
    rows = evidence.compare("wls_r", ("ols", "wls_c", "wls_rc"), priors)
    com = evidence.compare("wls_rc", FOUR[:3], priors, metrics=(COM,))
    leading = 2 * (len(rows) - len(rows.with_order(-1))) > len(rows)
    first = com.holds is not False
    prior = middle(priors)
    only, both = evidence.best(prior, "wls_r"), evidence.best(prior, "wls_rc")
    ratios = enumerate_words(f"{significant(both[m] / only[m])} in {NOUNS[m]}" for m in METRICS)
    holds = True if leading and first else None if leading or first else False
    return conclude(
        "With absolute errors of the prior, scaling the rows alone may be better, while WLS-RC "
        "stays best in CoM position (section 4.2.1, chapter 5, Table 4.1).",
        holds,
        f"{describe_lead('WLS-R', 'best of the four', rows)}; ratios of WLS-RC's errors to "
        f"WLS-R's at {prior}: {ratios} ({evidence.describe_errors(prior, FOUR)}).",
        evidence.describe_column_scales(prior),
        evidence.describe_rank_effect(prior, ("wls_r", "wls_rc")),
    )


def map_lmi_is_best(evidence: Evidence) -> Conclusion | None:
    """Check whether MAP-LMI is more accurate than all of the thesis's methods."""
    methods = (*FOUR, "map_lmi")
    priors = evidence.priors_with(False, *methods) + evidence.priors_with(True, *methods)
    if not priors:
        return None
    compared = evidence.compare("map_lmi", FOUR, priors)
    least = {
        metric: min(one.other / one.own for one in compared.comparisons if one.metric == metric)
        for metric in METRICS
    }
    holds = holds_by_share(len(compared.with_order(1)), len(compared))
    ratios = enumerate_words(f"{significant(least[m], 2)} ({NOUNS[m]})" for m in METRICS)
    behind = compared.with_order(0) + compared.with_order(-1)
    return conclude(
        "Ours: MAP-LMI, without validation data, is more accurate than all four in every metric.",
        holds,
        f"At {enumerate_words(priors)}, the errors of the best of the four are at least {ratios} "
        f"times those of MAP-LMI ({evidence.describe_errors(middle(priors), methods)}).",
        f"MAP-LMI is not {MARGIN} ahead of {enumerate_errors(behind, with_method=True)}",
    )


def prior_dependence(evidence: Evidence) -> Conclusion | None:
    """Check whether column-scaled methods' parameter errors are about as large as the prior's."""
    methods = [method for method in ("wls_c", "wls_rc") if evidence.priors_with(False, method)]
    priors = evidence.priors_with(False, REFERENCE, *methods)
    if not methods or len(priors) < 2:
        return None
    ratios = {
        method: [
            evidence.best(prior, method)[PARAMETERS] / evidence.best(prior, REFERENCE)[PARAMETERS]
            for prior in priors
        ]
        for method in methods
    }
    every = [ratio for found in ratios.values() for ratio in found]
    near = sum(1 - LITTLE <= ratio <= 1 + TIE for ratio in every)
    holds = holds_by_share(near, len(every))
    ranges = enumerate_words(
        f"{TITLES[one]} {format_range(found)}" for one, found in ratios.items()
    )
    closer = min(every) < 1 - LITTLE
    cause = "the data improve the parameters" if closer else "the data worsen the parameters"
    return conclude(
        "The column-scaled methods' estimation error follows the prior's and is only a little "
        "below it (section VI-A).",
        holds,
        f"Ratio of the parameter error to the prior's at {enumerate_words(priors)}: {ranges}.",
        f"{cause}: the ratio is outside {1 - LITTLE:g} to {1 + TIE:g} in "
        f"{len(every) - near} of {len(every)} cases",
        evidence.describe_ranks(middle(priors), methods),
    )


def worse_than_prior(evidence: Evidence) -> Conclusion | None:
    """Check whether all methods improve the generalised force but not the joint torque."""
    priors = evidence.priors_with(False, REFERENCE, *FOUR)
    if not priors:
        return None
    compared = {method: evidence.compare(method, (REFERENCE,), priors) for method in FOUR}
    force, torque = (
        [
            one.order
            for found in compared.values()
            for one in found.comparisons
            if one.metric == name
        ]
        for name in METRICS[:2]
    )
    improves, suffers = min(force) == 1, min(torque) < 1
    worse = [
        f"{TITLES[method]} in {enumerate_errors(found.with_order(-1))}"
        for method, found in compared.items()
        if found.with_order(-1)
    ]
    holds = True if improves and suffers else None if improves or suffers else False
    return conclude(
        "All methods improve the generalised force, but not the joint torque: some do worse than "
        "the prior (sections VI-A and VII).",
        holds,
        f"The generalised force is better than the prior's in {force.count(1)} of {len(force)} "
        f"cases, the joint torque in {torque.count(1)} of {len(torque)}; "
        + (f"worse than the prior: {'; '.join(worse)}." if worse else "no error is worse."),
        evidence.describe_rank_effect(middle(priors), ("ols", "wls_r")),
        evidence.describe_row_errors(),
    )


def better_than_prior(evidence: Evidence) -> Conclusion | None:
    """Check whether scaling rows and columns together improves every error of the prior."""
    priors = evidence.priors_with(False, REFERENCE, "wls_rc")
    if not priors:
        return None
    compared = evidence.compare("wls_rc", (REFERENCE,), priors)
    example = middle(priors)
    return conclude(
        "WLS-RC improves all metrics compared with the prior (section VII).",
        compared.holds,
        f"{describe_lead('WLS-RC', 'better than the prior', compared)} "
        f"({evidence.describe_errors(example, (REFERENCE, 'wls_rc'))}).",
        evidence.describe_ranks(example, ("wls_rc",)),
        evidence.describe_row_errors(),
    )


def growing_gap(evidence: Evidence) -> Conclusion | None:
    """Check whether estimation improves a worse prior more."""
    priors = evidence.priors_with(False, REFERENCE, "wls_rc")
    if len(priors) < 2:
        return None
    gaps = {
        metric: [
            evidence.best(prior, REFERENCE)[metric] - evidence.best(prior, "wls_rc")[metric]
            for prior in priors
        ]
        for metric in METRICS
    }
    # A negative gap counts as zero: estimation does not improve that prior.
    compared = ComparisonSet(
        tuple(
            Comparison(f"{priors[i]} to {priors[i + 1]}", metric, max(gap[i], 0.0), gap[i + 1])
            for metric, gap in gaps.items()
            for i in range(len(priors) - 1)
        )
    )
    holds = compared.holds
    others = compared.with_order(-1) + compared.with_order(0)
    steps = enumerate_words(
        " → ".join(format_error(metric, gap) for gap in gaps[metric]) + f" in {NOUNS[metric]}"
        for metric in (METRICS[0], COM, PARAMETERS)
    )
    first, last = evidence.best(priors[0], "wls_rc"), evidence.best(priors[-1], "wls_rc")
    return conclude(
        "The gap between prior and estimate grows as the prior gets worse (section VI-A).",
        holds,
        f"From {' to '.join(priors)} the gap between the prior and WLS-RC grows in "
        f"{len(compared.with_order(1))} of {len(compared)} steps: {steps}.",
        f"it does not grow in {enumerate_errors(others)}",
        "WLS-RC's own errors grow by factors of "
        f"{format_range(last[m] / first[m] for m in METRICS)}",
    )
