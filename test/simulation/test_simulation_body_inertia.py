"""Payloads attached to the running robot: inertia, time and effect on the controller."""

import dataclasses
import itertools
import re
import xml.etree.ElementTree as ET

import mujoco
import numpy as np
import pytest

from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.body_inertia import Payload
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.plant import Plant
from symbid_ros.simulation.scenario import SCENARIOS, SOLES
from symbid_ros.simulation.simulator import Simulator

PAYLOADS = [
    Payload("base_link", 2.0, (0.1, -0.05, 0.2)),
    Payload("L_thigh", 2.0, (0.2, 0.03, 0.0), radius=0.0),
    Payload("R_thigh", 0.5, (0.1, 0.0, 0.1), radius=0.2),
]


def robot_with_sphere(payload: Payload) -> mujoco.MjModel:
    """Compile the robot with the payload as a separate body welded to its link."""
    root = ET.parse(config_file("symbitron.xml")).getroot()
    link = root.find(f".//body[@name='{payload.link}']")
    position = " ".join(map(repr, payload.position))
    sphere = ET.SubElement(link, "body", pos=position)
    moment = max(
        2.0 / 5.0 * payload.mass * payload.radius**2, 1e-15
    )  # MuJoCo requires positive inertias
    ET.SubElement(
        sphere,
        "inertial",
        pos="0 0 0",
        mass=repr(payload.mass),
        diaginertia=" ".join([repr(moment)] * 3),
    )
    return mujoco.MjModel.from_xml_string(ET.tostring(root, encoding="unicode"))


def inverse_dynamics(model: mujoco.MjModel, random: np.random.Generator) -> np.ndarray:
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    data = mujoco.MjData(model)
    data.qpos[:] = random.normal(size=model.nq)
    mujoco.mj_normalizeQuat(model, data.qpos)
    data.qvel[:] = random.normal(size=model.nv)
    data.qacc[:] = random.normal(size=model.nv)
    mujoco.mj_inverse(model, data)
    return data.qfrc_inverse.copy()


@pytest.mark.parametrize("payload", PAYLOADS, ids=lambda payload: payload.link)
def test_loaded_robot_moves_like_one_with_a_welded_sphere(payload):
    plant = Plant(config_file("symbitron.xml"), SOLES)
    plant.attach(Payload("R_foot", 7.0))  # replaced by the next
    plant.attach(payload)
    truth = robot_with_sphere(payload)
    np.testing.assert_allclose(plant.mass, 41.05 + payload.mass, rtol=1e-9)
    np.testing.assert_allclose(plant.model.dof_M0, truth.dof_M0, rtol=1e-11)
    for seed in range(3):
        forces, expected = (
            inverse_dynamics(model, np.random.default_rng(seed)) for model in (plant.model, truth)
        )
        np.testing.assert_allclose(forces, expected, atol=1e-11 * np.abs(expected).max())


def test_detaching_restores_the_robot():
    plant = Plant(config_file("symbitron.xml"), SOLES)
    before = plant.data.qpos.copy()
    plant.attach(PAYLOADS[0])
    plant.detach()
    original = mujoco.MjModel.from_xml_path(str(config_file("symbitron.xml")))
    for name in ("mass", "ipos", "inertia", "iquat", "subtreemass", "invweight0", "sameframe"):
        field = f"body_{name}"
        np.testing.assert_array_equal(getattr(plant.model, field), getattr(original, field))
    np.testing.assert_array_equal(plant.data.qpos, before)


def test_payload_is_attached_at_its_time_without_changing_the_state():
    plain, loaded = (
        Simulator(SimulateOptions(moves=1, noise_seed=4, payload_time=0.3), payload=payload)
        for payload in (None, PAYLOADS[0])
    )
    for _ in range(300):
        one, other = plain.step(), loaded.step()
        for field in dataclasses.fields(one):
            np.testing.assert_array_equal(getattr(one, field.name), getattr(other, field.name))
    one, other = plain.step(), loaded.step()
    for name in ("true_position", "true_velocity", "base_position", "base_linear_velocity"):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name))
    # The controller does not know the payload: so far only gravity acts on it.
    np.testing.assert_array_equal(one.true_effort, other.true_effort)
    assert other.base_linear_acceleration[2] < one.base_linear_acceleration[2] - 1e-3


