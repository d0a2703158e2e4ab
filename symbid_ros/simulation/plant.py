"""The simulated robot: MuJoCo model, state, and the true quantities of one instant."""

import copy
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from symbid_ros.arrays import FloatArray, IntArray
from symbid_ros.errors import ModelError, SimulationError
from symbid_ros.model.mjcf_source import require_files_inside
from symbid_ros.simulation.body_inertia import Payload, add_payload, copy_inertias

# MuJoCo orders quaternions wxyz and wrenches (moment; force); messages use xyzw and force first.
SCALAR_LAST = np.array([1, 2, 3, 0])
FORCE_FIRST = np.array([3, 4, 5, 0, 1, 2])


class RobotFailureError(SimulationError):
    """The robot fell, reached an end stop, or its controller found no torques.

    Parameters
    ----------
    cause : str
        What happened, without time and fix.
    time : float
        Time of the failure, s; negative while the robot settles.
    fix : str
        What the user can do about it.
    code : str
        As in :class:`symbid_ros.errors.SymbidError`.
    """

    def __init__(self, cause: str, time: float, fix: str, code: str) -> None:
        super().__init__(f"{cause} at {time:.3f} s; {fix}", code)
        self.cause = cause
        self.time = time


@dataclass(frozen=True, slots=True)
class State:
    """State of the robot, as controllers receive it, in MuJoCo's conventions.

    Attributes
    ----------
    time : float
        Seconds.
    position : (nq,) float64
        Base position in the world, base quaternion wxyz, joint positions.
    velocity : (nv,) float64
        Base linear velocity in world axes, base angular velocity in base axes, joint velocities.
    """

    time: float
    position: FloatArray
    velocity: FloatArray


@dataclass(frozen=True, slots=True)
class Truth:
    """True quantities of one instant; together they satisfy the equation of motion.

    Attributes
    ----------
    state : State
        State before the step.
    acceleration : (nv,) float64
        Time derivative of ``state.velocity``, in the same axes.
    base_rotation : (3, 3) float64
        Rotation from base to world axes.
    effort : (J,) float64
        Torque applied at each joint, Nm.
    imu_orientation : (4,) float64
        Quaternion xyzw of the IMU in the world.
    imu_motion : (6,) float64
        Angular velocity (rad/s) and specific force (m/s²) in IMU axes.
    wrenches : (F, 6) float64
        Force and moment of the environment on the robot at each wrench frame, in the frame's
        axes about its origin, N and Nm.
    """

    state: State
    acceleration: FloatArray
    base_rotation: FloatArray
    effort: FloatArray
    imu_orientation: FloatArray
    imu_motion: FloatArray
    wrenches: FloatArray


def load_model(path: Path, text: str | None = None) -> mujoco.MjModel:
    """Compile an MJCF file, or ``text`` in its place; error messages name the file."""
    try:
        require_files_inside(path)
        if text is None:
            return mujoco.MjModel.from_xml_path(str(path))
        spec = mujoco.MjSpec.from_string(text)
        spec.modelfiledir = str(path.parent)  # relative mesh paths start here
        return spec.compile()
    except ModelError as error:
        raise SimulationError(str(error), "E601") from None
    except ValueError as error:
        reason = " ".join(str(error).split())
        raise SimulationError(
            f"{path}: MuJoCo cannot compile the model ({reason}); correct the file", "E601"
        ) from error


def site_ids(model: mujoco.MjModel, names: tuple[str, ...]) -> list[int]:
    """Return the indices of sites, all of which must exist."""
    ids = [mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_SITE, name) for name in names]
    for name, site in zip(names, ids, strict=True):
        if site < 0:
            raise SimulationError(
                f"{model_name(model)}: no site {name}; add it to the MJCF", "E602"
            )
    return ids


def model_name(model: mujoco.MjModel) -> str:
    """Return the name of the model, which is the first string in MuJoCo's name buffer."""
    return str(model.names.split(b"\0", 1)[0].decode())


def driven_dofs(model: mujoco.MjModel) -> IntArray:
    """Return the degree of freedom driven by each actuator, in actuator order."""
    return np.array(model.jnt_dofadr[model.actuator_trnid[:, 0]], dtype=np.int64)


def resting_data(model: mujoco.MjModel, position: FloatArray) -> mujoco.MjData:
    """Return the data of a model at rest in a pose (nq,)."""
    data = mujoco.MjData(model)
    data.qpos[:] = position
    mujoco.mj_kinematics(model, data)
    mujoco.mj_comPos(model, data)
    mujoco.mj_comVel(model, data)
    return data


def com_in_pose(model: mujoco.MjModel, position: FloatArray) -> FloatArray:
    """Return the centre of mass (3,) of a robot with a free base in a pose (nq,), m."""
    return np.array(resting_data(model, position).subtree_com[model.jnt_bodyid[0]])


