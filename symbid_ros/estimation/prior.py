"""Gaussian prior of the parameters: drawn, or taken from a model file."""

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from scipy.linalg import block_diag, solve_triangular

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import PriorError
from symbid_ros.estimation.block_matrices import independent_blocks
from symbid_ros.estimation.prior_scales import MISSING_PARTS
from symbid_ros.estimation.prior_std import (
    absolute_std,
    beyond_sensors,
    body_covariance,
    consistent_covariance,
    is_stated,
    link_floor,
    percent_floor,
    percent_std,
    sized_std,
    stated_covariance,
    term_scale,
)
from symbid_ros.model.inertia import (
    com_from_phi,
    phi_from_com,
    phi_from_pseudo_inertia,
    pseudo_inertia,
)
from symbid_ros.model.parameters import ParameterSet

Kind = Literal["percent", "absolute", "consistent", "separate"]

# Half-width of the prior of a model file without a prior of its own, %.
DEFAULT_PERCENT = 25.0
# Smallest share of a deviation that must remain given all parameters before it.
_CERTAINTY = 1e-10

# Variance that each parameter keeps if all others of its link are known, of its floor.
REGULARIZATION = 1e-6


@dataclass(frozen=True)
class Prior:
    """Gaussian distribution of the parameters of one model before the data.

    Attributes
    ----------
    model : str
        Name of the robot model.
    kind : str
        Origin, such as "percent 25".
    seed : int or None
        Seed of the draw; None if nothing was drawn.
    names : tuple of str
        Parameter names.
    mean, std : (p,) float64
        Means and standard deviations in SI units. Every standard deviation is positive.
    factor : (p, p) float64 or None
        Lower triangular L with covariance L Lᵀ, whose diagonal is ``std`` squared.
        None for independent parameters.
    assumed : tuple of str
        Parameters whose deviation is a default, because neither file nor user gives one.
    payloads : tuple of str
        Inertias of links beyond wrist sensors, whose deviations allow for any payload.
    alone : (k, p) float64 or None
        Deviations of each number by itself, if the covariance is a sum over kinds of errors of
        unknown sizes: links that are other bodies, and k kinds of numbers that are wrong by
        themselves. None if the sizes are known, or there is one kind.

    Raises
    ------
    PriorError
        When a number is not finite, a standard deviation is not positive, or the factor
        contradicts the standard deviations.
    """

    model: str
    kind: str
    seed: int | None
    names: tuple[str, ...]
    mean: FloatArray
    std: FloatArray
    factor: FloatArray | None = None
    assumed: tuple[str, ...] = ()
    payloads: tuple[str, ...] = ()
    alone: FloatArray | None = None

    def __post_init__(self) -> None:
        """Check that this is a distribution."""
        for name, value, deviation in zip(self.names, self.mean, self.std, strict=True):
            if not (np.isfinite(value) and np.isfinite(deviation) and deviation > 0):
                raise PriorError(
                    f"{name} has value {value} and std {deviation}; both must be finite and the "
                    "standard deviation positive",
                    "E404",
                )
        if self.factor is not None:
            _check_factor(self.factor, self.names, self.std)

    def covariance_factor(self) -> FloatArray:
        """Return the lower triangular L (p, p) with covariance L Lᵀ."""
        return np.diag(self.std) if self.factor is None else self.factor

    def judged(self, count: int) -> IntArray:
        """Return those of the first ``count`` parameters whose deviations the data may judge.

        Deviations that allow for any payload say nothing about the values of the model file.
        """
        return np.flatnonzero([name not in self.payloads for name in self.names[:count]])

    def kinds_of_errors(self, judged: IntArray) -> list[FloatArray]:
        """Return a root (m, m) of each kind's covariance, in units of the columns of ``factor``.

        They are those of the ``judged`` parameters (m,), which do not depend on the others. That
        of links that are other bodies is the first, and the only one if there is one kind.
        """
        whole = np.eye(len(judged))
        if self.alone is None:
            return [whole]
        own = self.covariance_factor()[np.ix_(judged, judged)]
        roots = [np.zeros_like(whole) for _ in range(1 + len(self.alone))]
        # Links are independent. Eigenvectors of all together would mix those with equal values.
        for block in independent_blocks(own):
            place = np.ix_(block, block)
            left = np.eye(len(block))
            for root, deviations in zip(roots[1:], self.alone[:, judged[block]], strict=True):
                root[place] = solve_triangular(own[place], np.diag(deviations), lower=True)
                left -= root[place] @ root[place].T
            squares, V = np.linalg.eigh(left)
            roots[0][place] = V * np.sqrt(np.maximum(squares, 0.0))
        return roots

    def widened(self, scale: FloatArray) -> "Prior":
        """Return the prior with column i of its covariance factor times ``scale[i]``."""
        if self.factor is None:
            return replace(self, std=scale * self.std)
        factor = self.factor * scale
        alone = None if self.alone is None else scale * self.alone
        return replace(self, std=np.linalg.norm(factor, axis=1), factor=factor, alone=alone)

    def with_root(self, root: FloatArray) -> "Prior":
        """Return the prior with the covariance root rootᵀ, whose sizes are known."""
        std = np.linalg.norm(root, axis=1)
        return replace(self, std=std, factor=_triangular(root), alone=None)

    def marginal(self, names: tuple[str, ...]) -> "Prior":
        """Return the prior of some parameters, in the order of ``names``."""
        if names == self.names:
            return self
        index = [self.names.index(name) for name in names]
        factor = None
        if self.factor is not None:
            factor = _triangular(self.factor[index])
        alone = None if self.alone is None else self.alone[:, index]
        mean, std = self.mean[index], self.std[index]
        return replace(self, names=names, mean=mean, std=std, factor=factor, alone=alone)

    def for_columns(self, parameters: ParameterSet) -> "Prior":
        """Return the prior of ``parameters``, in their order.

        Joint terms that are not among them are marginalised, and those that are missing here get
        the prior of :func:`model_prior`.
        """
        names = parameters.names
        if self.names == names:
            return self
        own = model_prior(parameters)
        place = {name: index for index, name in enumerate(self.names)}
        held = np.array([name in place for name in names])
        index = [place[name] for name in names if name in place]
        mean, std, factor, alone = own.mean.copy(), own.std.copy(), None, None
        mean[held], std[held] = self.mean[index], self.std[index]
        if self.factor is not None:
            # The marginal covariance has the same rows of the factor; QR makes the factor
            # triangular again.
            root = np.zeros((len(names), len(self.names) + len(names)))
            root[held, : len(self.names)] = self.factor[index]
            root[~held, len(self.names) :] = np.diag(std)[~held]
            factor = _triangular(root)
        if self.alone is not None:
            alone = np.tile(own.std, (len(self.alone), 1))
            alone[:, held] = self.alone[:, index]
        added = tuple(name for name in own.assumed if name not in place)
        assumed = *(name for name in self.assumed if name in names), *added
        return replace(
            self, names=names, mean=mean, std=std, factor=factor, assumed=assumed, alone=alone
        )

    def extended(
        self,
        names: tuple[str, ...],
        mean: FloatArray,
        std: FloatArray,
        factor: FloatArray | None = None,
    ) -> "Prior":
        """Return the prior with more parameters, independent of the others.

        ``factor`` is the covariance factor of parameters that depend on each other.
        """
        if self.factor is not None or factor is not None:
            own = np.diag(std) if factor is None else factor
            factor = block_diag(self.covariance_factor(), own)
        alone = self.alone
        if alone is not None:
            alone = np.hstack([alone, np.tile(std, (len(alone), 1))])
        return replace(
            self,
            names=self.names + names,
            mean=np.concatenate([self.mean, mean]),
            std=np.concatenate([self.std, std]),
            factor=factor,
            alone=alone,
        )


