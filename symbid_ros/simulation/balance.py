"""Closed-loop evaluation of an estimate: the balance controller uses the estimated inertias."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.controller import BalanceController, BalanceGains
from symbid_ros.simulation.controller_model import replace_inertias
from symbid_ros.simulation.plant import Plant, RobotFailureError
from symbid_ros.simulation.scenario import (
    SOLES,
    Scenario,
    ScenarioRun,
    draw_standing_task,
    require_seed,
)

# Periods between two samples of the torques without feedback: each sample solves one more QP.
FEED_FORWARD_EVERY = 10


@dataclass(frozen=True)
class BalanceResult:
    """How well a controller with an estimated model balanced the true robot.

    Attributes
    ----------
    com_rmse_mm : float
        Root mean square distance of the true centre of mass from its reference over the whole
        motion, mm; NaN if the run failed.
    com_bias_mm : tuple of 3 floats
        Mean of true centre of mass minus reference in world axes, mm; NaN if the run failed.
    feed_forward_share : float
        From 0 to 1: one minus the ratio of feedback torque to total torque (rms over time and
        drives); NaN if the run failed.
    failed_at : float or None
        Time of the failure after the start of the motion, s, negative while the robot settled;
        None if the run did not fail.
    failure : str
        Cause of the failure; empty if the run did not fail.
    duration : float
        Planned duration of the motion, s.
    """

    com_rmse_mm: float
    com_bias_mm: tuple[float, float, float]
    feed_forward_share: float
    failed_at: float | None
    failure: str
    duration: float


def balance(
    inertias: Mapping[str, FloatArray] | None,
    *,
    moves: int,
    motion_seed: int,
    model_path: Path | None = None,
) -> BalanceResult:
    """Simulate the scenario ``smooth`` with a controller that uses estimated inertias.

    The controller receives the true state, so its model is its only error. A fall, an end stop,
    a QP without solution and an indefinite mass matrix are returned as failures.

    Parameters
    ----------
    inertias : mapping of str to (10,) float64 or None
        By body name, as in `replace_inertias`; None for the true inertias.
    moves : int
        Number of moves of the centre of mass.
    motion_seed : int
        Seed of the random moves.
    model_path : Path or None
        MJCF of the true robot; None for config/symbitron.xml.

    Raises
    ------
    SimulationError
        When a body does not exist or has no centre of mass, or moves or seed are out of range.
    """
    require_seed("motion seed", motion_seed)
    plant = Plant(model_path or config_file("symbitron.xml"), SOLES)
    task = draw_standing_task(plant, moves, motion_seed)
    model = plant.model if inertias is None else replace_inertias(plant.model, inertias)
    gains = BalanceGains()
    controller = BalanceController(model, task, SOLES, gains)
    # A separate controller, because each QP starts from its own previous solution.
    feed_forward = BalanceController(model, task, SOLES, gains.feed_forward)
    run = ScenarioRun(plant, Scenario(controller, None, task.duration))
    errors = np.zeros((run.steps, 3))
    torques, model_torques = [], []
    duration = run.steps * plant.period
    try:
        for _ in run.settle():
            pass
        for step in range(run.steps):
            truth = run.advance(step)
            errors[step] = plant.com - task.com.at(truth.state.time)[0]
            if step % FEED_FORWARD_EVERY == 0:
                torques.append(truth.effort[plant.driven - 6])
                model_torques.append(feed_forward.torques(truth.state))
    except RobotFailureError as failure:
        nan = float("nan")
        return BalanceResult(nan, (nan, nan, nan), nan, failure.time, failure.cause, duration)
    errors_mm = 1e3 * errors
    x, y, z = errors_mm.mean(axis=0).tolist()
    applied = np.array(torques)
    feedback = _rms(applied - np.array(model_torques)) / _rms(applied)
    return BalanceResult(
        com_rmse_mm=float(np.sqrt(np.mean(np.sum(errors_mm**2, axis=1)))),
        com_bias_mm=(x, y, z),
        feed_forward_share=max(0.0, 1.0 - feedback),
        failed_at=None,
        failure="",
        duration=duration,
    )


def _rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))
