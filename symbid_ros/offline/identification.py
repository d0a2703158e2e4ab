"""The offline job: a record and a prior in, an estimate out."""

from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic import write_text
from symbid_ros.errors import EstimateError
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.prior import Prior
from symbid_ros.estimation.thesis import Method, scaled_problem
from symbid_ros.estimation.truncation import Criterion, select_rank
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.inertia import is_consistent
from symbid_ros.model.load import is_mjcf
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.record import Record

# A parameter is called determined when the data halve what was not known of it.
DETERMINED = 0.5


@dataclass(frozen=True)
class Truncation:
    """How the number of singular values z is chosen: given, or on a validation record."""

    rank: int | None = None
    validation: Record | None = None
    criterion: Criterion = "gen_force"


def identify(
    record: Record,
    parameters: ParameterSet,
    prior: Prior,
    method: Method,
    truncation: Truncation,
    *,
    row_deviation: FloatArray | None = None,
    inputs: tuple[str, ...] = (),
) -> Estimate:
    """Estimate the parameters with one of the thesis's methods.

    Parameters
    ----------
    record : Record
        The training data.
    parameters : ParameterSet
        The columns; kinematics only are used.
    prior : Prior
        Mean and deviation of the parameters.
    method : {"ols", "wls_r", "wls_c", "wls_rc"}
        Scaling of rows and columns.
    truncation : Truncation
        Choice of z.
    row_deviation : (n,) float64, optional
        σ of each coordinate instead of the OLS residual's.
    inputs : tuple of str
        What to write down as the estimate's origin.

    Raises
    ------
    EstimateError
        When z is neither given nor can be chosen, or is larger than the rank.
    """
    problem = scaled_problem(record.information, prior, method, row_deviation)
    if truncation.rank is not None:
        z = truncation.rank
        if not 1 <= z <= problem.rank:
            raise EstimateError(
                f"rank {z} is not between 1 and {problem.rank}, the rank of this log's equations; "
                "choose another --rank"
            )
    elif truncation.validation is not None:
        z = select_rank(problem, truncation.validation.information, truncation.criterion)
    else:
        raise EstimateError(
            f"{method} needs a number of singular values; give --rank, or --validate with a bag to "
            "choose it on"
        )
    value = problem.solution(z)
    std = problem.std(z, prior.std)
    return Estimate(
        method=method,
        model=parameters.model.name,
        names=parameters.names,
        units=parameters.units,
        value=value,
        prior=prior.mean,
        std=std,
        determined=np.asarray(std < DETERMINED * prior.std),
        rank=z,
        condition=float(problem.singular_values[0] / problem.singular_values[z - 1]),
        samples=record.information.samples,
        residual_rmse=record.information.residual_rmse(value),
        consistent={
            link: is_consistent(phi)
            for link, phi in zip(parameters.link_names, parameters.link_phi(value), strict=True)
        },
        inputs=inputs,
        software=f"symbid_ros {version('symbid_ros')}",
    )


def write_identification(estimate: Estimate, parameters: ParameterSet, out: Path) -> None:
    """Write estimate.json, model.urdf and model.xml into a folder.

    The user's own file is carried over in its format; the other is a bare tree. A
    comment in both names the links that no mass density can realise: programs that check,
    such as MuJoCo, refuse to load those.
    """
    write_text(out / "model.urdf", export_urdf(estimate, parameters))
    write_text(out / "model.xml", export_mjcf(estimate, parameters, out))
    estimate.write(out / "estimate.json")


def export_urdf(estimate: Estimate, parameters: ParameterSet) -> str:
    """Return the identified robot as URDF text, the user's own file if it is one."""
    source = Path(parameters.model.source)
    return urdf_text(
        parameters.apply(estimate.value),
        None if is_mjcf(source) else source,
        comment=_warning(estimate),
    )


def export_mjcf(estimate: Estimate, parameters: ParameterSet, folder: Path) -> str:
    """Return the identified robot as MJCF text for ``folder``, the user's own file if it is one."""
    source = Path(parameters.model.source)
    return mjcf_text(
        parameters.apply(estimate.value),
        source if is_mjcf(source) else None,
        folder,
        comment=_warning(estimate),
    )


def _warning(estimate: Estimate) -> str:
    impossible = [link for link, possible in estimate.consistent.items() if not possible]
    return f"physically impossible: {', '.join(impossible)}" if impossible else ""
