"""Folders of results of any robot without an identification: drawn numbers in its own file."""

from dataclasses import replace
from pathlib import Path

from drawn_estimates import drawn_estimate

from symbid_ros.choices import Base
from symbid_ros.estimation.estimate_file import write_estimate
from symbid_ros.estimation.prior import draw_prior
from symbid_ros.estimation.provenance import InputFile, Provenance
from symbid_ros.identification.result_files import export_mjcf, export_urdf
from symbid_ros.model.load import is_mjcf, load_model
from symbid_ros.model.parameters import ParameterSet
from symbid_ros.model.tree import RobotModel

PROVENANCE = Provenance(
    inputs=(InputFile("my_bag/my_bag_0.mcap", "ab" * 32, 9), InputFile("a.urdf", "cd" * 32, 9)),
    command="symbid identify my_bag --model a.urdf",
    date="2026-03-01T12:00:00+00:00",
)


def write_result(folder: Path, source: Path, seed: int = 0, base: Base = "auto") -> RobotModel:
    """Write a result whose links differ from the file's by up to 25 %; return the robot."""
    model = load_model(source, base)
    parameters, estimate = drawn_estimate(model, seed)
    values = draw_prior(ParameterSet(model), "consistent", 25, seed).mean
    estimate = replace(
        estimate,
        value=values,
        model_file="model.xml" if is_mjcf(source) else "model.urdf",
        base="floating" if model.floating else "fixed",
        provenance=PROVENANCE,
    )
    folder.mkdir()
    write_estimate(folder / "estimate.json", estimate)
    (folder / "model.urdf").write_text(export_urdf(estimate, parameters))
    for place, text in export_mjcf(estimate, parameters, folder).items():
        (folder / place).parent.mkdir(parents=True, exist_ok=True)
        (folder / place).write_text(text)
    return parameters.apply(values)
