"""Geared wrists and fingers whose rotors weigh more than the links that they move."""

import numpy as np
import pytest

import symbid_ros as sy

URDF = """<robot name="finger"><link name="world"/>
<link name="near"><inertial><mass value="0.3"/><origin xyz="0 0.01 0.06"/>
<inertia ixx="4e-4" iyy="4e-4" izz="1e-4" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="tip"><inertial><mass value="0.02"/><origin xyz="0 0 0.01"/>
<inertia ixx="1e-6" iyy="1e-6" izz="1e-6" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="base" type="revolute"><parent link="world"/><child link="near"/>
<axis xyz="1 0 0"/><limit lower="-2" upper="2" effort="2" velocity="6"/></joint>
<joint name="end" type="revolute"><parent link="near"/><child link="tip"/>
<origin xyz="0 0 0.12"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="1" velocity="6"/></joint></robot>"""
ROTOR = np.array([2e-3, 3e-3])  # kg m², reflected to the joints
FRICTION = np.array([0.01, 0.008])


NOISE = 0.01  # Nm


@pytest.mark.parametrize("seed", [1, 2])
def test_the_rotor_of_a_light_link_is_found(tmp_path, seed) -> None:
    """Its inertia is a thousand times that of the link, and explains half of the effort."""
    path = tmp_path / "finger.urdf"
    path.write_text(URDF)
    robot = sy.load_model(path)
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 20.0, 1 / 333)
    phase = 2 * np.pi * rng.uniform(0.3, 1.2, (4, 2))
    angle = time[:, None, None] * phase + rng.uniform(0, 6, (4, 2))
    position = 0.25 * np.sin(angle).sum(axis=1)
    velocity = 0.25 * (phase * np.cos(angle)).sum(axis=1)
    acceleration = -0.25 * (phase**2 * np.sin(angle)).sum(axis=1)
    truth = 1.15 * robot.inertial_parameters
    effort = sy.regressor(robot, position, velocity, acceleration) @ truth
    effort += ROTOR * acceleration + FRICTION * (np.tanh(velocity / 0.004) + 0.3 * velocity)
    effort += NOISE * rng.standard_normal(effort.shape)
    position += 2e-5 * rng.standard_normal(position.shape)
    result = sy.identify(
        robot, sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
    )
    found = result.parameters["end/armature"]
    assert result.alarms == ()
    assert abs(found.value - ROTOR[1]) < 3 * found.std
