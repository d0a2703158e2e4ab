"""Designed trajectories against random ones, and expected against actual errors.

Usage: .venv/bin/python bench/excitation.py [random] [rehearsals] [--robot ur5] [--draws 20]
       .venv/bin/python bench/excitation.py --robot solo12 --standing --no-collision

- random: standard deviations of the base parameters, by the data alone, of random trajectories of
  the same length, relative to the designed one's. Each random trajectory has the same harmonics
  and is scaled until it touches a limit. For a standing robot, whose data alone do not determine
  all base parameters: the deviations with the prior, of what the designed trajectory determines.
- rehearsals: true robots drawn within 25 % of the model follow the designed trajectory in MuJoCo,
  with friction, and the noisy logs are identified with the plan's prior. The error of each
  parameter that was expected to be determined is divided by the standard deviation that was stated
  before.
"""

import argparse
import logging
import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
from development import EXAMPLE_ROBOTS, require_packages
from foreign_robots import load_robot
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

import symbid_ros as sy
from symbid_ros.dynamics.regressor import equation_of_motion
from symbid_ros.estimation.base_parameters import base_parameters
from symbid_ros.estimation.prior import planning_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.excitation.files import write_plan
from symbid_ros.excitation.optimizer import TrajectoryOptimizer
from symbid_ros.excitation.options import ExciteOptions
from symbid_ros.excitation.plan import ExcitationPlan, ExcitationProblem, excitation_problem
from symbid_ros.excitation.rehearsal import draw_truth, standing_simulator
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.simulation.joint_sensors import BaseSensorOptions, JointSensorOptions
from symbid_ros.simulation.joint_trajectory import JointTrajectory, read_trajectory
from symbid_ros.simulation.options import TruthOptions
from symbid_ros.simulation.plant import RobotFailureError
from symbid_ros.simulation.standing_robot import StandingSimulator
from symbid_ros.simulation.tracking import TrackingSimulator, effort_capacity

FloatArray = NDArray[np.float64]
SYMBITRON = Path(__file__).parents[1] / "config" / "symbitron.xml"


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    options.add_argument("parts", nargs="*", default=["random", "rehearsals"])
    options.add_argument("--robot", default="ur5")
    options.add_argument("--draws", type=int, default=20)
    options.add_argument("--default-prior", action="store_true", help="in rehearsals")
    options.add_argument("--planned-terms", action="store_true", help="no others by evidence")
    options.add_argument("--truths", type=int, help="of rehearsals; default: as many as draws")
    options.add_argument("--starts", type=int, default=2)
    options.add_argument("--speed-share", type=float, default=0.8)
    options.add_argument("--floor", type=float)
    options.add_argument("--standing", action="store_true")
    options.add_argument("--no-collision", action="store_true")
    options.add_argument("--iterations", type=int, default=80)
    given = options.parse_args()
    require_packages(EXAMPLE_ROBOTS)
    logging.disable(logging.WARNING)
    feet: tuple[str, ...] = ()
    if given.robot == "symbitron":
        robot, feet = sy.load_model(SYMBITRON), ("left_sole", "right_sole")
    elif given.standing:
        robot, frames = load_robot(given.robot)
        feet = tuple(f"{frame}:point" for frame in frames)
    else:
        robot = load_robot(given.robot, base="fixed")[0]
    if given.robot == "solo12":  # the file states 1000 Nm and 1000 rad/s
        drives = (replace(joint, effort=2.7, speed=10.0) for joint in robot.joints)
        robot = replace(robot, joints=tuple(drives))
    chosen = ExciteOptions(
        speed_share=given.speed_share,
        floor=given.floor,
        starts=given.starts,
        iterations=given.iterations,
        no_collision=given.no_collision,
        feet=feet,
    )
    problem = excitation_problem(robot, chosen, JointSensorOptions())
    with threadpool_limits(1):
        started = time.perf_counter()
        optimizer = TrajectoryOptimizer(problem.design, seed=0)
        best = optimizer.run(chosen.starts, chosen.iterations)
        assert optimizer.random is not None
        plan = ExcitationPlan(problem, best, optimizer.random)
        print(f"{given.robot}: designed in {time.perf_counter() - started:.0f} s\n")
        if "random" in given.parts:
            compare(plan, given.draws)
        if "rehearsals" in given.parts:
            rehearse(
                plan,
                given.truths or given.draws,
                has_prior=not given.default_prior,
                terms=",".join(problem.parameters.terms) if given.planned_terms else "auto",
            )


