"""The tree is a ROS package: colcon builds it, and what it installs runs."""

import ast
import os
import re
import subprocess
import sys
import sysconfig
import tomllib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from xml.etree import ElementTree

import pytest
import yaml
from declared_environment import build_wheel, install
from documented_robots import ur5_urdf
from packaging.requirements import Requirement

from symbid_ros.dynamics import compiled_kernel
from symbid_ros.ros.launch_arguments import launch_arguments

PACKAGE = "symbid_ros"
ROOT = Path(__file__).resolve().parents[1]
EXECUTABLES = {
    "symbid",
    "mujoco_bridge",
    "recorder",
    "balance_controller",
    "identifier",
    "monitor",
    "web_monitor",
    "player",
}
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
EXTRAS = set(PROJECT["optional-dependencies"]) - {"docs", "test"}
LAUNCH_FILES = sorted((ROOT / "launch").glob("*.launch.py"))


def clean_environment() -> dict[str, str]:
    """Return an environment in which a child starts as from a fresh shell.

    The ROS wheels set LD_LIBRARY_PATH once and leave a guard variable; a child
    that inherits one without the other does not find its libraries.
    """
    inherited = {
        "LD_LIBRARY_PATH",
        "_ROS_WHEELS_BOOTSTRAP_COMPLETE",
        "PYTHONPATH",
        "AMENT_PREFIX_PATH",
        "COLCON_PREFIX_PATH",
        "CMAKE_PREFIX_PATH",
    }
    return {name: value for name, value in os.environ.items() if name not in inherited}


def colcon(*arguments: str, cwd: Path) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [Path(sysconfig.get_path("scripts")) / "colcon", *arguments],
        cwd=cwd,
        env=clean_environment(),
        capture_output=True,
        text=True,
        check=False,
    )


