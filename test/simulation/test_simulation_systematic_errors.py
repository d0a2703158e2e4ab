import dataclasses

import mujoco
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from symbid_ros.bags import read_streams
from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator
from symbid_ros.simulation.systematic_errors import (
    ERRORS,
    RESOLUTION,
    TYPICAL,
    draw_errors,
    parse_errors,
)

STEPS = 60
SENSOR_ERRORS = [name for name in ERRORS if name != "link_length"]


def instants(errors="", *, scenario="vibrating", seed=3, steps=STEPS, **options):
    """The drawn errors, and the first instants as arrays by name."""
    simulator = Simulator(
        SimulateOptions(scenario, moves=1, motion_seed=1, errors=errors, error_seed=seed, **options)
    )
    steps = [simulator.step() for _ in range(steps)]
    names = [field.name for field in dataclasses.fields(steps[0])]
    arrays = {name: np.array([getattr(step, name) for step in steps]) for name in names}
    return simulator.errors, arrays


@pytest.fixture(scope="module")
def perfect():
    """The first instants of a vibrating robot, whose readings differ from each other."""
    return instants(ideal=True)[1]


@pytest.fixture(scope="module")
def typical():
    return instants("typical", ideal=True)


def unchanged(readings, perfect, *names):
    for name in names:
        np.testing.assert_array_equal(readings[name], perfect[name], err_msg=name)


def between(values, smallest, largest):
    magnitude = np.abs(values)
    return smallest <= magnitude.min() <= magnitude.max() <= largest


READINGS = (
    "joint_position",
    "joint_velocity",
    "joint_effort",
    "imu_orientation",
    "imu_angular_velocity",
    "imu_linear_acceleration",
    "wrenches",
)


def others(*changed):
    return [name for name in READINGS if name not in changed]


def test_encoders_have_offsets(perfect):
    errors, readings = instants("encoder_offset", ideal=True)
    offset = readings["joint_position"] - perfect["joint_position"]
    np.testing.assert_allclose(offset, np.tile(errors.encoder_offset, (STEPS, 1)), atol=1e-15)
    assert between(np.degrees(errors.encoder_offset), 0.05, 0.15)
    unchanged(readings, perfect, *others("joint_position"))


def test_torque_sensors_have_gains(perfect):
    errors, readings = instants("torque_gain", ideal=True)
    driven = perfect["joint_effort"].any(axis=0)
    assert driven.sum() == 8
    ratio = readings["joint_effort"][:, driven] / perfect["joint_effort"][:, driven]
    np.testing.assert_allclose(ratio - 1, np.tile(errors.torque_gain[driven], (STEPS, 1)))
    assert not readings["joint_effort"][:, ~driven].any()
    assert between(errors.torque_gain, 0.01, 0.02)
    unchanged(readings, perfect, *others("joint_effort"))


def test_imu_has_a_mounting_error(perfect):
    errors, readings = instants("imu_mounting", ideal=True)
    # The sensor's axes in its frame.
    mounting = Rotation.from_rotvec(errors.imu_mounting)
    assert between(np.degrees(mounting.magnitude()), 0.1, 0.3)
    for name in ("imu_angular_velocity", "imu_linear_acceleration"):
        np.testing.assert_allclose(readings[name], mounting.inv().apply(perfect[name]), atol=1e-13)
    true, read = (
        Rotation.from_quat(run["imu_orientation"]).as_matrix() for run in (perfect, readings)
    )
    np.testing.assert_allclose(read, true @ mounting.as_matrix(), atol=1e-13)
    unchanged(readings, perfect, *others(*(name for name in READINGS if name.startswith("imu"))))


def test_plates_have_gains_on_every_channel(perfect):
    errors, readings = instants("wrench_gain", ideal=True)
    gain = readings["wrenches"] / perfect["wrenches"] - 1
    np.testing.assert_allclose(gain, np.tile(errors.wrench_gain, (STEPS, 1, 1)), atol=1e-12)
    assert between(errors.wrench_gain, 0.0025, 0.0075)
    unchanged(readings, perfect, *others("wrenches"))


