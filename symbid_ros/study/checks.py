"""Checks on whole logs: equation of motion, realistic predictions, filters and closed loop."""

from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.bags import read_streams, read_truth
from symbid_ros.dynamics.contact import contact_jacobian, contact_wrenches
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import equation_of_motion, known_force
from symbid_ros.identification.predictions.evaluation import TrueMotion
from symbid_ros.identification.predictions.realistic_prediction import evaluate_realistic
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import read_realistic_motion, read_true_motion
from symbid_ros.report.content import TRUTH
from symbid_ros.signals.alignment import align, joint_columns
from symbid_ros.signals.filters import LowPass
from symbid_ros.signals.sampled_rows import valid_coordinates
from symbid_ros.simulation.balance import BalanceResult, balance
from symbid_ros.study.draws import load_draw
from symbid_ros.study.logs import nominal_parameters, true_parameters
from symbid_ros.study.plan import (
    AccelerationPlan,
    ClosedLoopPlan,
    FigurePlan,
    Plan,
    PriorSpread,
    SimulatedLog,
)
from symbid_ros.study.scores import Case
from symbid_ros.study.study_folder import StudyFolder, read_result, write_result

# Every STRIDE-th sample of a noisy log is predicted, as the motion is slow.
STRIDE = 20
# Singular values of J_g below this share of the largest count as zero; ideal data have no noise.
RANK_TOLERANCE = 1e-9


@dataclass(frozen=True)
class EquationResidual:
    """Residual of the equation of motion at the true parameters; its fields are keys of a file.

    Attributes
    ----------
    robot, model, wrenches : str
        Whether the robot has friction, which columns the model has, and the source of the
        contact forces.
    rmse : float
        RMS norm of y - K φ over the samples, N and Nm, without joints that may stick.
    """

    robot: str
    model: str
    wrenches: str
    rmse: float


def check_equation(log: SimulatedLog, folder: StudyFolder) -> None:
    """Evaluate the equation of motion on ideal logs, with and without friction (Eq. B.1)."""
    frictionless, with_friction = (log.model_copy(update={"friction": on}) for on in (False, True))
    found = []
    for one, model, parameters in (
        (frictionless, "rigid links", true_parameters(frictionless, folder)),
        (with_friction, "rigid links, friction", true_parameters(with_friction, folder)),
        (with_friction, "rigid links", nominal_parameters(frictionless)),
    ):
        motion = read_true_motion([folder.log(one)], true_parameters(one, folder).model)
        robot = "with friction" if one.friction else "without friction"
        for wrenches, rmse in _equation_residuals(parameters, motion).items():
            found.append(EquationResidual(robot, model, wrenches, rmse))
    write_result(folder.check("equation"), [asdict(one) for one in found])


def _equation_residuals(parameters: ParameterSet, motion: TrueMotion) -> dict[str, float]:
    """Return the RMS residual with measured and with predicted contact wrenches."""
    squares, count = np.zeros(2), 0
    for block in motion.blocks():
        samples = block.samples
        valid = valid_coordinates(parameters, samples.velocity)
        # Predicted contact forces depend on all coordinates, so all of them must be valid.
        complete = valid.all(axis=1)
        rows = equation_of_motion(parameters, samples)
        needed = rows.K @ parameters.values
        poses = link_poses(parameters.model, samples.position)
        jacobian = contact_jacobian(parameters.model, samples.wrench_frames, poses)
        unmet = needed + known_force(parameters, samples)
        unmet[:, 6 * parameters.model.floating :] -= samples.effort
        wrenches = contact_wrenches(jacobian, unmet[:, None], RANK_TOLERANCE)[:, 0]
        stacked = wrenches.reshape(len(samples), 1, -1)
        predicted = unmet - (stacked @ jacobian)[:, 0]
        squares += [np.sum((rows.y - needed)[complete] ** 2), np.sum(predicted[complete] ** 2)]
        count += int(complete.sum())
    measured, from_motion = np.sqrt(squares / max(count, 1)).tolist()
    return {"measured": measured, "by Eq. 4.1": from_motion}


def load_equation_residuals(folder: StudyFolder) -> list[EquationResidual]:
    """Read the residuals that :func:`check_equation` wrote."""
    return read_result(
        folder.check("equation"), lambda content: [EquationResidual(**one) for one in content]
    )


