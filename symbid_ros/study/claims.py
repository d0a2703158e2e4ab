"""The thesis's claims about its methods, each examined on the means of one data set.

Every function returns None where a method, prior or filter that the claim is about is missing.
"""

from symbid_ros.report.formatting import significant
from symbid_ros.study.comparison import (
    COM,
    MARGIN,
    NOUNS,
    PARAMETERS,
    TIE,
    Tally,
    errors_at,
    factors,
    leads,
    listed,
    mean_factor,
    order,
    quantity,
    share,
    standing,
    unless,
)
from symbid_ros.study.examination import FOUR, Conclusion, Examination, middle
from symbid_ros.study.scores import METRICS, RANK
from symbid_ros.study.thesis import TITLES

# Unscaled and scaled columns, unscaled and scaled rows.
COLUMN_PAIRS = (("ols", "wls_c"), ("wls_r", "wls_rc"))
ROW_PAIRS = (("ols", "wls_r"), ("wls_c", "wls_rc"))


def best_of_four(seen: Examination) -> Conclusion | None:
    """Examine whether rows and columns scaled together do better than either alone."""
    priors = seen.with_prior(False, *FOUR)
    if not priors:
        return None
    tally = seen.against("wls_rc", FOUR[:3], priors)
    return Conclusion(
        "Scaling rows and columns together (WLS-RC) is the best of the four methods "
        "(sections VI-A and VII, Table II).",
        tally.holds,
        f"{standing('WLS-RC', 'best of the four', tally)} ({seen.figures(middle(priors), FOUR)}).",
        unless(tally.holds, seen.ranks(middle(priors), FOUR), seen.evidence.words),
    )


def column_scaling(seen: Examination) -> Conclusion | None:
    """Examine whether scaled columns lower every error, that of the parameters most."""
    priors = seen.with_prior(False, *FOUR)
    if not priors:
        return None
    tally = Tally(
        tuple(
            one
            for plain, scaled in COLUMN_PAIRS
            for one in seen.against(scaled, (plain,), priors).comparisons
        )
    )
    gains = {
        metric: [one.other / one.own for one in tally.comparisons if one.metric == metric]
        for metric in METRICS
    }
    most = max(gains, key=lambda metric: mean_factor(gains[metric]))
    holds = tally.holds
    if holds and most != PARAMETERS:
        holds = None
    others = [gain for metric, found in gains.items() if metric != most for gain in found]
    return Conclusion(
        "Scaling the columns improves all attributes, estimation accuracy most "
        "(section VI-A, Table II).",
        holds,
        f"Scaled columns lower {len(tally.of(1))} of {len(tally)} errors (OLS to WLS-C and "
        f"WLS-R to WLS-RC at {listed(priors)}); the ratio of unscaled to scaled is largest in "
        f"{NOUNS[most]}, {factors(gains[most])}, and {factors(others)} in the others.",
        unless(holds, seen.ranks(middle(priors), FOUR)),
    )


def row_scaling(seen: Examination) -> Conclusion | None:
    """Examine whether scaled rows lower the errors of prediction."""
    priors = seen.with_prior(False, *FOUR)
    if not priors:
        return None
    predictions = METRICS[:4]
    alone, combined = (
        seen.against(scaled, (plain,), priors, metrics=predictions) for plain, scaled in ROW_PAIRS
    )
    holds = Tally(alone.comparisons + combined.comparisons).holds
    return Conclusion(
        "Scaling the rows decreases the prediction errors (section VI-A, Table II).",
        holds,
        f"Scaling the rows lowers {len(combined.of(1))} of {len(combined)} prediction errors "
        f"where the columns are scaled too (WLS-C to WLS-RC) and {len(alone.of(1))} of "
        f"{len(alone)} where they are not (OLS to WLS-R).",
        unless(holds, seen.bought(middle(priors), ROW_PAIRS[0])),
    )


def row_scaling_alone(seen: Examination) -> Conclusion | None:
    """Examine whether scaled rows with unscaled columns make some errors larger."""
    priors = seen.with_prior(False, "ols", "wls_r")
    if not priors:
        return None
    tally = seen.against("wls_r", ("ols",), priors)
    told = [
        f"{verb} {errors_at(tally.of(outcome))}"
        for verb, outcome in (("raises", -1), ("lowers", 1), ("hardly changes", 0))
        if tally.of(outcome)
    ]
    holds = bool(tally.of(-1))
    return Conclusion(
        "Scaling the rows alone lowers performance in some attributes (section VII, Table II).",
        holds,
        f"Scaling the rows alone {'; it '.join(told)} "
        f"({seen.figures(middle(priors), ('ols', 'wls_r'))}).",
        unless(holds, seen.ranks(middle(priors), ("ols", "wls_r"))),
    )


