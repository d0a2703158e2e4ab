import dataclasses

import numpy as np
import pytest
import yaml

from symbid_ros.errors import SimulationError
from symbid_ros.package_paths import config_file
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.settings import load_noise
from symbid_ros.simulation.simulator import Simulator

SAMPLES = 2500
NOISY = (
    "joint_position",
    "joint_velocity",
    "joint_effort",
    "imu_angular_velocity",
    "imu_linear_acceleration",
    "wrenches",
)


def noise_file(folder, **changes):
    content = yaml.safe_load(config_file("noise.yaml").read_text()) | changes
    path = folder / "noise.yaml"
    path.write_text(yaml.safe_dump({k: v for k, v in content.items() if v != "gone"}))
    return path


@pytest.fixture(scope="module")
def noisy():
    return Simulator(SimulateOptions(moves=1, noise_seed=3))


@pytest.fixture(scope="module")
def driven(noisy):
    return np.array([name not in ("R_aie", "L_aie") for name in noisy.joint_names])


@pytest.fixture(scope="module")
def errors(noisy):
    """Reading minus truth of the first instants of a run, per sensor."""
    ideal = Simulator(SimulateOptions(moves=1, ideal=True))
    pairs = [(noisy.step(), ideal.step()) for _ in range(SAMPLES)]
    names = [field.name for field in dataclasses.fields(pairs[0][0])]
    return {
        name: np.array([getattr(reading, name) - getattr(truth, name) for reading, truth in pairs])
        for name in names
    }


def test_each_sensor_has_its_configured_noise(errors, driven):
    noise = load_noise(config_file("noise.yaml"))
    expected = {
        "joint_position": (errors["joint_position"], noise.joint_position),
        "joint_velocity": (errors["joint_velocity"], noise.joint_velocity),
        "joint_effort": (errors["joint_effort"][:, driven], noise.joint_effort),
        "angular_velocity": (errors["imu_angular_velocity"], noise.angular_velocity),
        "linear_acceleration": (errors["imu_linear_acceleration"], noise.linear_acceleration),
        "force": (errors["wrenches"][:, :, :3], noise.force),
        "moment": (errors["wrenches"][:, :, 3:], noise.moment),
    }
    for name, (error, sigma) in expected.items():
        channels = error.reshape(SAMPLES, -1)
        # Six standard errors of a standard deviation, of a mean, and of a correlation.
        assert np.abs(channels.std(axis=0) / sigma - 1).max() < 6 / np.sqrt(2 * SAMPLES), name
        assert np.abs(channels.mean(axis=0)).max() < 6 * sigma / np.sqrt(SAMPLES), name
        white = (channels[1:] * channels[:-1]).mean(axis=0) / sigma**2
        assert np.abs(white).max() < 6 / np.sqrt(SAMPLES), name


def test_channels_are_independent(errors):
    channels = np.hstack(
        [
            errors["joint_position"],
            errors["joint_velocity"],
            errors["wrenches"].reshape(SAMPLES, -1),
        ]
    )
    correlation = np.corrcoef(channels.T) - np.eye(channels.shape[1])
    assert np.abs(correlation).max() < 6 / np.sqrt(SAMPLES)


def test_orientation_and_undriven_efforts_have_no_noise(errors, driven):
    assert not errors["imu_orientation"].any()
    assert not errors["joint_effort"][:, ~driven].any()


def test_noise_does_not_influence_the_motion(errors):
    truths = [name for name in errors if name.startswith(("true_", "base_"))]
    assert len(truths) == 10
    for name in truths:
        assert not errors[name].any(), name


def test_zero_noise_gives_an_ideal_sensor(tmp_path):
    path = noise_file(tmp_path, joint_effort=0)
    instant = Simulator(SimulateOptions(moves=1, noise=path)).step()
    np.testing.assert_array_equal(instant.joint_effort, instant.true_effort)


@pytest.mark.parametrize("factor", [0.0, 0.25, 3.0])
def test_factor_multiplies_the_noise(factor):
    """The random numbers stay the same, so the errors are multiples of each other."""
    options = SimulateOptions(moves=1, noise_seed=3)
    scaled = Simulator(options, noise_factor=factor).step()
    plain, ideal = (
        Simulator(dataclasses.replace(options, ideal=is_ideal)).step() for is_ideal in (False, True)
    )
    for name in NOISY:
        true = getattr(ideal, name)
        np.testing.assert_allclose(
            getattr(scaled, name) - true, factor * (getattr(plain, name) - true), atol=1e-12
        )
    np.testing.assert_array_equal(scaled.true_acceleration, ideal.true_acceleration)


@pytest.mark.parametrize("factor", [-0.1, float("nan"), float("inf")])
def test_invalid_factors_raise_an_error(factor):
    with pytest.raises(SimulationError, match=r"^noise factor") as caught:
        Simulator(SimulateOptions(moves=1), noise_factor=factor)
    assert caught.value.code == "E605"


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"force": "gone"}, "force missing"),
        ({"forse": 1.0}, "unknown entry forse"),
        ({"force": -1.0}, "force is -1.0"),
        ({"force": float("nan")}, "force is nan"),
        ({"force": float("inf")}, "force is inf"),
        ({"force": "much"}, "force is 'much'"),
        ({"force": True}, "force is True"),
        ({"force": None}, "force is None"),
    ],
)
def test_invalid_values_are_named(tmp_path, changes, message):
    path = noise_file(tmp_path, **changes)
    with pytest.raises(SimulationError) as caught:
        load_noise(path)
    assert str(path) in str(caught.value)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "code"),
    [("force: [1", "E603"), ("- 1\n- 2\n", "E604"), ("", "E604")],
)
def test_files_without_a_mapping_raise_an_error(tmp_path, content, code):
    path = tmp_path / "noise.yaml"
    path.write_text(content)
    with pytest.raises(SimulationError) as caught:
        load_noise(path)
    assert caught.value.code == code
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_file_is_named(tmp_path):
    with pytest.raises(SimulationError, match=r"absent\.yaml") as caught:
        load_noise(tmp_path / "absent.yaml")
    assert caught.value.code == "E603"
