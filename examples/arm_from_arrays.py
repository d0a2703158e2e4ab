"""Identify an arm from arrays, and check the result on another motion.

    python examples/arm_from_arrays.py

The arrays come from any logger. Here the arm's own regressor makes them, with true masses that the
model file does not know.
"""

import tempfile
from pathlib import Path

import numpy as np

import symbid_ros as sy

ARM = """<robot name="arm">
  <link name="base"><inertial><mass value="4"/><origin xyz="0 0 0.05"/>
    <inertia ixx="0.02" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="upper"><inertial><mass value="3"/><origin xyz="0 0.02 0.2"/>
    <inertia ixx="0.04" iyy="0.04" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fore"><inertial><mass value="1.5"/><origin xyz="0 0 0.15"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
    <origin xyz="0 0 0.1"/><axis xyz="1 0 0"/>
    <limit lower="-3" upper="3" effort="80" velocity="5"/></joint>
  <joint name="elbow" type="revolute"><parent link="upper"/><child link="fore"/>
    <origin xyz="0 0 0.4"/><axis xyz="0 1 0"/>
    <limit lower="-3" upper="3" effort="40" velocity="5"/></joint>
</robot>
"""


def record(robot: sy.RobotModel, parameters: np.ndarray, seed: int) -> sy.Log:
    """Return 20 s of a motion of two joints, with noise in the efforts."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 20.0, 0.004)
    rate = 2 * np.pi * rng.uniform(0.2, 0.8, (3, 2))
    phase = time[:, None, None] * rate + rng.uniform(0, 6, (3, 2))
    position = np.sin(phase).mean(axis=1)
    velocity = (rate * np.cos(phase)).mean(axis=1)
    acceleration = (-(rate**2) * np.sin(phase)).mean(axis=1)
    effort = sy.regressor(robot, position, velocity, acceleration) @ parameters
    effort += rng.normal(0.0, 0.05, effort.shape)
    return sy.Log.from_arrays(robot, time=time, position=position, effort=effort)


def main() -> None:
    """Identify the arm and print the result."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "arm.urdf"
        file.write_text(ARM)
        robot = sy.load_model(file, "fixed")
        truth = robot.inertial_parameters * 1.2  # the real arm is heavier than its file says
        result = sy.identify(robot, record(robot, truth, seed=1))
        print(result)
        prediction = result.predict(record(robot, truth, seed=2))
        for joint, error in prediction.rmse.items():
            print(f"{joint}: torque error on another motion {error:.3f} Nm")


if __name__ == "__main__":
    main()
