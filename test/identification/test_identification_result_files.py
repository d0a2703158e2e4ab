"""What was found is not lost, whatever goes wrong when it is written."""

import tempfile
from pathlib import Path

import pytest
from random_logs import LogPlan, random_streams, small_robot, write_bag

from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.estimation.archive import load_archive
from symbid_ros.estimation.estimate import load_estimate
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.result_files import check_output, write_identification
from symbid_ros.identification.solver import Identification
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest

MISSING = Path("missing")


@pytest.fixture(scope="module", params=["robot.urdf", "robot.xml"])
def arm(request, tmp_path_factory) -> tuple[Path, Path]:
    """Return a robot's file and a log of it."""
    folder = tmp_path_factory.mktemp("arm")
    robot = small_robot(1, floating=False, links=2)
    path = folder / request.param
    path.write_text(urdf_text(robot) if path.suffix == ".urdf" else mjcf_text(robot))
    plan = LogPlan(100.0, 800, 1_723_456_789_012_345_678)
    log = write_bag(random_streams(load_model(path, "auto"), plan, 1), folder / "log")
    return path, log


@pytest.fixture
def found(arm, tmp_path) -> tuple[Identification, ParameterSet]:
    """Return a result whose model file the test may spoil."""
    model = tmp_path / arm[0].name
    model.write_text(arm[0].read_text())
    prepared = BagRequest((arm[1],), model).load(tmp_path / "out")
    assert not (tmp_path / "out").exists(), "the check leaves nothing behind"
    return prepared.solve("map"), prepared.parameters


def test_a_model_file_that_is_gone_does_not_cost_the_estimate(found, tmp_path) -> None:
    identification, parameters = found
    out = tmp_path / "out"
    Path(parameters.model.source).unlink()
    with pytest.raises(EstimateError, match=r"not written: model\.urdf, model\.xml$") as refused:
        write_identification(identification, parameters, out)
    assert "\n" not in str(refused.value)
    assert load_estimate(out / "estimate.json").value.tolist()
    assert load_archive(out / "information.npz")


def test_a_folder_that_is_gone_does_not_cost_the_estimate(found, tmp_path, monkeypatch) -> None:
    spare = tmp_path / "spare"
    spare.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(spare))
    (tmp_path / "out").write_text("a file has taken its place")
    with pytest.raises(EstimateError, match=r"written to .*/spare/symbid_.* instead") as refused:
        write_identification(*found, tmp_path / "out")
    assert "\n" not in str(refused.value)
    (folder,) = spare.iterdir()
    assert load_estimate(folder / "estimate.json").value.tolist()
    assert load_archive(folder / "information.npz")


def test_a_folder_that_cannot_be_is_refused_before_any_bag_is_read(arm, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out", tmp_path / ("long" * 100)):
        with pytest.raises(SymbidError, match="cannot write"):
            BagRequest((MISSING,), arm[0]).load(out)


def test_what_is_read_last_is_looked_at_first(arm, tmp_path) -> None:
    model, _ = arm

    def load(**options) -> None:
        BagRequest((MISSING,), model, IdentifyOptions(**options)).load()

    with pytest.raises(SymbidError, match="gone"):
        load(method="ols", validate=tmp_path / "gone")
    with pytest.raises(SymbidError, match=r"gone\.npz"):
        load(information=tmp_path / "gone.npz")
    with pytest.raises(SymbidError, match="`rank` 500 exceeds"):
        load(method="ols", rank=500)
    with pytest.raises(SymbidError, match="missing"):
        load()
    check_output(ParameterSet(load_model(model)), tmp_path / "deep" / "er")
    assert not (tmp_path / "deep").exists()
