"""Which identified models a controller may use."""

from dataclasses import replace

import numpy as np
import pytest
from random_robots import random_robot

from symbid_ros.errors import DataError, OptionError
from symbid_ros.estimation.model_gate import CandidateModel, ModelGate

LIMITS = np.array([100.0, 40.0])
NONE = np.zeros(2)


@pytest.fixture
def candidate() -> CandidateModel:
    robot = random_robot(3, links=4)
    return CandidateModel(robot.link_names, robot.phi, 0.1 * np.ones_like(robot.phi))


def refusal(gate, candidate, change=NONE):
    return gate.refusal(candidate, np.asarray(change, dtype=float), LIMITS)


def test_a_possible_model_is_accepted_and_then_only_better_ones_are_news(candidate):
    gate = ModelGate()
    assert gate.is_news(candidate)
    assert refusal(gate, candidate) == ""
    for share, is_news in ((1.0, False), (0.9, False), (0.7, True)):
        better = replace(candidate, std=share * candidate.std)
        assert gate.is_news(better) == is_news
    # Better known masses do not outweigh first moments that are known worse.
    std = candidate.std.copy()
    std[:, 0] *= 0.5
    assert gate.is_news(replace(candidate, std=std))
    std[:, 1:4] *= 1.1
    assert not gate.is_news(replace(candidate, std=std))


def test_the_whole_robot_counts_where_its_deviations_are_known(candidate):
    """Masses that are not told apart are uncertain, their sum is not."""
    gate, mass = ModelGate(), candidate.phi[:, 0].sum()
    known = replace(candidate, mass_std=0.05 * mass, com_std=0.02)
    assert refusal(gate, known) == ""
    assert not gate.is_news(replace(known, std=0.1 * known.std))
    assert gate.is_news(replace(known, std=2.0 * known.std, com_std=0.015))
    assert not gate.is_news(replace(known, mass_std=0.06 * mass, com_std=0.015))
    # More certainty than a controller notices does not make a model worth taking over.
    assert refusal(gate, replace(known, mass_std=9e-4 * mass, com_std=1.1e-3)) == ""
    assert not gate.is_news(replace(known, mass_std=1e-5 * mass, com_std=1e-6))


def test_the_number_of_models_of_an_unchanged_robot_is_limited(candidate):
    """Deviations shrink with the root of time; models follow each other ever more seldom."""
    gate, accepted = ModelGate(), []
    for second in range(1, 601):
        newer = replace(candidate, std=candidate.std / np.sqrt(second))
        if gate.is_news(newer) and not refusal(gate, newer):
            accepted.append(second)
    ratios = np.array(accepted[1:]) / accepted[:-1]
    assert ratios.min() > 1.5
    assert len(accepted) < 16


def test_after_a_change_the_next_model_is_news_although_less_is_known(candidate):
    gate = ModelGate()
    refusal(gate, candidate)
    worse = replace(candidate, std=2 * candidate.std)
    # An alarm about the estimate says nothing about the model in use.
    alarmed = replace(worse, alarms=("residuals are not white noise",))
    assert not gate.is_news(alarmed)
    assert refusal(gate, alarmed) == "alarm: residuals are not white noise"
    assert not gate.is_news(worse)
    changed = replace(worse, change="link_2 has changed")
    assert gate.is_news(changed)
    assert refusal(gate, changed) == "alarm: link_2 has changed"
    assert gate.is_news(worse)
    assert refusal(gate, worse) == ""
    assert not gate.is_news(worse)


def test_impossible_and_incomplete_models_are_refused(candidate):
    phi = candidate.phi.copy()
    phi[2, 4] = -1.0
    impossible = replace(candidate, phi=phi)
    assert refusal(ModelGate(), impossible) == f"physically impossible: {candidate.links[2]}"
    unknown = replace(candidate, std=np.full_like(candidate.std, np.nan))
    gate = ModelGate()
    assert gate.is_news(unknown)
    assert refusal(gate, unknown) == "parameters or standard deviations are missing"
    assert gate.is_news(candidate)


@pytest.mark.parametrize("change", [(0.0, 10.1), (0.0, -10.1), (26.0, 0.0), (np.nan, 0.0)])
def test_torques_must_not_jump(candidate, change):
    gate = ModelGate(0.25)
    worst = 1 if np.isnan(change[0]) else int(np.argmax(np.abs(change) / LIMITS)) + 1
    assert refusal(gate, candidate, change).startswith(f"drive {worst} would change by")
    # What was refused is not the last model.
    assert gate.is_news(candidate)
    assert refusal(gate, candidate, 0.9 * np.array([25.0, -10.0])) == ""


def test_a_drive_without_torque_may_not_change(candidate):
    limits = np.array([100.0, 0.0])
    assert ModelGate().refusal(candidate, np.array([1.0, 0.0]), limits) == ""
    refused = ModelGate().refusal(candidate, np.array([1.0, 1e-3]), limits)
    assert refused.startswith("drive 2 would change by")


def test_each_drive_has_a_limit(candidate):
    with pytest.raises(DataError, match=r"torque_change has shape \(5,\) and torque_limit \(6,\)"):
        ModelGate().refusal(candidate, np.zeros(5), np.full(6, 100.0))
    assert ModelGate().refusal(candidate, [0.0, 1.0], [100.0, 100.0]) == ""
    assert ModelGate().refusal(candidate, [], []) == ""


@pytest.mark.parametrize("share", [0.0, -1.0, np.nan, "x"])
def test_a_limit_without_meaning_raises_an_error(share):
    with pytest.raises(OptionError, match="largest_change"):
        ModelGate(share)


def test_arrays_of_another_shape_raise_an_error(candidate):
    with pytest.raises(DataError, match=r"std has shape \(4, 9\), expected \(4, 10\)"):
        replace(candidate, std=candidate.std[:, :9])
