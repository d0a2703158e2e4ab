"""A small study of everything, and tasks of studies in this process."""

from collections.abc import Callable
from concurrent.futures import Executor, Future
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from symbid_ros.study.draws import StudyResults
from symbid_ros.study.plan import Plan, load_plan
from symbid_ros.study.stages import study_stages
from symbid_ros.study.study_folder import StudyFolder
from symbid_ros.study.task_runner import run_tasks

PLAN = """\
title: A small study
thesis: true
data:
  smooth: { scenario: smooth, moves: 1, motion_seed: 21, noise_seed: 5 }
validation: { scenario: smooth, moves: 1, motion_seed: 22, noise: 0.0 }
priors: [{ percent: 25.0 }, { absolute: 0.125 }]
iterations: 2
prior_seed: 8
filters: [30.0]
figures:
  data: smooth
  prior: { percent: 25.0 }
  com: 30.0
  torque: 30.0
  momentum: 30.0
  links: 30.0
  parameters: 30.0
accelerations:
  cutoff: 70.0
  logs:
    vibrating: { scenario: vibrating, moves: 1 }
    floating: { scenario: suspended, moves: 1 }
equation: { scenario: smooth, moves: 1, motion_seed: 22, noise: 0.0 }
closed_loop: { data: smooth, priors: [{ percent: 25.0 }], iterations: 1, moves: 1 }
"""


@dataclass(frozen=True)
class SmallStudy:
    file: Path
    out: Path

    @property
    def plan(self) -> Plan:
        return load_plan(str(self.file))[0]

    @property
    def results(self) -> StudyResults:
        return StudyResults.read(self.plan, StudyFolder(self.out))


class InlineExecutor(Executor):
    """Runs tasks in this process, which has their libraries loaded already."""

    def submit(self, function: Callable[..., Any], /, *args: Any, **kwargs: Any) -> "Future[Any]":
        future: Future[Any] = Future()
        try:
            future.set_result(function(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


def run_inline(plan: Plan, folder: StudyFolder) -> None:
    """Run the missing tasks of a study in this process."""
    for stage in study_stages(plan, folder):
        run_tasks(InlineExecutor(), stage.tasks, lambda _: None)
