"""How far a standing controller moves while models are accepted, refused and withdrawn."""

import itertools
from dataclasses import replace

import numpy as np
import pytest

from symbid_ros.estimation.model_gate import CandidateModel
from symbid_ros.learning.model_update import ModelUpdate
from symbid_ros.model.load import load_model
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.reach import safe_reach
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.standing_controller import StandingController


class Robot:
    """A standing controller, whose time goes on when asked."""

    def __init__(self) -> None:
        self.controller = StandingController(is_cautious=True)
        self.update = ModelUpdate(self.controller)
        self._instants = iter(Simulator(SimulateOptions()))
        self.go_on(20)

    def go_on(self, steps: int) -> None:
        for instant in itertools.islice(self._instants, steps):
            self.controller.torques(instant)

    def kind(self, candidate: CandidateModel) -> str:
        decision = self.update.judge(candidate, "model")
        return "" if decision is None else decision.kind


@pytest.fixture(scope="module")
def known() -> CandidateModel:
    model = load_model(config_file("symbitron.xml"))
    std = 0.01 * np.ones_like(model.phi)
    return CandidateModel(model.link_names, model.phi, std, mass_std=0.1, com_std=0.015)


def test_only_a_change_of_the_robot_makes_moves_smaller(known) -> None:
    robot = Robot()
    wide = safe_reach(0.1 / known.phi[:, 0].sum(), 0.015, robot.controller.size)
    assert robot.kind(known) == "accepted"
    assert robot.controller.wanted_reach == wide > robot.controller.least_reach
    robot.go_on(1100)
    better = replace(known, com_std=0.005)
    assert robot.kind(replace(better, alarms=("too much noise",))) == "refused"
    assert robot.controller.wanted_reach == wide
    assert robot.kind(replace(better, change="L_thigh has changed")) == "refused"
    assert robot.controller.wanted_reach == robot.controller.least_reach
    # Less is known of the changed robot than of the one before.
    assert robot.kind(replace(known, com_std=0.016)) == "accepted"
    assert robot.controller.least_reach < robot.controller.wanted_reach < wide


def test_after_a_withdrawn_model_the_next_one_need_not_be_better(known) -> None:
    robot = Robot()
    assert robot.kind(known) == "accepted"
    assert robot.kind(replace(known, alarms=("too much noise",))) == "withdrawn"
    assert robot.update.used == ""
    robot.go_on(1100)
    assert robot.kind(known) == "accepted"
