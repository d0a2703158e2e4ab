"""What the thesis claims of estimates against the prior, examined on one data set."""

from symbid_ros.study.comparison import (
    COM,
    NOUNS,
    PARAMETERS,
    TIE,
    Comparison,
    Tally,
    errors_at,
    factors,
    listed,
    quantity,
    share,
    standing,
    unless,
)
from symbid_ros.study.examination import FOUR, Conclusion, Examination, middle
from symbid_ros.study.scores import METRICS, REFERENCE
from symbid_ros.study.thesis import TITLES

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
