"""What is believed about the parameters before the data: a mean and a deviation each."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic import write_text
from symbid_ros.errors import PriorError
from symbid_ros.model.inertia import phi_from_pseudo_inertia, pseudo_inertia, second_moments
from symbid_ros.model.parameters import ParameterSet

Kind = Literal["percent", "absolute", "consistent"]

# What is believed about a model file that comes without a prior of its own.
DEFAULT_PERCENT = 25.0
# A friction coefficient that no file states is small beside this, in SI units.
FRICTION_STD = 1.0
# The scale of a link that the file gives no mass or no extent.
_BARE_MASS, _BARE_EXTENT = 1.0, 0.1


@dataclass(frozen=True)
class Prior:
    """Independent Gaussian beliefs about the parameters of one model.

    Attributes
    ----------
    model : str
        Name of the robot model it belongs to.
    kind : str
        How it came about, such as "percent 25".
    seed : int or None
        Seed of the draw; None when nothing was drawn.
    names : tuple of str
        Parameter names.
    mean, std : (p,) float64
        In each parameter's SI unit; every standard deviation is positive.
    """

    model: str
    kind: str
    seed: int | None
    names: tuple[str, ...]
    mean: FloatArray
    std: FloatArray

    def write(self, path: Path) -> None:
        """Write prior.json."""
        parameters = {
            name: {"value": float(value), "std": float(std)}
            for name, value, std in zip(self.names, self.mean, self.std, strict=True)
        }
        document = {
            "model": self.model,
            "kind": self.kind,
            "seed": self.seed,
            "parameters": parameters,
        }
        write_text(path, json.dumps(document, indent=1) + "\n")


def model_prior(parameters: ParameterSet) -> Prior:
    """Return the model file's own values, believed to ±25 %."""
    mean = parameters.values
    kind = f"model, percent {DEFAULT_PERCENT:g}"
    std = _percent_std(parameters, mean, DEFAULT_PERCENT)
    return Prior(parameters.model.name, kind, None, parameters.names, mean, std)


def draw_prior(parameters: ParameterSet, kind: Kind, amount: float, seed: int) -> Prior:
    """Draw a prior around the model file's values.

    Parameters
    ----------
    parameters : ParameterSet
        The model and its columns. Friction coefficients keep the file's value.
    kind : {"percent", "absolute", "consistent"}
        "percent": each parameter uniform within ± ``amount`` % of its value;
        "absolute": uniform within ± ``amount`` in its unit (thesis, Table 4.1);
        "consistent": each link's pseudo-inertia J = L Lᵀ becomes L S Lᵀ, where S has
        random axes and eigenvalues uniform within 1 ± ``amount`` %, so that every
        drawn link is physically possible and every moment ∫(aᵀx + b)² dm within
        ± ``amount`` % of its value.
    amount : float
        Half-width of the distribution.
    seed : int
        Seed of the draw.

    Raises
    ------
    PriorError
        When the amount is not positive, or ≥ 100 % of a consistent link.
    """
    if not (np.isfinite(amount) and amount > 0):
        raise PriorError(f"a prior of ± {amount:g} is no distribution; give a positive half-width")
    rng = np.random.default_rng(seed)
    mean = parameters.values.copy()
    count = parameters.inertial
    if kind == "percent":
        mean[:count] *= 1 + rng.uniform(-amount / 100, amount / 100, count)
        std = _percent_std(parameters, mean, amount)
    elif kind == "absolute":
        mean[:count] += rng.uniform(-amount, amount, count)
        std = np.full(len(mean), amount / np.sqrt(3))
        std[count:] = FRICTION_STD
    else:
        if amount >= 100:
            raise PriorError(f"± {amount:g} % leaves no mass; a consistent prior stays below 100")
        drawn = [_consistent(phi, amount / 100, rng) for phi in parameters.link_phi(mean)]
        mean[:count] = np.concatenate([phi for phi, _ in drawn])
        std = np.concatenate([*(std for _, std in drawn), np.full(len(mean) - count, FRICTION_STD)])
        std = np.maximum(std, _floor(parameters, amount))
    name = parameters.model.name
    return Prior(name, f"{kind} {amount:g}", seed, parameters.names, mean, std)


