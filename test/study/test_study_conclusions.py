"""Conclusions from the thesis's numbers, and from reversed, scaled and incomplete ones."""

from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np
import pytest

from symbid_ros.report.content import LinkErrors
from symbid_ros.simulation.balance import BalanceResult
from symbid_ros.study import claims, thesis
from symbid_ros.study.conclusions import (
    claim_conclusions,
    closed_loop_conclusions,
    link_accuracy,
    realistic_conclusion,
)
from symbid_ros.study.evidence import Conclusion, Evidence
from symbid_ros.study.plan import PriorSpread
from symbid_ros.study.scores import METRICS, RANK, REFERENCE, Case, Scores

PRIORS = (*thesis.PRIORS, thesis.ABSOLUTE_PRIOR)
FOUR = ("ols", "wls_r", "wls_c", "wls_rc")
REVERSED = dict(zip(FOUR, reversed(FOUR), strict=True))
Claim = Callable[[Evidence], Conclusion | None]


def checked(
    claim: Claim, scores: Scores, row_errors: Mapping[float, float] | None = None
) -> Conclusion:
    found = claim(Evidence(scores, thesis.DATA, PRIORS, row_errors or {}))
    assert found is not None
    return found


def changed(change: Callable[[Case, dict[str, float]], tuple[Case, dict[str, float]]]) -> Scores:
    """The thesis's means, each of them changed."""
    return Scores(dict(change(case, dict(m)) for case, m in thesis.published().means.items()))


def renamed(names: Mapping[str, str]) -> Scores:
    return changed(
        lambda case, means: (replace(case, method=names.get(case.method, case.method)), means)
    )


def without(drop: Callable[[Case], bool]) -> Scores:
    means = thesis.published().means
    return Scores({case: found for case, found in means.items() if not drop(case)})


def claimed(scores: Scores) -> set[str]:
    return {one.claim for one in claim_conclusions(Evidence(scores, thesis.DATA, PRIORS))}


@pytest.mark.parametrize(
    "claim",
    [
        claims.best_of_four,
        claims.column_scaling,
        claims.row_scaling_alone,
        claims.unfiltered_order,
        claims.absolute_errors,
        claims.prior_dependence,
        claims.worse_than_prior,
        claims.better_than_prior,
        claims.growing_gap,
    ],
)
def test_claims_of_the_thesis_hold_in_its_tables(claim: Claim) -> None:
    found = checked(claim, thesis.published())
    assert found.holds is True, found.finding
    assert found.verdict == "holds"
    assert not found.explanation


def test_row_scaling_of_the_thesis_helps_only_with_scaled_columns() -> None:
    found = checked(claims.row_scaling, thesis.published())
    assert found.verdict == "holds in part"
    # Counted by hand in Table C.1; momentum and CoM position at ±25 % are the two.
    assert "8 of 8 prediction errors where the columns are scaled too" in found.finding
    assert "2 of 8 where they are not" in found.finding


def test_thesis_never_has_four_times_as_many_singular_values() -> None:
    found = checked(claims.singular_values, thesis.published())
    assert found.holds is None
    # 11.9 / 4.3 at ±12.5 % and 50 Hz is the largest.
    assert "1.1 to 2.8 times as many as WLS-C" in found.finding
    assert "16 of 16" in found.finding
    assert "unfiltered in 1 of 4" in found.finding


def test_sentence_states_the_values_of_the_table() -> None:
    found = checked(claims.best_of_four, thesis.published())
    assert "CoM position at ±25 %: OLS 20.4 mm, WLS-R 18.5 mm, WLS-C 3.28 mm, WLS-RC 0.996 mm" in (
        found.finding
    )


@pytest.mark.parametrize(
    ("claim", "text"),
    [
        (claims.best_of_four, "best of the four in 0 of 10 errors"),
        (claims.best_of_four, "behind OLS in every error"),
        (claims.column_scaling, "Scaled columns lower 0 of 20 errors"),
        (claims.singular_values, "0 of 16 comparisons"),
        (claims.absolute_errors, "0 of 5 errors, behind OLS in generalised force and CoM"),
        (claims.prior_dependence, "Ratio of the parameter error to the prior's"),
        (claims.better_than_prior, "behind Ref. in joint torque and parameters"),
    ],
)
def test_reversed_order_reverses_the_sentences(claim: Claim, text: str) -> None:
    found = checked(claim, renamed(REVERSED))
    assert text in found.finding
    assert found.holds is not True
    assert found.explanation


def test_row_scaling_that_only_helps_refutes_the_claim() -> None:
    found = checked(claims.row_scaling_alone, renamed({"wls_r": "wls_c", "wls_c": "wls_r"}))
    assert found.holds is False
    assert "Scaling the rows alone lowers every error at ±12.5 % and ±25 % (" in found.finding
    assert "raises" not in found.finding


