"""Standing robots: feet that stay where they are, and the postures that the base's moves leave.

The base of a standing robot moves by six coordinates, a shift and a turn. The joints of the legs
follow, because the feet stay in place: a closed kinematic chain.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from scipy.spatial.transform import Rotation

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import LinkPoses, link_poses, skew
from symbid_ros.dynamics.samples import Samples
from symbid_ros.model.tree import RobotModel

COORDINATES = ("base/x", "base/y", "base/z", "base/turn_x", "base/turn_y", "base/turn_z")
# Gauss-Newton steps from the stance. Point feet on legs of three joints reach their goals exactly;
# other legs follow the base as far as they can. A fixed number keeps the posture a smooth function
# of the coordinates, so that its differences are velocities and accelerations.
ITERATIONS, APPROACH = 8, 4
# Weight of the base's coordinates relative to the feet's places. Legs with few joints cannot follow
# each move of the base; the feet then stay, and the base gives way.
BASE_WEIGHT = 3e-3
POSTURE_WEIGHT = 1e-5  # of joints that are left free by feet and base
TIME_STEP = 5e-3  # s, of differences in time
UPWARD = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class Foot:
    """A frame on which a robot stands.

    Attributes
    ----------
    frame : str
        The z axis of a sole points up.
    sole : (4,) float64
        Smallest x, largest x, smallest y and largest y of the sole in the frame's axes, m; zeros
        for a foot that touches the ground in a point.
    radius : float
        Of a ball about the frame's origin that rolls on the ground, m; zero for a sole, and for a
        foot that touches the ground at the frame's origin.
    """

    frame: str
    sole: FloatArray
    radius: float = 0.0

    @property
    def is_point(self) -> bool:
        """Whether the foot transmits forces alone."""
        return not np.any(self.sole)

    @property
    def middle(self) -> FloatArray:
        """(3,) middle of the sole in the frame's axes, m."""
        return np.array([self.sole[:2].sum(), self.sole[2:].sum(), 0.0]) / 2

    @property
    def half_size(self) -> FloatArray:
        """(2,) half length and half width of the sole, m."""
        return np.array([self.sole[1] - self.sole[0], self.sole[3] - self.sole[2]]) / 2


@dataclass(frozen=True)
class StandingPoses:
    """Poses of a standing robot at N instants.

    Attributes
    ----------
    base_position : (N, 3) float64
        In the world, m.
    base_rotation : (N, 3, 3) float64
        From base axes to world axes.
    position : (N, J) float64
        Joints, rad or m.
    slip : (N,) float64
        Largest distance by which the foot's frame, or a corner of its sole, misses its place, m.
        The frame of a ball is at its place if the ball has rolled there from the stance.
    manipulability : (N, F) float64
        Volume of the foot's motions by unit rates of its leg's joints, over that in the stance
        (Yoshikawa 1985); 0 where a leg is stretched.
    """

    base_position: FloatArray
    base_rotation: FloatArray
    position: FloatArray
    slip: FloatArray
    manipulability: FloatArray


