"""Results of mutants: a file of JSON lines, the accepted survivors, and the report."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Collection, Iterable, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from benchmarks.mutating.modules import SOURCES
from benchmarks.mutating.sites import Mutation, Site

from lavt.errors import UserError

ACCEPTED_FILE: Final = Path(__file__).with_name("accepted.toml")
ENTRY_KEYS: Final = ("module", "function", "line", "mutated")
"""The keys that an entry of `accepted.toml` must have, in addition to `reason`."""
_FIELD_TYPES: Final[dict[str, type | tuple[type, ...]]] = {
    "module": str,
    "function": str,
    "line": str,
    "mutated": str,
    "occurrence": int,
    "line_number": int,
    "operator": str,
    "caught": bool,
    "by": str,
    "took_s": (int, float),
}

Place = tuple[str, str, str, str]
"""Module, function, line and mutated line, but not the occurrence: an accepted survivor covers each occurrence of its
line in the function."""


@dataclass(frozen=True)
class Result:
    """The result of one mutant; the first seven fields are those of its `Mutation`."""

    module: str
    function: str
    line: str
    mutated: str
    occurrence: int
    line_number: int
    operator: str
    caught: bool
    by: str
    """What caught the mutant: the first test that failed, `timeout`, or pytest's exit status; empty if it survived."""
    took_s: float

    @property
    def key(self) -> tuple[str, str, str, str, int]:
        """The same as `Mutation.key`."""
        return self.module, self.function, self.line, self.mutated, self.occurrence

    @property
    def place(self) -> Place:
        """The place of the mutation, by which the accepted survivors are looked up."""
        return self.module, self.function, self.line, self.mutated


def make_result(mutation: Mutation, by: str, took_s: float) -> Result:
    """Return the result of a mutation; `by` is what caught the mutant, or empty."""
    return Result(
        *mutation.key, mutation.line_number, mutation.operator, caught=bool(by), by=by, took_s=round(took_s, 2)
    )


def describe(mutant: Mutation | Result) -> str:
    """Describe a mutant in one line: file and line number, the source line before and after, and the operator."""
    location = f"{SOURCES}/{mutant.module}:{mutant.line_number}"
    return f"{location}: `{mutant.line}` -> `{mutant.mutated}` ({mutant.operator})"


def read_results(path: Path) -> dict[tuple[str, str, str, str, int], Result]:
    """Return the last result of each mutant. Raise `UserError` for an invalid line."""
    results = {}
    for number, line in enumerate(path.read_text().splitlines() if path.exists() else (), start=1):
        try:
            fields = json.loads(line)
            if set(fields) != set(_FIELD_TYPES) or not all(
                isinstance(fields[name], _FIELD_TYPES[name]) for name in _FIELD_TYPES
            ):
                raise ValueError
        except (ValueError, TypeError):
            raise UserError(f"{path}, line {number}: not a result of this program; choose another --out") from None
        result = Result(**fields)
        results[result.key] = result
    return results


def append_result(path: Path, result: Result) -> None:
    """Append a line to a file of results."""
    with path.open("a") as file:
        file.write(json.dumps(asdict(result)) + "\n")


def load_accepted(path: Path, sites: Mapping[str, Iterable[Site]]) -> dict[Place, str]:
    """Return the accepted survivors with their reasons.

    Raise `UserError` for an entry that is incomplete or matches no mutation of the sources.
    """
    places = {
        (mutation.module, mutation.function, mutation.line, mutation.mutated)
        for module_sites in sites.values()
        for site in module_sites
        for mutation in site
    }
    accepted: dict[Place, str] = {}
    try:
        entries = tomllib.loads(path.read_text()).get("accepted", [])
    except (OSError, tomllib.TOMLDecodeError) as error:
        raise UserError(f"{path}: {error}; correct the file") from error
    for number, entry in enumerate(entries, start=1):
        if set(entry) != {*ENTRY_KEYS, "reason"} or not all(isinstance(value, str) for value in entry.values()):
            raise UserError(f"{path}: entry {number} needs {', '.join(ENTRY_KEYS)} and reason, each as text")
        place = (entry["module"], entry["function"], entry["line"], entry["mutated"])
        if place not in places:
            raise UserError(
                f"{path}: entry {number} ({entry['module']}, `{entry['line']}`) matches no mutation; "
                "correct or remove the entry"
            )
        accepted[place] = entry["reason"]
    return accepted


def report(results: Collection[Result], accepted: Mapping[Place, str]) -> str:
    """Return a line for each survivor, a table with a row for each module, and the share of caught mutants."""
    survivors = sorted(
        (result for result in results if not result.caught), key=lambda result: (result.module, result.line_number)
    )
    new_survivors = [result for result in survivors if result.place not in accepted]
    accepted_survivors = [result for result in survivors if result.place in accepted]
    lines = [f"survived: {describe(result)}" for result in new_survivors]
    lines += [f"accepted: {describe(result)}: {accepted[result.place]}" for result in accepted_survivors]
    lines += ["", "| module | mutants | caught | survived | accepted |", "|---|---|---|---|---|"]
    for module in (*sorted({result.module for result in results}), ""):  # "" is the row of all modules
        mutants, survived, accepted_count = (
            sum(module in (result.module, "") for result in counted_results)
            for counted_results in (results, new_survivors, accepted_survivors)
        )
        lines.append(
            f"| {module or 'all'} | {mutants} | {mutants - survived - accepted_count} | {survived} | {accepted_count} |"
        )
    not_accepted = len(results) - len(accepted_survivors)
    if not_accepted:
        caught = not_accepted - len(new_survivors)
        share = caught / not_accepted
        lines += ["", f"caught: {caught} of {not_accepted} mutants that are not accepted, {share:.1%}"]
    return "\n".join(lines)