def test_plates_have_offsets(perfect):
    errors, readings = instants("wrench_offset", ideal=True)
    offset = readings["wrenches"] - perfect["wrenches"]
    np.testing.assert_allclose(offset, np.tile(errors.wrench_offset, (STEPS, 1, 1)), atol=1e-12)
    assert between(errors.wrench_offset[:, :3], 1.0, 2.0)
    assert between(errors.wrench_offset[:, 3:], 0.1, 0.2)
    unchanged(readings, perfect, *others("wrenches"))


def test_offsets_and_biases_drift(perfect):
    errors, readings = instants("drift", ideal=True)
    share = np.arange(1, STEPS + 1)[:, None] * 1e-3  # of the first second
    drift = share * errors.drift[1]
    plates = readings["wrenches"] - perfect["wrenches"]
    np.testing.assert_allclose(plates, drift[:, :12].reshape(STEPS, 2, 6), atol=1e-12)
    for name, columns in (
        ("imu_angular_velocity", slice(12, 15)),
        ("imu_linear_acceleration", slice(15, 18)),
    ):
        np.testing.assert_allclose(readings[name] - perfect[name], drift[:, columns], atol=1e-14)
    unchanged(
        readings, perfect, *others("imu_angular_velocity", "imu_linear_acceleration", "wrenches")
    )


def test_drift_is_a_random_walk_from_minute_to_minute():
    drift = draw_errors(("drift",), 0, joints=1, plates=2).drift
    assert not drift[0].any()
    steps = np.diff(drift[::60], axis=0)
    in_a_minute = np.array(2 * ([0.5] * 3 + [0.05] * 3) + [2e-4] * 3 + [2e-3] * 3)
    np.testing.assert_allclose(steps.std(axis=0), in_a_minute, rtol=0.25)
    neighbours = np.mean(steps[1:] * steps[:-1], axis=0) / in_a_minute**2
    assert np.abs(neighbours).max() < 0.3  # independent to 1 in sqrt(119)
    assert np.abs(np.diff(drift, 2, axis=0) / in_a_minute).max() < 0.02  # smooth


def test_plates_are_displaced(perfect):
    errors, readings = instants("wrench_position", ideal=True)
    assert between(np.linalg.norm(errors.wrench_position, axis=1), 1e-3, 3e-3)
    force, moment = np.split(readings["wrenches"], 2, axis=2)
    np.testing.assert_array_equal(force, perfect["wrenches"][..., :3])
    # The moment about the frame's origin includes that of the force at the displaced point.
    restored = moment + np.cross(errors.wrench_position, force)
    np.testing.assert_allclose(restored, perfect["wrenches"][..., 3:], atol=1e-12)
    assert np.abs(moment - restored).max() > 0.05
    unchanged(readings, perfect, *others("wrenches"))


def test_delayed_sensors_report_past_instants(perfect):
    errors, readings = instants("delays", ideal=True)
    joints, imu, *plates = errors.delays
    assert len({joints, imu, *plates}) == 4
    assert 1 <= errors.delays.min() <= errors.delays.max() <= 5
    late = {name: joints for name in READINGS if name.startswith("joint")}
    late |= {name: imu for name in READINGS if name.startswith("imu")}
    period = np.arange(STEPS)

    def reported(values, delay):
        """Linear interpolation of the readings of a sensor without delay, from the fifth on."""
        flat = values.reshape(STEPS, -1)
        columns = [np.interp(period[5:] - delay, period, column) for column in flat.T]
        return np.stack(columns, axis=1).reshape(-1, *values.shape[1:])

    for name, delay in late.items():
        # Quaternions have unit norm.
        atol = 1e-8 if name == "imu_orientation" else 1e-12
        np.testing.assert_allclose(readings[name][5:], reported(perfect[name], delay), atol=atol)
    for plate, delay in enumerate(plates):
        expected = reported(perfect["wrenches"][:, plate], delay)
        np.testing.assert_allclose(readings["wrenches"][5:, plate], expected, rtol=1e-12, atol=1e-9)
    # Their first readings are those before the first instant, not copies of it.
    assert np.all(readings["imu_linear_acceleration"][0] != perfect["imu_linear_acceleration"][0])
    unchanged(readings, perfect, "stamp")


