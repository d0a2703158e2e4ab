"""What resists the joints beside the links' inertia: the contents of config/friction.yaml."""

from dataclasses import dataclass, fields
from pathlib import Path

from symbid_ros.simulation.settings import numbers, read_mapping


@dataclass(frozen=True)
class JointFriction:
    """Friction and reflected inertia of one joint, named as MJCF names them.

    Attributes
    ----------
    damping : float
        Viscous friction, Nm s/rad or N s/m.
    frictionloss : float
        Coulomb friction, Nm or N.
    armature : float
        Inertia that turns with the joint alone, kg m² or kg.
    """

    damping: float
    frictionloss: float
    armature: float


def load_friction(path: Path) -> dict[str, JointFriction]:
    """Read and check a friction file.

    Parameters
    ----------
    path : Path
        YAML mapping of joint names to mappings of every field of `JointFriction` to a number.
        Joints it does not name keep what the robot's file gives them.

    Raises
    ------
    SimulationError
        When the file is missing or not of that form.
    """
    names = [field.name for field in fields(JointFriction)]
    return {
        joint: JointFriction(**numbers(content, names, f"{path}, joint {joint}"))
        for joint, content in read_mapping(path).items()
    }