def _triangular(root: FloatArray) -> FloatArray:
    """Return the lower triangular L with L Lᵀ equal to root rootᵀ."""
    upper = np.linalg.qr(root.T, mode="r")
    factor: FloatArray = (upper * np.sign(np.diag(upper))[:, None]).T
    return factor


def _of_model(parameters: ParameterSet, kind: str, std: FloatArray) -> Prior:
    """Return a prior around the model file's values."""
    model, names, mean = parameters.model.name, parameters.names, parameters.values
    payloads = tuple(name for own in beyond_sensors(parameters) for name in names[own])
    terms = names[parameters.inertial :]
    return Prior(model, kind, None, names, mean, std, assumed=terms, payloads=payloads)


def model_prior(parameters: ParameterSet, percent: float = DEFAULT_PERCENT) -> Prior:
    """Return a prior with the model file's values, uniform within ± ``percent`` %.

    Joint terms that the file does not give are zero with the deviation ``JOINT_TERMS[...].std``.

    Raises
    ------
    PriorError
        When ``percent`` is not positive.
    """
    _check_amount(percent)
    std = percent_std(parameters, parameters.values, percent)
    return _of_model(parameters, f"model, percent {percent:g}", std)


def consistent_prior(parameters: ParameterSet, percent: float = DEFAULT_PERCENT) -> Prior:
    """Return a prior around the model's values with the covariance of physically possible links.

    Every mass moment of a link is uniform within ± ``percent`` %, as drawn by :func:`draw_prior`
    with "consistent". Unlike with :func:`model_prior`, a zero in the file is as uncertain as the
    link's extent allows. Joint terms have the deviations of :func:`model_prior`.

    Raises
    ------
    PriorError
        When ``percent`` is not positive.
    """
    prior = model_prior(parameters, percent)
    variances = np.diag(prior.std**2)
    floor = link_floor(parameters, percent) ** 2
    for index, phi in enumerate(parameters.link_phi(parameters.values)):
        own = slice(10 * index, 10 * index + 10)
        covariance = body_covariance(phi, percent)
        # A link without mass or extent has no covariance of its own, a thin one a singular one.
        missing = np.maximum(floor[own] - np.diag(covariance), REGULARIZATION * floor[own])
        variances[own, own] = covariance + np.diag(missing)
    scale = np.sqrt(np.diag(variances))
    factor = scale[:, None] * np.linalg.cholesky(variances / np.outer(scale, scale))
    return replace(prior, kind=f"model, consistent {percent:g}", std=scale, factor=factor)