def test_unfiltered_order_follows_the_unfiltered_means() -> None:
    swapped = {"wls_c": "wls_rc", "wls_rc": "wls_c"}
    found = checked(claims.unfiltered_order, renamed(swapped))
    assert found.holds is False
    assert "behind WLS-RC in generalised force" in found.finding
    # With the filtered means exchanged as well, WLS-C is always ahead and nothing reverses.
    unreversed = changed(
        lambda case, means: (
            replace(case, method=swapped.get(case.method, case.method)) if case.filter else case,
            means,
        )
    )
    same = checked(claims.unfiltered_order, unreversed)
    assert same.holds is None
    assert "with the best filter WLS-RC is ahead in 0 of 10" in same.finding


def test_shrinking_gap_refutes_the_claim() -> None:
    other = {str(thesis.PRIORS[0]): thesis.PRIORS[1], str(thesis.PRIORS[1]): thesis.PRIORS[0]}
    scores = changed(
        lambda case, means: (
            replace(case, prior=str(other.get(case.prior, case.prior))),
            means,
        )
    )
    found = checked(claims.growing_gap, scores)
    assert found.holds is False
    assert "0 of 5 steps" in found.finding
    assert "does not grow in every error at ±12.5 % to ±25 %" in found.explanation


def test_ties_do_not_count_as_leads() -> None:
    """All methods are within two percent of each other."""
    generator = np.random.default_rng(5)
    scores = changed(
        lambda case, means: (
            case,
            {name: float(generator.uniform(1.0, 1.02)) for name in means},
        )
    )
    found = checked(claims.best_of_four, scores)
    assert found.holds is False
    assert "0 of 10 errors, within 5 % in 10" in found.finding
    assert checked(claims.row_scaling_alone, scores).holds is False


@pytest.mark.parametrize("factor", [1e-3, 0.7, 1e4])
@pytest.mark.parametrize("names", [{}, REVERSED])
def test_verdicts_do_not_depend_on_units(factor: float, names: dict[str, str]) -> None:
    plain = renamed(names)
    scaled = Scores(
        {
            case: {name: value * (factor if name != RANK else 1) for name, value in means.items()}
            for case, means in plain.means.items()
        }
    )
    before = claim_conclusions(Evidence(plain, thesis.DATA, PRIORS))
    after = claim_conclusions(Evidence(scaled, thesis.DATA, PRIORS))
    assert [one.holds for one in before] == [one.holds for one in after]
    assert [one.claim for one in before] == [one.claim for one in after]


def test_claims_without_numbers_are_omitted() -> None:
    everything = claimed(thesis.published())
    assert len(everything) == 11
    unfiltered = everything - claimed(without(lambda case: case.filter == 0))
    assert all("0 Hz" in claim for claim in unfiltered)
    assert len(unfiltered) == 1
    absolute = everything - claimed(without(lambda case: case.prior == "±0.125"))
    assert all("absolute" in claim for claim in absolute)
    assert len(absolute) == 1
    one_prior = everything - claimed(without(lambda case: case.prior == "±12.5 %"))
    assert all("follows" in claim or "gap" in claim for claim in one_prior)
    assert len(one_prior) == 2
    no_prior = everything - claimed(without(lambda case: case.method == REFERENCE))
    assert all("prior" in claim for claim in no_prior)
    assert not claimed(without(lambda case: case.method in FOUR))
    assert claim_conclusions(Evidence(thesis.published(), "another log", PRIORS)) == []


def test_nan_error_counts_as_missing() -> None:
    scores = changed(
        lambda case, means: (case, means | {METRICS[0]: np.nan} if case.method == "ols" else means)
    )
    assert not any("best of the four" in claim for claim in claimed(scores))


def ours(factor: float) -> Scores:
    """Return the thesis's means, and a MAP-LMI ``factor`` times better than its best method."""
    published = thesis.published()
    extra = {}
    for spread in PRIORS:
        best = [published.best(thesis.DATA, str(spread), method) for method in FOUR]
        extra[Case(thesis.DATA, str(spread), "map_lmi")] = {
            name: min(one[name] for one in best) / factor for name in METRICS
        }
    return Scores({**published.means, **extra})


def test_lead_of_map_lmi_is_stated_as_factors() -> None:
    found = checked(claims.map_lmi_is_best, ours(5.0))
    assert found.holds is True
    assert "at least 5.0 (generalised force), 5.0 (joint torque)" in found.finding
    behind = checked(claims.map_lmi_is_best, ours(0.5))
    assert behind.holds is False
    assert "at least 0.50 (generalised force)" in behind.finding
    assert "MAP-LMI is not 5 % ahead of WLS-RC in every error" in behind.explanation
    assert checked(claims.map_lmi_is_best, ours(1.01)).holds is False


def test_explanation_is_given_only_if_a_claim_fails() -> None:
    row_errors = {0.0: 40.0, 30.0: 12.5, 70.0: 20.0}
    failed = checked(claims.best_of_four, renamed(REVERSED), row_errors)
    assert (
        "the residual of the rows at the true parameters is 40.0 N & Nm RMS unfiltered and "
        "12.5 N & Nm RMS filtered at 30 Hz"
    ) in failed.explanation
    assert failed.explanation.startswith("Singular values kept at ±25 %: ")
    assert not checked(claims.best_of_four, thesis.published(), row_errors).explanation


