"""MJCF from anybody: includes, files and sizes, checked before MuJoCo sees anything of it."""

import os
import sys
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import numpy as np

from symbid_ros.errors import ModelError
from symbid_ros.model.xml_tree import LARGEST, MAX_ELEMENTS, Element, read_xml

# Bodies and joints cost MuJoCo's compiler time and memory with their square.
MAX_BODIES = 2_000
MAX_JOINTS = 1_000

# Elements that load code or other models, or stand for bodies that are not written out.
_REFUSED = {
    "plugin": "plugins are not loaded",
    "extension": "plugins are not loaded",
    "attach": "other models are not loaded",
    "model": "other models are not loaded",
    "composite": "bodies must be written out",
    "flexcomp": "bodies must be written out",
}
_NAMES = {"name", "class", "childclass", "joint", "body", "site", "geom", "mesh", "file", "model"}
_BOUNDED = {
    *("pos", "mass", "diaginertia", "fullinertia", "size", "fromto", "density"),
    *("damping", "frictionloss", "armature", "ref"),
}
# Of an asset, a compiler setting or a skin: names of files and folders.
_FILES = {"file", "fileup", "filedown", "fileleft", "fileright", "filefront", "fileback"}


def read_mjcf(path: Path) -> Element:
    """Return the root of an MJCF with its includes in place.

    Raises
    ------
    ModelError
        When a file cannot be read, an include leaves the model's folder or comes twice, an
        element would load code or another model, a number is not finite or absurd, or the
        model is larger than the limits.
    """
    root = read_xml(path)
    if root.tag != "mujoco":
        raise ModelError(f"{path}: the root element is <{root.tag}>, an MJCF has <mujoco>")
    _expand(root, path.parent, path.parent, {path.resolve()})
    for element in elements(root):
        if element.tag in _REFUSED and element is not root:
            raise ModelError(
                f"{element.place}: <{element.tag}>: {_REFUSED[element.tag]}; remove it"
            )
        for key, value in element.items():
            if key not in _NAMES:
                _check_numbers(element, key, value)
    for tag, limit in (("", MAX_ELEMENTS), ("body", MAX_BODIES), ("joint", MAX_JOINTS)):
        if _count(root, tag) > limit:
            what = {"": "elements", "body": "bodies", "joint": "joints"}[tag]
            raise ModelError(f"{path}: more than {limit} {what}, the limit; reduce the model")
    return root


def inside(folder: Path, name: str, element: Element) -> Path:
    """Return the path of a file that ``element`` names, which must lie in ``folder``.

    Raises
    ------
    ModelError
        When it lies elsewhere, symbolic links followed.
    """
    try:
        target, home = (folder / name).resolve(), folder.resolve()
        if target.is_relative_to(home):
            return target
    except (OSError, ValueError, RuntimeError):
        # A name too long, with a NUL, or of links that go round.
        pass
    raise ModelError(
        f"{element.place}: {name!r} is not in the model's folder {folder}; copy it there and name "
        "it by a relative path"
    )


def included_file(element: Element, folder: Path, here: Path) -> Path:
    """Return the file that is included: MuJoCo looks beside the model, then beside ``here``.

    Raises
    ------
    ModelError
        When it lies outside the model's ``folder``.
    """
    name = element.get("file", "")
    file = inside(folder, name, element)
    if os.path.isfile(file):  # also of names that are none
        return file
    return inside(folder, os.path.relpath(here / name, folder), element)


def require_files_inside(path: Path) -> None:
    """Refuse an MJCF that names files outside its own folder, before all of it is compiled.

    Raises
    ------
    ModelError
        As :func:`read_mjcf`, or when a mesh, texture or height field lies elsewhere.
    """
    root = read_mjcf(path)
    folders = {
        key: value
        for compiler in root.iterfind("compiler")
        for key, value in compiler.items()
        if key in ("assetdir", "meshdir", "texturedir")
    }
    common = folders.get("assetdir", "")
    for element in elements(root):
        own = {"mesh": "meshdir", "skin": "meshdir", "texture": "texturedir"}.get(element.tag, "")
        for key in _FILES & set(element.keys()):
            name = element.get(key, "")
            inside(path.parent, str(Path(folders.get(own, common)) / name), element)


def elements(root: Element) -> Iterator[Element]:
    """Walk through a tree in the file's order."""
    for element in root.iter():
        assert isinstance(element, Element)
        yield element


def _expand(parent: Element, folder: Path, here: Path, seen: set[Path]) -> None:
    """Put the content of included files where they are included."""
    for child in list(parent):
        assert isinstance(child, Element)
        if child.tag != "include":
            _expand(child, folder, here, seen)
            continue
        file = included_file(child, folder, here)
        if file in seen:
            raise ModelError(f"{child.place}: {file} is included twice; include it once")
        seen.add(file)
        included = read_xml(file)
        _expand(included, folder, file.parent, seen)
        position = list(parent).index(child)
        parent[position : position + 1] = list(included)


def _check_numbers(element: Element, key: str, value: str) -> None:
    limit = LARGEST if key in _BOUNDED else sys.float_info.max
    for word in value.split():
        try:
            # MuJoCo also reads the hexadecimal numbers of C.
            number = float.fromhex(word) if "0x" in word.lower() else float(word)
        except ValueError:
            continue  # a word, or MuJoCo says what is wrong with it
        except OverflowError:
            number = np.inf
        if not abs(number) <= limit:
            raise ModelError(
                f'{element.place}: <{element.tag}> has {key}="{word}"; give a finite number of '
                "a robot's size"
            )
        if key == "mass" and number < 0:
            raise ModelError(f'{element.place}: <{element.tag}> has mass="{word}"; give 0 or more')


def _count(element: ET.Element, tag: str) -> int:
    """Return how many elements of a kind (all for "") there are once copies are made."""
    own = int(tag in ("", element.tag))
    below = sum(_count(child, tag) for child in element)
    if element.tag == "replicate":
        with suppress(ValueError):  # MuJoCo says what is wrong with it
            below *= max(int(element.get("count", "1")), 1)
    return own + below