def compare(plan: ExcitationPlan, draws: int) -> None:
    """Print base parameters' deviations of random trajectories relative to the designed one."""
    problem = plan.problem
    optimizer = TrajectoryOptimizer(problem.design, seed=1)
    deviations = base_deviations
    if problem.options.feet:
        deviations = known_deviations
        print(f"{plan.determined.sum()} of {len(plan.std)} determined, {plan.gain:.0f} bits")
    designed = deviations(problem, plan.coefficients)
    others = [drawn(optimizer) for _ in range(draws)]
    ratios = np.array([deviations(problem, other) for other in others]) / designed
    if problem.options.feet:
        ratios = ratios[:, plan.determined]
        gains = np.array([problem.design.gain(other) for other in others]) / np.log(2)
        print(f"random: {gains.max():.0f} bits at most, {np.median(gains):.0f} in the median\n")
    means = np.sort(np.exp(np.mean(np.log(ratios), axis=1)))
    print("| trajectory | σ of parameters, geometric mean | of the median parameter |")
    print("|---|---|---|")
    print("| designed | 1 | 1 |")
    middles = np.sort(np.median(ratios, axis=1))
    for name, row in (("best", 0), ("median", draws // 2), ("worst", -1)):
        print(f"| {name} of {draws} random | {means[row]:.2f} | {middles[row]:.2f} |")
    better = np.mean(np.median(ratios, axis=0) > 1)
    print(f"\nSmaller than with the median random trajectory: {100 * better:.0f} % of parameters\n")


def drawn(optimizer: TrajectoryOptimizer) -> FloatArray:
    while (coefficients := optimizer.draw()) is None:
        pass
    return coefficients


def base_deviations(problem: ExcitationProblem, coefficients: FloatArray) -> FloatArray:
    """Return the deviations of base and friction parameters by least squares, without a prior."""
    expected, design = problem.design.expected, problem.design
    instants = design.instants(10 * design.samples)
    samples = expected.joints.samples(design.series.motion(coefficients, instants))
    base = base_parameters(expected.parameters)
    K = equation_of_motion(expected.parameters, samples).K[:, :, base.independent]
    rows = expected.whitened(K)
    repeats = problem.sensors.rate * design.seconds / len(instants)
    scale = np.linalg.norm(rows, axis=0)
    upper = np.linalg.qr(rows / scale, mode="r")
    deviations = np.linalg.norm(np.linalg.inv(upper), axis=1) / scale / np.sqrt(repeats)
    return np.asarray(deviations)


def known_deviations(problem: ExcitationProblem, coefficients: FloatArray) -> FloatArray:
    """Return the deviations of all parameters by data and prior."""
    return np.asarray(np.linalg.norm(problem.expected_factor(coefficients), axis=1))


def rehearse(
    plan: ExcitationPlan, draws: int, *, has_prior: bool = True, terms: str = "auto"
) -> None:
    """Print the pooled ratio of errors to the deviations that were expected."""
    problem = plan.problem
    robot = plan.joints.model
    folder = tempfile.TemporaryDirectory()
    write_plan(plan, Path(folder.name) / "plan")
    trajectory = read_trajectory(Path(folder.name) / "plan", robot.measured_joint_names)
    names = problem.parameters.names
    passive = {joint.name for joint in robot.joints if joint.effort == 0}  # simulated frictionless
    known = plan.determined & [name.partition("/")[0] not in passive for name in names]
    ratios, own = [], []
    prior = Path(folder.name) / "prior.json"
    write_prior(prior, planning_prior(problem.parameters))
    print("| truth | rms of error/expected σ | of error/σ of the estimate | alarms |")
    print("|---|---|---|---|", flush=True)
    for seed in range(draws):
        if problem.options.feet:
            simulator = standing_simulator(
                robot,
                Path(folder.name) / "plan",
                truth=TruthOptions(truth_seed=seed),
                has_friction=True,
                sensors=problem.sensors,
                base_sensors=BaseSensorOptions(),
                seed=seed,
            )
            try:
                log = standing_log(simulator)
            except RobotFailureError as failure:
                print(f"| {seed} | {failure.cause} | | |", flush=True)
                continue
            truth = simulator.truth
        else:
            truth = draw_truth(robot, percent=25, seed=seed, has_friction=True)
            log = simulated_log(truth, robot, trajectory, problem.sensors, seed)
        found = sy.identify(
            robot,
            log,
            prior=prior if has_prior else None,
            joint_terms=[terms],
            no_holdout=True,
        )
        exact = true_values(truth)
        estimate = found.estimate
        place = {name: index for index, name in enumerate(estimate.names)}
        some = [i for i, name in enumerate(names) if known[i] and name in place]
        rows = [place[names[i]] for i in some]
        error = estimate.value[rows] - [exact[names[i]] for i in some]
        ratios.append(error / plan.std[some])
        kept = estimate.determined[rows] & (estimate.std[rows] > 0)
        own.append(error[kept] / estimate.std[rows][kept])
        print(
            f"| {seed} | {rms(ratios[-1]):.2f} | {rms(own[-1]):.2f} | "
            f"{'; '.join(alarm[:50] for alarm in found.alarms) or 'none'} |",
            flush=True,
        )
    print(f"| pooled | {rms(np.concatenate(ratios)):.2f} | {rms(np.concatenate(own)):.2f} | |")
    by_parameter = np.sqrt(np.mean(np.square(ratios), axis=0))
    worst = np.argsort(by_parameter)[::-1][:8]
    chosen = [name for name, is_known in zip(names, known, strict=True) if is_known]
    folder.cleanup()
    print("\nlargest:", ", ".join(f"{chosen[i]} {by_parameter[i]:.2f}" for i in worst))


def simulated_log(
    truth: sy.RobotModel,
    robot: sy.RobotModel,
    trajectory: JointTrajectory,
    sensors: JointSensorOptions,
    seed: int,
) -> sy.Log:
    simulator = TrackingSimulator(
        truth,
        robot,
        trajectory,
        sensors=sensors,
        capacity=effort_capacity(robot),
        seed=seed,
    )
    instants = [simulator.step() for _ in range(simulator.steps)]
    measured = [robot.joint_names.index(name) for name in robot.measured_joint_names]
    return sy.Log.from_arrays(
        robot,
        time=np.array([each.stamp for each in instants]),
        position=np.array([each.joint_position for each in instants])[:, measured],
        effort=np.array([each.joint_effort for each in instants])[:, measured],
    )


def standing_log(simulator: StandingSimulator) -> sy.Log:
    instants = [simulator.step() for _ in range(simulator.steps)]
    robot = simulator.truth
    order = [simulator.joint_names.index(name) for name in robot.measured_joint_names]
    wrenches = np.array([each.wrenches for each in instants])
    imu = [[*each.imu_angular_velocity, *each.imu_linear_acceleration] for each in instants]
    return sy.Log.from_arrays(
        robot,
        time=np.array([each.stamp for each in instants]),
        position=np.array([each.joint_position for each in instants])[:, order],
        effort=np.array([each.joint_effort for each in instants])[:, order],
        imus={simulator.imu_frame: np.array(imu)},
        wrenches={
            sensor.frame_id: wrenches[:, index]
            for index, sensor in enumerate(simulator.wrench_sensors)
        },
    )


def true_values(truth: sy.RobotModel) -> dict[str, float]:
    parameters = ParameterSet(truth, ("viscous", "coulomb", "armature"))
    return dict(zip(parameters.names, parameters.values.tolist(), strict=True))


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


if __name__ == "__main__":
    main()
