"""mujoco.sysid on one problem of bench/peers.py: rollouts of short windows, fitted to the motion.

    python mujoco_sysid_peer.py FOLDER

FOLDER holds model.urdf, training.npz and heldout.npz (see bench/peers.py). Writes mujoco_sysid.npz
with the torques of the held-out motion. Free are the ten inertial parameters of every link as a
pseudo-inertia, which is always possible, and damping, friction loss and armature of every joint.
"""

import sys
import time

import mujoco
import numpy as np
from mujoco import sysid
from mujoco.sysid._src.model_modifier import pi_from_theta, skew
from scipy.signal import butter, sosfiltfilt

# user: begin
CUTOFF = 20.0  # Hz
WINDOW = 0.2  # s, after which a rollout begins again from the measured state
WINDOWS = 40
STEP = 0.002  # s


def build():
    urdf = mujoco.MjSpec.from_file("model.urdf")
    urdf.compiler.boundmass, urdf.compiler.boundinertia = 1e-3, 1e-6  # of links without inertia
    urdf.compile()
    spec = mujoco.MjSpec.from_string(urdf.to_xml())
    spec.option.timestep = STEP
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    spec.option.disableflags |= mujoco.mjtDisableBit.mjDSBL_LIMIT
    for joint in spec.joints:
        motor = spec.add_actuator(name=joint.name, target=joint.name)
        motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
        for kind, name in (
            (mujoco.mjtSensor.mjSENS_JOINTPOS, "position"),
            (mujoco.mjtSensor.mjSENS_JOINTVEL, "velocity"),
        ):
            spec.add_sensor(
                name=f"{joint.name}_{name}",
                type=kind,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname=joint.name,
            )
    return spec


def set_inertia(spec, name, parameter):
    """As sysid.apply_body_inertia, whose full inertia MuJoCo 4.0.0 refuses to compile."""
    body, pi = spec.body(name), pi_from_theta(parameter.value)
    body.mass, body.ipos = pi[0], pi[1:4] / pi[0]
    arm = skew(body.ipos)
    values, axes = np.linalg.eigh(pi[4:].reshape(3, 3) + pi[0] * arm @ arm)
    axes[:, 2] *= np.sign(np.linalg.det(axes))
    quaternion = np.empty(4)
    mujoco.mju_mat2Quat(quaternion, axes.ravel())
    body.inertia, body.iquat = values, quaternion


def inertia_parameter(spec, model, name):
    return sysid.body_inertia_param(
        spec,
        model,
        name,
        inertia_type=sysid.InertiaType.Pseudo,
        modifier=lambda spec, parameter: set_inertia(spec, name, parameter),
    )


def joint_parameter(joint, attribute, start, largest):
    def apply(spec, parameter):
        value = parameter.value[0]
        if attribute == "damping":  # with MuJoCo 4, a polynomial in the speed
            value = np.array([[value], [0.0], [0.0]])
        setattr(spec.joint(joint), attribute, value)

    return sysid.Parameter(f"{joint}_{attribute}", start, 0.0, largest, modifier=apply)


def parameters(spec, model):
    found = sysid.ParameterDict()
    for body in spec.bodies[1:]:
        if model.body(body.name).mass[0] > 0:
            found.add(inertia_parameter(spec, model, body.name))
    for joint in spec.joints:
        found.add(joint_parameter(joint.name, "damping", 0.1, 100.0))
        found.add(joint_parameter(joint.name, "frictionloss", 0.1, 100.0))
        found.add(joint_parameter(joint.name, "armature", 0.01, 20.0))
    return found


def sequences(spec, model):
    data = np.load("training.npz")
    names = list(data["joints"])
    order = [names.index(joint.name) for joint in spec.joints]
    clock = data["time"] - data["time"][0]
    low_pass = butter(4, CUTOFF, fs=1.0 / float(np.median(np.diff(clock))), output="sos")
    position, effort = (
        sosfiltfilt(low_pass, data[key][:, order], axis=0) for key in ("position", "effort")
    )
    velocity = np.gradient(position, clock, axis=0)
    sensed = np.stack([position, velocity], axis=2).reshape(len(clock), -1)
    starts = np.linspace(1.0, clock[-1] - WINDOW - 1.0, WINDOWS)
    mapping = sysid.TimeSeries.compute_all_sensor_mapping(model)
    controls = sysid.TimeSeries.compute_all_state_mappings(model)[3]
    length = round(WINDOW / float(np.median(np.diff(clock))))
    controlled, measured, initial = [], [], []
    for first in np.searchsorted(clock, starts):
        part = slice(first, first + length + 1)
        times = clock[part] - clock[first]
        controlled.append(sysid.TimeSeries(times, effort[part], signal_mapping=controls))
        measured.append(sysid.TimeSeries(times, sensed[part], signal_mapping=mapping))
        initial.append(sysid.create_initial_state(model, position[first], velocity[first]))
    labels = [f"window {number}" for number in range(WINDOWS)]
    return sysid.ModelSequences("robot", spec, labels, initial, controlled, measured)


def identify():
    spec = build()
    model = spec.compile()
    residual = sysid.build_residual_fn(models_sequences=[sequences(spec, model)])
    found, _ = sysid.optimize(parameters(spec, model), residual, max_iters=30, verbose=False)
    return sysid.apply_param_modifiers(found, spec)


# user: end


def predict(model):
    """Return the held-out torques (N, J) in the log's order of joints."""
    data = np.load("heldout.npz")
    order = [list(data["joints"]).index(model.joint(j).name) for j in range(model.njnt)]
    state = mujoco.MjData(model)
    torque = np.empty_like(data["position"])
    for row, (q, v, a) in enumerate(
        zip(data["position"], data["velocity"], data["acceleration"], strict=True)
    ):
        state.qpos[:], state.qvel[:], state.qacc[:] = q[order], v[order], a[order]
        mujoco.mj_inverse(model, state)
        # mj_inverse's friction loss depends on the solver; the sign of the velocity is exact.
        rigid = state.qfrc_inverse + state.qfrc_constraint
        torque[row, order] = rigid + model.dof_frictionloss * np.sign(state.qvel)
    return torque


if __name__ == "__main__":
    import os

    os.chdir(sys.argv[1])
    start = time.perf_counter()
    model = identify()
    seconds = time.perf_counter() - start
    np.savez(
        "mujoco_sysid.npz",
        torque=predict(model),
        impossible=0,  # a pseudo-inertia from its Cholesky factor is always possible
        seconds=seconds,
        note="",
        version=mujoco.__version__,
    )
