"""Use the regressor alone, for an estimator of your own: here plain least squares.

python examples/regressor_alone.py my_robot.urdf
"""

import sys

import numpy as np

import symbid_ros as sy


def main(model: str) -> None:
    """Recover the identifiable parameters of a robot with a fixed base from perfect torques."""
    robot = sy.load_model(model, "fixed")
    rng = np.random.default_rng(0)
    position, velocity, acceleration = rng.normal(size=(3, 500, len(robot.joints)))

    K = sy.regressor(robot, position, velocity, acceleration)  # (N, n, p)
    torque = K @ robot.inertial_parameters

    A, b = K.reshape(-1, K.shape[2]), torque.ravel()
    found, _, rank, _ = np.linalg.lstsq(A, b, rcond=None)
    print(f"{rank} of {K.shape[2]} parameter combinations are identifiable")
    print(f"largest torque error {np.abs(A @ found - b).max():.1e} Nm")


if __name__ == "__main__":
    main(*sys.argv[1:])
