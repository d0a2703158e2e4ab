"""Payloads behind wrist sensors, as robot controllers ask for them."""

from dataclasses import replace

import numpy as np
import pytest
from report_pages import content_of_a_log, estimate

from symbid_ros.model.inertia import com_from_phi, phi_from_com
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.wrist_sensors import with_wrist_sensors
from symbid_ros.report.inertia_shapes import com_covariance
from symbid_ros.report.page import render
from symbid_ros.report.payloads import payloads

GRIPPER = """<robot name="gripper"><link name="base"/>
 <joint name="turn" type="continuous"><parent link="base"/><child link="arm"/></joint>
 <link name="arm"><inertial><mass value="3"/>
  <inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <joint name="fix" type="fixed"><parent link="arm"/><child link="hand"/>
  <origin xyz="0.4 0 0" rpy="0 0.7 0"/></joint>
 <link name="hand"><inertial><origin xyz="0 0 0.1"/><mass value="1"/>
  <inertia ixx="1e-3" iyy="1e-3" izz="1e-3" ixy="0" ixz="0" iyz="0"/></inertial></link>
 <joint name="slide" type="prismatic"><parent link="hand"/><child link="finger"/>
  <origin xyz="0 0.02 0.15"/><axis xyz="1 0 0"/>
  <limit lower="0" upper="0.1" effort="9" velocity="9"/></joint>
 <link name="finger"><inertial><mass value="0.25"/>
  <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
PHI = phi_from_com(1.7, np.array([0.03, -0.02, 0.08]), np.diag([0.009, 0.011, 0.006]))


@pytest.fixture(scope="module")
def carrying():
    shown = estimate(("arm", "tool0"), ("joint",))
    value = np.concatenate([shown.value[:10], PHI])
    return replace(shown, value=value, wrist_sensors=("-tool0:tool0",))


def numbers(text):
    return [float(one) for one in text.replace("−", "-").split(" ± ")]


def test_values_and_deviations_are_those_of_the_parameters(carrying):
    rng = np.random.default_rng(0)
    factor = np.zeros((20, 10))
    factor[10:] = 2e-3 * rng.normal(size=(10, 10)) * np.abs(PHI).clip(1e-3)[:, None]
    (found,) = payloads(carrying, factor)
    assert (found.sensor, found.link) == ("tool0", "tool0")
    # Products of inertia that are zero share a power of ten with their deviations.
    rows = {name: numbers(text) for name, text, _ in found.rows if "e" not in text}
    assert rows["mass"] == pytest.approx([1.7, np.linalg.norm(factor[10])], rel=0.05)
    std = 1e3 * np.sqrt(np.diag(com_covariance(PHI, factor[10:] @ factor[10:].T)))
    for axis, expected in zip("xyz", std, strict=True):
        assert rows[f"centre of mass {axis}"][1] == pytest.approx(expected, rel=0.05)
    drawn = PHI + rng.normal(size=(4000, 10)) @ factor[10:].T
    inertia = np.array([com_from_phi(one)[2][1, 1] for one in drawn])
    assert rows["inertia yy"][0] == pytest.approx(0.011, abs=3 * np.std(inertia))
    assert rows["inertia yy"][1] == pytest.approx(np.std(inertia), rel=0.1)


def test_values_stand_alone_without_covariance(carrying):
    (found,) = payloads(carrying, None)
    rows = {name: text for name, text, _ in found.rows}
    assert (rows["mass"], rows["centre of mass y"], rows["inertia zz"]) == (
        "1.70",
        "−20.0",
        "0.00600",
    )


def test_moving_fingers_belong_to_the_payload(tmp_path):
    """A point of 250 g that slides 80 mm along x; a gain of 1 % changes the mass alone."""
    (tmp_path / "gripper.urdf").write_text(GRIPPER)
    model = with_wrist_sensors(load_model(tmp_path / "gripper.urdf", "fixed"), ["hand"])
    parameters = ParameterSet(model)
    posture = np.zeros(len(model.joints))
    posture[model.joint_names.index("slide")] = 0.08
    value = parameters.values
    shown = replace(
        estimate(model.link_names, ("joint",)),
        names=parameters.names,
        value=value,
        wrist_sensors=("hand:hand",),
    )
    (found,) = payloads(shown, 0.01 * value[:, None], parameters, posture)
    assert found.note == "It includes finger at the mean position in the log."
    # Products of inertia that are zero share a power of ten with their deviations.
    rows = {name: numbers(text) for name, text, _ in found.rows if "e" not in text}
    assert rows["mass"] == pytest.approx([1.25, 0.0125], rel=0.05)
    com = [rows[f"centre of mass {axis}"] for axis in "xyz"]
    expected = (0.25 * np.array([80, 20, 150]) + np.array([0, 0, 100])) / 1.25
    np.testing.assert_allclose([one[0] for one in com], expected, rtol=1e-3)
    assert all(one[1] < 1e-3 for one in com if len(one) > 1)
    # Of a point and a ball, about their common centre: reduced mass times squared distances.
    inertia = 1e-3 + 0.2 * (0.08**2 + 0.05**2)
    assert rows["inertia yy"][0] == pytest.approx(inertia, rel=0.01)
    assert len(payloads(shown, None)[0].rows) == len(found.rows)


def test_the_page_has_a_section_of_them(carrying):
    base = content_of_a_log(2)
    page = render(replace(base, payloads=payloads(carrying, None)))
    assert "Beyond tool0" in page
    assert 'href="#payload"' in page
    assert 'href="#payload"' not in render(base)
