"""Write the identified parameters of a result into the user's own robot file, or as YAML."""

import logging
import os
import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import yaml

from symbid_ros.atomic_write import write_text
from symbid_ros.choices import JOINT_TERMS, Base
from symbid_ros.errors import EstimateError, ModelError
from symbid_ros.estimation.estimate import MODEL_FILES, Estimate
from symbid_ros.estimation.estimate_file import load_estimate
from symbid_ros.model.export_mjcf import updated_mjcf
from symbid_ros.model.export_urdf import UNWRITTEN, urdf_text, with_nonnegative_terms
from symbid_ros.model.inertia import com_from_phi
from symbid_ros.model.load import is_mjcf, load_model
from symbid_ros.model.mjcf import load_mjcf
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.model.urdf import UrdfReader, load_urdf
from symbid_ros.model.wrist_sensors import (
    sensor_frame,
    with_wrist_sensors,
    without_wrist_sensors,
)
from symbid_ros.model.xml_file import MAX_BYTES, is_editable, read_bytes, read_xml, with_comment

logger = logging.getLogger(__name__)

# Differences of placements below this come from rounding in a text file, m and rad.
PLACEMENT = 1e-6
# The same of parameters that are read back, relative to the largest of their kind.
READ_BACK = 1e-9
MARK = "symbid_ros:"
TERMS = ("damping", "friction_loss", "armature", "stiffness")


@dataclass(frozen=True)
class Installation:
    """Files that were written.

    Attributes
    ----------
    files : tuple of Path
        The robot's file, then the files that it includes and that changed.
    backups : tuple of Path
        Copies of the files that were replaced.
    """

    files: tuple[Path, ...]
    backups: tuple[Path, ...]


def install(folder: Path, robot: Path, out: Path | None = None) -> Installation:
    """Write the identified parameters of a result into a URDF or MJCF.

    Everything else in the file stays as it is. A comment says where the numbers come from. The file
    is read again afterwards; if it does not hold these parameters, the earlier one is restored.

    Parameters
    ----------
    folder : Path
        Folder of the result.
    robot : Path
        The user's file, of the robot that was identified.
    out : Path, optional
        File to write instead of ``robot``, of which a copy named ``.orig`` is kept otherwise.

    Raises
    ------
    SymbidError
        When a file is invalid, cannot be written, or is of another robot.
    """
    estimate = load_estimate(folder / "estimate.json")
    target = robot.resolve() if out is None else out
    wanted = identified_robot(folder, robot, estimate)
    texts = _texts(wanted, robot, target, in_place=out is None)
    first = next(iter(texts))
    texts[first] = with_comment(robot, texts[first], MARK, provenance_comment(estimate))
    changed = {path: text for path, text in texts.items() if not _holds(path, text)}
    backups = {path: _backed_up(path) for path in changed if path.exists() and out is None}
    try:
        # The included files first: a robot that is killed half-way still has its old main file.
        for path, text in reversed(changed.items()):
            write_text(path, text)
            if path in backups:
                shutil.copymode(backups[path], path)
        _require_parameters(target, wanted)
    except BaseException:
        for path in changed:
            if path in backups:
                shutil.move(backups[path], path)
            elif out is not None:
                path.unlink(missing_ok=True)
        raise
    if lost := unheld_terms(estimate, is_mjcf(target)):
        logger.warning(
            "%s: the format cannot hold %s; estimate.json has them", target, ", ".join(lost)
        )
    return Installation(tuple(changed), tuple(backups.values()))


def unheld_terms(estimate: Estimate, mjcf: bool) -> tuple[str, ...]:
    """Return the kinds of identified joint terms that a format cannot hold."""
    values = dict(zip(estimate.names, estimate.value.tolist(), strict=True))
    kinds = {
        name.rpartition("/")[2]
        for name, value in values.items()
        if value and name not in estimate.fixed
    }
    return tuple(
        term
        for term, traits in JOINT_TERMS.items()
        if term in kinds and (traits.field is None or (traits.field in UNWRITTEN and not mjcf))
    )


