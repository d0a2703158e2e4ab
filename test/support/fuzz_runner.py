"""Runs numbered cases in several processes and prints what failed and how to repeat it."""

import argparse
import sys
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context


def run_cases(run: Callable[[range], list[str]], what: str, *, cases: int, batch: int) -> int:
    """Run the cases that the command line asks for and return the exit status.

    Parameters
    ----------
    run : callable
        Runs some cases in a process of its own and returns a text for each failure, which begins
        with a word and the case's number.
    what : str
        What the cases are, for the command line.
    cases, batch : int
        How many there are by default, and how many a process runs at once.
    """
    parser = argparse.ArgumentParser(description=f"Try random {what}.")
    parser.add_argument("--cases", type=int, default=cases)
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    given = parser.parse_args()
    last = given.first + given.cases
    batches = [range(n, min(n + batch, last)) for n in range(given.first, last, batch)]
    failures = 0
    with ProcessPoolExecutor(given.processes, mp_context=get_context("spawn")) as pool:
        for some, found in zip(batches, pool.map(run, batches), strict=True):
            failures += len(found)
            for text in found:
                case = text.split(":")[0].split()[-1]
                print(f"{text}\n    repeat: python {sys.argv[0]} --first {case} --cases 1")
            if some.stop % (10 * batch) == 0:
                print(f"{what} up to {some.stop}: {failures} failures", flush=True)
    print(f"{given.cases} {what} from {given.first}: {failures} failures")
    return 1 if failures else 0
