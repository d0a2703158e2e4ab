"""The thesis's claims about its methods, each examined on the means of one data set.

Every function returns None where a method, prior or filter that the claim is about is missing.
"""

from symbid_ros.report.formatting import significant
from symbid_ros.study.evidence import (
    COM,
    FOUR,
    MARGIN,
    NOUNS,
    PARAMETERS,
    TIE,
    Comparison,
    Conclusion,
    Examination,
    Tally,
    errors_at,
    factors,
    leads,
    listed,
    mean_factor,
    middle,
    order,
    quantity,
    share,
    standing,
    unless,
)
from symbid_ros.study.scores import METRICS, RANK, REFERENCE
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


# An error this much below the prior's is still "only a little more accurate" than it.
LITTLE = 0.25


def prior_dependence(seen: Examination) -> Conclusion | None:
    """Examine whether the column-scaled methods' parameters are about as wrong as the prior's."""
    methods = [method for method in ("wls_c", "wls_rc") if seen.with_prior(False, method)]
    priors = seen.with_prior(False, REFERENCE, *methods)
    if not methods or len(priors) < 2:
        return None
    ratios = {
        method: [
            seen.best(prior, method)[PARAMETERS] / seen.best(prior, REFERENCE)[PARAMETERS]
            for prior in priors
        ]
        for method in methods
    }
    every = [ratio for found in ratios.values() for ratio in found]
    near = sum(1 - LITTLE <= ratio <= 1 + TIE for ratio in every)
    holds = share(near, len(every))
    told = listed(f"{TITLES[method]} {factors(found)}" for method, found in ratios.items())
    closer = min(every) < 1 - LITTLE
    direction = "the data determine more" if closer else "the data lead away from the truth"
    return Conclusion(
        "The column-scaled methods' estimation error follows the prior's and is only a little "
        "below it (section VI-A).",
        holds,
        f"Parameter error over the prior's at {listed(priors)}: {told}.",
        unless(
            holds,
            f"{direction}: the ratio is outside {1 - LITTLE:g} to {1 + TIE:g} in "
            f"{len(every) - near} of {len(every)}",
            seen.ranks(middle(priors), methods),
        ),
    )


def worse_than_prior(seen: Examination) -> Conclusion | None:
    """Examine whether all improve the generalised force but not the joint torque."""
    priors = seen.with_prior(False, REFERENCE, *FOUR)
    if not priors:
        return None
    tallies = {method: seen.against(method, (REFERENCE,), priors) for method in FOUR}
    force, torque = (
        [one.order for tally in tallies.values() for one in tally.comparisons if one.metric == name]
        for name in METRICS[:2]
    )
    improves, suffers = min(force) == 1, min(torque) < 1
    worse = [
        f"{TITLES[method]} in {errors_at(tally.of(-1))}"
        for method, tally in tallies.items()
        if tally.of(-1)
    ]
    holds = True if improves and suffers else None if improves or suffers else False
    return Conclusion(
        "All methods improve the generalised force, but not the joint torque: some do worse than "
        "the prior (sections VI-A and VII).",
        holds,
        f"The generalised force is better than the prior's in {force.count(1)} of {len(force)} "
        f"cases, the joint torque in {torque.count(1)} of {len(torque)}; "
        + (f"worse than the prior: {'; '.join(worse)}." if worse else "no error is worse."),
        unless(holds, seen.bought(middle(priors), ("ols", "wls_r")), seen.evidence.words),
    )


def better_than_prior(seen: Examination) -> Conclusion | None:
    """Examine whether rows and columns scaled together improve on the prior in everything."""
    priors = seen.with_prior(False, REFERENCE, "wls_rc")
    if not priors:
        return None
    tally = seen.against("wls_rc", (REFERENCE,), priors)
    return Conclusion(
        "WLS-RC improves all metrics compared with the prior (section VII).",
        tally.holds,
        f"{standing('WLS-RC', 'better than the prior', tally)} "
        f"({seen.figures(middle(priors), (REFERENCE, 'wls_rc'))}).",
        unless(tally.holds, seen.ranks(middle(priors), ("wls_rc",)), seen.evidence.words),
    )


def growing_gap(seen: Examination) -> Conclusion | None:
    """Examine whether estimation gains more where the prior is worse."""
    priors = seen.with_prior(False, REFERENCE, "wls_rc")
    if len(priors) < 2:
        return None
    gaps = {
        metric: [
            seen.best(prior, REFERENCE)[metric] - seen.best(prior, "wls_rc")[metric]
            for prior in priors
        ]
        for metric in METRICS
    }
    # A gap that is negative is none, and cannot be said to grow.
    tally = Tally(
        tuple(
            Comparison(f"{priors[i]} to {priors[i + 1]}", metric, max(gap[i], 0.0), gap[i + 1])
            for metric, gap in gaps.items()
            for i in range(len(priors) - 1)
        )
    )
    holds = tally.holds
    told = listed(
        " → ".join(quantity(metric, gap) for gap in gaps[metric]) + f" in {NOUNS[metric]}"
        for metric in (METRICS[0], COM, PARAMETERS)
    )
    prior, worse = seen.best(priors[0], "wls_rc"), seen.best(priors[-1], "wls_rc")
    return Conclusion(
        "The gap between prior and estimate grows as the prior gets worse (section VI-A).",
        holds,
        f"From {' to '.join(priors)} the gap between the prior and WLS-RC grows in "
        f"{len(tally.of(1))} of {len(tally)} steps: {told}.",
        unless(
            holds,
            f"it does not in {errors_at(tally.of(-1) + tally.of(0))}",
            f"WLS-RC's own errors grow {factors(worse[m] / prior[m] for m in METRICS)} times",
        ),
    )