def default_prior(parameters: ParameterSet, percent: float = DEFAULT_PERCENT) -> Prior:
    """Return a prior around a model file of which nobody says how good it is.

    A link may be another body than in the file: another shape, as with :func:`consistent_prior`, or
    of another mass, centre of mass and central inertia. Each parameter may be wrong by itself, as
    with :func:`model_prior`. And small parts may be missing anywhere within the link's extent, such
    as a motor in a thin leg, which moves centres of mass beside the file's axis and tilts principal
    axes. The covariances add up, because each alone is far too certain of a file with another kind
    of error: a wrong mass beside a right inertia contradicts the first kind, and a product of
    inertia that the file puts at zero the second. The data scale the errors of bodies, of single
    parameters and of missing parts, see
    :func:`~symbid_ros.estimation.posterior.posterior`.

    Raises
    ------
    PriorError
        When ``percent`` is not positive.
    """
    prior = consistent_prior(parameters, percent)
    factor = prior.covariance_factor()
    variances = factor @ factor.T
    for index, phi in enumerate(parameters.link_phi(parameters.values)):
        own = slice(10 * index, 10 * index + 10)
        variances[own, own] += stated_covariance(phi, percent / 100)
    shares = np.array(
        [model_prior(parameters, percent).std, MISSING_PARTS * sized_std(parameters, percent)]
    )
    alone = np.where(np.arange(len(parameters)) < parameters.inertial, shares, prior.std)
    links = np.arange(parameters.inertial)
    variances[links, links] += np.sum(alone[:, links] ** 2, axis=0)
    std = np.sqrt(np.diag(variances))
    factor = std[:, None] * np.linalg.cholesky(variances / np.outer(std, std))
    kind = f"model, default {percent:g}"
    return replace(prior, kind=kind, std=std, factor=factor, alone=alone)


def planning_prior(parameters: ParameterSet, percent: float = DEFAULT_PERCENT) -> Prior:
    """Return :func:`consistent_prior` with the deviations of unknown joint terms.

    Files often state placeholders for friction, which must not make it look known to a plan.

    Raises
    ------
    PriorError
        When ``percent`` is not positive.
    """
    prior = consistent_prior(parameters, percent)
    terms = slice(parameters.inertial, None)
    std = prior.std.copy()
    std[terms] = np.maximum(std[terms], term_scale(parameters))
    # Joint terms are independent of all others, so a row of the factor scales with its deviation.
    factor = (std / prior.std)[:, None] * prior.covariance_factor()
    return replace(prior, std=std, factor=factor)


def absolute_model_prior(parameters: ParameterSet, amount: float) -> Prior:
    """Return a prior with the model file's values, uniform within ± ``amount`` in SI units.

    Joint terms that the file does not give are zero with the deviation ``JOINT_TERMS[...].std``.

    Raises
    ------
    PriorError
        When ``amount`` is not positive.
    """
    _check_amount(amount)
    return _of_model(parameters, f"model, absolute {amount:g}", absolute_std(parameters, amount))