def identified_robot(folder: Path, robot: Path, estimate: Estimate) -> RobotModel:
    """Return the robot of the user's file with the identified parameters.

    Raises
    ------
    EstimateError
        When its links or joints are not those of the result.
    """
    base, mjcf = estimate.base_option, is_mjcf(robot)
    source = load_model(robot, base)
    file = folder / MODEL_FILES[mjcf]
    if not mjcf:
        _refuse_negative_masses(folder, estimate)
    try:
        found = load_mjcf(file, base) if mjcf else load_urdf(file, base)
    except ModelError as error:
        raise EstimateError(
            f"{folder}: its model cannot be read ({error}); identify the log again", "E527"
        ) from None
    source, found = (_divided(one, estimate.wrist_sensors) for one in (source, found))
    if reason := _difference(source, found):
        raise EstimateError(
            f"{robot}: not the robot of {folder}: {reason}; give the file that was identified, or "
            "identify this one",
            "E575",
        )
    phi = {link.name: link.phi for link in found.links}
    terms = {joint.name: joint for joint in found.joints}
    kept = TERMS if mjcf else TERMS[:2]  # a URDF has neither armature nor springs
    joints = tuple(
        replace(joint, **{term: getattr(terms[joint.name], term) for term in kept})
        for joint in source.joints
    )
    identified = source.with_phi(np.array([phi[name] for name in source.link_names]))
    return with_nonnegative_terms(replace(identified, joints=joints))


def _divided(model: RobotModel, sensors: Sequence[str]) -> RobotModel:
    """Return a robot divided at its wrist sensors, so that each payload keeps its own link."""
    known = {*model.link_names, *(frame.name for frame in model.frames)}
    return with_wrist_sensors(model, [one for one in sensors if sensor_frame(one) in known])


def _refuse_negative_masses(folder: Path, estimate: Estimate) -> None:
    values = zip(estimate.names, estimate.value.tolist(), strict=True)
    links = [name[: -len("/m")] for name, value in values if name.endswith("/m") and value < 0]
    if links:
        raise EstimateError(
            f"{folder}: the identified mass of {', '.join(links)} is negative, which no URDF may "
            "have; identify the log with `method` map_lmi",
            "E577",
        )


def _difference(one: RobotModel, other: RobotModel) -> str:
    """Return in what the links or joints of two robots differ; empty if in nothing."""
    for kind, names, others in (
        ("link", one.link_names, other.link_names),
        ("joint", one.joint_names, other.joint_names),
    ):
        if missing := sorted(set(others) - set(names)):
            return f"it has no {kind} {missing[0]!r}"
        if added := sorted(set(names) - set(others)):
            return f"the result has no {kind} {added[0]!r}"
    if one.floating != other.floating:
        return "one of them has a floating base"
    twins = {joint.name: joint for joint in other.joints}
    for joint in one.joints:
        twin = twins[joint.name]
        parents = one.link_names[joint.parent], other.link_names[twin.parent]
        if parents[0] != parents[1]:
            return f"joint {joint.name!r} is on link {parents[0]!r} instead of {parents[1]!r}"
        if not _is_placed_alike(joint, twin):
            return f"joint {joint.name!r} has another type, place or axis"
    return ""


def _is_placed_alike(one: Joint, other: Joint) -> bool:
    pairs = (
        (one.rotation, other.rotation),
        (one.translation, other.translation),
        (one.axis, other.axis),
        (np.array(one.reference), np.array(other.reference)),
    )
    is_near = all(np.abs(a - b).max() <= PLACEMENT for a, b in pairs)
    return one.kind == other.kind and is_near


def _texts(wanted: RobotModel, robot: Path, target: Path, *, in_place: bool) -> dict[Path, str]:
    """Return the files to write, the robot's own first."""
    folder = target.parent
    if not is_mjcf(robot):
        if is_editable(robot):
            return {target: urdf_text(wanted, robot)}
        reason = "it is in UTF-16; convert it to UTF-8"
    else:
        source = robot.resolve() if in_place else robot
        files = updated_mjcf(wanted, source, folder, target.name, in_place=in_place)
        if files is not None:
            return {folder / place: text for place, text in files.items()}
        reason = "it is in UTF-16, or its bodies come from <replicate>; use the result's model.xml"
    raise EstimateError(f"{robot}: cannot be edited: {reason}", "E577")


def _holds(path: Path, text: str) -> bool:
    return path.is_file() and read_bytes(path, MAX_BYTES) == text.encode(errors="surrogateescape")


def _backed_up(path: Path) -> Path:
    """Copy a file to the first free name among ``.orig``, ``.orig.1`` and so on."""
    backup, number = path.with_name(f"{path.name}.orig"), 0
    while os.path.lexists(backup):
        number += 1
        backup = path.with_name(f"{path.name}.orig.{number}")
    try:
        shutil.copy2(path, backup)
    except OSError as error:
        raise EstimateError(
            f"{backup}: cannot write the backup ({error.strerror}); give `out`", "E552"
        ) from None
    return backup


