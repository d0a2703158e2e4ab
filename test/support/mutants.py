"""Put random faults into the code, one at a time, and list those that the tests do not notice.

The faults come from cosmic-ray. A place in the code is drawn first, then one of the faults
possible there, so that no place counts more often because it can be changed in many ways.
Equal seeds draw equal faults from equal code. Everything happens in a temporary copy of
the checkout. An interrupted run resumes where it stopped.

Left out are faults that no test can or should notice, or that every test notices:

* in type annotations, in ``raise`` statements and in calls of a logger, which hold text;
* in the guards ``frozen=``, ``slots=``, ``kw_only=`` of dataclasses and ``strict=`` of zip;
* in lists of parameters (a bare ``*``) and decorators, without which nothing can be imported
  or a property is a method;
* arithmetic replaced by bit operations and the reverse, ``==`` by ``is``, ``-x`` by ``~x``
  or ``not x``: most raise a TypeError at once.
"""

import argparse
import hashlib
import json
import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast_from_path
from cosmic_ray.mutating import _make_diff, use_mutation
from cosmic_ray.plugins import get_operator, operator_names
from cosmic_ray.work_db import WorkDB, use_db
from cosmic_ray.work_item import MutationSpec, TestOutcome, WorkerOutcome, WorkItem, WorkResult

ROOT = Path(__file__).resolve().parents[2]
PACKAGE = "symbid_ros"
SUBPACKAGES = ("model", "dynamics", "signals", "estimation", "diagnosis", "bags")
SESSIONS = ROOT / ".mutants"
NOT_COPIED = (".*", "build", "install", "log", "demo", "__pycache__", "*.egg-info")
GOAL = 0.85
# pytest's statuses of an internal error, wrong usage, and no tests: no fault does that.
BROKEN = (3, 4, 5)

ARITHMETIC = {"Add", "Sub", "Mul", "Div", "FloorDiv", "Mod", "Pow"}
BITWISE = {"RShift", "LShift", "BitOr", "BitAnd", "BitXor"}
ORDER = {"Eq", "NotEq", "Lt", "LtE", "Gt", "GtE"}
IDENTITY = {"Is", "IsNot"}
UNARY = {"USub_UAdd", "Delete_USub", "Delete_Not", "Delete_Invert"}
GUARDS = {"frozen", "slots", "kw_only", "strict"}