@pytest.mark.parametrize("payload", PAYLOADS[:2], ids=lambda payload: payload.link)
def test_equation_of_motion_holds_with_payload(payload, body):
    simulator = Simulator(
        SimulateOptions(motion_seed=7, ideal=True, payload_time=0.3), payload=payload
    )
    instants = list(itertools.islice(simulator, 1500))
    body.model = robot_with_sphere(payload)
    body.model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
    body.data = mujoco.MjData(body.model)
    for instant in instants[300::31]:
        body.set(instant)
        mujoco.mj_inverse(body.model, body.data)
        residual = body.data.qfrc_inverse.copy()
        residual[6:] -= instant.true_effort
        for sensor, wrench in zip(simulator.wrench_sensors, instant.wrenches, strict=True):
            origin, rotation, link = body.site(sensor.frame_id)
            force, moment = rotation @ wrench[:3], rotation @ wrench[3:]
            applied = np.zeros(body.model.nv)
            mujoco.mj_applyFT(body.model, body.data, force, moment, origin, link, applied)
            residual -= applied
        assert np.abs(residual).max() < 1e-8
    load = np.mean([instant.wrenches[:, 2].sum() for instant in instants[-300:]])
    assert load == pytest.approx((41.05 + payload.mass) * 9.81, rel=2e-3)


def test_balance_controller_does_not_know_the_payload():
    torques = []
    for payload in (None, PAYLOADS[0]):
        plant = Plant(config_file("symbitron.xml"), SOLES)
        controller = SCENARIOS["smooth"](plant, 1, 0).controller
        if payload is not None:
            plant.attach(payload)
        torques.append(controller.torques(plant.observe()))
    np.testing.assert_array_equal(*torques)


def test_payload_can_be_replaced_and_detached_while_running():
    simulator = Simulator(SimulateOptions(moves=1, ideal=True))

    def load() -> float:
        instants = [simulator.step() for _ in range(400)]
        return float(np.mean([instant.wrenches[:, 2].sum() for instant in instants[200:]]))

    for payload, mass in ((PAYLOADS[0], 2.0), (PAYLOADS[2], 0.5), (None, 0.0)):
        simulator.attach(payload)
        assert load() == pytest.approx((41.05 + mass) * 9.81, rel=5e-3)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"link": "tail"}, "E609: .*'tail'.* base_link, R_haa"),
        ({"link": "world"}, "E609: .*'world'"),
        ({"mass": 0.0}, "E608: .*base_link.* mass 0 kg"),
        ({"mass": float("nan")}, "E608: .* mass nan kg"),
        ({"position": (0.0, 0.0)}, "E608: .* position"),
        ({"position": (0.0, float("inf"), 0.0)}, "E608: .* position"),
        ({"radius": -1.0}, "E608: .* radius -1 m"),
    ],
)
def test_invalid_payloads_raise_an_error(values, message):
    simulator = Simulator(SimulateOptions(moves=1))
    with pytest.raises(SimulationError) as caught:
        simulator.attach(Payload(**{"link": "base_link", "mass": 1.0} | values))
    assert re.match(message, f"{caught.value.code}: {caught.value}")
    assert "\n" not in str(caught.value)


def test_an_infinite_payload_time_raises_an_error():
    with pytest.raises(SimulationError, match="payload time"):
        Simulator(SimulateOptions(moves=1, payload_time=float("inf")), payload=PAYLOADS[0])


def test_scheduled_payload_is_checked_immediately():
    with pytest.raises(SimulationError, match="no link 'tail'"):
        Simulator(SimulateOptions(moves=1, payload_time=9.0), payload=Payload("tail", 1.0))
