"""From estimates and, where there is one, a true motion to a report's content."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass

from symbid_ros.arrays import FloatArray
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.evaluation import (
    TrueMotion,
    environment_force,
    evaluate,
    link_errors,
    predict,
)
from symbid_ros.report.content import (
    PRIOR,
    TRUTH,
    LinkErrors,
    MethodResult,
    PredictionSeries,
    ReportContent,
)

TITLES = {"ols": "OLS", "wls_r": "WLS-R", "wls_c": "WLS-C", "wls_rc": "WLS-RC"}


@dataclass(frozen=True)
class Reference:
    """What estimates are judged against.

    Attributes
    ----------
    motion : TrueMotion
        The true motion of a validation record.
    values : (p,) float64
        The true parameters.
    """

    motion: TrueMotion
    values: FloatArray


def compose(
    estimates: Mapping[str, Estimate],
    parameters: ParameterSet,
    *,
    chosen: str,
    facts: Mapping[str, str],
    reference: Reference | None = None,
) -> ReportContent:
    """Return the content of a page about several estimates of one robot.

    Parameters
    ----------
    estimates : mapping of str to Estimate
        By the label people write, in the order shown; all from one prior.
    parameters : ParameterSet
        The robot's columns.
    chosen : str
        Label of the estimate that is shown in full.
    facts : mapping of str to str
        What was done to which data.
    reference : Reference, optional
        The truth; without it nothing is judged and no prediction drawn.
    """
    model = parameters.model
    vectors = {PRIOR: estimates[chosen].prior}
    vectors |= {label: estimate.value for label, estimate in estimates.items()}
    if reference is not None:
        vectors[TRUTH] = reference.values
    metrics: dict[str, dict[str, float]] = {}
    if reference is not None:
        judged = evaluate(parameters, vectors, reference.values, reference.motion)
        metrics = {label: asdict(figures) for label, figures in judged.items()}
    methods = tuple(
        MethodResult(label, estimates.get(label), metrics.get(label)) for label in vectors
    )
    predictions, errors = None, None
    if reference is not None:
        shown = {label: vectors[label] for label in (TRUTH, PRIOR, chosen)}
        predictions = tuple(
            _series(label, parameters, values, reference.motion) for label, values in shown.items()
        )
        errors = LinkErrors(
            parameters.link_names,
            {
                label: link_errors(parameters, values, reference.values)
                for label, values in vectors.items()
                if label != TRUTH
            },
        )
    return ReportContent(
        title=f"Identification of {model.name}",
        model=model.name,
        methods=methods,
        chosen=chosen,
        joint_names=model.joint_names,
        facts=dict(facts),
        predictions=predictions,
        link_errors=errors,
    )


def _series(
    label: str, parameters: ParameterSet, values: FloatArray, motion: TrueMotion
) -> PredictionSeries:
    prediction = predict(parameters, values, motion)
    samples = motion.samples
    first_joint = 6 * parameters.model.floating
    # The environment's share of each joint's load is measured; the motors owe the rest.
    environment = environment_force(parameters.model, motion)[:, first_joint:]
    return PredictionSeries(
        label=label,
        time=(samples.stamp - samples.stamp[0]) * 1e-9,
        com=prediction.com,
        torque=prediction.gen_force[:, first_joint:] - environment,
        linear_momentum=prediction.momentum[:, 3:],
        angular_momentum=prediction.momentum[:, :3],
    )