@dataclass(frozen=True)
class Stance:
    """A posture in which a robot stands, and the moves of its base from there.

    Attributes
    ----------
    model : RobotModel
        With a floating base.
    feet : tuple of Foot
        The F feet, all of which touch the ground at height 0.
    position : (J,) float64
        Joints, rad or m.
    base_position : (3,) float64
        m.
    base_rotation : (3, 3) float64
        From base axes to world axes.
    """

    model: RobotModel
    feet: tuple[Foot, ...]
    position: FloatArray
    base_position: FloatArray
    base_rotation: FloatArray

    @property
    def frames(self) -> tuple[str, ...]:
        """Names of the feet's frames."""
        return tuple(foot.frame for foot in self.feet)

    @cached_property
    def leg_joints(self) -> IntArray:
        """Joints between base and feet that move by themselves."""
        links = [self.model.frame(name).link for name in self.frames]
        carries = np.any(self.model.ancestors[:, links], axis=1)
        followers = np.isin(np.arange(len(carries)), list(self.model.followers))
        return np.flatnonzero(carries & ~followers)

    @cached_property
    def places(self) -> tuple[FloatArray, FloatArray]:
        """Positions (F, 3) and rotations (F, 3, 3) of the feet in the world, in the stance.

        The nominal posture may miss the ground slightly; these are level.
        """
        one = self.base_position[None], self.base_rotation[None], self.position[None]
        position, rotation = (each[0] for each in self.feet_poses(*one))
        position[:, 2] = [foot.radius for foot in self.feet]
        for index, foot in enumerate(self.feet):
            if not foot.is_point:
                heading = np.arctan2(rotation[index, 1, 0], rotation[index, 0, 0])
                rotation[index] = Rotation.from_euler("z", heading).as_matrix()
        return position, rotation

    def feet_poses(
        self,
        base_position: FloatArray,
        base_rotation: FloatArray,
        position: FloatArray,
        poses: LinkPoses | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Return positions (N, F, 3) and rotations (N, F, 3, 3) of the feet in the world."""
        poses = poses or link_poses(self.model, position)
        frames = [self.model.frame(name) for name in self.frames]
        links = [frame.link for frame in frames]
        turn = base_rotation[:, None] @ poses.rotation[:, links]
        offset = np.array([frame.translation for frame in frames])
        at_base = poses.position[:, links] + np.einsum(
            "nfij,fj->nfi", poses.rotation[:, links], offset
        )
        place = base_position[:, None] + np.einsum("nij,nfj->nfi", base_rotation, at_base)
        return place, turn @ np.array([frame.rotation for frame in frames])

    def poses(self, coordinates: FloatArray) -> StandingPoses:
        """Return the poses for coordinates (N, 6).

        They are the shift of the base in world axes, in units of its height in the stance, and its
        turn from the stance, a rotation vector in base axes, rad.
        """
        count, legs = len(coordinates), self.leg_joints
        place = np.tile(self.base_position, (count, 1))
        rotation = np.tile(self.base_rotation, (count, 1, 1))
        position = np.tile(self.position, (count, 1))
        unknowns = 6 + len(legs)
        base_rows = np.zeros((count, 6, unknowns))
        base_rows[:, :, :6] = BASE_WEIGHT * np.eye(6)
        for number in range(ITERATIONS):
            # The goal departs from the stance in steps, so that no knee bends backwards.
            share = min(1.0, (number + 1) / APPROACH)
            goal = self.base_position + share * self.base_position[2] * coordinates[:, :3]
            goal_rotation = self.base_rotation @ _rotations(share * coordinates[:, 3:])
            rows, miss = self._feet_rows(place, rotation, position)
            to_base = rotation.transpose(0, 2, 1)
            turn = _small_turn(to_base @ goal_rotation)
            shift = np.einsum("nij,nj->ni", to_base, goal - place)
            A = np.concatenate([rows, base_rows], axis=1)
            b = np.concatenate([miss, BASE_WEIGHT * np.hstack([turn, shift])], axis=1)
            normal = A.transpose(0, 2, 1) @ A
            normal[:, range(6, unknowns), range(6, unknowns)] += POSTURE_WEIGHT**2
            step = np.linalg.solve(normal, A.transpose(0, 2, 1) @ b[..., None])[..., 0]
            place = place + np.einsum("nij,nj->ni", rotation, step[:, 3:6])
            rotation = rotation @ _rotations(step[:, :3])
            position[:, legs] += step[:, 6:]
            position = self.model.apply_mimics(position)
        rows, miss = self._feet_rows(place, rotation, position)
        slip = np.abs(miss).max(axis=1)
        return StandingPoses(place, rotation, position, slip, self._volumes(rows) / self._volume)

    @cached_property
    def _volume(self) -> FloatArray:
        """(F,) volume of each foot's motions in the stance."""
        one = self.base_position[None], self.base_rotation[None], self.position[None]
        return np.asarray(self._volumes(self._feet_rows(*one)[0])[0])

    def _volumes(self, rows: FloatArray) -> FloatArray:
        """Return the volumes (N, F) of the feet's motions from their Jacobian (N, r, 6 + legs)."""
        volumes, first = [], 0
        for foot in self.feet:
            size = 3 if foot.is_point else 6
            own = self.model.ancestors[self.leg_joints, self.model.frame(foot.frame).link]
            J = rows[:, first : first + size, 6:][:, :, own]
            first += size
            if J.shape[2] > J.shape[1]:
                J = J.transpose(0, 2, 1)
            volumes.append(np.sqrt(np.abs(np.linalg.det(J.transpose(0, 2, 1) @ J))))
        return np.stack(volumes, axis=1)

    def _feet_rows(
        self, place: FloatArray, rotation: FloatArray, position: FloatArray
    ) -> tuple[FloatArray, FloatArray]:
        """Return the Jacobian (N, r, 6 + legs) of the feet's places and what they miss (N, r), m.

        Turns of a sole count by the distance of its corners. A ball that turns by a rotation vector
        φ rolls by φ × r e with e upwards. That neglects the order of turns about several axes,
        which moves the ball by r φ² / 2 at most, about a millimetre.
        """
        poses = link_poses(self.model, position)
        here, turned = self.feet_poses(place, rotation, position, poses)
        goal, goal_rotation = self.places
        own = turned.transpose(0, 1, 3, 2)
        radius = np.array([foot.radius for foot in self.feet])[:, None]
        turn = Rotation.from_matrix((turned @ goal_rotation.transpose(0, 2, 1)).reshape(-1, 3, 3))
        rolled = np.cross(turn.as_rotvec().reshape(here.shape), radius * UPWARD)
        away = np.einsum("nfij,nfj->nfi", own, goal + rolled - here)
        jacobian = contact_jacobian(self.model, self.frames, poses)
        columns = np.concatenate([np.arange(6), 6 + self.leg_joints])
        rows, miss = [], []
        for index, foot in enumerate(self.feet):
            part = jacobian[:, 6 * index : 6 * index + 6][:, :, columns]
            if not foot.is_point:
                lever = float(np.linalg.norm(foot.half_size))
                rows.append(lever * part[:, :3])
                miss.append(lever * _small_turn(own[:, index] @ goal_rotation[index]))
            down = -foot.radius * own[:, index, :, 2]
            lever = np.einsum("ikt,tkn->tin", skew(down.T), part[:, :3])
            rows.append(part[:, 3:] - lever)
            miss.append(away[:, index])
        return np.concatenate(rows, axis=1), np.concatenate(miss, axis=1)

    def samples(self, motion: FloatArray) -> tuple[Samples, StandingPoses]:
        """Return the motion of the robot, without wrenches and efforts, and its poses.

        Parameters
        ----------
        motion : (3, N, 6) float64
            Coordinates, their rates and accelerations.
        """
        at, rate, acceleration = motion
        count, h = len(at), TIME_STEP
        bend = h**2 / 2 * acceleration
        found = self.poses(np.concatenate([at - h * rate + bend, at, at + h * rate + bend]))
        before, here, after = (
            replace(found, **{name: values[part] for name, values in vars(found).items()})
            for part in (slice(k * count, (k + 1) * count) for k in range(3))
        )
        own = here.base_rotation.transpose(0, 2, 1)
        # With R(t + h) = R(t) exp(ξ), the rates of ξ at h = 0 are ω and its rate, in base axes.
        ahead, behind = (
            Rotation.from_matrix(own @ each.base_rotation).as_rotvec() for each in (after, before)
        )
        lift = (
            after.base_position - 2 * here.base_position + before.base_position
        ) / h**2 - self.model.gravity
        samples = Samples(
            stamp=np.arange(count, dtype=np.int64),
            position=here.position,
            velocity=(after.position - before.position) / (2 * h),
            acceleration=(after.position - 2 * here.position + before.position) / h**2,
            effort=np.zeros_like(here.position),
            base_angular_velocity=(ahead - behind) / (2 * h),
            base_angular_acceleration=(ahead + behind) / h**2,
            base_specific_force=np.einsum("nij,nj->ni", own, lift),
            wrenches=np.zeros((count, 0, 6)),
            wrench_frames=(),
        )
        return samples, here


def _small_turn(rotation: FloatArray) -> FloatArray:
    """Return the vectors sin(θ) a (N, 3) of rotations (N, 3, 3) by θ about unit axes a."""
    bent = rotation - rotation.transpose(0, 2, 1)
    return np.stack([bent[:, 2, 1], bent[:, 0, 2], bent[:, 1, 0]], axis=1) / 2


def _rotations(vectors: FloatArray) -> FloatArray:
    """Return the rotation matrices (N, 3, 3) of rotation vectors (N, 3), rad."""
    return np.asarray(Rotation.from_rotvec(vectors).as_matrix())
