"""Mutate the most important modules, and measure the share of mutants that the quick tests catch.

    python benchmarks/mutation.py [--seed 16] [--count 320] [--jobs 1] [--only safety/gate.py] [--out results.jsonl]

A mutant is the sources with one small change, for example another comparison, another number, or a removed statement. A
site is a place in a source where such a change can be made (`mutating/sites.py`). The sites are sampled from all sites
of the modules in `mutating/modules.py`. Seed and sources determine the sample. For each mutant, the tests of the
changed module run in a copy of the sources. If they pass, the other quick tests of the module's area run. A mutant is
caught if a test fails, or if the tests take ten times as long as without the mutation. Otherwise it survives.

With --out each result is saved as a line of JSON in a file. A later run with the same file skips the mutants in the
file. --rerun-survivors runs only the survivors in the file again. Survivors that need no test are listed with their
reasons in `mutating/accepted.toml` and counted separately. Progress goes to standard error, the report to standard
output.
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

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.mutating.modules import MODULES, REPOSITORY, SOURCES, area_of, own_tests, rest_of_area
from benchmarks.mutating.results import (
    ACCEPTED_FILE,
    Result,
    append_result,
    describe,
    load_accepted,
    make_result,
    read_results,
    report,
)
from benchmarks.mutating.sites import Mutation, Site, find_sites
from benchmarks.mutating.trial import WorkTree

from lavt.errors import UserError
from lavt.streams import stream

MIN_LIMIT_S = 30.0
"""The shortest time limit. Other work on the machine can delay short tests by more than `--timeout-factor` allows."""
UNMUTATED_LIMIT_S = 3600.0
"""The time limit of the tests without a mutation."""


def sites_of(modules: Sequence[str]) -> dict[str, list[Site]]:
    """Return the sites in the current sources, by module."""
    return {module: find_sites(module, (REPOSITORY / SOURCES / module).read_text()) for module in modules}


def sample(sites: Mapping[str, Sequence[Site]], seed: int, count: int) -> list[Mutation]:
    """Return one mutation of each of `count` random sites, each site equally likely.

    With the same seed, a smaller count gives the beginning of the list that a larger count gives.
    """
    all_sites = [site for module_sites in sites.values() for site in module_sites]
    order = stream(seed, "mutation sites").permutation(len(all_sites))
    choices = stream(seed, "mutation replacements").integers(0, 2**32, size=len(all_sites))
    return [all_sites[index][int(choices[index]) % len(all_sites[index])] for index in order[:count]]


class MutantRunner:
    """A runner that tests mutants in parallel, each in a tree of its own: a copy of the repository."""

    def __init__(self, directory: Path, jobs: int, factor: float) -> None:
        self._first = WorkTree(directory / "0", REPOSITORY)
        self._directory = directory
        self._jobs = jobs
        self._factor = factor
        self._limits_s: dict[tuple[str, ...], float] = {}
        self._lock = Lock()

    def limit_s(self, tests: tuple[str, ...], tree: WorkTree) -> float:
        """Return the time limit of the tests on a mutant. Raise `UserError` if the tests fail without a mutation."""
        with self._lock:
            if tests not in self._limits_s:
                trial = tree.run(tests, UNMUTATED_LIMIT_S, unchanged=True)
                if not trial.passed:
                    raise UserError(f"the tests fail without any mutation ({trial.failed_test}): repair them first")
                self._limits_s[tests] = max(MIN_LIMIT_S, self._factor * trial.took_s)
            return self._limits_s[tests]

    def run(self, mutations: Sequence[Mutation]) -> Iterator[Result]:
        """Run the tests on the mutant of each mutation, and yield each result when it is available."""
        for module in sorted({mutation.module for mutation in mutations}):
            self.limit_s(own_tests(module), self._first)  # checks the tests before the first mutant
        trees: SimpleQueue[WorkTree] = SimpleQueue()
        trees.put(self._first)
        for number in range(1, self._jobs):
            trees.put(WorkTree(self._directory / str(number), self._first.directory))

        def run_in_free_tree(mutation: Mutation) -> Result:
            tree = trees.get()
            try:
                return self._run_mutation(mutation, tree)
            finally:
                trees.put(tree)

        pool = ThreadPoolExecutor(self._jobs)
        try:
            for future in as_completed([pool.submit(run_in_free_tree, mutation) for mutation in mutations]):
                yield future.result()
        finally:
            pool.shutdown(cancel_futures=True)

    def _run_mutation(self, mutation: Mutation, tree: WorkTree) -> Result:
        took_s = 0.0
        own, area = own_tests(mutation.module), area_of(mutation.module)
        # The limit for the rest of the area is that of the whole area, which modules of the area share.
        for tests, limiting_tests in ((own, own), (rest_of_area(mutation.module), area)):
            trial = tree.run_mutated(mutation, tests, self.limit_s(limiting_tests, tree))
            took_s += trial.took_s
            if not trial.passed:
                return make_result(mutation, trial.failed_test, took_s)
        return make_result(mutation, "", took_s)


def parse_arguments(argv: list[str] | None = None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=320, help="number of mutants")
    parser.add_argument("--jobs", type=int, default=1, help="number of mutants that are tested in parallel")
    parser.add_argument("--only", action="append", choices=MODULES, metavar="MODULE", help="can be repeated")
    parser.add_argument("--timeout-factor", type=float, default=10.0, help="time limit / time without a mutation")
    parser.add_argument("--out", type=Path, help="file of results; mutants in it are not run again")
    parser.add_argument("--list", action="store_true", help="print the mutants without running their tests")
    parser.add_argument("--rerun-survivors", action="store_true", help="only run the survivors in --out again")
    options = parser.parse_args(argv)
    if options.count < 1 or options.jobs < 1 or not options.timeout_factor >= 1:
        parser.error("--count and --jobs must be above zero, --timeout-factor at least 1")
    if options.rerun_survivors and (options.out is None or not options.out.exists()):
        parser.error("--rerun-survivors needs --out with the file of an earlier run")
    return options


def measure(options: argparse.Namespace, log: Callable[[str], None]) -> str:
    """Run the selected mutants, and return the report. Raise `UserError` for invalid files."""
    all_sites = sites_of(list(MODULES))
    accepted = load_accepted(ACCEPTED_FILE, all_sites)
    sites = {module: all_sites[module] for module in options.only or MODULES}
    results = read_results(options.out) if options.out else {}
    if options.rerun_survivors:
        current_mutations = {
            mutation.key: mutation for module_sites in sites.values() for site in module_sites for mutation in site
        }
        survivors = [result for result in results.values() if not result.caught and result.place not in accepted]
        for survivor in survivors:
            if survivor.key not in current_mutations:
                log(f"no longer in the sources: {describe(survivor)}")
        selected = todo = [
            current_mutations[survivor.key] for survivor in survivors if survivor.key in current_mutations
        ]
    else:
        selected = sample(sites, options.seed, options.count)
        todo = [mutation for mutation in selected if mutation.key not in results]
    if options.list:
        return "\n".join(map(describe, selected))
    with TemporaryDirectory(prefix="lavt_mutation_") as directory:
        runner = MutantRunner(Path(directory), min(options.jobs, max(1, len(todo))), options.timeout_factor)
        for number, result in enumerate(runner.run(todo), start=1):
            results[result.key] = result
            if options.out:
                append_result(options.out, result)
            outcome_text = f"caught by {result.by}" if result.caught else "SURVIVED"
            log(f"{number} of {len(todo)}, {result.took_s:.1f} s: {describe(result)}: {outcome_text}")
    reported_keys = results if options.rerun_survivors else [mutation.key for mutation in selected]
    return report([results[key] for key in reported_keys], accepted)


def main() -> int:
    """Run the program; return 2 for a user error."""
    options = parse_arguments()
    try:
        print(measure(options, log=lambda line: print(line, file=sys.stderr, flush=True)))
    except UserError as error:
        print(error, file=sys.stderr)
        return 2
    return 0


if __name__ == "__main__":
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # removes the trees and kills running tests
    sys.exit(main())