def check_realistic(plan: Plan, figures: FigurePlan, folder: StudyFolder) -> None:
    """Predict the noisy validation log from its own sensors, for every method and draw."""
    log, spread = plan.noisy_validation_log(figures.data), figures.prior
    true = true_parameters(plan.data[figures.data], folder)
    motion = read_realistic_motion([folder.log(log)], true.model)
    thinned = type(motion)(motion.measured[::STRIDE], motion.truth[::STRIDE])
    candidates = {TRUTH: true.values}
    for iteration in range(plan.iterations):
        draw = load_draw(folder.draw(figures.data, spread, iteration))
        for method in plan.compared:
            result = draw[Case.of(figures.data, spread, method, figures.torque)]
            candidates[f"{method} {iteration}"] = np.array(result.values)
    metrics = evaluate_realistic(true, candidates, true.values, thinned)
    means: dict[str, dict[str, float]] = {TRUTH: asdict(metrics[TRUTH])}
    for method in plan.compared:
        each = [asdict(metrics[f"{method} {i}"]) for i in range(plan.iterations)]
        means[method] = {name: float(np.mean([one[name] for one in each])) for name in each[0]}
    write_result(folder.check("realistic"), means)


def load_realistic(folder: StudyFolder) -> dict[str, dict[str, float]]:
    """Read the mean errors that :func:`check_realistic` wrote, by method."""
    return read_result(folder.check("realistic"), dict)


@dataclass(frozen=True)
class AccelerationCheck:
    """True joint accelerations of one log, and the error of filtered ones.

    Attributes
    ----------
    joint_names : tuple of str
    time : (N,) float64
        s.
    acceleration : (N, J) float64
        True accelerations, rad/s².
    rms, error : float
        RMS norms of the true acceleration and of the error e_a of the filtered one (Eq. 4.2),
        rad/s².
    """

    joint_names: tuple[str, ...]
    time: FloatArray
    acceleration: FloatArray
    rms: float
    error: float


def check_accelerations(
    plan: AccelerationPlan, name: str, folder: StudyFolder
) -> AccelerationCheck:
    """Compare second derivatives of a noisy log's filtered positions with the truth."""
    log = plan.logs[name]
    bag = [Path(folder.log(log))]
    model = true_parameters(log, folder).model
    truth = read_truth(bag)
    columns = joint_columns(truth.joint_names, model, f"{truth.source}: ground_truth/joints")
    low_pass = LowPass(plan.cutoff, "thesis")
    true, found = [], []
    for segment in align(read_streams(bag), model):
        edge = low_pass.settling(segment.rate)
        filtered = low_pass.motion(segment.position, segment.rate, 2)[2]
        _, here, there = np.intersect1d(segment.stamp, truth.stamp, return_indices=True)
        inner = (here >= edge) & (here < len(segment.stamp) - edge)
        found.append(filtered[here[inner]])
        true.append(truth.acceleration[np.ix_(there[inner], columns)])
    acceleration = truth.acceleration[:, columns]
    error = np.concatenate(found) - np.concatenate(true)
    return AccelerationCheck(
        joint_names=model.joint_names,
        time=(truth.stamp - truth.stamp[0]) * 1e-9,
        acceleration=acceleration,
        rms=_rms_norm(acceleration),
        error=_rms_norm(error),
    )


def _rms_norm(vectors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.sum(vectors**2, axis=1))))


def run_closed_loop(
    loop: ClosedLoopPlan, folder: StudyFolder, spread: PriorSpread, iteration: int, method: str
) -> None:
    """Run the balance controller with one estimate as its model, and write the result."""
    draw = load_draw(folder.draw(loop.data, spread, iteration))
    values = np.array(draw[Case.of(loop.data, spread, method, loop.filter)].values)
    parameters = nominal_parameters(SimulatedLog())
    inertias = dict(zip(parameters.link_names, parameters.link_phi(values), strict=True))
    run = balance(inertias, moves=loop.moves, motion_seed=loop.motion_seed)
    write_result(folder.loop(spread, iteration, method), asdict(run))


def run_true_closed_loop(loop: ClosedLoopPlan, folder: StudyFolder) -> None:
    """Run the balance controller with the true model, and write the result."""
    run = balance(None, moves=loop.moves, motion_seed=loop.motion_seed)
    write_result(folder.check(TRUTH), asdict(run))


def load_closed_loop_runs(
    plan: Plan, folder: StudyFolder, spread: PriorSpread
) -> dict[str, list[BalanceResult]]:
    """Read the runs with one kind of prior, by method; the true model comes last."""
    loop = plan.closed_loop
    if loop is None:
        return {}
    runs = {
        method: [
            _load_run(folder.loop(spread, iteration, method))
            for iteration in range(loop.iterations)
        ]
        for method in plan.compared
    }
    return runs | {TRUTH: [_load_run(folder.check(TRUTH))]}


def _load_run(file: Path) -> BalanceResult:
    return read_result(file, lambda content: BalanceResult(**content))