def test_readings_are_quantised(perfect):
    _, readings = instants("quantisation", ideal=True)
    steps = RESOLUTION
    force, moment = (slice(None), slice(None), slice(0, 3)), (slice(None), slice(None), slice(3, 6))
    for name, part, step in (
        ("joint_position", ..., steps.joint_position),
        ("joint_velocity", ..., steps.joint_velocity),
        ("joint_effort", ..., steps.joint_effort),
        ("imu_angular_velocity", ..., steps.angular_velocity),
        ("imu_linear_acceleration", ..., steps.linear_acceleration),
        ("wrenches", force, steps.force),
        ("wrenches", moment, steps.moment),
    ):
        read, true = readings[name][part], perfect[name][part]
        np.testing.assert_allclose(read / step, np.rint(read / step), atol=1e-9)
        assert np.abs(read - true).max() <= 0.5 * step * (1 + 1e-9), name
        assert np.abs(read - true).max() > 0.25 * step, name
    unchanged(readings, perfect, "imu_orientation")


def test_sensors_have_different_rates(tmp_path):
    record(
        Simulator(SimulateOptions("tare", noise_seed=2, errors="sample_rates")), tmp_path / "bag"
    )
    streams = read_streams([tmp_path / "bag"])
    plates, support = streams.wrenches[:2], streams.wrenches[2]
    for stream, every in (
        (streams.joints, 1),
        (streams.imus[0], 2),
        (plates[0], 3),
        (plates[1], 3),
        (support, 1),
    ):
        np.testing.assert_array_equal(stream.stamp, np.arange(1, 5001, every) * 1_000_000)
    # Longer than the blocks in which a bag is written.
    _, full = instants(scenario="tare", noise_seed=2, steps=1500)
    for read, expected, every in (
        (streams.joints.position, full["joint_position"], 1),
        (streams.imus[0].angular_velocity, full["imu_angular_velocity"], 2),
        (plates[0].force, full["wrenches"][:, 0, :3], 3),
        (plates[1].torque, full["wrenches"][:, 1, 3:], 3),
    ):
        np.testing.assert_array_equal(read[: len(expected[::every])], expected[::every])


def test_links_differ_in_length_from_the_file():
    simulator = Simulator(
        SimulateOptions("smooth", moves=1, errors="link_length", error_seed=3, ideal=True)
    )
    file = mujoco.MjModel.from_xml_path(str(config_file("symbitron.xml")))
    robot = mujoco.MjModel.from_xml_string(simulator.robot)
    moved = file.jnt_bodyid[1:]
    length, offset = (np.linalg.norm(model.body_pos[moved], axis=1) for model in (robot, file))
    np.testing.assert_allclose(length - offset, simulator.errors.link_length, atol=1e-12)
    np.testing.assert_allclose(
        robot.body_pos[moved] / length[:, None],
        file.body_pos[moved] / offset[:, None],
        atol=1e-12,
    )
    assert between(simulator.errors.link_length, 1e-3, 2e-3)
    for name in ("body_mass", "body_ipos", "body_inertia", "body_iquat", "jnt_axis", "site_pos"):
        np.testing.assert_array_equal(getattr(robot, name), getattr(file, name), err_msg=name)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_robot_with_modified_lengths_stands_on_both_feet(seed):
    _, run = instants("link_length", scenario="smooth", seed=seed, steps=400, ideal=True)
    upward = run["wrenches"][:, :, 2]
    assert upward.min() > 0.35 * 41.05 * 9.81
    np.testing.assert_allclose(upward.sum(axis=1), 41.05 * 9.81, rtol=1e-3)
    assert np.abs(run["true_acceleration"]).max() < 1.0


def test_errors_do_not_change_motion_and_truth(perfect):
    errors, readings = instants(",".join(SENSOR_ERRORS), ideal=True)
    assert not errors.link_length.any()
    unchanged(readings, perfect, *(name for name in perfect if name not in READINGS))
    assert all(np.any(readings[name] != perfect[name]) for name in READINGS)


def test_noise_is_added_and_does_not_depend_on_errors(perfect, typical):
    exact = typical[1]
    _, noisy = instants(noise_seed=4)
    _, both = instants("typical", noise_seed=4)
    for name in READINGS:
        noise = noisy[name] - perfect[name]
        np.testing.assert_allclose(both[name] - exact[name], noise, atol=1e-12, err_msg=name)


