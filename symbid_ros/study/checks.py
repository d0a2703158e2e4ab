"""Checks of whole logs: the equation of motion, filtered accelerations, realistic predictions."""

import json
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.atomic_write import write_text
from symbid_ros.bags import read_streams, read_truth
from symbid_ros.choices import GAUSSIAN
from symbid_ros.dynamics.contact import contact_jacobian, contact_wrenches
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion, known_force
from symbid_ros.errors import StudyError
from symbid_ros.identification.evaluation import TrueMotion
from symbid_ros.identification.realistic_prediction import evaluate_realistic
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_realistic_motion, read_true_motion
from symbid_ros.report.content import TRUTH
from symbid_ros.signals.alignment import align, joint_columns
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.weak_form import sticking_left_out
from symbid_ros.simulation.balance import BalanceResult, balance
from symbid_ros.study.draws import load_draw
from symbid_ros.study.logs import identified, truth
from symbid_ros.study.plan import Accelerations, ClosedLoop, Figures, Log, Plan, Spread
from symbid_ros.study.scores import REFERENCE, Case
from symbid_ros.study.workspace import Workspace

# Samples of a noisy log that are predicted: one in so many, as the motion is slow.
STRIDE = 20

# Combinations of contact wrenches that ideal data tell apart, as a share of the best felt one.
DEPENDENT = 1e-9


@dataclass(frozen=True)
class Closure:
    """How well the equation of motion closes at the true parameters.

    Attributes
    ----------
    robot, model, wrenches : str
        With friction or not; which columns the model has; where contact forces come from.
    rmse : float
        Norm per sample of y - K φ, N and Nm; joints that may stick are left out.
    """

    robot: str
    model: str
    wrenches: str
    rmse: float


def check_equation(log: Log, space: Workspace) -> None:
    """Close the equation of motion on ideal logs, with friction and without (Eq. B.1)."""
    smooth, rubbing = (log.model_copy(update={"friction": on}) for on in (False, True))
    found = []
    for one, model, parameters in (
        (smooth, "rigid links", truth(smooth, space)),
        (rubbing, "rigid links, friction", truth(rubbing, space)),
        (rubbing, "rigid links", identified(smooth)),
    ):
        motion = read_true_motion([space.log(one)], truth(one, space).model)
        robot = "with friction" if one.friction else "without friction"
        for wrenches, rmse in _closures(parameters, motion).items():
            found.append(Closure(robot, model, wrenches, rmse))
    write_text(space.check("equation"), json.dumps([asdict(one) for one in found]) + "\n")


def _closures(parameters: ParameterSet, motion: TrueMotion) -> dict[str, float]:
    """Return the root mean square of the residual with measured and with predicted wrenches."""
    squares, count = np.zeros(2), 0
    for block in motion.blocks():
        samples = block.samples
        valid = sticking_left_out(parameters, samples.velocity)
        # Contact forces follow from all coordinates, so all of them have to hold.
        whole = valid.all(axis=1)
        rows = equation_of_motion(parameters, samples)
        needed = rows.K @ parameters.values
        poses = link_poses(parameters.model, samples.position)
        jacobian = contact_jacobian(parameters.model, samples.wrench_frames, poses)
        unmet = needed + known_force(parameters, samples)
        unmet[:, 6 * parameters.model.floating :] -= samples.effort
        wrenches = contact_wrenches(jacobian, unmet[:, None], DEPENDENT)[:, 0]
        stacked = wrenches.reshape(len(samples), 1, -1)
        predicted = unmet - (stacked @ jacobian)[:, 0]
        squares += [np.sum((rows.y - needed)[whole] ** 2), np.sum(predicted[whole] ** 2)]
        count += int(whole.sum())
    measured, from_motion = np.sqrt(squares / max(count, 1)).tolist()
    return {"measured": measured, "by Eq. 4.1": from_motion}


def load_closures(space: Workspace) -> list[Closure]:
    """Read what :func:`check_equation` found."""
    return [Closure(**one) for one in json.loads(space.check("equation").read_text())]


