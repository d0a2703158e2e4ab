"""A user's mistake ends with one helpful line and leaves earlier files unchanged."""

import json
import re
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from symbid_ros.cli.main import main
from symbid_ros.estimation.archive import write_archive
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import model_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.package_paths import config_file
from symbid_ros.signals.weak_form import WINDOWS
from symbid_ros.simulation.options import SimulateOptions
from symbid_ros.simulation.recording import record
from symbid_ros.simulation.simulator import Simulator

Refusal = Callable[..., str]

PENDULUM = """
<robot name="pendulum">
  <link name="world"/>
  <link name="rod">
    <inertial>
      <origin xyz="0 0 -0.5"/> <mass value="2"/>
      <inertia ixx="0.2" iyy="0.2" izz="0.01" ixy="0" ixz="0" iyz="0"/>
    </inertial>
  </link>
  <joint name="hinge" type="continuous">
    <parent link="world"/> <child link="rod"/> <axis xyz="0 1 0"/>
  </joint>
</robot>
"""


@pytest.fixture
def good(model, short, tmp_path) -> dict[str, object]:
    return {"bag": short, "model": model, "out": tmp_path / "out"}


@pytest.fixture
def fails(monkeypatch, capfd, caplog) -> Refusal:
    """Run the command in this process; return its one line on stderr."""

    def run(*words: str, **given: object) -> str:
        arguments = [given.pop("bag")] if "bag" in given else []
        for name, value in given.items():
            values = value if isinstance(value, tuple) else (value,)
            arguments += [f"--{name.replace('_', '-')}", *values]
        monkeypatch.setattr(sys, "argv", ["symbid", "identify", *map(str, arguments)])
        with pytest.raises(SystemExit) as ended:
            main()
        out, err = capfd.readouterr()
        assert ended.value.code == 2, err
        assert (out, caplog.messages) == ("", [])
        assert err.startswith("symbid: ")
        assert err.count("\n") == 1, err
        for word in words:
            assert word in err
        assert not Path(str(given.get("out"))).exists()
        return err

    return run


def test_a_missing_bag(fails, good) -> None:
    fails("nowhere", **good | {"bag": "nowhere"})


def test_a_file_that_is_not_a_bag(fails, good, tmp_path) -> None:
    (tmp_path / "notes.mcap").write_text("not a bag")
    fails("notes.mcap", **good | {"bag": tmp_path / "notes.mcap"})


def test_a_missing_model(fails, good) -> None:
    fails("nowhere.urdf", **good | {"model": "nowhere.urdf"})


@pytest.mark.parametrize(
    "command",
    [
        ("identify", "BAG", "--out", "OUT", "--model"),
        ("identify", "BAG", "--out", "OUT", "--unchecked", "--model"),
        ("bag", "doctor", "BAG", "--model"),
        ("init", "--bag", "BAG", "--out", "OUT", "--model"),
        ("evaluate", "OUT", "--bag", "BAG", "--truth"),
        ("excite", "--base", "fixed", "--out", "OUT", "--model"),
    ],
    ids=" ".join,
)
def test_a_model_without_any_inertia(symbid_here, short, tmp_path, command) -> None:
    bare = tmp_path / "visual.urdf"
    text = config_file("symbitron.urdf").read_text()
    bare.write_text(re.sub("<inertial>.*?</inertial>", "", text, flags=re.DOTALL))
    paths = {"BAG": short, "OUT": tmp_path / "out"}
    ended = symbid_here(*(paths.get(word, word) for word in command), bare)
    assert ended.returncode == 2
    (line,) = ended.stderr.splitlines()
    assert line.startswith(f"symbid: {bare}: the model has no mass; give each moving link")
    assert not paths["OUT"].exists()


def test_a_model_with_other_joints(fails, good, model, tmp_path) -> None:
    other = tmp_path / "other.xml"
    other.write_text(model.read_text().replace("R_kfe", "R_knee"))
    fails("R_knee", "--rename-joint", **good | {"model": other})


