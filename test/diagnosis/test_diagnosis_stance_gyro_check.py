"""Feet that stand tell how the base turns, unless they stand in line."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.diagnosis.stance_gyro_check import base_rate_over_feet
from symbid_ros.model.load import load_model
from symbid_ros.signals.sensor_samples import SensorSamples

FEET = ("foot_0", "foot_1", "foot_2")
LINK = """<link name="{name}"><inertial><mass value="1"/>
<inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>"""
JOINT = """<joint name="{name}" type="prismatic"><parent link="{parent}"/><child link="{child}"/>
<origin xyz="{at}"/><axis xyz="{axis}"/>
<limit lower="-9" upper="9" effort="80" velocity="20"/></joint>"""


@pytest.fixture(scope="module")
def tripod(tmp_path_factory):
    """Three feet that slide anywhere under a base: any turn of it leaves them where they are."""
    parts = [LINK.format(name="base")]
    for index in range(3):
        parent = "base"
        for axis, letter in zip(("1 0 0", "0 1 0", "0 0 1"), "xyz", strict=True):
            child = FEET[index] if letter == "z" else f"slider_{index}_{letter}"
            parts.append(LINK.format(name=child))
            parts.append(
                JOINT.format(
                    name=f"{letter}_{index}", parent=parent, child=child, at="0 0 0", axis=axis
                )
            )
            parent = child
    path = tmp_path_factory.mktemp("tripod") / "tripod.urdf"
    path.write_text(f'<robot name="tripod">{"".join(parts)}</robot>')
    return load_model(path, "floating")


def stood_on(tripod, feet: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return truth, told rate and where it is told, of a base that turns over feet at rest."""
    time = np.linspace(0, 1, 21)
    step = 1e-6
    angles = np.outer(time, [0.5, -0.3, 0.8])
    now, then = (Rotation.from_rotvec(angles + dt * np.array([0.5, -0.3, 0.8])) for dt in (0, step))
    truth = (now.inv() * then).as_rotvec() / step

    def seen(rotation: Rotation, sway: float) -> np.ndarray:
        base = np.outer(np.sin(3 * (time + sway)), [0.1, 0.05, 0.2]) + np.array([0, 0, 1.0])
        return np.hstack([rotation.inv().apply(foot - base) for foot in feet])

    position = seen(now, 0.0)
    velocity = (seen(then, step) - position) / step
    order = [tripod.joint_names.index(f"{axis}_{foot}") for foot in range(3) for axis in "xyz"]
    joints = np.zeros((2, len(time), 9))
    joints[0][:, order], joints[1][:, order] = position, velocity
    readings = SensorSamples(
        stamp=np.round(time * 1e9).astype(np.int64),
        position=joints[0],
        velocity=joints[1],
        acceleration=np.zeros_like(joints[0]),
        effort=np.zeros_like(joints[0]),
        **dict.fromkeys(
            ("angular_velocity", "angular_acceleration", "specific_force"),
            np.zeros((len(time), 0, 3)),
        ),
        wrenches=np.zeros((len(time), 3, 6)),
        imu_frames=(),
        wrench_frames=FEET,
    )
    told, is_told = base_rate_over_feet(tripod, FEET, readings, np.ones((len(time), 3), dtype=bool))
    return truth, told, is_told


def test_a_tripod_tells_how_its_base_turns(tripod) -> None:
    feet = np.array([[0.3, 0, 0], [-0.2, 0.25, 0], [-0.2, -0.25, 0.1]])
    truth, told, is_told = stood_on(tripod, feet)
    assert is_told.all()
    np.testing.assert_allclose(told, truth, atol=1e-4)


@pytest.mark.parametrize("aside", [0.0, 0.02])
def test_three_feet_in_line_do_not(tripod, aside) -> None:
    """Nor do those nearly in line: about that line a foot that gives would turn the base far."""
    feet = np.array([[0.3, 0.3, 0], [0.0, aside, 0], [-0.3, -0.3, 0]])
    _, told, is_told = stood_on(tripod, feet)
    assert not is_told.any()
    assert not told.any()