def _require_parameters(path: Path, wanted: RobotModel) -> None:
    """Raise an error unless a written file loads and holds the parameters of a robot."""
    base: Base = "floating" if wanted.floating else "fixed"
    try:
        read = load_mjcf(path, base) if is_mjcf(path) else load_urdf(path, base)
    except ModelError as error:
        reason = str(error)
    else:
        reason = _lost(read, without_wrist_sensors(wanted))
    if reason:
        raise EstimateError(
            f"{path}: not changed, as the new file would be wrong: {reason}; use a model file of "
            "the result's folder",
            "E576",
        )


def _lost(read: RobotModel, wanted: RobotModel) -> str:
    """Return which parameter of a robot was not read back; empty if there is none."""
    links = {link.name: link.phi for link in read.links}
    for name, expected in ((link.name, link.phi) for link in wanted.links):
        found = links[name]
        for part in (slice(1), slice(1, 4), slice(4, None)):
            scale = max(np.abs(expected[part]).max(), np.abs(expected).max() * READ_BACK)
            if np.abs(found[part] - expected[part]).max() > READ_BACK * scale:
                return f"link {name!r} has other parameters"
    joints = {joint.name: joint for joint in read.joints}
    for joint in wanted.joints:
        for term in TERMS[:2]:
            value = getattr(joint, term)
            if abs(getattr(joints[joint.name], term) - value) > READ_BACK * max(abs(value), 1.0):
                return f"joint {joint.name!r} has another {term.replace('_', ' ')}"
    return ""


def provenance_comment(estimate: Estimate) -> str:
    """Return one sentence that says where the numbers come from."""
    made = estimate.provenance
    when = "" if made is None or not made.date else f" on {made.date[:10]}"
    inputs = () if made is None else made.inputs
    bags = [one for one in inputs if one.path.endswith((".mcap", ".db3"))]
    named = ", ".join(
        f"{Path(one.path).name} (sha256 {(one.sha256 or 'unknown')[:12]})" for one in bags
    )
    checked = "" if estimate.holdout is None else f"; held out: {estimate.holdout.summary}"
    return (
        f"inertial and joint parameters identified by {estimate.software}{when}, method "
        f"{estimate.method}{f', from {named}' if named else ''}{checked}"
    ).replace("→", "to")


def inertials_yaml(folder: Path) -> str:
    """Return the links and joints of a result as YAML for ``xacro.load_yaml``.

    Frames are those of the result's model.urdf: ``xyz`` and ``rpy`` place the inertial frame in the
    link's, and the moments are about the centre of mass.

    Raises
    ------
    SymbidError
        When a file of the result is missing or invalid.
    """
    estimate = load_estimate(folder / "estimate.json")
    _refuse_negative_masses(folder, estimate)
    path = folder / "model.urdf"
    reader = UrdfReader(str(path), read_xml(path))
    links = {
        name: _inertial(reader, name)
        for name, link in reader.links.items()
        if link.find("inertial") is not None
    }
    joints: dict[str, Mapping[str, float]] = {}
    for joint in reader.joints:
        dynamics = joint.find("dynamics")
        if dynamics is not None:
            joints[joint.get("name", "")] = {
                key: float(dynamics.get(key, "0")) for key in ("damping", "friction")
            }
    head = f"# {MARK} {provenance_comment(estimate)}\n# SI units; read with xacro.load_yaml.\n"
    content = {"links": links, "joints": joints}
    return head + yaml.safe_dump(content, sort_keys=False, allow_unicode=True)


def _inertial(reader: UrdfReader, name: str) -> dict[str, object]:
    inertial = reader.links[name].find("inertial")
    assert inertial is not None
    rotation, _ = reader.pose(inertial)
    origin = inertial.find("origin")
    mass, com, central = com_from_phi(reader.phi(name))
    central = rotation.T @ central @ rotation
    rpy = "0 0 0" if origin is None else origin.get("rpy", "0 0 0")
    moments = {
        f"i{'xyz'[i]}{'xyz'[j]}": float(central[i, j]) for i in range(3) for j in range(i, 3)
    }
    xyz = " ".join(repr(float(value)) for value in com)
    return {"mass": mass, "xyz": xyz, "rpy": rpy, **moments}
