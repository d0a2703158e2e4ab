"""Forces of the ground on a standing robot: the smallest that balance a motion, and their limits.

Feet that stand still share the load in many ways. The smallest forces are chosen, in the sense of
least squares. Where they lie inside the friction cones and the soles, they also solve the
quadratic program with these limits.
"""

from dataclasses import dataclass

import numpy as np

from symbid_ros.arrays import BoolArray, FloatArray
from symbid_ros.dynamics.contact import contact_jacobian
from symbid_ros.dynamics.kinematics import link_poses, skew
from symbid_ros.dynamics.stance import UPWARD, Stance, StandingPoses

LEAST_LOAD = 0.2  # of an equal share of the weight, that each foot carries at least
LARGEST_SLIP = 5e-4  # m, by which a foot of the planned motion may miss its place
LEAST_MANIPULABILITY = 0.4  # of a leg, of that in the stance; 0 where it is stretched
UNLOADED = 1e3  # share of a foot without load


@dataclass(frozen=True)
class GroundForces:
    """Forces of the ground and of the drives that cause a motion.

    Attributes
    ----------
    wrench : (N, F, 6) float64
        (moment; force) on each foot about the middle of its sole, in the sole's axes; for a point
        about the point that touches the ground, in world axes, with a moment of zero.
    torque : (N, J) float64
        Of the drives, Nm or N.
    """

    wrench: FloatArray
    torque: FloatArray


def smallest_forces(
    stance: Stance, poses: StandingPoses, force: FloatArray, driven: BoolArray
) -> GroundForces:
    """Return the smallest ground forces that balance a motion, and the torques that remain.

    Parameters
    ----------
    stance : Stance
    poses : StandingPoses
        At N instants.
    force : (N, 6 + J) float64
        Generalised force that the motion needs, without the ground's forces.
    driven : (J,) bool
        Joints with a drive; no torque acts on the others.
    """
    model, count = stance.model, len(force)
    bodies = link_poses(model, poses.position)
    _, rotation = stance.feet_poses(
        poses.base_position, poses.base_rotation, poses.position, bodies
    )
    jacobian = contact_jacobian(model, stance.frames, bodies)
    rows: list[FloatArray] = []
    scale: list[float] = []
    places: list[int] = []
    for index, foot in enumerate(stance.feet):
        angular = jacobian[:, 6 * index : 6 * index + 3]
        linear = jacobian[:, 6 * index + 3 : 6 * index + 6]
        if foot.is_point:
            to_world = rotation[:, index]
            lever = skew(foot.radius * UPWARD)  # from the lowest point of a ball to its centre
            rows.append(to_world @ linear + lever @ to_world @ angular)
            places += range(6 * index + 3, 6 * index + 6)
            scale += 3 * [1.0]
            continue
        # The middle moves by v + ω × m.
        m = foot.middle
        across = np.array([[0, -m[2], m[1]], [m[2], 0, -m[0]], [-m[1], m[0], 0]])
        rows += [angular, linear - across @ angular]
        places += range(6 * index, 6 * index + 6)
        scale += 3 * [float(foot.half_size.min())] + 3 * [1.0]
    J = np.concatenate(rows, axis=1)
    owed = np.concatenate([np.ones(6, dtype=bool), ~driven])
    owed[6 + np.array(list(model.followers), dtype=np.int64)] = False
    weighted = np.square(scale)[:, None] * J[:, :, owed]
    needed = force[:, owed, None]
    some = weighted @ np.linalg.solve(J[:, :, owed].transpose(0, 2, 1) @ weighted, needed)
    wrench = np.zeros((count, 6 * len(stance.feet)))
    wrench[:, places] = some[..., 0]
    torque = force[:, 6:] - np.einsum("nri,nr->ni", J, some[..., 0])[:, 6:]
    return GroundForces(wrench.reshape(count, -1, 6), np.where(driven, torque, 0.0))


def contact_shares(
    stance: Stance, poses: StandingPoses, forces: GroundForces, friction: float, margin: float
) -> dict[str, FloatArray]:
    """Return how much of each limit of the contacts is used, by its name; at most 1 is allowed.

    Parameters
    ----------
    stance : Stance
    poses : StandingPoses
        At N instants.
    forces : GroundForces
    friction : float
        Friction coefficient that the forces may use.
    margin : float
        Distance of the centre of pressure from the edge of a sole, m.

    Returns
    -------
    dict of str to (N, k) float64
        Friction and least load of each foot, centre of pressure and twist of each sole, how far
        each leg is stretched, and the places of the feet.
    """
    force = forces.wrench[:, :, 3:]
    load = force[:, :, 2]
    is_loaded = load > 0
    safe = np.where(is_loaded, load, 1.0)
    least = LEAST_LOAD * stance_weight(stance) / len(stance.feet)

    def checked(share: FloatArray) -> FloatArray:
        return np.where(is_loaded, share, UNLOADED)

    shares = {
        "friction": checked(np.hypot(force[:, :, 0], force[:, :, 1]) / (friction * safe)),
        "load": checked(least / safe),
        "stretch": 1.0 + LEAST_MANIPULABILITY - poses.manipulability,
        "slip": poses.slip[:, None] / LARGEST_SLIP,
    }
    soles = [index for index, foot in enumerate(stance.feet) if not foot.is_point]
    if soles:
        half = np.array([stance.feet[index].half_size for index in soles])
        moment, safe = forces.wrench[:, soles, :3], safe[:, soles]
        centre = np.stack([-moment[:, :, 1], moment[:, :, 0]], axis=2) / safe[..., None]
        pressure = np.abs(centre) / np.maximum(half - margin, 1e-3)
        twist = np.abs(moment[:, :, 2]) / (friction * safe * half[:, 0])
        shares["centre of pressure"] = pressure.reshape(len(pressure), -1)
        shares["twist"] = twist
    return shares


def stance_weight(stance: Stance) -> float:
    """Return the weight of the robot, N."""
    return float(stance.model.phi[:, 0].sum() * np.linalg.norm(stance.model.gravity))
