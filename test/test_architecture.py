"""The rooms import each other in one direction, and foreign libraries stay in their rooms."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = "symbid_ros"
ROOT = Path(__file__).resolve().parents[1]
ROOMS = (
    "model",
    "dynamics",
    "signals",
    "estimation",
    "bags",
    "diagnosis",
    "offline",
    "online",
    "simulation",
    "report",
    "study",
    "ros",
    "cli",
)
# Within the bags' room; what stands beside these rooms there is common to them.
BAG_ROOMS: dict[str, set[str]] = {
    "container": set(),
    "writing": {"container"},
    "rescue": {"container", "writing"},
    "streams": {"container"},
}
FREE = {"arrays", "atomic", "documents", "ending", "errors", "share", "user_files"}
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
    "std_msgs",
    "std_srvs",
}
BAG_LIBRARIES = {"mcap", "rosbags"}
NUMERIC_ROOMS = {"model", "dynamics", "signals", "estimation"}

MODULES = sorted((ROOT / PACKAGE).rglob("*.py"))


def imported(text: str, package: tuple[str, ...]) -> Iterator[str]:
    """Every module that an import anywhere in the text names, lazy ones and those for types too."""
    for node in ast.walk(ast.parse(text)):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = package[: len(package) - node.level + 1] if node.level else ()
            module = ".".join([*base, *filter(None, [node.module])])
            yield module
            # `from symbid_ros import bags` names the room only in the alias.
            yield from (f"{module}.{alias.name}" for alias in node.names if module == PACKAGE)


def imports(path: Path) -> set[str]:
    package = path.relative_to(ROOT).parent.parts
    return set(imported(path.read_text(encoding="utf-8"), package))


def room_of(module: str) -> str:
    parts = module.split(".")
    return parts[1] if parts[0] == PACKAGE and len(parts) > 1 else ""


def libraries(path: Path) -> set[str]:
    return {name.split(".")[0] for name in imports(path)}


def room(path: Path) -> str:
    parts = path.relative_to(ROOT / PACKAGE).parts
    return parts[0] if len(parts) > 1 else ""


def is_of_a_bag_room(module: str) -> bool:
    parts = module.split(".")
    return parts[:2] == [PACKAGE, "bags"] and len(parts) > 2 and parts[2] in BAG_ROOMS


def test_every_folder_is_a_known_room() -> None:
    folders = {path.name for path in (ROOT / PACKAGE).iterdir() if (path / "__init__.py").is_file()}
    assert folders <= set(ROOMS)
    assert {path.stem for path in MODULES if not room(path)} == FREE | {"__init__"}


@pytest.mark.parametrize("path", MODULES, ids=lambda p: str(p.relative_to(ROOT / PACKAGE)))
class TestModule:
    def test_imports_only_rooms_before_its_own(self, path: Path) -> None:
        used = {room_of(module) for module in imports(path)} - {"", room(path)} - FREE
        allowed = set(ROOMS[: ROOMS.index(room(path))]) if room(path) else set()
        # The command starts nodes as processes.
        allowed -= {"ros"}
        assert used <= allowed

    def test_rooms_of_bags_keep_apart(self, path: Path) -> None:
        parts = path.relative_to(ROOT / PACKAGE).parts
        if parts[0] == "bags" and len(parts) > 2:
            used = {module.split(".")[2] for module in imports(path) if is_of_a_bag_room(module)}
            assert used <= BAG_ROOMS[parts[1]] | {parts[1]}

    def test_ros_stays_in_its_room(self, path: Path) -> None:
        if room(path) != "ros":
            assert not libraries(path) & ROS_LIBRARIES

    def test_numeric_rooms_know_neither_bags_nor_simulator(self, path: Path) -> None:
        if room(path) in NUMERIC_ROOMS:
            assert not libraries(path) & BAG_LIBRARIES
            is_parser = room(path) == "model" and path.name.startswith("mjcf")
            assert is_parser or "mujoco" not in libraries(path)

    def test_stores_no_code(self, path: Path) -> None:
        assert not libraries(path) & {"pickle", "dill", "cloudpickle", "joblib", "shelve"}


def test_no_import_escapes() -> None:
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