class Plant:
    """A floating-base robot in MuJoCo, advanced in two half steps.

    `observe` updates everything that depends on the state. From that state the caller chooses
    torques, and optionally an external wrench; `advance` then takes the step. State, acceleration,
    torques and forces thus belong to one instant and satisfy the equation of motion.

    Parameters
    ----------
    path : Path
        MJCF with a free base as its first joint, hinge or slide joints after it, a site
        ``imu_link`` with the sensors ``imu_orientation``, ``imu_angular_velocity`` and
        ``imu_linear_acceleration``, and a keyframe ``standing``.
    contact_frames : tuple of str
        Sites at which the contact forces on their bodies are summed.
    text : str or None
        MJCF to compile instead of the file's content.

    Attributes
    ----------
    model, data : mujoco.MjModel, mujoco.MjData
        MuJoCo's model and state; the initial state is the keyframe.
    text : str
        The MJCF.
    joint_names : tuple of str
        All joints except the free joint.
    base_frame : str
        The floating body.
    driven : (n_actuated,) int64
        Degrees of freedom with a drive, in actuator order.
    drive_names : tuple of str
        The joint of each drive, in actuator order.
    torque_limits : (n_actuated, 2) float64
        Lowest and highest torque of each drive, Nm.
    period : float
        Time step, s.
    """

    def __init__(
        self, path: Path, contact_frames: tuple[str, ...], text: str | None = None
    ) -> None:
        self.path = path
        self.model = load_model(path, text)
        self.text = path.read_text(encoding="utf-8") if text is None else text
        self.data = mujoco.MjData(self.model)
        self._require(path)
        self._unloaded_model = copy.copy(self.model)
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
        self._applied_wrenches: list[FloatArray] = []
        self._state = State(0.0, data.qpos.copy(), data.qvel.copy())
        mujoco.mj_resetDataKeyframe(model, data, model.key("standing").id)

    def _require(self, path: Path) -> None:
        model = self.model
        kinds = [mujoco.mjtJoint(kind) for kind in model.jnt_type]
        moving = {mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE}
        if kinds[:1] != [mujoco.mjtJoint.mjJNT_FREE] or set(kinds[1:]) - moving:
            raise SimulationError(
                f"{path}: the first joint must be free and the others hinges or slides; "
                "change the joint types",
                "E602",
            )
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
                    raise SimulationError(f"{path}: no {name}; add that sensor or keyframe", "E602")

    @property
    def mass(self) -> float:
        """Total mass of the robot, kg."""
        return float(self.model.body_subtreemass[self.model.jnt_bodyid[0]])

    @property
    def com(self) -> FloatArray:
        """(3,) centre of mass in the world at the last observed state, m."""
        return np.array(self._com)

    def attach(self, payload: Payload) -> None:
        """Attach a payload to a link from the next `observe` on, in place of any other payload.

        The state does not change: the payload starts with the velocity of its link.

        Raises
        ------
        SimulationError
            When the robot has no such link.
        """
        loaded = copy.copy(self._unloaded_model)
        add_payload(loaded, payload)
        self._set_inertias(loaded)

    def detach(self) -> None:
        """Remove the payload, if there is one."""
        self._set_inertias(self._unloaded_model)

    def _set_inertias(self, source: mujoco.MjModel) -> None:
        copy_inertias(source, self.model)
        # Recomputes sums of masses and similar constants. Needs its own data: it resets the pose.
        mujoco.mj_setConst(self.model, mujoco.MjData(self.model))

    def observe(self) -> State:
        """Compute everything that depends on the state alone and return the state."""
        mujoco.mj_step1(self.model, self.data)
        if self._applied_wrenches:
            self.data.qfrc_applied[:] = 0.0
            self._applied_wrenches.clear()
        data = self.data
        self._state = State(data.time, data.qpos.copy(), data.qvel.copy())
        return self._state

    def apply_wrench(self, site: int, wrench: FloatArray) -> None:
        """Apply an external wrench at a site during the next step.

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
        self._applied_wrenches.append(wrench)

    def advance(self, torques: FloatArray) -> Truth:
        """Apply the drive torques (n_actuated,), Nm, for one period and return the truth.

        Torques are clipped to the limits of each drive.
        """
        model, data = self.model, self.data
        data.ctrl[:] = torques
        mujoco.mj_step2(model, data)
        wrenches, applied = self._contact_wrenches(), self._applied_wrenches
        return Truth(
            state=self._state,
            acceleration=data.qacc.copy(),
            base_rotation=self._base_rotation.copy(),
            effort=data.qfrc_actuator[6:].copy(),
            imu_orientation=self._orientation.take(SCALAR_LAST),
            imu_motion=np.concatenate([self._gyroscope, self._accelerometer]),
            wrenches=np.vstack([wrenches, *applied]) if applied else wrenches,
        )

    def _contact_wrenches(self) -> FloatArray:
        # MuJoCo gives the total contact force on each body as (moment; force) in world axes
        # about the robot's centre of mass. It computes this because the model has an accelerometer.
        wrenches = self._spatial
        for wrench, (force, origin, rotation) in zip(wrenches, self._contact_frames, strict=True):
            mujoco.mju_transformSpatial(wrench, force, 1, origin, self._com, rotation)
        return wrenches.take(FORCE_FIRST, axis=1)

    @property
    def joint_at_limit(self) -> str | None:
        """Name of a joint that is at its end stop, if any."""
        if self.data.nl == 0:
            return None
        rows = self.data.efc_type == mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT
        return str(self.model.joint(int(self.data.efc_id[rows][0])).name)
