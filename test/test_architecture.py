"""Subpackages import each other in one direction; libraries stay where they belong."""

import ast
import re
import subprocess
import sys
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

from symbid_ros import bags

PACKAGE = "symbid_ros"
ROOT = Path(__file__).resolve().parents[1]
# Each subpackage may import those before it.
SUBPACKAGES = (
    "model",
    "dynamics",
    "signals",
    "estimation",
    "diagnosis",
    "identification",
    "messages",
    "bags",
    "offline",
    "cluster",
    "online",
    "simulation",
    "report",
    "excitation",
    "study",
    "learning",
    "ros",
    "cli",
)
# What runs with NumPy, SciPy, Numba, Clarabel and PyYAML alone.
CORE = SUBPACKAGES[: SUBPACKAGES.index("messages")]
# Whole lists of what these may import, where order says too little.
NEVER = {
    "messages": {"estimation", "diagnosis", "identification"},
    "bags": {"estimation", "diagnosis", "identification"},
    "online": {"bags"},
    "simulation": {"estimation", "diagnosis", "identification", "offline", "online"},
    "cli": {"ros"},  # the command starts nodes as processes
}
# Parts of a subpackage, and those of its other parts that each may import. Modules beside the parts
# may be imported by all of them.
PARTS: dict[str, dict[str, set[str]]] = {
    "bags": {
        "container": set(),
        "writing": {"container"},
        "recovery": {"container", "writing"},
    },
    "identification": {
        "conventions": set(),
        "rows": set(),
        "terms": {"rows"},
        "calibration": {"rows", "terms"},
        "predictions": {"rows", "terms"},
        "causes": {"conventions", "rows", "terms", "calibration"},
    },
}
FREE = {
    "arrays",
    "blas_threads",
    "choices",
    "options",
    "atomic_write",
    "shutdown",
    "errors",
    "json_documents",
    "package_paths",
    "progress",
    "user_files",
}
ROS_LIBRARIES = {
    "rclpy",
    "rosidl_runtime_py",
    "ament_index_python",
    "builtin_interfaces",
    "rcl_interfaces",
    "rosgraph_msgs",
    "sensor_msgs",
    "geometry_msgs",
    "nav_msgs",
    "trajectory_msgs",
    "diagnostic_msgs",
    "visualization_msgs",
    "std_msgs",
    "std_srvs",
}
CORE_LIBRARIES = {
    "numpy",
    "scipy",
    "clarabel",
    "yaml",
    "pandas",
    "numba",
    "llvmlite",
    "threadpoolctl",
}
BAG_LIBRARIES = {"mcap", "rosbags", "apsw"}

API = ROOT / PACKAGE / "__init__.py"  # names everything public, imports nothing before it is used
MODULES = sorted(path for path in (ROOT / PACKAGE).rglob("*.py") if path != API)


def imported(text: str, package: tuple[str, ...]) -> Iterator[str]:
    """Every module that an import anywhere in the text names, lazy ones and those for types too."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *filter(None, [node.module])])
            yield module
            # `from symbid_ros import bags` names the subpackage only in the alias.
            yield from (f"{module}.{alias.name}" for alias in node.names if module == PACKAGE)


@cache
def imports(path: Path) -> set[str]:
    package = path.relative_to(ROOT).parent.parts
    return set(imported(path.read_text(encoding="utf-8"), package))


def subpackage_of(module: str) -> str:
    parts = module.split(".")
    return parts[1] if parts[0] == PACKAGE and len(parts) > 1 else ""


def subpackage(path: Path) -> str:
    parts = path.relative_to(ROOT / PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def libraries(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


def test_every_folder_is_a_known_subpackage() -> None:
    folders = {path.name for path in (ROOT / PACKAGE).iterdir() if (path / "__init__.py").is_file()}
    assert folders == set(SUBPACKAGES)
    assert {path.stem for path in MODULES if not subpackage(path)} == FREE


def wrong(forbidden: Callable[[Path], set[str]]) -> list[str]:
    """Each module that imports something forbidden, with that."""
    return [
        f"{path.relative_to(ROOT)}: {', '.join(bad)}"
        for path in MODULES
        if (bad := forbidden(path))
    ]


def test_subpackages_import_only_those_before_them() -> None:
    def forbidden(path: Path) -> set[str]:
        own = subpackage(path)
        used = {subpackage_of(module) for module in imports(path)} - {"", own} - FREE
        allowed = (
            set(SUBPACKAGES[: SUBPACKAGES.index(own)]) - NEVER.get(own, set()) if own else set()
        )
        return used - allowed

    assert not wrong(forbidden)


def test_parts_of_subpackages_keep_apart() -> None:
    def forbidden(path: Path) -> set[str]:
        own = path.relative_to(ROOT / PACKAGE).parts
        if own[0] not in PARTS or len(own) < 3:
            return set()
        parts = PARTS[own[0]]
        used = {tuple(module.split(".")) for module in imports(path)}
        named = {name[2] for name in used if name[:2] == (PACKAGE, own[0]) and len(name) > 2}
        return named & set(parts) - parts[own[1]] - {own[1]}

    assert not wrong(forbidden)


def test_bags_are_imported_through_their_facade() -> None:
    assert not wrong(
        lambda path: (
            {module for module in imports(path) if module.startswith(f"{PACKAGE}.bags.")}
            if subpackage(path) != "bags"
            else set()
        )
    )


def test_the_facade_of_bags_loads_what_it_names_and_no_more() -> None:
    assert all(getattr(bags, name).__name__ == name for name in bags.__all__)
    code = (
        "import sys; from symbid_ros.bags import read_streams; "
        "print(*(name for name in sys.modules if name.startswith('symbid_ros.bags.writing')))"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert not found.stdout.strip()


def test_ros_is_imported_by_nodes_alone() -> None:
    assert not wrong(
        lambda path: libraries(path) & ROS_LIBRARIES if subpackage(path) != "ros" else set()
    )


def test_the_core_needs_few_libraries() -> None:
    def forbidden(path: Path) -> set[str]:
        if subpackage(path) not in CORE:
            return set()
        allowed = CORE_LIBRARIES | sys.stdlib_module_names | {PACKAGE}
        is_parser = subpackage(path) == "model" and path.name.startswith("mjcf")
        return libraries(path) - allowed - ({"mujoco"} if is_parser else set())

    assert not wrong(forbidden)


def test_no_module_stores_code() -> None:
    assert not wrong(
        lambda path: libraries(path) & {"pickle", "dill", "cloudpickle", "joblib", "shelve"}
    )


def test_all_kinds_of_imports_are_found() -> None:
    text = """
from typing import TYPE_CHECKING
if TYPE_CHECKING:
    from ..cli.main import app
def lazy():
    from symbid_ros import study
    from . import process
    import rclpy.node
"""
    assert set(imported(text, (PACKAGE, "ros"))) == {
        "typing",
        "symbid_ros.cli.main",
        "symbid_ros",
        "symbid_ros.study",
        "symbid_ros.ros",
        "rclpy.node",
    }


def test_the_documentation_lists_the_subpackages_in_order() -> None:
    page = (ROOT / "docs" / "architecture.md").read_text(encoding="utf-8")
    table = page.partition("| subpackage |")[2].partition("\n\n")[0]
    assert tuple(re.findall(r"^\| `(\w+)` \|", table, re.MULTILINE)) == SUBPACKAGES