def main() -> int:
    """Draw faults, run the tests on each, and print what survived."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument(
        "--again", action="store_true", help="run survivors of an earlier run once more"
    )
    given = parser.parse_args()
    drawn = draw(given.seed, given.count)
    SESSIONS.mkdir(exist_ok=True)
    name = f"{given.seed}-{given.count}-{digest()}"
    with use_db(SESSIONS / f"{name}.sqlite") as session:
        if session.num_work_items == 0:
            session.add_work_items(drawn)
        with tempfile.TemporaryDirectory(prefix="mutants-") as folder:
            runner = Runner(Path(folder), SESSIONS / f"{name}.json")
            run(session, drawn, runner, again=given.again)
        return report(session, drawn)


def draw(seed: int, count: int) -> list[WorkItem]:
    """Return faults drawn at random; each has its number as its name."""
    chooser = random.Random(seed)
    places = [faults for path in sources() for _, faults in sorted(faults_by_place(path).items())]
    chosen = chooser.sample(places, count)
    return [
        WorkItem.single(f"{number:04d}", chooser.choice(faults))
        for number, faults in enumerate(chosen)
    ]


def sources() -> list[Path]:
    """Return the modules that get faults, relative to the checkout."""
    folders = [ROOT / PACKAGE / subpackage for subpackage in SUBPACKAGES]
    return [path.relative_to(ROOT) for folder in folders for path in sorted(folder.rglob("*.py"))]


def digest() -> str:
    """Return what tells one state of these modules from another."""
    content = b"".join((ROOT / path).read_bytes() for path in sources())
    return hashlib.sha256(content).hexdigest()[:12]


def faults_by_place(path: Path) -> dict[tuple[int, int], list[MutationSpec]]:
    """Return the faults possible at each line and column of a module."""
    nodes = list(ast_nodes(get_ast_from_path(ROOT / path)))
    lines = (ROOT / path).read_text().splitlines()
    found: dict[tuple[int, int], list[MutationSpec]] = defaultdict(list)
    for name in operator_names():
        kind = get_operator(name)
        if kind.arguments() or not is_plausible(name.partition("/")[2]):
            continue
        operator = kind()
        places = [
            (node, start, end) for node in nodes for start, end in operator.mutation_positions(node)
        ]
        for occurrence, (node, start, end) in enumerate(places):
            # Cosmic-ray breaks the code of exceptions with a dotted name, or fails.
            text = lines[start[0] - 1][start[1] : end[1]]
            is_broken = name.endswith("/ExceptionReplacer") and not text.isidentifier()
            if not (is_broken or is_left_out(node)):
                found[start].append(MutationSpec(path, name, occurrence, start, end))
    return found


def is_plausible(operator: str) -> bool:
    """Tell whether a programmer might make this mistake without an immediate TypeError."""
    family, _, change = operator.partition("_")
    before, _, after = change.partition("_")
    if family == "ReplaceBinaryOperator":
        return any({before, after} <= kin for kin in (ARITHMETIC, BITWISE))
    if family == "ReplaceComparisonOperator":
        return any({before, after} <= kin for kin in (ORDER, IDENTITY))
    if family == "ReplaceUnaryOperator":
        return change in UNARY
    return family != "RemoveDecorator"


def is_left_out(node) -> bool:
    """Tell whether a node lies in an annotation, in text, in a decorator or in a guard."""
    child, parent = node, node.parent
    while parent is not None:
        if _leaves_out(parent, child):
            return True
        child, parent = parent, parent.parent
    return False


def _leaves_out(parent, child) -> bool:
    """Tell whether what lies in a child of a node is left out."""
    if parent.type == "funcdef":
        return parent.annotation is child
    if parent.type == "annassign":
        return parent.children[1] is child
    if parent.type in {"param", "parameters"}:  # a bare * or /
        return child.type == "operator"
    if parent.type == "argument":
        return parent.children[0].get_code().strip() in GUARDS
    if parent.type in {"atom_expr", "power"}:
        return parent.get_code().strip().startswith(("logger.", "warnings."))
    return parent.type in {"tfpdef", "raise_stmt", "decorator"}


@dataclass
class Runner:
    """Runs tests on a copy of the checkout.

    Parameters
    ----------
    folder : Path
        Temporary; the copy lies in it.
    times_file : Path
        The processor time that each subpackage's tests take without a fault, s.
    """

    folder: Path
    times_file: Path

    def __post_init__(self) -> None:
        self.copy = self.folder / "tree"
        shutil.copytree(ROOT, self.copy, ignore=shutil.ignore_patterns(*NOT_COPIED))
        self._second = 0
        self._times: dict[str, float] = {}
        if self.times_file.exists():
            self._times = json.loads(self.times_file.read_text())

    def result(self, fault: MutationSpec) -> WorkResult:
        """Return what the tests say of a fault."""
        limit = self._limit(fault.module_path.parts[1])
        path = self.copy / fault.module_path
        operator = get_operator(fault.operator_name)()
        with use_mutation(path, operator, fault.occurrence) as (before, after):
            # Bytecode knows its source by size and second: no two states may share a second.
            self._second += 1
            os.utime(path, (self._second, self._second))
            is_noticed, output = self._pytest(self._tests_of(fault.module_path), limit)
        return WorkResult(
            WorkerOutcome.NORMAL,
            output=output[-20_000:],
            test_outcome=TestOutcome.KILLED if is_noticed else TestOutcome.SURVIVED,
            diff="\n".join(_make_diff(before, after, fault.module_path)),
        )

    def _limit(self, subpackage: str) -> int:
        """Return the processor time that a subpackage's tests may take, s.

        Without a fault they must pass. On a busy machine the time on the clock says nothing.
        """
        if subpackage not in self._times:
            began = _spent()
            is_noticed, output = self._pytest([f"test/{subpackage}"], None)
            if is_noticed:
                sys.exit(f"{output}\nthe tests of {subpackage} fail without any fault")
            self._times[subpackage] = _spent() - began
            self.times_file.write_text(json.dumps(self._times))
        return round(60 + 3 * self._times[subpackage])

    def _tests_of(self, module: Path) -> list[str]:
        """Return the test files of a module's subpackage, those named after the module first."""
        subpackage = module.parts[1]
        files = sorted((self.copy / "test" / subpackage).glob("test_*.py"))
        name = f"test_{subpackage}_{module.stem}"
        files.sort(key=lambda file: not file.stem.startswith(name))
        return [str(file.relative_to(self.copy)) for file in files]

    def _pytest(self, files: Sequence[str], limit: int | None) -> tuple[bool, str]:
        """Return whether a test fails, and the output of pytest up to there."""
        command = [sys.executable, "-m", "pytest", "-x", "-q", "--no-header", "--tb=line"]
        command += ["-p", "no:cacheprovider", f"--basetemp={self.folder / 'pytest'}", *files]
        environment = os.environ | {"PYTHONPATH": str(self.copy)}
        if limit is not None:  # ends a loop without end; pytest-timeout ends a deadlock
            command = ["bash", "-c", f'ulimit -t {limit} && exec "$@"', "bash", *command]
        with subprocess.Popen(
            command,
            cwd=self.copy,
            env=environment,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            text=True,
            start_new_session=True,
        ) as process:
            try:
                output, _ = process.communicate()
            finally:
                if process.poll() is None:  # interrupted: what it has started ends with it
                    os.killpg(process.pid, signal.SIGKILL)
        if process.returncode in BROKEN:
            sys.exit(f"{output}\npytest could not run the tests (status {process.returncode})")
        return process.returncode != 0, output


