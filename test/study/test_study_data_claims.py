"""Sentences on data sets and methods follow from the means."""

import pytest

from symbid_ros.study.conclusions import data_sentences, headline
from symbid_ros.study.plan import Plan
from symbid_ros.study.scores import METRICS, Case, Scores

PRIOR = "±25 %"


def scores(com: dict[tuple[str, str], float]) -> Scores:
    """Return means whose other errors are all 1."""
    return Scores(
        {
            Case(data, PRIOR, method): dict.fromkeys(METRICS, 1.0) | {"com_position_rmse_mm": error}
            for (data, method), error in com.items()
        }
    )


def plan(*data: str) -> Plan:
    return Plan.model_validate(
        {
            "title": "A",
            "data": {name: {"motion_seed": seed} for seed, name in enumerate(data)},
            "priors": [{"percent": 50.0}, {"percent": 25.0}, {"absolute": 25.0}],
            "methods": ["wls_rc", "map_lmi"],
        }
    )


@pytest.mark.parametrize(
    ("ours", "theirs", "text"),
    [
        (
            0.2,
            4.0,
            "MAP-LMI has the smallest CoM error, 0.200 mm; the best truncated method, WLS-RC, "
            "has 4.00 mm (20 times)",
        ),
        (
            4.0,
            0.2,
            "WLS-RC has the smallest CoM error, 0.200 mm; the best other method, MAP-LMI, has "
            "4.00 mm",
        ),
    ],
)
def test_headline_names_the_best_method(ours, theirs, text):
    means = scores({("a", "map_lmi"): ours, ("a", "wls_rc"): theirs, ("a", "ref"): 20.0})
    found = headline(means, plan("a"))
    assert found.startswith(f"Priors {PRIOR}. On a data ")
    assert text in found
    assert "the prior has 20.0 mm" in found


@pytest.mark.parametrize(("best", "worst"), [("a", "c"), ("c", "a")])
def test_headline_of_many_data_sets_names_the_best_and_the_worst(best, worst):
    errors = {best: 0.1, "b": 0.5, worst: 2.0}
    means = scores(
        {(name, "map_lmi"): error for name, error in errors.items()}
        | {(name, "wls_rc"): 10 * error for name, error in errors.items()}
        | {(name, "ref"): 20.0 for name in errors}
    )
    text = headline(means, plan("a", "b", "c"))
    assert f"smallest with {best}, 0.100 mm by MAP-LMI" in text
    assert f"largest with {worst}, 2.00 mm by MAP-LMI" in text


def test_sentences_name_data_on_which_a_method_is_worse_than_the_prior():
    means = scores(
        {
            ("a", "map_lmi"): 1.0,
            ("b", "map_lmi"): 30.0,
            ("a", "ref"): 20.0,
            ("b", "ref"): 20.0,
        }
    )
    (sentence,) = data_sentences(means, ["a", "b"], PRIOR, ["map_lmi", "wls_rc"])
    assert "1.00 mm with a (smallest), 30.0 mm with b (largest, 30 times as much)" in sentence
    assert sentence.endswith("Less accurate than the prior: b (CoM position).")


def test_sentences_count_data_if_a_method_is_worse_with_many():
    names = ("a", "b", "c", "d")
    means = scores(
        {(name, "map_lmi"): 30.0 - 20.0 * (name == "d") for name in names}
        | {(name, "ref"): 20.0 for name in names}
    )
    (sentence,) = data_sentences(means, names, PRIOR, ["map_lmi"])
    assert sentence.endswith("Less accurate than the prior: CoM position with 3 of 4.")
