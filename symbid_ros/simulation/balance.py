"""The robot in balance by an estimate: what errors of the model cost in closed loop."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from symbid_ros.arrays import FloatArray
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.controller import BalanceController, BalanceGains
from symbid_ros.simulation.controller_model import replace_inertias
from symbid_ros.simulation.plant import Plant, RobotFailureError
from symbid_ros.simulation.scenario import SOLES, Scenario, ScenarioRun, require_seed, standing_task

# Periods between two looks at the torques that come from the model alone: each costs a programme.
FEED_FORWARD_EVERY = 10


@dataclass(frozen=True)
class BalanceResult:
    """How well the true robot was balanced by a controller with a model of its own.

    Attributes
    ----------
    com_rmse_mm : float
        Root mean square distance of the true centre of mass from its reference over the whole
        motion, mm; nan if the robot did not last.
    com_bias_mm : tuple of 3 floats
        Mean of true centre of mass minus reference in world axes, mm; nan likewise.
    feed_forward_share : float
        From 0 to 1: one minus what the feedback adds to the torques, relative to them (rms over
        time and drives); nan likewise.
    failed_at : float or None
        When it failed, s after the motion's beginning and negative while it settled; None if it
        lasted.
    failure : str
        What happened then; empty if it lasted.
    duration : float
        Of the whole motion, s, also if it did not last.
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
    """Let the true robot stand and move as in ``smooth``, its controller believing an estimate.

    The true state is fed back, so that the model is all that the controller has wrong. A fall,
    an end stop, a programme without solution and inertias of no use to a controller are outcomes.

    Parameters
    ----------
    inertias : mapping of str to (10,) float64 or None
        By body name, as in `replace_inertias`; None for the truth.
    moves : int
        Number of moves of the centre of mass.
    motion_seed : int
        Decides the moves.
    model_path : Path or None
        MJCF of the true robot; None for config/symbitron.xml.

    Raises
    ------
    SimulationError
        When a body does not exist or has no centre of mass, or moves or seed are out of range.
    """
    require_seed("motion seed", motion_seed)
    plant = Plant(model_path or config_file("symbitron.xml"), SOLES)
    task = standing_task(plant, moves, motion_seed)
    model = plant.model if inertias is None else replace_inertias(plant.model, inertias)
    gains = BalanceGains()
    controller = BalanceController(model, task, SOLES, gains)
    # On its own, lest its programme's last solution be where the other one's next begins.
    feed_forward = BalanceController(model, task, SOLES, gains.feed_forward)
    run = ScenarioRun(plant, Scenario(controller, None, task.duration))
    errors = np.zeros((run.steps, 3))
    torques, from_model = [], []
    duration = run.steps * plant.period
    try:
        for _ in run.settle():
            pass
        for step in range(run.steps):
            truth = run.advance(step)
            errors[step] = plant.com - task.com.at(truth.state.time)[0]
            if step % FEED_FORWARD_EVERY == 0:
                torques.append(truth.effort[plant.driven - 6])
                from_model.append(feed_forward.torques(truth.state))
    except RobotFailureError as breakdown:
        nan = float("nan")
        return BalanceResult(nan, (nan, nan, nan), nan, breakdown.time, breakdown.cause, duration)
    errors_mm = 1e3 * errors
    x, y, z = errors_mm.mean(axis=0).tolist()
    applied = np.array(torques)
    feedback = _rms(applied - np.array(from_model)) / _rms(applied)
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
