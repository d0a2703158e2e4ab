"""The order of the files, and simulated logs that several of them read, each recorded once."""

import contextlib
import fcntl
import gc
import io
import logging
import os
import signal
import subprocess
import sys
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from browser import Browser, find_chromium, started_browser
from hypothesis import HealthCheck, settings

from symbid_ros.cli.processes import unused_domain

# NumPy reads these when it is loaded, which is later: threads of BLAS slow small matrices down.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# The tests start hundreds of processes: without bytecode each would compile SciPy anew.
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
sys.dont_write_bytecode = False

# A busy machine is slow, which is no fault of what is tested; equal runs test equal examples.
settings.register_profile(
    "tests",
    deadline=None,
    derandomize=True,
    database=None,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("tests")

# Files by duration, the longest first; shorter ones are not listed.
LONGEST = (
    "test_study_small.py",
    "test_ros_balance_controller.py",
    "test_ros_online_identifier.py",
    "test_cli_online_demo.py",
    "test_cli_documentation.py",
    "test_report_browser.py",
    "test_identification_contacts.py",
    "test_ros_soak.py",
    "test_ros_online_changes.py",
    "test_packaging.py",
    "test_learning_lockstep.py",
    "test_ros_bridge.py",
    "test_ros_model_source.py",
    "test_simulation_scenario.py",
    "test_cli_identify.py",
    "test_examples.py",
    "test_ros_identifier.py",
    "test_identification_solved_problem.py",
    "test_simulation_balance.py",
    "test_diagnosis_clean.py",
    "test_cli_rehearsal.py",
    "test_online_sensor_errors.py",
    "test_ros_malformed_requests.py",
    "test_simulation_stepping.py",
    "test_identification_trees.py",
    "test_study_figures.py",
    "test_cli_demo.py",
    "test_online_identification.py",
    "test_identification_change_monitor.py",
    "test_simulation_standing_controller.py",
    "test_excitation_standing.py",
    "test_ros_udp.py",
    "test_diagnosis_faults.py",
    "test_model_export.py",
    "test_api.py",
    "test_cli_excite.py",
    "test_docs_browser.py",
    "test_cli_learning_demo.py",
    "test_ros_player.py",
    "test_cli_evaluate.py",
    "test_ros_web_monitor.py",
    "test_identification_fleet.py",
    "test_cluster_study.py",
    "test_report_page.py",
    "test_bench_excitation.py",
    "test_cli_wrist_sensor.py",
    "test_estimation_bound.py",
    "test_study_sensor_subsets.py",
    "test_ros_recorder.py",
    "test_simulation_udp.py",
    "test_ros_process_udp.py",
    "test_cluster_identify.py",
    "test_diagnosis_quadruped.py",
    "test_cli_verbosity.py",
    "test_identification_rates.py",
    "test_ros_base_topics.py",
    "test_identification_joint_terms.py",
    "test_cli_faults.py",
    "test_signals_sensor_samples.py",
    "test_ros_online_shutdown.py",
    "test_estimation_posterior.py",
    "test_identification_validation.py",
    "test_bags_recover.py",
    "test_ros_recorder_kill.py",
    "test_bags_limits.py",
    "test_browser.py",
    "test_model_limits.py",
    "test_identification_loaded_problem.py",
    "test_simulation_systematic_errors.py",
    "test_cli_robot_file.py",
    "test_simulation_noise.py",
    "test_identification_likely_cause.py",
    "test_online_other_drivers.py",
    "test_identification_calibration.py",
    "test_ros_monitor.py",
    "test_bags_conformance.py",
    "test_signals_weak_form.py",
    "test_simulation_body_inertia.py",
    "test_identification_base_pose.py",
    "test_estimation_archive.py",
    "test_signals_filters.py",
    "test_ros_process.py",
    "test_ros_commands.py",
    "test_bench_foreign_robots.py",
    "test_report_robot_view.py",
    "test_identification_realistic_prediction.py",
    "test_signals_sensor_errors.py",
    "test_cli_live.py",
    "test_diagnosis_closed_form.py",
    "test_bags_fuzz.py",
    "test_identification_stated_friction.py",
    "test_excitation_page.py",
    "test_estimation_change.py",
    "test_ros_web_server.py",
    "test_estimation_prior.py",
    "test_cli_simulate.py",
    "test_identification_window_comparison.py",
    "test_cli_doctor.py",
    "test_cli_validate.py",
    "test_simulation_friction.py",
    "test_diagnosis_arms.py",
)


def pytest_configure(config: pytest.Config) -> None:
    # A shell starts background jobs deaf to Ctrl-C, and what these start inherits that.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    config.option.loadscopereorder = False  # by number of tests, which says nothing here
    if "PYTEST_XDIST_WORKER" not in os.environ:
        from symbid_ros.dynamics.inertial_rows import compile_kernel

        # Once for all workers, and for processes whose output is compared.
        compile_kernel()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    rank = {name: place for place, name in enumerate(LONGEST)}
    # Several workers finish together if the longest files start first (--dist loadfile). A
    # single process starts with the short files, so that -x stops early.
    is_worker = "PYTEST_XDIST_WORKER" in os.environ
    items.sort(
        key=lambda item: rank.get(item.path.name, len(LONGEST)),
        reverse=not is_worker,
    )


@pytest.hookimpl(wrapper=True)
def pytest_collection(session: pytest.Session) -> Iterator[None]:
    if not hasattr(session.config, "workerinput"):  # the environment of workers is inherited
        return (yield)
    # In a fresh checkout, the first worker writes the bytecode of tests and libraries, which takes
    # most of its time here; the others wait and read it.
    marker = Path(session.config.getoption("basetemp")).parent / "collected"
    with marker.open("a") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not marker.stat().st_size:
            collected = yield
            lock.write("by the first worker")
            return collected
    return (yield)


def pytest_collection_finish() -> None:
    # Modules and collected tests live until the end: without them in each search for garbage, and
    # with fewer searches, the tests need about a tenth less processor time.
    gc.collect()
    gc.freeze()
    gc.set_threshold(10_000)


@pytest.fixture
def domain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[int]:
    """A ROS domain of the test's own, in the environment as well."""
    with unused_domain() as number:
        monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
        monkeypatch.setenv("ROS_DOMAIN_ID", str(number))
        monkeypatch.setenv("ROS_LOG_DIR", str(tmp_path / "log"))
        yield number


@pytest.fixture(scope="session")
def symbid_here() -> Callable[..., subprocess.CompletedProcess[str]]:
    """Return what runs the command in this process, which has its libraries loaded already."""

    def run(*arguments: object, columns: int = 100) -> subprocess.CompletedProcess[str]:
        from symbid_ros.cli.main import main

        words = ["symbid", *map(str, arguments)]
        out, err = io.StringIO(), io.StringIO()
        with (
            pytest.MonkeyPatch.context() as patch,
            contextlib.redirect_stdout(out),
            contextlib.redirect_stderr(err),
            warnings.catch_warnings(),
        ):
            # Neither pytest's log handlers nor its record of warnings keep any from stderr.
            patch.setattr(logging.root, "handlers", [])
            warnings.simplefilter("error")
            patch.setattr(sys, "argv", words)
            patch.setenv("COLUMNS", str(columns))
            with pytest.raises(SystemExit) as ended:
                main()
        return subprocess.CompletedProcess(
            words, ended.value.code or 0, out.getvalue(), err.getvalue()
        )

    return run


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    """Chromium without a window; without one the tests are skipped, and the summary warns."""
    executable = find_chromium()
    if executable is None:
        reason = "no Chromium found: pages are not tested; install it or set SYMBID_CHROMIUM"
        warnings.warn(reason, stacklevel=1)
        pytest.skip(reason)
    # Playwright's event loop runs until the file's last test, so a file that uses asyncio must
    # not ask for this fixture.
    with started_browser(executable) as started:
        yield started


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return the bag of a name; of all workers the first to ask makes and records its robot."""
    folder = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        folder = folder.parent  # the workers' folders lie side by side

    def bag(name: str, make: Callable[[], Any]) -> Path:
        from symbid_ros.simulation.recording import record

        path = folder / name
        with (folder / f"{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not path.exists():
                record(make(), path)
        return path

    return bag


@pytest.fixture(scope="session")
def simulated(recorded: Callable[..., Path]) -> Callable[..., Path]:
    """Return the bag of a simulation."""

    def bag(scenario: str, **options: object) -> Path:
        from symbid_ros.simulation.options import SimulateOptions
        from symbid_ros.simulation.simulator import Simulator

        robot = {key: options[key] for key in ("payload",) if key in options}
        motion = {key: value for key, value in options.items() if key not in robot}
        name = "_".join([scenario, *(f"{key}_{options[key]}" for key in sorted(options))])
        return recorded(name, lambda: Simulator(SimulateOptions(scenario, **motion), **robot))

    return bag


@pytest.fixture(scope="session")
def tree_log(recorded: Callable[..., Path]) -> Callable[[int, bool], tuple[Any, Path]]:
    """Return a random robot of five links and its bag of 2.5 s."""

    def log(seed: int, floating: bool) -> tuple[Any, Path]:
        from random_robots import random_robot
        from tree_simulation import TreeSimulation

        robot = random_robot(seed, links=5, floating=floating, wrench_frames=seed)
        name = f"tree_{seed}_{floating}"
        return robot, recorded(name, lambda: TreeSimulation(robot, 2.5, seed))

    return log
