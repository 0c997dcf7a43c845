"""Mutate the modules that matter, and measure which share of the mutants the quick tests catch.

    python benchmarks/mutation.py [--seed 16] [--count 320] [--jobs 1] [--only safety/gate.py] [--out results.jsonl]

A mutant is one small change in one place: a comparison, a number, a statement that is removed (`mutating/sites.py`).
The places are drawn at random from all places of the modules in `mutating/modules.py`, and follow from the seed and the
sources. Each mutant runs in a copy of the sources: first the tests that are about its module, then, if they pass, the
quick tests of its area. A mutant that fails a test, or takes ten times as long as unmutated, is caught.

With --out each result is kept in a file as a line of JSON, and a later run with the same file runs only what is not in
it; --rerun-survivors runs what survived in it again. Survivors that are equivalent or accepted are listed with their
reasons in `mutating/accepted.toml` and counted apart. Progress is on standard error, the report on standard output.
"""

from __future__ import annotations

import argparse
import signal
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path
from queue import SimpleQueue
from tempfile import TemporaryDirectory
from threading import Lock

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a program it finds only what is beside it

from benchmarks.mutating.modules import MODULES, REPOSITORY, SOURCES, area_of, own_tests, rest_of_area
from benchmarks.mutating.results import (
    ACCEPTED_FILE,
    Result,
    append_result,
    described,
    load_accepted,
    read_results,
    report,
    result_of,
)
from benchmarks.mutating.sites import Mutation, Site, find_sites
from benchmarks.mutating.trial import WorkTree

from lavt.errors import UserError
from lavt.streams import stream

LEAST_LIMIT_S = 30.0
"""A short test may wait longer than some times its own duration where other work keeps the machine busy."""
UNMUTATED_LIMIT_S = 3600.0


def sites_of(modules: Sequence[str]) -> dict[str, list[Site]]:
    """Return the sites of the modules as they are now."""
    return {module: find_sites(module, (REPOSITORY / SOURCES / module).read_text()) for module in modules}


def sample(sites: Mapping[str, Sequence[Site]], seed: int, count: int) -> list[Mutation]:
    """Return mutations of so many sites, each site as likely as any other; a smaller count gives the first ones."""
    every = [site for of_module in sites.values() for site in of_module]
    order = stream(seed, "mutation sites").permutation(len(every))
    choices = stream(seed, "mutation replacements").integers(0, 2**32, size=len(every))
    return [every[index][int(choices[index]) % len(every[index])] for index in order[:count]]


class Runner:
    """Tries mutants in several trees at a time."""

    def __init__(self, directory: Path, jobs: int, factor: float) -> None:
        self._first = WorkTree(directory / "0", REPOSITORY)
        self._directory = directory
        self._jobs = jobs
        self._factor = factor
        self._limits_s: dict[tuple[str, ...], float] = {}
        self._lock = Lock()

    def check(self, tests: tuple[str, ...], tree: WorkTree) -> float:
        """Return how long the tests may take with a mutant.

        Raises `UserError` where they fail without one.
        """
        with self._lock:
            if tests not in self._limits_s:
                trial = tree.run(tests, UNMUTATED_LIMIT_S, unchanged=True)
                if not trial.passed:
                    raise UserError(f"the tests fail without any mutation ({trial.failed_test}): repair them first")
                self._limits_s[tests] = max(LEAST_LIMIT_S, self._factor * trial.took_s)
            return self._limits_s[tests]

    def run(self, mutations: Sequence[Mutation]) -> Iterator[Result]:
        """Try all mutations, and give each result when it is there."""
        for module in sorted({mutation.module for mutation in mutations}):
            self.check(own_tests(module), self._first)
        trees: SimpleQueue[WorkTree] = SimpleQueue()
        trees.put(self._first)
        for number in range(1, self._jobs):
            trees.put(WorkTree(self._directory / str(number), self._first.directory))

        def outcome(mutation: Mutation) -> Result:
            tree = trees.get()
            try:
                return self._outcome(mutation, tree)
            finally:
                trees.put(tree)

        pool = ThreadPoolExecutor(self._jobs)
        try:
            for future in as_completed([pool.submit(outcome, mutation) for mutation in mutations]):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)

    def _outcome(self, mutation: Mutation, tree: WorkTree) -> Result:
        took_s = 0.0
        own, area = own_tests(mutation.module), area_of(mutation.module)
        for tests, checked in ((own, own), (rest_of_area(mutation.module), area)):
            trial = tree.run_mutated(mutation, tests, self.check(checked, tree))
            took_s += trial.took_s
            if not trial.passed:
                return result_of(mutation, trial.failed_test, took_s)
        return result_of(mutation, "", took_s)


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=320, help="mutants")
    parser.add_argument("--jobs", type=int, default=1, help="mutants at a time")
    parser.add_argument("--only", action="append", choices=MODULES, metavar="MODULE", help="may be given again")
    parser.add_argument("--timeout-factor", type=float, default=10.0, help="times the duration without a mutation")
    parser.add_argument("--out", type=Path, help="file of results; what is in it is not run again")
    parser.add_argument("--list", action="store_true", help="print the mutants and run none")
    parser.add_argument(
        "--rerun-survivors", action="store_true", help="run what survived in --out again, and only that"
    )
    requested = parser.parse_args(words)
    if requested.count < 1 or requested.jobs < 1 or not requested.timeout_factor >= 1:
        parser.error("--count and --jobs must be above zero, --timeout-factor at least 1")
    if requested.rerun_survivors and (requested.out is None or not requested.out.exists()):
        parser.error("--rerun-survivors needs --out with the file of an earlier run")
    return requested


def measure(requested: argparse.Namespace, tell: Callable[[str], None]) -> str:
    """Run what is asked, and return the report. Raises `UserError`."""
    every = sites_of(list(MODULES))
    accepted = load_accepted(ACCEPTED_FILE, every)
    sites = {module: every[module] for module in requested.only or MODULES}
    results = read_results(requested.out) if requested.out else {}
    if requested.rerun_survivors:
        of_sources = {mutation.key: mutation for of_module in sites.values() for site in of_module for mutation in site}
        again = [each for each in results.values() if not each.caught and each.place not in accepted]
        for each in again:
            if each.key not in of_sources:
                tell(f"not in the sources any more: {described(each)}")
        wanted = todo = [of_sources[each.key] for each in again if each.key in of_sources]
    else:
        wanted = sample(sites, requested.seed, requested.count)
        todo = [mutation for mutation in wanted if mutation.key not in results]
    if requested.list:
        return "\n".join(map(described, wanted))
    with TemporaryDirectory(prefix="lavt_mutation_") as directory:
        runner = Runner(Path(directory), min(requested.jobs, max(1, len(todo))), requested.timeout_factor)
        for number, result in enumerate(runner.run(todo), start=1):
            results[result.key] = result
            if requested.out:
                append_result(requested.out, result)
            said = f"caught by {result.by}" if result.caught else "SURVIVED"
            tell(f"{number} of {len(todo)}, {result.took_s:.1f} s: {described(result)}: {said}")
    counted = results if requested.rerun_survivors else [mutation.key for mutation in wanted]
    return report([results[key] for key in counted], accepted)


def main() -> int:
    """Measure; 2 for what the user did wrong."""
    requested = arguments()
    try:
        print(measure(requested, tell=lambda line: print(line, file=sys.stderr, flush=True)))
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # the trees are removed, and the tests that run are ended
    sys.exit(main())
