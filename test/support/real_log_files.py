"""Tiny synthetic files in the formats of the public logs that bench/real_data.py reads."""

from pathlib import Path

import numpy as np
import pinocchio

VISCOUS, COULOMB, OFFSET = 2.0, 3.0, 0.5


def arm(joints: list[str], rng: np.random.Generator, hand: str = "") -> str:
    """Return the URDF of a serial arm; a hand is fastened by a fixed joint of that name."""
    parts = ['<link name="base"/>']
    parent = "base"
    for index, name in enumerate(joints):
        parts += [
            f'<link name="link_{index}">{inertial(rng)}</link>',
            f'<joint name="{name}" type="revolute"><parent link="{parent}"/>'
            f'<child link="link_{index}"/><origin xyz="{words(rng.normal(size=3) * 0.2)}" '
            f'rpy="{words(rng.normal(size=3))}"/><axis xyz="0 0 1"/>'
            '<limit lower="-9" upper="9" effort="100" velocity="9"/></joint>',
        ]
        parent = f"link_{index}"
    if hand:
        parts += [
            f'<link name="finger">{inertial(rng)}</link><link name="hand">{inertial(rng)}</link>',
            '<joint name="slide" type="prismatic"><parent link="hand"/><child link="finger"/>'
            '<axis xyz="0 1 0"/><limit lower="0" upper=".04" effort="9" velocity="1"/></joint>',
            f'<joint name="{hand}" type="fixed"><parent link="{parent}"/><child link="hand"/>'
            "</joint>",
        ]
    return f'<robot name="arm">{"".join(parts)}</robot>'


def inertial(rng: np.random.Generator) -> str:
    mass = rng.uniform(1, 3)
    return (
        f'<inertial><mass value="{mass}"/><origin xyz="{words(rng.normal(size=3) * 0.1)}"/>'
        f'<inertia ixx="{0.02 * mass}" iyy="{0.03 * mass}" izz="{0.02 * mass}" ixy="0" ixz="0" '
        'iyz="0"/></inertial>'
    )


def words(values: np.ndarray) -> str:
    return " ".join(f"{value:.6f}" for value in values)


def motion(time: np.ndarray, joints: int) -> np.ndarray:
    """Return angles (N, J) whose frequencies have no common multiple."""
    phase = np.arange(joints)
    slow = 0.31 + 0.07 * phase
    return 0.8 * np.sin(2 * np.pi * slow * time[:, None] + phase) + 0.3 * np.sin(
        2 * np.pi * 1.7 * slow * time[:, None] + 2 * phase
    )


def torque(urdf: str, time: np.ndarray, position: np.ndarray) -> np.ndarray:
    """Return Pinocchio's inverse dynamics and friction along a motion."""
    model = pinocchio.buildModelFromXML(urdf)
    data = model.createData()
    velocity = np.gradient(position, time, axis=0)
    acceleration = np.gradient(velocity, time, axis=0)
    inertial = [
        pinocchio.rnea(model, data, *each)
        for each in zip(position, velocity, acceleration, strict=True)
    ]
    return np.array(inertial) + VISCOUS * velocity + COULOMB * np.sign(velocity) + OFFSET


def write_table(path: Path, header: str, values: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savetxt(path, values, delimiter=",", header=header, comments="")