def test_a_prior_of_another_model(fails, good, tmp_path) -> None:
    prior = {"model": "other", "kind": "percent", "seed": 0, "parameters": {}}
    prior["parameters"]["trunk/m"] = {"value": 1.0, "std": 0.1}
    (tmp_path / "prior.json").write_text(json.dumps(prior))
    fails("prior.json", "other", **good | {"prior": tmp_path / "prior.json"})


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"prior_percent": -3}, "--prior-percent"),
        ({"prior_percent": 0}, "--prior-percent: 0.0 is not valid; give a number (%) above 0"),
        ({"prior_absolute": "nan"}, "--prior-absolute"),
        ({"prior_percent": 5, "prior_absolute": 0.1}, "give only one of --prior, --prior-percent"),
        ({"total_mass": -41}, "--total-mass"),
        (
            {"total_mass": 41, "total_mass_std": 0},
            "--total-mass-std: 0.0 is not valid; give a number (kg) above 0",
        ),
        ({"total_mass": 60, "prior_percent": 5}, "60 kg contradicts the prior, whose links weigh"),
        ({"mirror": 0}, "--mirror: 0.0 is not valid; give a number above 0"),
        ({"sensor_errors": "wrench_offse"}, "'wrench_offse' is not known; give typical"),
        ({"sensor_errors": "typical", "filter": "butterworth"}, "leave --filter out"),
        ({"rank": 5, "choose_truncation": "log"}, "--rank and --choose-truncation both choose"),
        ({"select_by": "torque"}, "--select-by has no effect without --choose-truncation"),
        ({"rank": 0}, "--rank"),
        ({"rank": 5}, "map_lmi truncates no singular values"),
        ({"method": "map", "sensor_std": (0.1, 1, 0.1)}, "map truncates no singular values"),
        ({"method": "ols", "total_mass": 41}, "ols supports neither"),
        ({"total_mass_std": 0.1}, "has no effect without --total-mass"),
        ({"sensor_errors": ","}, "--sensor-errors is empty"),
        ({"cutoff": 20}, "weak has neither --cutoff nor --channels"),
        ({"method": "wls_rc", "cutoff": 0.05}, "too short for this filter"),
        ({"filter": "savitzky_golay", "channels": "thesis"}, "has neither --cutoff nor --channels"),
        ({"filter": "butterworth", "window": 0.1}, "butterworth has no --window"),
        ({"window": 0}, "--window: 0.0 is not valid; give a number (s) above 0"),
        ({"window": "nan"}, "--window"),
        ({"window": 60}, "long enough for a window of 60000 ms"),
        ({"filter": "savitzky_golay", "window": 60}, "record longer"),
        ({"filter": "butterworth", "cutoff": 500}, "not below half the rate of 1000 Hz"),
        ({"filter": "butterworth", "cutoff": 0.05}, "too short for this filter"),
        ({"method": "wls_r", "sensor_std": (0.1, 0, 0.1)}, "must all be positive"),
        ({"method": "guess"}, "--method"),
    ],
    ids=lambda value: " ".join(map(str, value.items())) if isinstance(value, dict) else "",
)
def test_an_invalid_option(fails, good, given, says) -> None:
    fails(says, **good | given)


@pytest.mark.parametrize("std", [0, -0.1, float("nan")])
def test_an_invalid_prior(fails, good, model, tmp_path, std) -> None:
    path = tmp_path / "prior.json"
    parameters = ParameterSet(load_model(model))
    write_prior(path, model_prior(parameters))
    prior = json.loads(path.read_text())
    name = parameters.names[7]
    prior["parameters"][name]["std"] = std
    path.write_text(json.dumps(prior))
    fails("prior.json", name, "standard deviation positive", **good | {"prior": path})


def test_missing_information(fails, good, tmp_path) -> None:
    path = tmp_path / "information.npz"
    fails("information.npz", "cannot read it", **good | {"information": path})


def test_information_that_is_not_an_archive(fails, good, model) -> None:
    said = fails("not an information.npz", **good | {"information": model})
    assert "pickle" not in said, "advice to load what nobody should load"


def test_information_about_another_robot(fails, good, tmp_path) -> None:
    (tmp_path / "pendulum.urdf").write_text(PENDULUM)
    layout = RowLayout.of(ParameterSet(load_model(tmp_path / "pendulum.urdf", "fixed")))
    path = tmp_path / "information.npz"
    write_archive(path, [Observations.empty(layout, window) for window in WINDOWS])
    fails("information.npz", "another robot", **good | {"information": path})


def test_a_tare_without_wrenches(fails, good, copied_without, tmp_path) -> None:
    bag = copied_without(good["bag"], tmp_path / "blank", "foot")
    fails("blank", "no unloaded wrench sensor", **good | {"tare": bag})