def check_realistic(plan: Plan, figures: Figures, space: Workspace) -> None:
    """Predict the noisy validation log as the robot could, with every method and draw."""
    log, spread = plan.realistic_of(figures.data), figures.prior
    true = truth(plan.data[figures.data], space)
    motion = read_realistic_motion([space.log(log)], true.model)
    thin = type(motion)(motion.measured[::STRIDE], motion.truth[::STRIDE])
    candidates = {TRUTH: true.values}
    for iteration in range(plan.iterations):
        draw = load_draw(space.draw(figures.data, spread, iteration))
        for method in (REFERENCE, *plan.methods):
            cutoff = None if method == REFERENCE or method in GAUSSIAN else figures.torque
            outcome = draw[Case(figures.data, str(spread), method, cutoff)]
            candidates[f"{method} {iteration}"] = np.array(outcome.values)
    judged = evaluate_realistic(true, candidates, true.values, thin)
    means: dict[str, dict[str, float]] = {TRUTH: asdict(judged[TRUTH])}
    for method in (REFERENCE, *plan.methods):
        each = [asdict(judged[f"{method} {i}"]) for i in range(plan.iterations)]
        means[method] = {name: float(np.mean([one[name] for one in each])) for name in each[0]}
    write_text(space.check("realistic"), json.dumps(means) + "\n")


def load_realistic(space: Workspace) -> dict[str, dict[str, float]]:
    """Read the means that :func:`check_realistic` found, by method."""
    found: dict[str, dict[str, float]] = json.loads(space.check("realistic").read_text())
    return found


@dataclass(frozen=True)
class AccelerationCheck:
    """Joint accelerations of one log, true and as a filter leaves them.

    Attributes
    ----------
    joint_names : tuple of str
    time : (N,) float64
        s.
    acceleration : (N, J) float64
        True, rad/s².
    rms, error : float
        Norms per sample of the true one, and of e_a (Eq. 4.2) behind the filter, rad/s².
    """

    joint_names: tuple[str, ...]
    time: FloatArray
    acceleration: FloatArray
    rms: float
    error: float


def check_accelerations(
    accelerations: Accelerations, name: str, space: Workspace
) -> AccelerationCheck:
    """Differentiate a noisy log's filtered positions as the thesis does, and compare."""
    log = accelerations.logs[name]
    bag = [Path(space.log(log))]
    model = truth(log, space).model
    known = read_truth(bag)
    columns = joint_columns(known.joint_names, model, f"{known.source}: ground_truth/joints")
    low_pass = LowPass(accelerations.cutoff, "thesis")
    true, found = [], []
    for segment in align(read_streams(bag), model):
        edge = low_pass.settling(segment.rate)
        filtered = low_pass.motion(segment.position, segment.rate, 2)[2]
        _, here, there = np.intersect1d(segment.stamp, known.stamp, return_indices=True)
        inner = (here >= edge) & (here < len(segment.stamp) - edge)
        found.append(filtered[here[inner]])
        true.append(known.acceleration[np.ix_(there[inner], columns)])
    acceleration = known.acceleration[:, columns]
    error = np.concatenate(found) - np.concatenate(true)
    return AccelerationCheck(
        joint_names=model.joint_names,
        time=(known.stamp - known.stamp[0]) * 1e-9,
        acceleration=acceleration,
        rms=_rms(acceleration),
        error=_rms(error),
    )


def _rms(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def believers(plan: Plan) -> list[str]:
    """Return whose models the controller is given, beside the truth."""
    return [REFERENCE, *plan.methods]


def run_loop(
    loop: ClosedLoop, space: Workspace, spread: Spread, iteration: int, method: str
) -> None:
    """Let the controller believe one estimate."""
    cutoff = None if method == REFERENCE or method in GAUSSIAN else loop.filter
    draw = load_draw(space.draw(loop.data, spread, iteration))
    values = np.array(draw[Case(loop.data, str(spread), method, cutoff)].values)
    parameters = identified(Log())
    inertias = dict(zip(parameters.link_names, parameters.link_phi(values), strict=True))
    _write(
        balance(inertias, moves=loop.moves, motion_seed=loop.motion_seed),
        space.loop(spread, iteration, method),
    )


def run_truth(loop: ClosedLoop, space: Workspace) -> None:
    """Let the controller know the truth."""
    _write(balance(None, moves=loop.moves, motion_seed=loop.motion_seed), space.check(TRUTH))


def load_runs(plan: Plan, space: Workspace, spread: Spread) -> dict[str, list[BalanceResult]]:
    """Read the runs of one kind of prior, by method; the truth comes last."""
    loop = plan.closed_loop
    if loop is None:
        return {}
    runs = {
        method: [
            _read(space.loop(spread, iteration, method)) for iteration in range(loop.iterations)
        ]
        for method in believers(plan)
    }
    return runs | {TRUTH: [_read(space.check(TRUTH))]}


def _write(run: BalanceResult, file: Path) -> None:
    write_text(file, json.dumps(asdict(run)) + "\n")


def _read(file: Path) -> BalanceResult:
    try:
        return BalanceResult(**json.loads(file.read_text(encoding="utf-8")))
    except (OSError, ValueError, TypeError) as error:
        raise StudyError(f"{file}: cannot be read ({error}); delete it and start again") from None