@pytest.fixture(scope="module")
def installation(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The install/ folder of a colcon build of this tree."""
    workspace = tmp_path_factory.mktemp("workspace")
    done = colcon(
        *("--log-base", "log", "build", "--base-paths", str(ROOT)),
        *("--build-base", "build", "--install-base", "install"),
        cwd=workspace,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return workspace / "install"


def run_installed(installation: Path, command: str) -> subprocess.CompletedProcess[str]:
    """Run a shell command as a user does who has sourced the workspace."""
    return subprocess.run(
        ["bash", "-c", f'source "{installation}/setup.bash" && {command}'],
        # Outside the checkout, whose package would be found in the working directory.
        cwd=installation,
        env=clean_environment()
        | {
            "ROS_LOG_DIR": str(installation.parent / "log"),
            "ROS_DOMAIN_ID": "102",  # outside of those that are given to whoever asks
            "ROS_AUTOMATIC_DISCOVERY_RANGE": "LOCALHOST",
        },
        capture_output=True,
        text=True,
        check=False,
    )


class TestManifest:
    root = ElementTree.parse(ROOT / "package.xml").getroot()

    def test_is_format_3_of_build_type_ament_python(self) -> None:
        assert (self.root.tag, self.root.get("format")) == ("package", "3")
        assert self.root.findtext("export/build_type") == "ament_python"

    @pytest.mark.parametrize("tag", ["name", "version", "description", "maintainer", "license"])
    def test_has_what_every_package_must_have(self, tag: str) -> None:
        assert self.root.findtext(tag)

    def test_maintainer_can_be_written_to(self) -> None:
        emails = [element.get("email", "") for element in self.root.findall("maintainer")]
        assert all(re.fullmatch(r"[\w.+-]+@[\w-]+(\.[\w-]+)+", email) for email in emails)

    def test_licence_file_is_the_licence_named(self) -> None:
        licence = self.root.find("license")
        assert licence is not None
        text = (ROOT / licence.get("file", "")).read_text()
        assert licence.text == "Apache-2.0"
        assert "Apache License" in text
        assert "END OF TERMS AND CONDITIONS" in text

    def test_dependencies_are_rosdep_keys_named_once(self) -> None:
        keys = [e.text or "" for e in self.root if e.tag.endswith("depend")]
        assert all(re.fullmatch(r"[a-z][a-z0-9]*([_-][a-z0-9]+)*", key) for key in keys)
        assert len(keys) == len(set(keys))

    def test_every_ros_package_imported_is_declared(self) -> None:
        declared = {e.text for e in self.root if e.tag.endswith("depend")}
        sources = [*(ROOT / PACKAGE / "ros").glob("*.py"), *LAUNCH_FILES]
        used = {
            name.split(".")[0]
            for source in sources
            for node in ast.walk(ast.parse(source.read_text()))
            for name in _modules(node)
        }
        ros = {name for name in used if name.endswith("_msgs") or name.endswith("_srvs")}
        ros |= used & {"rclpy", "launch", "launch_ros", "ament_index_python", "rpyutils"}
        assert ros <= declared

    def test_states_what_pyproject_does(self) -> None:
        assert self.root.findtext("version") == PROJECT["version"]
        assert self.root.findtext("name") == PROJECT["name"]
        (maintainer,) = self.root.findall("maintainer")
        (stated,) = PROJECT["maintainers"]
        assert (maintainer.text, maintainer.get("email")) == (stated["name"], stated["email"])


def _modules(node: ast.AST) -> list[str]:
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        return [node.module]
    return []


def test_colcon_recognises_a_ros_package(tmp_path: Path) -> None:
    listed = colcon("list", "--base-paths", str(ROOT), cwd=tmp_path)
    assert listed.stdout.split()[0] == PACKAGE
    assert listed.stdout.split()[-1] == "(ros.ament_python)"


class TestInstallation:
    def test_holds_the_executables(self, installation: Path) -> None:
        folder = installation / PACKAGE / "lib" / PACKAGE
        assert {path.name for path in folder.iterdir()} == EXECUTABLES
        assert all(os.access(path, os.X_OK) for path in folder.iterdir())

    def test_holds_the_shared_files(self, installation: Path) -> None:
        share = installation / PACKAGE / "share"
        marker = share / "ament_index" / "resource_index" / "packages" / PACKAGE
        assert marker.is_file()
        for folder in ("config", "launch"):
            installed = {p.name for p in (share / PACKAGE / folder).iterdir() if p.is_file()}
            tracked = {p.name for p in (ROOT / folder).iterdir() if p.is_file()}
            assert installed == tracked

    def test_is_what_a_sourced_shell_imports(self, installation: Path) -> None:
        code = "import symbid_ros.package_paths as s; print(s.__file__); print(s.share_directory())"
        done = run_installed(installation, f"{sys.executable} -c '{code}'")
        assert done.returncode == 0, done.stderr
        module, share = map(Path, done.stdout.split())
        assert module.is_relative_to(installation)
        assert share == installation / PACKAGE / "share" / PACKAGE

    def test_command_runs(self, installation: Path) -> None:
        done = run_installed(installation, f"{PACKAGE}/lib/{PACKAGE}/symbid --version")
        assert (done.returncode, done.stderr) == (0, "")
        assert done.stdout.startswith(PACKAGE)

    @pytest.mark.parametrize(
        ("executable", "parameter"),
        [
            ("mujoco_bridge", "scenario:=dancing"),
            ("recorder", "queue_depth:=0"),
            ("identifier", "method:=guess"),
        ],
    )
    def test_node_starts_and_refuses_a_bad_parameter(
        self, installation: Path, executable: str, parameter: str
    ) -> None:
        node = f"{PACKAGE}/lib/{PACKAGE}/{executable}"
        done = run_installed(installation, f"{node} --ros-args -p {parameter}")
        assert done.returncode == 2, done.stderr
        assert parameter.partition(":=")[0] in done.stderr
        assert "Traceback" not in done.stderr

    def test_holds_all_parts_of_pages(self, installation: Path) -> None:
        (package,) = installation.glob(f"{PACKAGE}/lib/python*/*/{PACKAGE}")

        def parts(folder: Path) -> set[Path]:
            kinds = {".html", ".css", ".js"}
            return {one.relative_to(folder) for one in folder.rglob("*") if one.suffix in kinds}

        assert parts(package) == parts(ROOT / PACKAGE) != set()


def test_colcon_runs_the_tests(installation: Path) -> None:
    """One short file stands for all of them, which colcon finds in the same way."""
    done = colcon(
        *("--log-base", "log", "test", "--base-paths", str(ROOT)),
        *("--build-base", "build", "--install-base", "install"),
        *("--pytest-args", "test/test_shutdown.py", "-p", "no:cacheprovider"),
        cwd=installation.parent,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    result = colcon("test-result", "--test-result-base", "build", cwd=installation.parent)
    assert re.match(r"Summary: [1-9]\d* tests, 0 errors, 0 failures", result.stdout)


def _calls(path: Path, function: str) -> list[ast.Call]:
    return [
        node
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id == function
    ]


@pytest.mark.parametrize("path", LAUNCH_FILES, ids=lambda p: p.name)
class TestLaunchFile:
    def test_starts_executables_of_this_package(self, path: Path) -> None:
        tree = ast.parse(path.read_text())
        started = {
            keyword.value.value
            for node in ast.walk(tree)
            if isinstance(node, ast.Call)
            for keyword in node.keywords
            if keyword.arg == "executable" and isinstance(keyword.value, ast.Constant)
        }
        assert started
        assert started <= EXECUTABLES

    def test_no_node_is_killed_before_it_can_end_nor_waited_for_when_it_has(
        self, path: Path
    ) -> None:
        """Launch escalates to SIGTERM after 5 s by default; a busy machine needs more."""
        handles_all = bool(_calls(path, "OnProcessExit"))
        for call in _calls(path, "Node"):
            words = {keyword.arg: keyword.value for keyword in call.keywords}
            for timeout in ("sigterm_timeout", "sigkill_timeout"):
                assert float(ast.literal_eval(words[timeout])) > 5
            assert isinstance(words["executable"], ast.Constant)
            # Nobody waits for a monitor.
            assert "on_exit" in words or handles_all or words["executable"].value == "monitor"

    def test_names_files_that_exist(self, path: Path) -> None:
        strings = [
            node.value
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]
        for name in (s for s in strings if s.endswith(".yaml")):
            parameters = yaml.safe_load((ROOT / "config" / name).read_text())
            assert set(parameters) == {"/**"}

    def test_every_argument_is_described_and_every_one_used_is_declared(self, path: Path) -> None:
        (generated,) = _calls(path, "launch_arguments")
        nodes = [node.value for node in generated.args if isinstance(node, ast.Constant)]
        declared = {argument.name for argument in launch_arguments(*map(str, nodes))}
        for call in _calls(path, "DeclareLaunchArgument"):
            assert "description" in {keyword.arg for keyword in call.keywords}
            if isinstance(call.args[0], ast.Constant):
                declared.add(call.args[0].value)
        used = {
            call.args[0].value
            for call in _calls(path, "LaunchConfiguration")
            if isinstance(call.args[0], ast.Constant)
        }
        used |= {
            node.slice.value
            for node in ast.walk(ast.parse(path.read_text()))
            if isinstance(node, ast.Subscript)
            and isinstance(node.value, ast.Name)
            and node.value.id == "given"
            and isinstance(node.slice, ast.Constant)
        }
        assert used <= declared

    def test_says_what_an_included_file_requires(self, path: Path) -> None:
        """Launch refuses an inclusion otherwise, even where the argument is given to the whole."""
        for call in _calls(path, "IncludeLaunchDescription"):
            words = {node.value for node in ast.walk(call) if isinstance(node, ast.Constant)}
            (included,) = (each for each in LAUNCH_FILES if each.name in words)
            required = {
                declared.args[0].value
                for declared in _calls(included, "DeclareLaunchArgument")
                if isinstance(declared.args[0], ast.Constant)
                and "default_value" not in {keyword.arg for keyword in declared.keywords}
            }
            assert required <= words

    def test_defines_the_entry_point(self, path: Path) -> None:
        functions = {
            n.name for n in ast.parse(path.read_text()).body if isinstance(n, ast.FunctionDef)
        }
        assert "generate_launch_description" in functions


def _pins(name: str) -> dict[str, str]:
    """Return the version that a list pins each distribution to, by name."""
    lines = (ROOT / name).read_text().splitlines()
    pinned = [line for line in lines if line and line[0] not in "#-"]
    assert all(re.fullmatch(r"[\w-]+==\S+", line) for line in pinned), name
    return dict(line.split("==") for line in pinned)


def _declared(*extras: str) -> list[Requirement]:
    optional = PROJECT["optional-dependencies"]
    texts = [*PROJECT["dependencies"], *(text for extra in extras for text in optional[extra])]
    return [each for each in map(Requirement, texts) if each.name != PACKAGE]


class TestRequirements:
    lists = ("requirements.txt", "requirements-pypi.txt", "requirements-ros.txt")
    apt = ("numpy", "scipy", "matplotlib", "PyYAML", "jinja2")

    def test_every_dependency_is_pinned_in_one_list_within_its_range(self) -> None:
        pins = [_pins(name) for name in (*self.lists, "requirements-docs.txt")]
        for requirement in _declared("bags", "sim", "study", "dask", "ros", "docs"):
            names = {requirement.name, requirement.name.capitalize()}
            found = [versions[name] for versions in pins for name in names if name in versions]
            assert len(found) == 1, requirement
            assert requirement.specifier.contains(found[0]), requirement

    def test_every_pin_is_of_a_declared_dependency(self) -> None:
        pinned = [name for each in self.lists for name in _pins(each)]
        assert sorted(pinned) == sorted({each.name for each in _declared(*EXTRAS)})

    def test_ros_can_be_left_out(self) -> None:
        assert all(name.startswith("ros-") for name in _pins("requirements-ros.txt"))
        others = _pins("requirements.txt") | _pins("requirements-pypi.txt")
        assert not any(name.startswith("ros-") for name in others)

    def test_ranges_hold_what_ubuntu_has(self) -> None:
        """Packages with an apt key in the manifest come from there, all others from PyPI."""
        versions = dict(zip(self.apt, ("1.26.4", "1.11.4", "3.6.3", "6.0.1", "3.1.2"), strict=True))
        for requirement in _declared(*EXTRAS):
            if requirement.name in versions:
                assert requirement.specifier.contains(versions[requirement.name])
        keys = {e.text for e in TestManifest.root if e.tag == "exec_depend"}
        assert set(_pins("requirements.txt")) == set(self.apt)
        named = {"PyYAML": "yaml"}
        assert {f"python3-{named.get(name, name)}" for name in self.apt} <= keys
        assert {"python3-mujoco-pip", "python3-rosbags-pip", "proxsuite"} <= keys

    def test_tools_that_cannot_be_dependencies_of_the_core_stay_in_extras(self) -> None:
        assert {each.name for each in _declared()} == {
            "numpy",
            "scipy",
            "clarabel",
            "PyYAML",
            "numba",
            "llvmlite",
            "threadpoolctl",
        }


def test_other_files_state_what_pyproject_does() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    urls = PROJECT["urls"]
    assert citation["version"] == PROJECT["version"]
    assert citation["repository-code"] == urls["Repository"]
    assert f"git clone {urls['Repository']}.git" in (ROOT / "README.md").read_text()


def test_continuous_integration_runs_targets_of_the_makefile() -> None:
    targets = re.findall(r"^([\w-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    workflows = sorted((ROOT / ".github" / "workflows").glob("*.yml"))
    assert {path.stem for path in workflows} == {"test", "docs", "wheel"}
    for path in workflows:
        jobs = yaml.safe_load(path.read_text())["jobs"].values()
        commands = [step["run"] for job in jobs for step in job["steps"] if "run" in step]
        assert commands == [f"make {path.stem}"]
        assert path.stem in targets


def test_entry_points_exist() -> None:
    assert set(PROJECT["scripts"]) == EXECUTABLES
    for target in PROJECT["scripts"].values():
        module, function = target.split(":")
        source = ROOT / Path(*module.split(".")).with_suffix(".py")
        body = ast.parse(source.read_text()).body
        names = {n.name for n in body if isinstance(n, ast.FunctionDef)}
        for node in (n for n in body if isinstance(n, ast.Assign)):
            names |= {target.id for target in node.targets if isinstance(target, ast.Name)}
        assert function in names


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build_wheel(tmp_path_factory.mktemp("wheel"))


@pytest.fixture(scope="module")
def compiled() -> str:
    """Return the folder of the compiled kernel, which equals that of the wheel."""
    compiled_kernel.load_kernel()  # compiled, unless it was kept
    file = f"kernel-{compiled_kernel._fingerprint()}.o"
    return str(next(one for one in compiled_kernel._folders() if (one / file).is_file()))


def run_in(folder: Path, compiled: str, *words: object) -> subprocess.CompletedProcess[str]:
    """Run a command as from a fresh shell, with the compiled kernel."""
    return subprocess.run(
        [str(word) for word in words],
        cwd=folder,
        env=clean_environment() | {compiled_kernel.FOLDER: compiled},
        capture_output=True,
        text=True,
        check=False,
    )


FROM_ARRAYS = """
import sys
import numba
import numpy as np
import symbid_ros as sy

# Numba compiles here; the kernel itself has been compiled before.
assert numba.njit(lambda x: x + 1.0)(2.0) == 3.0
from symbid_ros.dynamics import kernel

robot = sy.load_model(sys.argv[1])
time = np.arange(0.0, 20.0, 0.004)
phase = np.outer(time, [1.1, 1.7, 2.3, 2.9, 3.7, 4.1])
rate = phase[1] / time[1]
position = np.sin(phase)
K = sy.regressor(robot, position, rate * np.cos(phase), -(rate**2) * position)
effort = K @ robot.phi.ravel() + np.random.default_rng(1).normal(0.0, 0.1, position.shape)
log = sy.Log.from_arrays(robot, time=time, position=position, effort=effort)
assert not sy.diagnose(robot, log).severity
result = sy.identify(robot, log, prior_percent=25)
assert not result.alarms
assert result.parameters["wrist_3_link/mc_z"].is_determined
result.save("result")
print("identified")
"""


class TestWheel:
    def test_with_bags_identifies_and_reports(
        self, wheel: Path, compiled: str, simulated: Callable[..., Path], tmp_path: Path
    ) -> None:
        scripts = install(wheel, tmp_path / "environment", {"bags"})
        symbid, bag = scripts / "symbid", simulated("smooth", moves=1, motion_seed=21, noise_seed=5)
        run = partial(run_in, tmp_path, compiled)
        model = scripts.parent / "share" / PACKAGE / "config" / "symbitron.urdf"
        quick = ("--joint-terms", "none", "--no-holdout", "--out", "result")
        done = run(symbid, "identify", bag, "--model", model, *quick)
        assert (done.returncode, done.stderr) == (0, "")
        page = ("--bag", bag, "--out", "report.html")
        done = run(symbid, "report", "result", "--model", model, *page)
        assert (done.returncode, done.stderr) == (0, "")
        assert (tmp_path / "report.html").is_file()
        done = run(symbid, "bag", "doctor", bag, "--model", model)
        assert (done.returncode, done.stderr) == (0, "")

        # What needs another extra names it.
        done = run(symbid, "simulate", "--out", "simulated")
        assert done.returncode == 2
        assert done.stderr.count("\n") == 1
        assert "pip install 'symbid_ros[sim]'" in done.stderr
        done = run(scripts / "identifier")
        assert done.returncode == 2
        assert "pip install 'symbid_ros[ros]'" in done.stderr

    def test_alone_identifies_from_arrays(self, wheel: Path, compiled: str, tmp_path: Path) -> None:
        """The core needs NumPy, SciPy, Numba, Clarabel, PyYAML; no bags, ROS or simulator."""
        scripts = install(wheel, tmp_path / "environment", set())
        run = partial(run_in, tmp_path, compiled)
        done = run(scripts / "python", "-c", FROM_ARRAYS, ur5_urdf())
        assert done.returncode == 0, done.stderr
        assert done.stdout == "identified\n"

        # What needs an extra names it.
        done = run(scripts / "symbid", "--version")
        assert done.returncode == 2
        assert "pip install 'symbid_ros[bags]'" in done.stderr