def _spent() -> float:
    """Return the processor time of all processes that have been waited for, s."""
    usage = resource.getrusage(resource.RUSAGE_CHILDREN)
    return usage.ru_utime + usage.ru_stime


def run(session: WorkDB, drawn: Sequence[WorkItem], runner: Runner, *, again: bool) -> None:
    """Run the tests on each fault that has no result yet."""
    known = dict(session.results)
    for number, item in enumerate(drawn, 1):
        before = known.get(item.job_id)
        if before is not None and not (again and not before.is_killed):
            continue
        (fault,) = item.mutations
        began = time.monotonic()
        result = runner.result(fault)
        session.set_result(item.job_id, result)
        word = "caught  " if result.is_killed else "SURVIVED"
        spent = time.monotonic() - began
        print(f"{number:4d}/{len(drawn)} {word} {spent:4.0f} s  {described(fault)}", flush=True)


def described(fault: MutationSpec) -> str:
    """Return where a fault is and what it is, in a line."""
    line, column = fault.start_pos
    return f"{fault.module_path}:{line}:{column + 1} {fault.operator_name.partition('/')[2]}"


def survivors(session: WorkDB, drawn: Sequence[WorkItem]) -> Iterator[tuple[WorkItem, WorkResult]]:
    """Yield the faults that no test has noticed."""
    known = dict(session.results)
    for item in drawn:
        if item.job_id in known and not known[item.job_id].is_killed:
            yield item, known[item.job_id]


def report(session: WorkDB, drawn: Sequence[WorkItem]) -> int:
    """Print the faults that survived, and return the exit status."""
    left = list(survivors(session, drawn))
    for item, result in left:
        print(f"\n{item.job_id}: {described(item.mutations[0])}\n{result.diff}")
    caught = session.num_results - len(left)
    print(f"\n{caught} of {session.num_results} faults caught, at least {GOAL:.0%} wanted")
    return 0 if caught >= GOAL * session.num_results else 1


if __name__ == "__main__":
    sys.exit(main())
