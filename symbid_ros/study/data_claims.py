"""What a study says of its data sets and methods, in words that follow from the means."""

from collections.abc import Mapping, Sequence

from symbid_ros.report.formatting import significant
from symbid_ros.study.plan import Plan
from symbid_ros.study.scores import METRICS, REFERENCE, Scores
from symbid_ros.study.thesis import TITLES

NOUNS = dict(zip(METRICS, ("gen. force", "torque", "CoM", "momentum", "parameters"), strict=True))
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
        errors = _com(scores, data, prior, {method})
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
    errors = {method: error for (_, method), error in _com(scores, [data], prior, methods).items()}
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
    errors = _com(scores, data, prior, methods)
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


def _com(
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
        worse = [NOUNS[metric] for metric in METRICS if own and own[metric] > reference[metric]]
        if worse:
            told.append(f"{name} ({', '.join(worse)})")
    return told
