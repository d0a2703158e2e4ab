"""Motion of a robot that stands: its base moves, its feet stay, and its legs follow."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray, IntArray
from symbid_ros.dynamics.kinematics import link_poses
from symbid_ros.dynamics.regressor import com_position
from symbid_ros.dynamics.samples import Samples
from symbid_ros.dynamics.stance import COORDINATES, Stance
from symbid_ros.dynamics.stance_forces import contact_shares, smallest_forces
from symbid_ros.excitation.limits import JointLimits
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.rotation import quaternion_from_rotation
from symbid_ros.model.tree import RobotModel
from symbid_ros.simulation.joint_trajectory import (
    BASE_POSE,
    CENTRE_OF_MASS,
    EFFORT,
    POSITION,
)

STEP = 1e-5  # m or rad, of differences of postures


@dataclass(frozen=True)
class StandingMotion:
    """Shift and turn of the base of a standing robot, and the limits of its joints and contacts.

    Attributes
    ----------
    stance : Stance
    limits : JointLimits
        Of all joints of the legs, as far as they may be used.
    indices : tuple of int
        Joints of the legs that have a drive.
    driven : (J,) bool
        Which joints have a drive.
    friction : float
        Friction coefficient that the ground's forces may use.
    margin : float
        Distance of the centres of pressure from the edges of the soles, m.
    """

    stance: Stance
    limits: JointLimits
    indices: tuple[int, ...]
    driven: BoolArray
    friction: float
    margin: float

    @property
    def model(self) -> RobotModel:
        """The robot, without unmeasured contacts."""
        return self.stance.model

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the driven joints of the legs."""
        return tuple(self.model.joint_names[index] for index in self.indices)

    @property
    def coordinates(self) -> tuple[str, ...]:
        """Names of the base's coordinates."""
        return COORDINATES

    @property
    def rest(self) -> FloatArray:
        """(6,) coordinates of the robot at rest."""
        return np.zeros(len(COORDINATES))

    @property
    def _legs(self) -> IntArray:
        return self.stance.leg_joints

    def other_columns(self, motion: FloatArray) -> tuple[list[str], FloatArray]:
        """Return what else describes the motion (3, N, 6): names of columns, and values (N, c).

        These are joints without a drive, the base's pose and the centre of mass in the world.
        """
        samples, poses = self.stance.samples(motion)
        others = [index for index in self._legs.tolist() if not self.driven[index]]
        names = [f"{self.model.joint_names[index]}/{POSITION}" for index in others]
        names += [f"{self.model.joint_names[index]}/{EFFORT}" for index in others]
        links = ParameterSet(self.model)
        com = com_position(links, links.values, link_poses(self.model, poses.position))
        in_world = poses.base_position + np.einsum("nij,nj->ni", poses.base_rotation, com)
        quaternion = [quaternion_from_rotation(rotation) for rotation in poses.base_rotation]
        at = samples.position[:, others]
        columns = [at, np.zeros_like(at), poses.base_position, np.array(quaternion), in_world]
        return [*names, *BASE_POSE, *CENTRE_OF_MASS], np.hstack(columns)

    def samples(self, motion: FloatArray) -> Samples:
        """Return the robot's motion for coordinates, rates and accelerations (3, N, 6)."""
        return self.stance.samples(motion)[0]

    def limited(self, motion: FloatArray) -> tuple[Samples, Callable[[FloatArray], FloatArray]]:
        """Return the motion, and the shares of limits (N, k) as a function of forces (N, n)."""
        samples, poses = self.stance.samples(motion)
        limits, legs = self.limits, self._legs
        of_joints = [
            (samples.position[:, legs] - limits.centre) / limits.half_width,
            samples.velocity[:, legs] / limits.speed,
            samples.acceleration[:, legs] / limits.acceleration,
        ]

        def shares(force: FloatArray) -> FloatArray:
            found = smallest_forces(self.stance, poses, force, self.driven)
            contacts = contact_shares(self.stance, poses, found, self.friction, self.margin)
            return np.hstack(
                [*of_joints, found.torque[:, legs] / limits.effort, *contacts.values()]
            )

        return samples, shares

    def share_names(self, count: int) -> list[str]:
        """Return the names of the ``count`` shares of `limited`."""
        legs = [self.model.joint_names[index] for index in self._legs.tolist()]
        kinds = ("position", "speed", "acceleration", "effort")
        of_joints = [f"the {kind} of {name}" for kind in kinds for name in legs]
        return [*of_joints, *["a contact or a leg's stretch"] * (count - len(of_joints))]

    def contact_shares(self, motion: FloatArray, force: FloatArray) -> dict[str, FloatArray]:
        """Return the shares of the contacts' limits by name, for forces (N, n)."""
        poses = self.stance.samples(motion)[1]
        found = smallest_forces(self.stance, poses, force, self.driven)
        return contact_shares(self.stance, poses, found, self.friction, self.margin)

    def torques(self, motion: FloatArray, force: FloatArray) -> FloatArray:
        """Return the efforts (N, D) of the driven joints for generalised forces (N, n)."""
        poses = self.stance.samples(motion)[1]
        found = smallest_forces(self.stance, poses, force, self.driven)
        return np.asarray(found.torque[:, list(self.indices)])

    def slopes(self, motion: FloatArray) -> FloatArray:
        """Return the derivatives (N, J, 6) of all joints' positions by the coordinates."""
        found = []
        for place in range(len(COORDINATES)):
            ahead, behind = motion[0].copy(), motion[0].copy()
            ahead[:, place] += STEP
            behind[:, place] -= STEP
            change = self.stance.poses(ahead).position - self.stance.poses(behind).position
            found.append(change / (2 * STEP))
        return np.stack(found, axis=2)