def accuracy(outer: float, inner: float) -> Conclusion | None:
    names = ("base", "thigh", "shank", "foot")
    errors = np.array([inner, inner, 0.9 * outer, outer])
    percent = {"ref": np.full(4, 12.5), "wls_rc": errors, "ols": 10 * errors}
    return link_accuracy(LinkErrors(names, percent), (0, 1, 2, 3))


def test_outer_links_are_compared_with_inner_ones() -> None:
    found = accuracy(12.0, 3.0)
    assert found is not None
    assert found.holds is True
    assert (
        "ratio of the mean of the outer links to that of the inner ones: OLS 3.8 and WLS-RC 3.8"
        in found.finding
    )
    alike = accuracy(12.0, 12.0)
    assert alike is not None
    assert alike.holds is False
    assert "ratio of largest to smallest for the prior itself: 1.0" in alike.explanation
    inverse = accuracy(3.0, 12.0)
    assert inverse is not None
    assert inverse.holds is False


def test_realistic_gain_is_checked_by_difference_and_factor() -> None:
    ideal = {"ref": 3.6, "wls_rc": 1.8, "truth": 0.0}
    more = realistic_conclusion(ideal, {"ref": 9.0, "wls_rc": 3.0, "truth": 0.5})
    assert more is not None
    assert more.holds is True
    assert "WLS-RC 1.80 and 3.00 Nm" in more.finding
    # By 3 instead of 1.8 Nm, but by a factor of 1.5 instead of 2.
    in_part = realistic_conclusion(ideal, {"ref": 9.0, "wls_rc": 6.0, "truth": 5.5})
    assert in_part is not None
    assert in_part.holds is None
    assert "even the true parameters have an error of 5.50 Nm" in in_part.explanation
    less = realistic_conclusion(ideal, {"ref": 4.0, "wls_rc": 3.9})
    assert less is not None
    assert less.holds is False
    assert realistic_conclusion({"wls_rc": 1.0}, {"wls_rc": 1.0}) is None
    assert realistic_conclusion({"ref": 1.0, "ols": 1.0}, {"ref": 1.0, "wls_r": 1.0}) is None


def run(com: float, share: float, failure: str = "") -> BalanceResult:
    if failure:
        com = share = float("nan")
    return BalanceResult(com, (com, com, com), share, 1.0 if failure else None, failure, 20.0)


def test_balance_is_compared_over_the_draws_with_which_both_stood() -> None:
    runs = {
        "ref": [run(9.0, 0.8), run(0, 0, "the robot fell"), run(11.0, 0.7)],
        "wls_rc": [run(3.0, 0.9), run(90.0, 0.1), run(5.0, 0.92)],
        "ols": [run(0, 0, "joint R_hfe ran into its end stop"), run(0, 0, "the robot fell")],
        "truth": [run(2.0, 0.99)],
    }
    by_method = {one.claim.split()[0]: one for one in closed_loop_conclusions(runs)}
    assert list(by_method) == ["OLS", "WLS-RC"]
    better = by_method["WLS-RC"]
    assert better.holds is True
    assert "3 of 3 runs with WLS-RC, 2 of 3 runs with the prior and 1 of 1 runs with the truth" in (
        better.finding
    )
    # Draws with which only one of them stood are in neither mean.
    assert "4.00 mm with WLS-RC, 10.0 mm with the prior, 2.00 mm with truth" in better.finding
    assert "91.0 % with WLS-RC, 75.0 % with the prior, 99.0 % with truth" in better.finding
    worse = by_method["OLS"]
    assert worse.holds is False
    assert "joint R_hfe ran into its end stop and the robot fell" in worse.explanation


def test_better_tracking_with_less_feed_forward_holds_in_part() -> None:
    mixed = {"ref": [run(9.0, 0.8)], "map_lmi": [run(2.0, 0.6)]}
    assert closed_loop_conclusions(mixed)[0].holds is None
    worse = {"ref": [run(2.0, 0.9)], "map_lmi": [run(9.0, 0.6)]}
    assert closed_loop_conclusions(worse)[0].holds is False
    falls = {"ref": [run(9.0, 0.8)] * 2, "map_lmi": [run(2.0, 0.9), run(0, 0, "the robot fell")]}
    assert closed_loop_conclusions(falls)[0].holds is False
    assert closed_loop_conclusions({"map_lmi": [run(2.0, 0.9)]}) == ()


def test_order_of_the_priors_does_not_matter() -> None:
    scores = thesis.published()
    assert claim_conclusions(Evidence(scores, thesis.DATA, PRIORS)) == claim_conclusions(
        Evidence(
            scores,
            thesis.DATA,
            (thesis.ABSOLUTE_PRIOR, PriorSpread(percent=25.0), PriorSpread(percent=12.5)),
        )
    )
