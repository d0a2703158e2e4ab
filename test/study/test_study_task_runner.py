"""Tasks in processes: each runs once, interrupted studies resume, and errors reach the caller."""

import multiprocessing
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from multiprocessing import connection
from pathlib import Path

import pytest
import study_tasks

from symbid_ros.errors import StudyError
from symbid_ros.study.plan import Plan
from symbid_ros.study.study_folder import StudyFolder
from symbid_ros.study.task_runner import Task, run_tasks, worker_pool


def task(place: Path, run=study_tasks.write, *more) -> Task:
    return Task(place, run, (place, *more), 1.0)


def test_completed_tasks_are_not_repeated(tmp_path):
    old, new = tmp_path / "old", tmp_path / "new"
    old.write_text("as it was")
    finished = []
    with worker_pool(2) as pool:
        run_tasks(
            pool,
            [task(old, study_tasks.write, "again"), task(new, study_tasks.write, "new")],
            finished.append,
        )
    assert [one.output for one in finished] == [old, new]
    assert (old.read_text(), new.read_text()) == ("as it was", "new")
    assert not multiprocessing.active_children()


def test_error_of_a_task_reaches_the_caller_and_results_stay(tmp_path):
    done, bad = tmp_path / "done", tmp_path / "bad"
    with pytest.raises(StudyError, match="refused") as caught, worker_pool(1) as pool:
        run_tasks(
            pool,
            [task(done, study_tasks.write, "kept"), task(bad, study_tasks.refuse)],
            lambda _: None,
        )
    assert caught.value.code == "E701"
    assert done.read_text() == "kept"
    # Not join(): it returns at once if another thread is collecting the process's status.
    running = [process.sentinel for process in multiprocessing.active_children()]
    while running and (ended := connection.wait(running, 300)):
        running = [one for one in running if one not in ended]
    assert not running


def test_a_worker_never_receives_ctrl_c(tmp_path):
    """It would print a traceback if it still imported libraries, so it starts with the mask."""
    with worker_pool(1) as pool:
        run_tasks(pool, [task(tmp_path / "a", study_tasks.tell_blocked_signals)], lambda _: None)
    assert int(signal.SIGINT) in map(int, (tmp_path / "a").read_text().split())
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, ())


def test_killed_process_is_reported(tmp_path):
    with pytest.raises(StudyError, match="start the study again to resume"), worker_pool(1) as pool:
        run_tasks(pool, [task(tmp_path / "never", study_tasks.die)], lambda _: None)


def test_killed_study_leaves_no_process(tmp_path):
    """Both a busy and an idle worker end."""
    places = tmp_path / "working", tmp_path / "waiting"
    script = f"""
import sys
from pathlib import Path
sys.path.append({str(Path(study_tasks.__file__).parent)!r})
import study_tasks
from symbid_ros.study.task_runner import Task, run_tasks, worker_pool
if __name__ == "__main__":
    working, waiting = map(Path, {list(map(str, places))!r})
    with worker_pool(2) as pool:
        run_tasks(pool, [
            Task(working, study_tasks.stay, (working,), 1.0),
            Task(waiting, study_tasks.tell, (waiting,), 1.0),
        ], lambda _: None)
"""
    program = tmp_path / "study.py"
    program.write_text(script, encoding="utf-8")
    with subprocess.Popen([sys.executable, program]) as study:
        until(lambda: all(place.exists() for place in places))
        study.kill()
    for place in places:
        state = Path("/proc", place.read_text(), "stat")
        until(lambda state=state: is_gone(state))


def is_gone(state: Path) -> bool:
    try:
        # Without an init process that reaps orphans, they remain as zombies.
        return state.read_text().rpartition(")")[2].split()[0] == "Z"
    except (FileNotFoundError, ProcessLookupError):
        return True


def until(condition: Callable[[], bool]) -> None:
    """Wait at most five minutes for another process."""
    deadline = time.monotonic() + 300
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def plan(**other) -> Plan:
    content = {"title": "A", "data": {"a": {}}, "priors": [{"percent": 25.0}]}
    return Plan.model_validate(content | other)


class TestStudyFolder:
    def test_reserved_folder_can_be_reserved_again(self, tmp_path):
        folder = StudyFolder(tmp_path / "out")
        folder.reserve(plan())
        mark = (folder.work / "plan.json").read_bytes()
        folder.reserve(plan())
        assert (folder.work / "plan.json").read_bytes() == mark

    def test_results_of_another_plan_stay_without_overwrite(self, tmp_path):
        folder = StudyFolder(tmp_path / "out")
        folder.reserve(plan())
        result = folder.work / "result"
        result.write_text("of the first plan")
        with pytest.raises(StudyError, match="another plan"):
            folder.reserve(plan(iterations=3))
        assert result.exists()
        folder.reserve(plan(iterations=3), overwrite=True)
        assert not result.exists()

    def test_an_overwritten_study_is_kept_until_the_new_one_is_complete(self, tmp_path):
        folder = StudyFolder(tmp_path / "out")
        folder.reserve(plan())
        result = folder.work / "result"
        result.write_text("of the first plan")
        (folder.out / "report.html").write_text("published")
        for iterations in (3, 4):  # the first of these never ends
            folder.reserve(plan(iterations=iterations), overwrite=True)
            assert not result.exists()
        # The new one resumes, and the first one comes back.
        folder.reserve(plan(iterations=4))
        assert not result.exists()
        folder.reserve(plan())
        assert result.read_text() == "of the first plan"
        folder.reserve(plan(iterations=4), overwrite=True)
        folder.complete()
        with pytest.raises(StudyError, match="another plan"):
            folder.reserve(plan())
        assert sorted(each.name for each in folder.out.iterdir()) == ["report.html", "work"]

    @pytest.mark.parametrize("overwrite", [False, True])
    def test_folder_of_something_else_is_rejected(self, tmp_path, overwrite):
        (tmp_path / "thesis.doc").write_text("mine")
        with pytest.raises(StudyError, match="not the folder of a study"):
            StudyFolder(tmp_path).reserve(plan(), overwrite=overwrite)
        assert [file.name for file in tmp_path.iterdir()] == ["thesis.doc"]
        with pytest.raises(StudyError, match="not the folder of a study"):
            StudyFolder(tmp_path / "thesis.doc").reserve(plan())