def singular_values(seen: Examination) -> Conclusion | None:
    """Examine whether scaled rows let more singular values be used, filter by filter."""
    ratios: dict[str, list[float]] = {}
    unfiltered: list[int] = []
    for prior in seen.with_prior(False):
        for plain, scaled in ROW_PAIRS:
            for cutoff in seen.scores.filters(seen.data, prior, scaled):
                few, many = (
                    seen.scores.at(seen.data, prior, method, cutoff) for method in (plain, scaled)
                )
                if few.get(RANK) and many.get(RANK):
                    if cutoff == 0:
                        unfiltered.append(order(few[RANK], many[RANK]))
                    else:
                        ratios.setdefault(scaled, []).append(many[RANK] / few[RANK])
    if not ratios:
        return None
    orders = [order(1.0, ratio) for found in ratios.values() for ratio in found]
    more = leads(orders)
    fourfold = max(ratios.get("wls_rc", [1.0])) >= 4 * (1 - TIE)
    holds = None if more and not fourfold else more
    told = listed(
        f"{TITLES[scaled]} {factors(ratios[scaled])} times as many as {TITLES[plain]}"
        for plain, scaled in ROW_PAIRS
        if scaled in ratios
    )
    without = f"; unfiltered in {unfiltered.count(1)} of {len(unfiltered)}" if unfiltered else ""
    return Conclusion(
        "Row-scaled methods use more singular values, WLS-RC up to four times as many as WLS-C "
        "(section VI-A).",
        holds,
        f"With filtered rows the row-scaled methods use more singular values in "
        f"{orders.count(1)} of {len(orders)} comparisons: {told}{without}.",
        unless(
            holds,
            "" if fourfold else "WLS-RC nowhere uses four times as many as WLS-C",
            "" if more else seen.evidence.words,
        ),
    )


def unfiltered_order(seen: Examination) -> Conclusion | None:
    """Examine whether, without a filter, scaled columns alone come first."""
    priors = [
        prior
        for prior in seen.with_prior(False)
        if seen.at(prior, "wls_c", 0.0) and seen.at(prior, "wls_rc", 0.0)
    ]
    if not priors:
        return None
    tally = seen.against(
        "wls_c", ("wls_rc",), priors, figures=lambda prior, method: seen.at(prior, method, 0.0)
    )
    best = seen.against("wls_rc", ("wls_c",), priors)
    # Where WLS-C is ahead with any filter, nothing reverses.
    holds = None if tally.holds and best.holds is False else tally.holds
    prior = middle(priors)
    figures = listed(
        f"{TITLES[method]} {quantity(COM, seen.at(prior, method, 0.0)[COM])}"
        for method in ("wls_c", "wls_rc")
    )
    return Conclusion(
        "Without a filter the order reverses: WLS-C comes before WLS-RC (Table C.1, 0 Hz).",
        holds,
        f"Unfiltered, {standing('WLS-C', 'ahead of WLS-RC', tally)} ({NOUNS[COM]} at {prior}: "
        f"{figures}); with the best filter WLS-RC is ahead in {len(best.of(1))} of {len(best)}.",
        unless(holds, seen.evidence.words),
    )


def absolute_errors(seen: Examination) -> Conclusion | None:
    """Examine which method comes first where priors are off by an absolute amount."""
    priors = seen.with_prior(True, *FOUR)
    if not priors:
        return None
    rows = seen.against("wls_r", ("ols", "wls_c", "wls_rc"), priors)
    com = seen.against("wls_rc", FOUR[:3], priors, metrics=(COM,))
    leading = 2 * (len(rows) - len(rows.of(-1))) > len(rows)
    first = com.holds is not False
    prior = middle(priors)
    only, both = seen.best(prior, "wls_r"), seen.best(prior, "wls_rc")
    told = listed(f"{significant(both[m] / only[m])} in {NOUNS[m]}" for m in METRICS)
    holds = True if leading and first else None if leading or first else False
    return Conclusion(
        "With absolute errors of the prior, scaling the rows alone may be better, while WLS-RC "
        "stays best in CoM position (section 4.2.1, chapter 5, Table 4.1).",
        holds,
        f"{standing('WLS-R', 'best of the four', rows)}; WLS-RC's errors over those of WLS-R at "
        f"{prior}: {told} ({seen.figures(prior, FOUR)}).",
        unless(holds, seen.wrong_scales(prior), seen.bought(prior, ("wls_r", "wls_rc"))),
    )


def ours(seen: Examination) -> Conclusion | None:
    """Examine whether MAP-LMI is more accurate than all of the thesis's methods."""
    methods = (*FOUR, "map_lmi")
    priors = seen.with_prior(False, *methods) + seen.with_prior(True, *methods)
    if not priors:
        return None
    tally = seen.against("map_lmi", FOUR, priors)
    least = {
        metric: min(one.other / one.own for one in tally.comparisons if one.metric == metric)
        for metric in METRICS
    }
    holds = share(len(tally.of(1)), len(tally))
    told = listed(f"{significant(least[metric], 2)} ({NOUNS[metric]})" for metric in METRICS)
    return Conclusion(
        "Ours: MAP-LMI, without validation data, is more accurate than all four in every metric.",
        holds,
        f"Over priors of {listed(priors)} the best of the four errs at least {told} times as much "
        f"as MAP-LMI ({seen.figures(middle(priors), methods)}).",
        unless(
            holds,
            f"not {MARGIN} ahead of {errors_at(tally.of(0) + tally.of(-1), with_rival=True)}",
        ),
    )
