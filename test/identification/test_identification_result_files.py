"""Files of a result are written whatever fails, and read in the order of the model."""

import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from random_logs import LogPlan, random_streams, small_robot, write_bag
from random_robots import random_robot

from symbid_ros.errors import EstimateError, SymbidError
from symbid_ros.estimation.archive import load_archive, write_archive
from symbid_ros.estimation.estimate import Estimate
from symbid_ros.estimation.estimate_file import load_estimate, write_estimate
from symbid_ros.estimation.observations import Observations
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.prior_file import write_prior
from symbid_ros.estimation.row_layout import RowLayout
from symbid_ros.identification import result_files
from symbid_ros.identification.identification import Identification
from symbid_ros.identification.installation import inertials_yaml, install
from symbid_ros.identification.options import IdentifyOptions
from symbid_ros.identification.predictions.predictor import ForcePredictor
from symbid_ros.identification.result_files import (
    check_output,
    load_estimated_model,
    write_identification,
)
from symbid_ros.model.coupling import Coupling
from symbid_ros.model.export_mjcf import mjcf_text
from symbid_ros.model.export_urdf import urdf_text
from symbid_ros.model.load import load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.offline.bags import BagRequest

MISSING = Path("missing")
TERMS = ("viscous", "offset")


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
    """Return a result whose model file the test may delete."""
    model = tmp_path / arm[0].name
    model.write_text(arm[0].read_text())
    prepared = BagRequest((arm[1],), model).load(tmp_path / "out")
    assert not (tmp_path / "out").exists(), "the check leaves nothing behind"
    return prepared.solve("map"), prepared.parameters


@pytest.fixture
def spare(tmp_path, monkeypatch) -> Path:
    """Return the folder of temporary folders."""
    folder = tmp_path / "spare"
    folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    return folder


def test_the_estimate_is_written_elsewhere_if_the_model_file_is_gone(
    found, spare, tmp_path
) -> None:
    identification, parameters = found
    out = tmp_path / "out"
    Path(parameters.model.source).unlink()
    with pytest.raises(EstimateError, match=r"not written: model\.urdf, model\.xml$") as caught:
        write_identification(identification, parameters, out)
    assert "\n" not in str(caught.value)
    assert caught.value.code == "E522"
    assert not out.exists()
    (folder,) = spare.iterdir()
    assert load_estimate(folder / "estimate.json").value.tolist()
    assert load_archive(folder / "information.npz")


def test_a_failure_leaves_no_mixture_of_two_results(found, spare, tmp_path, monkeypatch) -> None:
    identification, parameters = found
    out = tmp_path / "out"
    written = write_identification(identification, parameters, out)
    before = {path.name: path.read_bytes() for path in out.iterdir()}
    estimate = replace(identification.estimate, value=1.5 * identification.estimate.value)

    def full(path: Path, *_: object) -> None:
        if out in path.parents:
            raise EstimateError(f"{path}: cannot write (No space left on device)", "E552")

    monkeypatch.setattr(result_files, "write_archive", full)
    with pytest.raises(EstimateError, match="No space left") as caught:
        write_identification(replace(identification, estimate=estimate), parameters, out)
    assert {path.name: path.read_bytes() for path in out.iterdir()} == before
    (folder,) = spare.iterdir()
    assert {path.name for path in folder.iterdir()} == {*written} - {"information.npz"}
    np.testing.assert_allclose(load_estimate(folder / "estimate.json").value, estimate.value)
    assert all(str(caught.value).count(f" {name}") == 1 for name in ("model.urdf", "model.xml"))


def test_a_warning_about_many_links_names_the_first(found, tmp_path, caplog, monkeypatch) -> None:
    monkeypatch.setattr(result_files, "MOST_NAMED", 1)
    identification, parameters = found
    first, *rest = identification.estimate.consistent
    impossible = dict.fromkeys((first, *rest), False)
    estimate = replace(identification.estimate, consistent=impossible)
    write_identification(replace(identification, estimate=estimate), parameters, tmp_path / "out")
    assert f"other programs may refuse: {first} and {len(rest)} more" in caplog.text


def test_a_result_with_a_negative_mass_is_read(found, tmp_path, caplog) -> None:
    """Least squares without a constraint finds such results, which can be compared all the same."""
    identification, parameters = found
    estimate = identification.estimate
    value = estimate.value.copy()
    link = parameters.model.link_names[-1]
    value[parameters.names.index(f"{link}/m")] = -0.25
    consistent = estimate.consistent | {link: False}
    changed = replace(estimate, value=value, consistent=consistent)
    write_identification(replace(identification, estimate=changed), parameters, tmp_path / "out")
    assert f"model.urdf: impossible bodies, which other programs may refuse: {link}" in caplog.text
    predictor = ForcePredictor.load(tmp_path / "out")
    np.testing.assert_allclose(predictor.unknowns[: len(value)], value)
    if Path(parameters.model.source).suffix == ".urdf":
        with pytest.raises(SymbidError, match=f"identified mass of {link} is negative"):
            install(tmp_path / "out", Path(parameters.model.source), tmp_path / "new.urdf")
    with pytest.raises(SymbidError, match=f"identified mass of {link} is negative"):
        inertials_yaml(tmp_path / "out")


def test_the_estimate_is_written_elsewhere_if_the_folder_is_gone(found, spare, tmp_path) -> None:
    (tmp_path / "out").write_text("a file has taken its place")
    with pytest.raises(EstimateError, match=r"written to .*/spare/symbid_.* instead") as caught:
        write_identification(*found, tmp_path / "out")
    assert "\n" not in str(caught.value)
    assert caught.value.code == "E522"
    (folder,) = spare.iterdir()
    assert load_estimate(folder / "estimate.json").value.tolist()
    assert load_archive(folder / "information.npz")