def test_a_tare_for_a_log_without_wrenches(fails, good, copied_without, tmp_path) -> None:
    bag = copied_without(good["bag"], tmp_path / "afloat", "foot")
    fails("afloat", "do not balance the model's weight", **good | {"bag": bag, "tare": good["bag"]})


def test_a_total_mass_with_a_truncated_method(fails, good) -> None:
    fails("use --method map or map_lmi", **good | {"method": "wls_rc", "total_mass": 41})


def test_a_rank_larger_than_the_log_supports(fails, good) -> None:
    fails("rank 1000", "--rank 1000 exceeds", **good | {"method": "ols", "rank": 1000})


def test_an_unknown_topic(fails, good) -> None:
    fails("/absent", **good | {"imu_topic": "/absent"})


def test_a_topic_that_was_not_recorded(fails, good, copied_without, tmp_path) -> None:
    bag = copied_without(good["bag"], tmp_path / "blind", "imu")
    fails("blind", "Imu", **good | {"bag": bag})


def test_a_forgotten_force_plate(fails, good, copied_without, tmp_path) -> None:
    """Its bag reads well, but the forces in it do not carry the robot."""
    bag = copied_without(good["bag"], tmp_path / "limping", "left_foot")
    fails("limping", "right_sole", "do not balance the model's weight", **good | {"bag": bag})


def test_earlier_files_stay_unchanged(symbid_here, good) -> None:
    out = good["out"]
    out.mkdir()
    (out / "estimate.json").write_text("of yesterday")
    (out / "thesis.txt").write_text("years of work")
    bad = symbid_here("identify", "nowhere", "--model", good["model"], "--out", out, "--overwrite")
    assert bad.returncode == 2
    assert bad.stderr.startswith("symbid: nowhere")
    assert bad.stderr.count("\n") == 1
    assert (out / "estimate.json").read_text() == "of yesterday"
    words = ("identify", good["bag"], "--model", good["model"], "--out", out)
    words += ("--joint-terms", "none", "--no-holdout")
    refused = symbid_here(*words)
    assert refused.returncode == 2
    assert "holds an earlier estimate.json; choose another --out, or give --o" in refused.stderr
    assert [path.name for path in out.iterdir()].count("model.urdf") == 0
    written = symbid_here(*words, "--overwrite")
    assert written.returncode == 0
    assert (out / "thesis.txt").read_text() == "years of work"
    again = symbid_here("simulate", "--out", good["bag"])
    assert again.returncode == 2
    assert again.stderr.count("\n") == 1


def test_nan_and_infinite_values(fails, good, tmp_path) -> None:
    class Faulty(Simulator):
        def step(self):
            instant = super().step()
            if self._steps_done > 400:
                instant.joint_position[2] = float("nan")
            return instant

    faulty = Faulty(SimulateOptions("smooth", moves=1, motion_seed=3))
    faulty.steps = 1000
    record(faulty, tmp_path / "faulty")
    fails("joint_states", "R_kfe", **good | {"bag": tmp_path / "faulty"})


@pytest.mark.parametrize("columns", [40, 200])
@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["identify", "log"], "Missing option '--out'; see `symbid identify --help`"),
        (["simulate", "--out", "bag", "--moves", 0], "'--moves'"),
        (["identify", "log", "--rank", "x"], "'--rank': it is not a valid integer; see"),
        (["identify", "log", "--rank", "0"], "'--rank': it should be greater than or equal to 1"),
        (["identify", "log", "--method", "x"], "'--method': 'x' is not one of 'map_lmi'"),
        (["identify", "log", "--gravity", "1"], "3 arguments; see `symbid identify --help`"),
        (["dance"], "No such command 'dance'; see `symbid --help`"),
        (["doctor", "log"], "No such command 'doctor'; give `symbid bag doctor`"),
    ],
)
def test_a_usage_error_is_one_line_at_any_width(symbid_here, arguments, says, columns) -> None:
    ended = symbid_here(*arguments, columns=columns)
    assert ended.returncode == 2
    assert ended.stderr.startswith("symbid: ")
    assert ended.stderr.count("\n") == 1
    assert says in ended.stderr


def test_no_arguments_show_the_help(symbid) -> None:
    ended = symbid()
    assert ended.stderr == ""
    assert "identify" in ended.stdout
