"""The doctor distinguishes a body that the model lacks from wrong factors of efforts."""

from dataclasses import replace

import numpy as np
import pytest
from drive_logs import arm, drives, light_wrist, log_of

from symbid_ros.diagnosis.findings import Kind
from symbid_ros.identification.api import diagnose
from symbid_ros.model.inertia import phi_from_com

FRICTION = {"viscous": 0.02, "coulomb": 0.05}
TOOL = 2.0


@pytest.mark.parametrize("seed", [3, 4])
def test_a_missing_tool_is_no_factor_of_the_wrists_efforts(seed):
    robot, model = light_wrist(seed)
    phi = robot.phi.copy()
    phi[-1] += phi_from_com(TOOL, np.array([0.1, 0.0, 0.0]), np.zeros((3, 3)))
    found = diagnose(model, log_of(robot, drives(robot.with_phi(phi), **FRICTION)))
    (finding,) = found.findings
    assert finding.kind is Kind.MISSING_BODY
    assert "at link_5 that the model lacks" in finding.message
    assert finding.figures["mass_kg"] == pytest.approx(TOOL, rel=0.25)


def test_a_light_tool_explains_the_wrists_efforts_as_well_as_a_factor():
    """Factors of all efforts leave as little, so that the finding names both."""
    robot, model = light_wrist(4)
    phi = robot.phi.copy()
    phi[-1] += phi_from_com(0.2, np.array([0.1, 0.0, 0.0]), np.zeros((3, 3)))
    found = diagnose(model, log_of(robot, drives(robot.with_phi(phi), **FRICTION)))
    (finding,) = found.findings
    assert finding.kind is Kind.TORQUE_GAIN
    assert "a body of about 0.22 kg at link_5" in finding.message
    assert finding.figures["or_body_kg"] == pytest.approx(0.22, abs=0.005)


@pytest.mark.parametrize("seed", [0, 2])
@pytest.mark.parametrize("factor", [0.4, 2.5])
def test_a_wrong_factor_is_no_body(seed, factor):
    robot = arm(seed=seed, links=6)
    robot = replace(robot, joints=tuple(replace(one, effort=np.inf) for one in robot.joints))
    gain = np.array([1.0, 1.0, 1.0, 1.0, 1 / factor])
    found = diagnose(robot, log_of(robot, drives(robot, viscous=0.4, coulomb=0.8), gain=gain))
    assert Kind.MISSING_BODY not in {one.kind for one in found.findings}
    reads = [one.figures.get("joint_4/reads") for one in found.findings]
    assert any(one == pytest.approx(factor, rel=0.05) for one in reads), found.findings
    assert not any("a body of about" in one.message for one in found.findings)
