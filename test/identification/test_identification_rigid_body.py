"""A body without joints on a force/torque sensor is a robot too."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import symbid_ros as sy

URDF = """<robot name="frame"><link name="body"><inertial><mass value="1.5"/>
<inertia ixx="0.01" iyy="0.01" izz="0.015" ixy="0" ixz="0" iyz="0"/></inertial></link></robot>"""
MASS, CENTRE = 1.7, np.array([0.02, -0.015, 0.01])
CENTRAL = np.diag([0.011, 0.009, 0.017])
RATE = 250.0


@pytest.fixture(scope="module")
def robot(tmp_path_factory):
    path = tmp_path_factory.mktemp("body") / "body.urdf"
    path.write_text(URDF)
    return sy.load_model(path)


def shaken(robot, seed: int) -> sy.Log:
    """Return 15 s in which somebody shakes the body by a sensor at its origin (Newton, Euler)."""
    rng = np.random.default_rng(seed)
    time = np.arange(0.0, 15.0, 1 / RATE)
    phase = 2 * np.pi * rng.uniform(0.2, 1.2, 6)
    waves = np.sin(np.outer(time, phase) + rng.uniform(0, 6, 6))
    turned = Rotation.from_rotvec(0.8 * waves[:, :3])
    axes = turned.as_matrix()
    # ω× = Rᵀ dR/dt
    spin = np.swapaxes(axes, 1, 2) @ np.gradient(axes, 1 / RATE, axis=0, edge_order=2)
    omega = np.stack([spin[:, 2, 1], spin[:, 0, 2], spin[:, 1, 0]], axis=1)
    alpha = np.gradient(omega, 1 / RATE, axis=0, edge_order=2)
    acceleration = -0.05 * phase[3:] ** 2 * waves[:, 3:] + [0.0, 0.0, 9.81]
    specific = turned.inv().apply(acceleration)

    def about_origin(rate):
        inertia = CENTRAL + MASS * (CENTRE @ CENTRE * np.eye(3) - np.outer(CENTRE, CENTRE))
        return rate @ inertia

    force = MASS * (specific + np.cross(alpha, CENTRE) + np.cross(omega, np.cross(omega, CENTRE)))
    moment = (
        about_origin(alpha)
        + np.cross(omega, about_origin(omega))
        + MASS * np.cross(CENTRE, specific)
    )

    def noisy(values, deviation):
        return values + deviation * rng.standard_normal(values.shape)

    nothing = np.zeros((len(time), 0))
    return sy.Log.from_arrays(
        robot,
        time=time,
        position=nothing,
        effort=nothing,
        imus={"body": np.hstack([noisy(omega, 2e-3), noisy(specific, 0.02)])},
        wrenches={"body": np.hstack([noisy(force, 0.05), noisy(moment, 2e-3)])},
    )


def test_a_body_without_joints_is_identified(robot) -> None:
    result = sy.identify(robot, shaken(robot, 1))
    assert result.alarms == ()
    truth = {"m": MASS, **{f"mc_{axis}": MASS * c for axis, c in zip("xyz", CENTRE, strict=True)}}
    for name, value in truth.items():
        found = result.parameters[f"body/{name}"]
        assert abs(found.value - value) < 4 * found.std
        assert found.is_determined
    assert sy.validate(result, shaken(robot, 2)).verdict.startswith("use it")


def test_a_centre_of_mass_beside_the_axis_of_the_file_is_no_gain(robot) -> None:
    """The file's zero says that the body is symmetrical, not that nothing is mounted on it."""
    diagnosis = sy.diagnose(robot, shaken(robot, 1))
    assert [one.message for one in diagnosis.findings] == []