def test_the_output_folder_is_checked_before_any_bag_is_read(arm, tmp_path) -> None:
    (tmp_path / "file").write_text("")
    for out in (tmp_path / "file", tmp_path / "file" / "out", tmp_path / ("long" * 100)):
        with pytest.raises(SymbidError, match="cannot write"):
            BagRequest((MISSING,), arm[0]).load(out)


def test_options_and_files_are_checked_before_the_log_is_read(arm, tmp_path) -> None:
    model, _ = arm

    def load(**options) -> None:
        BagRequest((MISSING,), model, IdentifyOptions(**options)).load()

    with pytest.raises(SymbidError, match="gone"):
        load(method="ols", choose_truncation=tmp_path / "gone")
    with pytest.raises(SymbidError, match=r"gone\.npz"):
        load(information=tmp_path / "gone.npz")
    with pytest.raises(SymbidError, match="`rank` 500 exceeds"):
        load(method="ols", rank=500)
    with pytest.raises(SymbidError, match="missing"):
        load()
    check_output(ParameterSet(load_model(model)), tmp_path / "deep" / "er")
    assert not (tmp_path / "deep").exists()


@pytest.fixture
def parameters():
    return ParameterSet(random_robot(4, links=3), TERMS)


@pytest.fixture
def estimate(parameters):
    p = len(parameters)
    return Estimate(
        method="map",
        model=parameters.model.name,
        names=parameters.names,
        units=parameters.units,
        value=np.arange(p) + 0.5,
        prior=np.arange(p) + 0.25,
        std=np.arange(p) + 1.0,
        determined=np.arange(p) % 3 == 0,
        rank=None,
        condition=1.0,
        samples=7,
        residual_rmse={},
        consistent=dict.fromkeys(parameters.link_names, True),
        inputs=(),
        software="test",
    )


def write(estimate, parameters, folder, factor):
    write_estimate(folder / "estimate.json", estimate)
    observations = Observations.empty(RowLayout.of(parameters), 0.1)
    write_archive(folder / "information.npz", [observations], factor)


def test_values_are_read_in_the_order_of_the_model(parameters, estimate, tmp_path):
    rng = np.random.default_rng(0)
    order = rng.permutation(len(parameters))
    factor = rng.normal(size=(len(order), 5))
    shuffled = replace(
        estimate,
        names=tuple(estimate.names[i] for i in order),
        units=tuple(estimate.units[i] for i in order),
        value=estimate.value[order],
        prior=estimate.prior[order],
        std=estimate.std[order],
        determined=estimate.determined[order],
    )
    write(shuffled, parameters, tmp_path, factor[order])
    found = load_estimated_model(tmp_path, parameters.model)
    assert found.parameters.names == parameters.names
    assert found.estimate.names == estimate.names
    assert found.estimate.units == estimate.units
    for name in ("value", "prior", "std", "determined"):
        np.testing.assert_array_equal(getattr(found.estimate, name), getattr(estimate, name))
    np.testing.assert_array_equal(found.values, estimate.value)
    np.testing.assert_array_equal(found.deviation_factor, factor)


def test_an_estimate_without_covariance_has_none(parameters, estimate, tmp_path):
    write(replace(estimate, std=None, determined=None), parameters, tmp_path, None)
    assert load_estimated_model(tmp_path, parameters.model).deviation_factor is None
    alone = load_estimated_model(tmp_path / "estimate.json", parameters.model)
    assert (alone.deviation_factor, alone.estimate.std) == (None, None)


def test_a_covariance_of_other_parameters_is_refused(parameters, estimate, tmp_path):
    write(estimate, parameters, tmp_path, np.ones((3, 3)))
    with pytest.raises(EstimateError, match=r"information\.npz") as caught:
        load_estimated_model(tmp_path, parameters.model)
    assert caught.value.code == "E523"


def test_a_prior_has_values_only(parameters, tmp_path):
    links = ParameterSet(parameters.model)
    prior = draw_prior(links, "percent", 10, 1)
    write_prior(tmp_path / "prior.json", prior)
    found = load_estimated_model(tmp_path / "prior.json", parameters.model)
    np.testing.assert_array_equal(found.values, prior.mean)
    assert (found.estimate, found.deviation_factor) == (None, None)
    assert found.parameters.names == links.names


def test_another_robot_is_refused(parameters, estimate, tmp_path):
    write_estimate(tmp_path / "estimate.json", estimate)
    with pytest.raises(EstimateError, match=r"estimate\.json") as caught:
        load_estimated_model(tmp_path, random_robot(4, links=4))
    assert caught.value.code == "E512"


def test_another_robot_is_named_before_its_joints(parameters, estimate, tmp_path):
    coupling = Coupling.of(parameters.model, (0, 1), (1.0, 1.0))
    coupled = replace(parameters, couplings=(coupling,))
    zero = np.zeros(len(coupled))
    estimate = replace(
        estimate,
        names=coupled.names,
        units=coupled.units,
        value=zero,
        prior=zero,
        std=zero,
        determined=zero > 0,
    )
    write_estimate(tmp_path / "estimate.json", estimate)
    with pytest.raises(EstimateError, match="is not the robot of") as caught:
        load_estimated_model(tmp_path, random_robot(4, links=4))
    assert caught.value.code == "E512"