def load_prior(path: Path, parameters: ParameterSet) -> Prior:
    """Read prior.json and check that it belongs to the model.

    Raises
    ------
    PriorError
        When the file is missing, malformed, for another model, or has a value that
        is not finite or a standard deviation that is not positive.
    """
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise PriorError(f"{path}: cannot read it ({error.strerror}); check the path") from None
    except ValueError as error:
        raise PriorError(
            f"{path}: not a prior.json ({error}); write one with `symbid prior`"
        ) from None
    try:
        model, entries = document["model"], document["parameters"]
        values = {name: (float(e["value"]), float(e["std"])) for name, e in entries.items()}
        kind, seed = str(document["kind"]), document["seed"]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise PriorError(
            f"{path}: not a prior.json ({type(error).__name__}: {error}); write one with "
            "`symbid prior`"
        ) from None
    _check_belongs(path, model, values, parameters)
    names = parameters.names
    defaults = dict(zip(names, parameters.values.tolist(), strict=True))
    # A prior drawn without friction serves a model with it: nothing is known there.
    chosen = [values.get(name, (defaults[name], FRICTION_STD)) for name in names]
    mean, std = np.array(chosen).T
    for name, value, deviation in zip(names, mean, std, strict=True):
        if not (np.isfinite(value) and np.isfinite(deviation) and deviation > 0):
            raise PriorError(
                f"{path}: {name} has value {value} and std {deviation}; both must be finite and "
                "the standard deviation positive"
            )
    return Prior(model, kind, seed, names, mean, std)


def _check_belongs(
    path: Path, model: str, values: dict[str, tuple[float, float]], parameters: ParameterSet
) -> None:
    robot = parameters.model
    inertial = parameters.names[: parameters.inertial]
    missing = [name for name in inertial if name not in values]
    known = set(ParameterSet(robot, friction=True).names)
    unknown = [name for name in values if name not in known]
    if model != robot.name or missing or unknown:
        detail = f"the model calls itself {robot.name!r}"
        if missing:
            detail = f"it lacks {missing[0]}"
        elif unknown:
            detail = f"{unknown[0]} is unknown there"
        raise PriorError(
            f"{path}: this prior is for model {model!r}, not for {robot.source} ({detail}); draw "
            f"one with `symbid prior --model {robot.source}`"
        )


def _percent_std(parameters: ParameterSet, mean: FloatArray, percent: float) -> FloatArray:
    """Return the deviation of a uniform ± percent, floored so that a zero is no certainty."""
    uniform = percent / 100 * np.abs(mean) / np.sqrt(3)
    std: FloatArray = np.maximum(uniform, _floor(parameters, percent))
    return std


def _floor(parameters: ParameterSet, percent: float) -> FloatArray:
    """Return 1 % of the deviation that a parameter of its link's scale {m, mℓ, mℓ²} would have.

    ℓ is the link's root-mean-square extent about its origin. The floor is small: it
    serves zeros in somebody's file, and leaves small true values their own scale.
    """
    floor = np.full(len(parameters), FRICTION_STD)
    for index, phi in enumerate(parameters.link_phi(parameters.values)):
        mass = abs(phi[0])
        extent = np.sqrt(max(np.trace(second_moments(phi)), 0.0) / mass) if mass > 0 else 0.0
        mass, extent = mass or _BARE_MASS, extent or _BARE_EXTENT
        scale = np.repeat([mass, mass * extent, mass * extent**2], [1, 3, 6])
        floor[10 * index : 10 * index + 10] = 0.01 * percent / 100 / np.sqrt(3) * scale
    return floor


def _consistent(
    phi: FloatArray, half_width: float, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """Return φ (10,) of a random possible link near φ, and its deviations (10,)."""
    matrix = pseudo_inertia(phi)
    eigenvalues, axes = np.linalg.eigh(matrix)
    if eigenvalues[0] < -1e-12 * abs(eigenvalues[-1]):
        raise PriorError(
            "the model has a physically impossible link, so no consistent prior can be drawn "
            "around it; mend the model or use --percent"
        )
    root = axes * np.sqrt(np.maximum(eigenvalues, 0))
    turn, upper = np.linalg.qr(rng.normal(size=(4, 4)))
    turn = turn * np.sign(np.diag(upper))
    S = turn @ np.diag(1 + rng.uniform(-half_width, half_width, 4)) @ turn.T
    drawn = root @ S @ root.T
    return phi_from_pseudo_inertia(drawn), _consistent_std(root, half_width)


def _consistent_std(root: FloatArray, half_width: float) -> FloatArray:
    """Return the deviations (10,) of φ under J → L S Lᵀ, in closed form.

    With iid eigenvalues of variance σ² and axes uniform over O(4), S has
    E[S_ij S_kl] - E[S_ij] E[S_kl] = σ²/6 (δ_ij δ_kl + δ_ik δ_jl + δ_il δ_jk).
    """
    variance = half_width**2 / 3 / 6
    spread = np.zeros((10, 4, 4))
    for i in range(4):
        for j in range(4):
            unit = np.zeros((4, 4))
            unit[i, j] = 1.0
            moved = root @ (unit + unit.T) @ root.T / 2
            spread[:, i, j] = phi_from_pseudo_inertia(moved)
    trace = np.trace(spread, axis1=1, axis2=2)
    std: FloatArray = np.sqrt(variance * (trace**2 + 2 * np.sum(spread**2, axis=(1, 2))))
    return std