def draw_prior(parameters: ParameterSet, kind: Kind, amount: float, seed: int) -> Prior:
    """Draw a prior around the model file's values.

    Parameters
    ----------
    parameters : ParameterSet
        The model and its columns. Joint terms that the file does not give stay zero, with the
        deviation ``JOINT_TERMS[...].std``.
    kind : {"percent", "absolute", "consistent", "separate"}
        "percent": each parameter uniform within ± ``amount`` % of its value.
        "absolute": uniform within ± ``amount`` in its unit (thesis, Table 4.1).
        "consistent": each link's pseudo-inertia J = L Lᵀ becomes L S Lᵀ, where S has random axes
        and eigenvalues uniform within 1 ± ``amount`` %. Every drawn link is then physically
        consistent, and every moment ∫(aᵀx + b)² dm is within ± ``amount`` % of its value. Joint
        terms as with "percent".
        "separate": the mass, each coordinate of the centre of mass and each central moment of a
        link are uniform within ± ``amount`` %. Joint terms as with "percent".
    amount : float
        Half-width of the distribution.
    seed : int
        Seed of the draw.

    Raises
    ------
    PriorError
        When the amount is not positive, or ≥ 100 % of a consistent link.
    """
    _check_amount(amount)
    rng = np.random.default_rng(seed)
    mean = parameters.values.copy()
    count = parameters.inertial
    if kind == "percent":
        mean *= 1 + rng.uniform(-amount / 100, amount / 100, len(mean))
        std = percent_std(parameters, mean, amount)
    elif kind == "absolute":
        mean += np.where(is_stated(parameters), rng.uniform(-amount, amount, len(mean)), 0.0)
        std = absolute_std(parameters, amount)
    else:
        if amount >= 100:
            raise PriorError(
                f"± {amount:g} % leaves no mass; give a {kind} prior less than 100 %", "E406"
            )
        draw = _consistent if kind == "consistent" else _separate
        drawn = [draw(phi, amount / 100, rng) for phi in parameters.link_phi(mean)]
        mean[:count] = np.concatenate([phi for phi, _ in drawn])
        mean[count:] *= 1 + rng.uniform(-amount / 100, amount / 100, len(mean) - count)
        std = percent_std(parameters, mean, amount)
        links = np.concatenate([deviation for _, deviation in drawn])
        std[:count] = np.maximum(links, percent_floor(parameters, amount)[:count])
    name = parameters.model.name
    return Prior(name, f"{kind} {amount:g}", seed, parameters.names, mean, std)


def _check_amount(amount: float) -> None:
    if not (np.isfinite(amount) and amount > 0):
        raise PriorError(
            f"a prior cannot be uniform within ± {amount:g}; give a positive half-width", "E406"
        )


def _check_factor(factor: FloatArray, names: tuple[str, ...], std: FloatArray) -> None:
    size = len(names)
    if factor.shape != (size, size):
        raise PriorError(
            f"covariance_factor has shape {factor.shape}; {size} parameters need "
            f"{size} rows of {size} numbers",
            "E405",
        )
    if not np.all(np.isfinite(factor)):
        raise PriorError("covariance_factor has a number that is not finite; correct it", "E405")
    if np.any(np.triu(factor, 1)):
        raise PriorError(
            "covariance_factor is not lower triangular; give L of covariance L Lᵀ", "E405"
        )
    # The diagonal is the conditional deviation of each parameter given those before it.
    certain = np.flatnonzero(np.diag(factor) <= _CERTAINTY * std)
    if len(certain):
        raise PriorError(
            f"covariance_factor is not positive definite: its diagonal at {names[certain[0]]} is "
            f"{factor[certain[0], certain[0]]:g}; give every parameter some freedom",
            "E405",
        )
    implied = np.linalg.norm(factor, axis=1)
    wrong = np.flatnonzero(np.abs(implied / std - 1) > 1e-6)
    if len(wrong):
        raise PriorError(
            f"covariance_factor gives {names[wrong[0]]} a std of {implied[wrong[0]]:g}, its own "
            f"entry {std[wrong[0]]:g}; make them agree",
            "E405",
        )


def _separate(
    phi: FloatArray, half_width: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return φ (10,) of a link each of whose numbers in a file is wrong, and its deviations."""
    mass, com, central = com_from_phi(phi)
    factors = 1 + rng.uniform(-half_width, half_width, 10)
    drawn = phi_from_com(factors[0] * mass, factors[1:4] * com, np.zeros((3, 3)))
    drawn[4:] += factors[4:] * phi_from_com(0.0, com, central)[4:]
    return drawn, np.sqrt(np.diag(stated_covariance(drawn, half_width)))


def _consistent(
    phi: FloatArray, half_width: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return φ (10,) of a random consistent link near φ, and its deviations (10,)."""
    matrix = pseudo_inertia(phi)
    eigenvalues, axes = np.linalg.eigh(matrix)
    if eigenvalues[0] < -1e-12 * abs(eigenvalues[-1]):
        raise PriorError(
            "the model has a physically inconsistent link, so no consistent prior can be drawn "
            "around it; correct the model or use --percent",
            "E407",
        )
    root = axes * np.sqrt(np.maximum(eigenvalues, 0))
    turn, upper = np.linalg.qr(rng.normal(size=(4, 4)))
    turn = turn * np.sign(np.diag(upper))
    S = turn @ np.diag(1 + rng.uniform(-half_width, half_width, 4)) @ turn.T
    drawn = root @ S @ root.T
    std: FloatArray = np.sqrt(np.diag(consistent_covariance(root, half_width)))
    return phi_from_pseudo_inertia(drawn), std
