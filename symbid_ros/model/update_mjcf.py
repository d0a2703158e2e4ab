"""Write identified parameters into a user's own MJCF and the files that it includes."""

import os
from pathlib import Path, PurePosixPath
from xml.sax.saxutils import quoteattr

from symbid_ros.arrays import FloatArray
from symbid_ros.model.export_urdf import NEGLIGIBLE, numbers
from symbid_ros.model.inertia import com_from_phi, nearest_possible
from symbid_ros.model.mjcf import load_mjcf, stated_bodies
from symbid_ros.model.mjcf_source import included_file, read_mjcf
from symbid_ros.model.tree import Joint, RobotModel
from symbid_ros.model.welded_bodies import updated_bodies
from symbid_ros.model.xml_edit import XmlEditor, is_editable
from symbid_ros.model.xml_tree import Element, as_element, read_xml

# Compiler settings that change the inertias which the file states.
_OVERRIDES = ("balanceinertia", "boundinertia", "boundmass", "settotalmass")
_ORIENTATIONS = ("quat", "axisangle", "xyaxes", "zaxis", "euler")
_FOLDERS = ("assetdir", "meshdir", "texturedir")
# Attributes of a joint element and the joint's fields.
TERMS = {"damping": "damping", "frictionloss": "friction_loss", "armature": "armature"}


def updated_mjcf(
    model: RobotModel, source: Path, folder: Path, name: str
) -> dict[PurePosixPath, str] | None:
    """Return the user's MJCF with the robot's inertias and joint terms, as files for ``folder``.

    Everything else stays as it is, byte for byte, except compiler settings: those that would
    change inertias are removed, and folders of meshes and textures are named as seen from
    ``folder``.

    Parameters
    ----------
    model : RobotModel
        The robot to write.
    source : Path
        The MJCF that ``model`` was loaded from.
    folder : Path
        Where the files will be saved.
    name : str
        What the main file will be called there.

    Returns
    -------
    dict of PurePosixPath to str, or None
        The main file first, then the files that it includes, at the same places beside it as
        beside ``source``. None if bodies of the model cannot be traced to elements of a file,
        as below <replicate>, or a file is in UTF-16.
    """
    root = read_mjcf(source)
    elements = [as_element(body) for body in root.iterfind("worldbody//body")]
    names, stated = stated_bodies(source)
    named = [element.get("name", body) for element, body in zip(elements, names, strict=False)]
    if len(elements) != len(names) or named != names:
        return None
    files = _Files(source)
    if not all(is_editable(path) for path in files.editors):
        return None
    overridden = _compiler_overrides(root)
    bodies = dict(zip(names, elements, strict=True))
    for body, phi in updated_bodies(model, stated, rewrite=overridden).items():
        inertial = bodies[body].find("inertial")
        if inertial is None and bodies[body].find("frame//inertial") is not None:
            return None
        _set_inertial(files, bodies[body], nearest_possible(phi))
    # An element may inherit its terms from a class, so what the file states is what MuJoCo reads.
    before = {joint.name: joint for joint in load_mjcf(source).joints}
    after = {joint.name: joint for joint in model.joints}
    for element in root.iterfind("worldbody//joint"):
        joint = element.get("name", "")
        if joint in after:
            _set_terms(files, as_element(element), before[joint], after[joint])
    _settle_compilers(files, root, folder)
    return files.texts(folder, name)


class _Files:
    """The main file and its includes while they are edited."""

    def __init__(self, source: Path) -> None:
        self.source = source
        self.editors: dict[Path, XmlEditor] = {}
        self._includes: list[tuple[Element, Path]] = []
        self._add(source)

    def _add(self, path: Path) -> None:
        self.editors[path] = XmlEditor(path)
        for element in read_xml(path).iter("include"):
            include = as_element(element)
            file = included_file(include, self.source.parent, path.parent)
            self._includes.append((include, file))
            self._add(file)

    def editor(self, element: Element) -> XmlEditor:
        return self.editors[element.file]

    def texts(self, folder: Path, name: str) -> dict[PurePosixPath, str]:
        """Return the files' texts by their places in ``folder``, the main one first."""
        home = self.source.parent.resolve()
        places = {self.source: PurePosixPath(name)}
        for _, file in self._includes:
            place = PurePosixPath(file.relative_to(home).as_posix())
            # Neither an output nor one of the user's own files may be replaced.
            while place in places.values() or (folder / place).resolve() in self.editors:
                place = place.with_stem(f"{place.stem}_identified")
            places[file] = place
        for include, file in self._includes:
            if PurePosixPath(include.get("file", "")) != places[file]:
                self.editor(include).set(include, "file", str(places[file]))
        return {place: self.editors[file].text() for file, place in places.items()}


def _compiler_overrides(root: Element) -> bool:
    """Return whether the compiler is told to use other inertias than the stated ones."""
    return any(
        compiler.get("inertiafromgeom") == "true"
        or any(key in compiler.attrib for key in _OVERRIDES)
        for compiler in root.iterfind("compiler")
    )


def _set_inertial(files: _Files, body: Element, phi: FloatArray) -> None:
    mass, com, inertia = com_from_phi(phi)
    values = {
        "mass": repr(mass),
        "pos": numbers(com),
        "fullinertia": full_inertia(inertia),
    }
    editor, found = files.editor(body), body.find("inertial")
    if found is None:
        attributes = "".join(f' {key}="{value}"' for key, value in values.items())
        editor.insert(body, f"<inertial{attributes}/>")
        return
    inertial = as_element(found)
    for key in ("diaginertia", *_ORIENTATIONS):
        editor.drop(inertial, key)
    for key, value in values.items():
        editor.set(inertial, key, value)


def full_inertia(inertia: FloatArray) -> str:
    """Return a (3, 3) inertia as MJCF's fullinertia: xx, yy, zz, xy, xz, yz."""
    return numbers(inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]])


def _set_terms(files: _Files, element: Element, before: Joint, after: Joint) -> None:
    """Write the joint's terms that differ from those that MuJoCo reads."""
    for key, field in TERMS.items():
        old, new = getattr(before, field), getattr(after, field)
        if old != new and max(old, new) > NEGLIGIBLE:
            files.editor(element).set(element, key, repr(float(new)))


def _settle_compilers(files: _Files, root: Element, folder: Path) -> None:
    """Keep the compiler from changing inertias, and find the files that it names."""
    compilers = [as_element(compiler) for compiler in root.iterfind("compiler")]
    home = files.source.parent.resolve()
    moved = folder.resolve() != home
    named = False
    for compiler in compilers:
        editor = files.editor(compiler)
        for override in _OVERRIDES:
            editor.drop(compiler, override)
        if compiler.get("inertiafromgeom") == "true":
            editor.set(compiler, "inertiafromgeom", "auto")
        for key in _FOLDERS:
            if key in compiler.attrib:
                named = True
                if moved:
                    place = os.path.relpath(home / compiler.get(key, ""), folder.resolve())
                    editor.set(compiler, key, place)
    if moved and not named and root.find("asset//*[@file]") is not None:
        place = os.path.relpath(home, folder.resolve())
        main = [compiler for compiler in compilers if compiler.file == files.source]
        if main:
            files.editor(main[0]).set(main[0], "assetdir", place)
        else:
            files.editor(root).insert(root, f"<compiler assetdir={quoteattr(place)}/>")
