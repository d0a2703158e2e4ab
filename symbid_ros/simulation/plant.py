"""The simulated robot: MuJoCo's model, its state, and the true quantities of one instant."""

import copy
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import ModelError, SimulationError
from symbid_ros.model.mjcf_source import require_files_inside
from symbid_ros.simulation.body_inertia import Payload, add_payload, copy_inertias


class RobotFailureError(SimulationError):
    """A robot that cannot go on: fallen, at an end stop, or without a command.

    Parameters
    ----------
    cause : str
        What happened, without time and remedy.
    time : float
        When, s; negative while the robot settles.
    remedy : str
        What to do about it.
    """

    def __init__(self, cause: str, time: float, remedy: str) -> None:
        super().__init__(f"{cause} at {time:.3f} s; {remedy}")
        self.cause = cause
        self.time = time


# MuJoCo has quaternions as wxyz and wrenches as (moment; force); messages the other way round.
SCALAR_LAST = np.array([1, 2, 3, 0])
FORCE_FIRST = np.array([3, 4, 5, 0, 1, 2])


@dataclass(frozen=True, slots=True)
class State:
    """What a controller is told, in MuJoCo's conventions.

    Attributes
    ----------
    time : float
        Seconds.
    position : (nq,) float64
        Base position in the world, base quaternion wxyz, joint positions.
    velocity : (nv,) float64
        Base linear velocity in world axes, angular in base axes, joint velocities.
    """

    time: float
    position: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class Truth:
    """True quantities of one instant; together they close the equation of motion.

    Attributes
    ----------
    state : State
        Before the step.
    acceleration : (nv,) float64
        Time derivative of ``state.velocity``, same axes.
    base_rotation : (3, 3) float64
        From base to world axes.
    effort : (J,) float64
        Torque applied at each joint, Nm.
    imu_orientation : (4,) float64
        Quaternion xyzw of the IMU in the world.
    imu_motion : (6,) float64
        Angular velocity (rad/s) and specific force (m/s²) in IMU axes.
    wrenches : (F, 6) float64
        Force and moment per wrench frame, environment on robot, in the frame's axes
        about its origin, N and Nm.
    """

    state: State
    acceleration: FloatArray
    base_rotation: FloatArray
    effort: FloatArray
    imu_orientation: FloatArray
    imu_motion: FloatArray
    wrenches: FloatArray


def load_model(path: Path, text: str | None = None) -> mujoco.MjModel:
    """Compile an MJCF file, or a text in its place, with the file named in any error."""
    try:
        require_files_inside(path)
        if text is None:
            return mujoco.MjModel.from_xml_path(str(path))
        spec = mujoco.MjSpec.from_string(text)
        spec.modelfiledir = str(path.parent)  # where relative mesh paths begin
        return spec.compile()
    except ModelError as error:
        raise SimulationError(str(error)) from None
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise SimulationError(f"{path}: MuJoCo refuses the model ({reason})") from error


def site_ids(model: mujoco.MjModel, names: tuple[str, ...]) -> list[int]:
    """Return the sites' indices, each checked to exist."""
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in names]
    for name, site in zip(names, ids, strict=True):
        if site < 0:
            raise SimulationError(f"{model_name(model)}: no site {name}; add it to the MJCF")
    return ids


def model_name(model: mujoco.MjModel) -> str:
    """Return the name of the model, the first string of MuJoCo's name buffer."""
    return str(model.names.split(b"\0", 1)[0].decode())


def driven_dofs(model: mujoco.MjModel) -> IntArray:
    """Return the degree of freedom that each actuator drives, in actuator order."""
    return np.array(model.jnt_dofadr[model.actuator_trnid[:, 0]], dtype=np.int64)