def test_displacement_and_gain_precede_the_offset(perfect, typical):
    errors, readings = typical
    force, moment = np.split(perfect["wrenches"], 2, axis=2)
    about = np.concatenate([force, moment - np.cross(errors.wrench_position, force)], axis=2)
    expected = about * (1 + errors.wrench_gain) + errors.wrench_offset
    np.testing.assert_allclose(readings["wrenches"], expected, atol=1e-12)


class TestTare:
    def test_plates_read_their_offsets(self):
        errors, readings = instants("typical", scenario="tare", ideal=True)
        for reading in readings["wrenches"][:, :2]:
            np.testing.assert_array_equal(reading, errors.wrench_offset)

    def test_overhead_support_has_no_errors(self):
        everything = ",".join(SENSOR_ERRORS)
        (_, wrong), (_, right) = (
            instants(names, scenario="tare", ideal=True) for names in (everything, "")
        )
        np.testing.assert_array_equal(wrong["wrenches"][:, 2], right["wrenches"][:, 2])
        pull = np.linalg.norm(right["wrenches"][0, 2, :3])
        assert pull == pytest.approx(41.05 * 9.81, rel=1e-3)

    def test_has_the_same_errors_as_the_log(self, typical):
        errors, _ = instants("typical", scenario="tare")
        for field in dataclasses.fields(errors):
            np.testing.assert_array_equal(
                getattr(errors, field.name), getattr(typical[0], field.name)
            )

    def test_lasts_five_seconds_at_rest_for_any_moves(self):
        short, long = (
            Simulator(SimulateOptions("tare", moves=moves, motion_seed=moves, ideal=True))
            for moves in (1, 30)
        )
        assert short.steps == long.steps == 5000
        run = [short.step() for _ in range(2500)]
        velocity = np.array([instant.true_velocity for instant in run])
        driven = [not name.endswith("_aie") for name in short.joint_names]
        assert np.abs(velocity[:, driven]).max() < 0.02
        # The undriven ankles have no damping; they hang vertically within a third of a degree.
        assert np.ptp([instant.true_position for instant in run], axis=0).max() < 0.02
        spin = np.array([instant.base_angular_velocity for instant in run])
        assert np.abs(spin).max() < 2e-3
        np.testing.assert_array_equal(long.step().true_position, run[0].true_position)


def draw(names, seed=0):
    return draw_errors(names, seed, joints=10, plates=2)


class TestDraws:
    @pytest.mark.parametrize("name", ERRORS)
    def test_depend_on_their_name_only(self, name):
        alone, among = draw((name,), 7), draw(tuple(ERRORS), 7)
        np.testing.assert_array_equal(getattr(alone, name), getattr(among, name))
        nothing = draw(())
        for field in dataclasses.fields(nothing):
            if field.name != name:
                np.testing.assert_array_equal(
                    getattr(alone, field.name), getattr(nothing, field.name)
                )

    @pytest.mark.parametrize("name", [*TYPICAL, "link_length"])
    def test_differ_between_seeds_in_size_and_sign(self, name):
        values = np.array([getattr(draw((name,), seed), name) for seed in range(40)])
        assert len(np.unique(values.reshape(40, -1), axis=0)) == 40
        assert np.all((values > 0).any(axis=0) & (values < 0).any(axis=0))

    def test_of_different_errors_are_independent(self):
        drawn = draw(tuple(ERRORS), 5)
        gain, offset = drawn.torque_gain, drawn.encoder_offset
        assert np.any(np.sign(gain) != np.sign(offset))


def test_typical_means_the_six_calibration_errors():
    assert parse_errors("typical") == parse_errors(",".join(TYPICAL)) == TYPICAL
    assert set(parse_errors("delays, typical")) == {*TYPICAL, "delays"}
    assert parse_errors("") == ()


@pytest.mark.parametrize(
    "text", ["wrench_gian", "typical,wrench_gian", "plate gain", "all", "none"]
)
def test_unknown_error_is_named_with_the_choices(text):
    with pytest.raises(SimulationError) as caught:
        parse_errors(text)
    assert caught.value.code == "E607"
    assert repr(text.split(",")[-1]) in str(caught.value)
    assert all(name in str(caught.value) for name in ("typical", *ERRORS))
    assert "\n" not in str(caught.value)