class Plant:
    """A floating-base robot in MuJoCo, advanced in two halves.

    `observe` brings everything that depends on the state up to date; then torques and, where
    there is one, an outside wrench are chosen from that same state and `advance` takes the step.
    This order keeps state, acceleration, torques and forces of one instant together, without
    which the equation of motion would not close.

    Parameters
    ----------
    path : Path
        MJCF with a free base as its first joint, hinge or slide joints after it, a site
        ``imu_link`` with the sensors ``imu_orientation``, ``imu_angular_velocity`` and
        ``imu_linear_acceleration``, and a keyframe ``standing``.
    contact_frames : tuple of str
        Sites at which the contact forces on their bodies are summed.
    text : str or None
        MJCF to compile in the file's place.

    Attributes
    ----------
    model, data : mujoco.MjModel, mujoco.MjData
        MuJoCo's own, the state at the keyframe to begin with.
    text : str
        The MJCF.
    joint_names : tuple of str
        Of all joints but the free one.
    base_frame : str
        The floating body.
    driven : (n_actuated,) int64
        Degrees of freedom with a drive, in actuator order.
    drive_names : tuple of str
        The joint of each drive, in actuator order.
    torque_limits : (n_actuated, 2) float64
        Lowest and highest torque of each drive, Nm.
    period : float
        Seconds.
    """

    def __init__(
        self, path: Path, contact_frames: tuple[str, ...], text: str | None = None
    ) -> None:
        self.path = path
        self.model = load_model(path, text)
        self.text = path.read_text(encoding="utf-8") if text is None else text
        self.data = mujoco.MjData(self.model)
        self._require(path)
        self._bare = copy.copy(self.model)
        model, data = self.model, self.data
        self.joint_names = tuple(model.joint(i).name for i in range(1, model.njnt))
        self.base_frame = str(model.body(model.jnt_bodyid[0]).name)
        self.driven = driven_dofs(model)
        drives = model.actuator_trnid[:, 0]
        self.drive_names = tuple(model.joint(int(joint)).name for joint in drives)
        self.torque_limits: FloatArray = model.actuator_ctrlrange.copy()
        self.period = float(model.opt.timestep)
        self._contact_frames = [
            (data.cfrc_ext[model.site_bodyid[site]], data.site_xpos[site], data.site_xmat[site])
            for site in site_ids(model, contact_frames)
        ]
        self._com = data.subtree_com[model.jnt_bodyid[0]]
        self._spatial = np.zeros((len(contact_frames), 6))
        self._base_rotation = data.xmat[model.jnt_bodyid[0]].reshape(3, 3)
        self._orientation = data.sensor("imu_orientation").data
        self._gyroscope = data.sensor("imu_angular_velocity").data
        self._accelerometer = data.sensor("imu_linear_acceleration").data
        self._outside: list[FloatArray] = []
        self._state = State(0.0, data.qpos.copy(), data.qvel.copy())
        mujoco.mj_resetDataKeyframe(model, data, model.key("standing").id)

    def _require(self, path: Path) -> None:
        model = self.model
        kinds = [mujoco.mjtJoint(kind) for kind in model.jnt_type]
        moving = {mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE}
        if kinds[:1] != [mujoco.mjtJoint.mjJNT_FREE] or set(kinds[1:]) - moving:
            raise SimulationError(f"{path}: needs one free joint, then hinges or slides only")
        needed = {
            mujoco.mjtObj.mjOBJ_SENSOR: (
                "imu_orientation",
                "imu_angular_velocity",
                "imu_linear_acceleration",
            ),
            mujoco.mjtObj.mjOBJ_KEY: ("standing",),
        }
        for kind, names in needed.items():
            for name in names:
                if mujoco.mj_name2id(model, kind, name) < 0:
                    raise SimulationError(f"{path}: no {name}; add that sensor or keyframe")

    @property
    def mass(self) -> float:
        """Total mass of the robot, kg."""
        return float(self.model.body_subtreemass[self.model.jnt_bodyid[0]])

    @property
    def com(self) -> FloatArray:
        """(3,) centre of mass in the world at the state last observed, m."""
        return np.array(self._com)

    def attach(self, payload: Payload) -> None:
        """Fasten a payload to a link, in place of any other, from the next `observe` on.

        State and velocities stay as they are: the payload arrives with those of its link.

        Raises
        ------
        SimulationError
            When the robot has no such link.
        """
        loaded = copy.copy(self._bare)
        add_payload(loaded, payload)
        self._set_inertias(loaded)

    def detach(self) -> None:
        """Take the payload off again, if there is one."""
        self._set_inertias(self._bare)

    def _set_inertias(self, source: mujoco.MjModel) -> None:
        copy_inertias(source, self.model)
        # Sums of masses and the like; in data of its own, as this moves the robot.
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def observe(self) -> State:
        """Compute all that follows from the state alone and return the state."""
        mujoco.mj_step1(self.model, self.data)
        if self._outside:
            self.data.qfrc_applied[:] = 0.0
            self._outside.clear()
        data = self.data
        self._state = State(data.time, data.qpos.copy(), data.qvel.copy())
        return self._state

    def push(self, site: int, wrench: FloatArray) -> None:
        """Apply an outside wrench at a site during the coming step.

        Parameters
        ----------
        site : int
            Index of the site.
        wrench : (6,) float64
            Force and moment on the robot, in the site's axes about its origin.
        """
        rotation = self.data.site_xmat[site].reshape(3, 3)
        mujoco.mj_applyFT(
            self.model,
            self.data,
            rotation @ wrench[:3],
            rotation @ wrench[3:],
            self.data.site_xpos[site],
            self.model.site_bodyid[site],
            self.data.qfrc_applied,
        )
        self._outside.append(wrench)

    def advance(self, torques: FloatArray) -> Truth:
        """Apply the drives' torques (n_actuated,), Nm, for one period and return the truth.

        Torques beyond a drive's range are cut off at its limit, as the drive would.
        """
        model, data = self.model, self.data
        data.ctrl[:] = torques
        mujoco.mj_step2(model, data)
        wrenches = self._contact_wrenches()
        return Truth(
            state=self._state,
            acceleration=data.qacc.copy(),
            base_rotation=self._base_rotation.copy(),
            effort=data.qfrc_actuator[6:].copy(),
            imu_orientation=self._orientation.take(SCALAR_LAST),
            imu_motion=np.concatenate([self._gyroscope, self._accelerometer]),
            wrenches=np.vstack([wrenches, *self._outside]) if self._outside else wrenches,
        )

    def _contact_wrenches(self) -> FloatArray:
        # MuJoCo sums the contact forces on each body (moment; force) in world axes about the
        # whole robot's centre of mass; it does so because the model has an accelerometer.
        wrenches = self._spatial
        for wrench, (force, origin, rotation) in zip(wrenches, self._contact_frames, strict=True):
            mujoco.mju_transformSpatial(wrench, force, 1, origin, self._com, rotation)
        return wrenches.take(FORCE_FIRST, axis=1)

    @property
    def joint_at_limit(self) -> str | None:
        """Name of a joint pressed against its end stop, if there is one."""
        if self.data.nl == 0:
            return None
        rows = self.data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
        return str(self.model.joint(int(self.data.efc_id[rows][0])).name)
