from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import ClassVar

import pytest
from benchmarks import mutation
from benchmarks.mutating import results
from benchmarks.mutating.modules import MODULES, area_of, own_tests, rest_of_area
from benchmarks.mutating.sites import Mutation, Site, find_sites
from benchmarks.mutating.trial import ENDLESS, Trial, WorkTree
from tests.lanes import REPOSITORY

from lavt.errors import UserError

PROGRAM = REPOSITORY / "benchmarks" / "mutation.py"


@pytest.fixture(scope="module")
def every() -> dict[str, list[Site]]:
    """Give the sites of all modules."""
    return mutation.sites_of(list(MODULES))


def mutated(source: str, operator: str) -> list[str]:
    """Return every mutated source that an operator makes."""
    return [
        each.applied_to(source) for site in find_sites("a.py", source) for each in site if each.operator == operator
    ]


def body(*lines: str) -> str:
    return "\n".join(["def f(a, b, c):", *(f"    {line}" for line in lines), ""])


@pytest.mark.parametrize(
    ("operator", "line", "others"),
    [
        ("comparison", "g(a < b)", ["g(a <= b)", "g(a > b)"]),
        ("comparison", "g(a >= b)", ["g(a > b)", "g(a <= b)"]),
        ("comparison", "g((a) == (b))", ["g((a) != (b))"]),
        ("comparison", "g(a is not None)", ["g(a is None)"]),
        ("comparison", "g(a not in b)", ["g(a in b)"]),
        ("comparison", "g(a < b is c)", ["g(a <= b is c)", "g(a > b is c)", "g(a < b is not c)"]),
        ("and/or", "g(a and b and c)", ["g(a or b and c)", "g(a and b or c)"]),
        ("not removed", "g(not a)", ["g(a)"]),
        ("not added", "g(a if b else c)", ["g(a if not (b) else c)"]),
        ("not added", "while a < b: g()", ["while not (a < b): g()"]),
        ("not added", "g(a for a in b if a)", ["g(a for a in b if not (a))"]),
        ("arithmetic", "g(a + b * c)", ["g(a - b * c)", "g(a + b / c)"]),
        ("arithmetic", "a <<= b", ["a >>= b"]),
        ("number", "g(7, -1.5)", ["g(8, -1.5)", "g(14, -1.5)", "g(7, -2.5)", "g(7, -3.0)"]),
        ("number", "g(0, 1)", ["g(1, 1)", "g(0, 2)"]),
        ("number", "g(0xFF)", ["g(0x100)", "g(0x1fe)"]),
        ("boolean", "g(a, b=True)", ["g(a, b=False)"]),
        ("min/max", "g(min(a, b), a.maximum(b))", ["g(max(a, b), a.maximum(b))", "g(min(a, b), a.minimum(b))"]),
        ("statement", "a.b = c", ["pass"]),
        ("statement", "a += c", ["pass"]),
        ("statement", "g: int = c", ["pass"]),
        ("return value", "return a", ["return None"]),
        ("break/continue", "for a in b: break", ["for a in b: continue"]),
        ("break/continue", "for a in b: continue", ["for a in b: break"]),
        ("number", 'g("ü", 1)', ['g("ü", 2)']),
    ],
)
def test_operators(operator: str, line: str, others: list[str]) -> None:
    """Each operator replaces the text of one operator, value or statement, and nothing else."""
    assert mutated(body(line), operator) == [body(other) for other in others]


@pytest.mark.parametrize(
    "source",
    [
        '"""A docstring."""\n__all__ = ("a", "b")\n',
        "Name = int | None\n",
        "from typing import TYPE_CHECKING\nif TYPE_CHECKING:\n    a = 1\n",
        "class A:\n    __slots__ = ('a',)\n    a: Literal[1, True]\n",
        "@value(slots=True)\nclass A:\n    a: int | None\n",
        body('log.warning(f"{a + 1} of {b}", 3)'),
        body("return None"),
    ],
)
def test_left_out(source: str) -> None:
    """Docstrings, annotations, decorators, type aliases, lists of names, log calls and type checking have no sites."""
    assert find_sites("a.py", source) == []


def test_operators_that_would_repeat_another() -> None:
    """A condition that the comparison or a constant negates already, and False that is returned, are mutated once."""
    assert mutated(body("if a == b: g()", "while True: g()"), "not added") == []
    assert mutated(body("return False"), "return value") == []
    assert mutated(body('raise E("a" + f"{b}")'), "arithmetic") == []


def test_lines_stay() -> None:
    """A mutation of text over several lines leaves the number of lines, and everything after it, as it was."""
    source = body("a = g(", "    b,", "    c,", ")", "return (", "    a", "    + b", ")")
    for site in find_sites("a.py", source):
        for each in site:
            made = each.applied_to(source)
            compile(made, "a.py", "exec")
            assert made.count("\n") == source.count("\n")
    assert mutated(source, "statement")[0].split("\n")[1:6] == ["    pass", "", "", "", "    return ("]


def test_what_identifies_a_mutation() -> None:
    """Function, line before and after, and occurrence stay the same when lines are added above."""
    source = "class A:\n    def f(self, a):\n        g(a + 1)\n        g(a + 1)\n"
    found, moved = (
        [each for site in find_sites("a.py", text) for each in site] for text in (source, f"import b\n\n{source}")
    )
    assert [each.key for each in found] == [each.key for each in moved]
    assert len({each.key for each in found}) == len(found)
    assert {each.function for each in found} == {"A.f"}
    assert [each.line_number + 2 for each in found] == [each.line_number for each in moved]


def test_every_path_of_the_table_exists() -> None:
    """Each module, each test file about one, and each folder of wider tests is there."""
    for module in MODULES:
        paths = [f"src/lavt/{module}", *own_tests(module), *area_of(module)]
        assert [path for path in paths if not (REPOSITORY / path).exists()] == []
        assert len(set(own_tests(module))) == len(own_tests(module))
        assert not rest_of_area(module)[0].startswith("-")


def test_the_sample_follows_from_the_seed() -> None:
    """The same seed gives the same mutants, a smaller count the first of them, and another seed others."""
    sites = mutation.sites_of(["safety/takeover_requests.py", "transport/rtp/adaptive_hold.py"])
    drawn = mutation.sample(sites, 1, 30)
    assert drawn == mutation.sample(sites, 1, 30)
    assert drawn[:10] == mutation.sample(sites, 1, 10)
    assert drawn != mutation.sample(sites, 2, 30)
    assert len({(each.module, each.begin, each.end, each.operator) for each in drawn}) == 30
    assert {each.module for each in drawn} == set(sites)


def test_sampled_mutants_compile(every: dict[str, list[Site]]) -> None:
    """Every mutant that is drawn from the modules is Python that compiles, and differs from the source."""
    for each in mutation.sample(every, 1, 40):
        source = (REPOSITORY / "src" / "lavt" / each.module).read_text()
        compile(each.applied_to(source), each.module, "exec")
        assert each.line != each.mutated


def a_result(by: str, module: str = "safety/takeover_requests.py") -> results.Result:
    return results.Result(module, "f", "g(a < b)", "g(a <= b)", 0, 3, "comparison", bool(by), by, 1.0)


def test_results_are_kept(tmp_path: Path) -> None:
    """Of several results of a mutant the last one counts, and a line that is none is the user's error."""
    file = tmp_path / "results.jsonl"
    assert results.read_results(file) == {}
    for by in ("", "tests/test_a.py::test_b"):
        results.append_result(file, a_result(by))
    assert list(results.read_results(file).values()) == [a_result("tests/test_a.py::test_b")]
    for line in ("[]", '{"module": "a"}', "nothing"):
        file.write_text(line)
        with pytest.raises(UserError):
            results.read_results(file)


def test_the_report_counts_accepted_survivors_apart() -> None:
    """The table has one row for each module and one for all, and the share leaves out what is accepted."""
    accepted = {a_result("", "a.py").place: "equivalent"}
    made = [a_result("", "a.py"), a_result("timeout", "b.py"), a_result("", "c.py")]
    lines = results.report(made, accepted).splitlines()
    assert [line.partition(":")[0] for line in lines[:2]] == ["survived", "accepted"]
    assert "src/lavt/c.py:3" in lines[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
    assert rows[2:] == [
        ["a.py", "1", "0", "0", "1"], ["b.py", "1", "1", "0", "0"], ["c.py", "1", "0", "1", "0"],
        ["all", "3", "1", "1", "1"],
    ]  # fmt: skip
    assert "50.0%" in lines[-1]


def an_entry(of: Mutation) -> str:
    fields = {"module": of.module, "function": of.function, "line": of.line, "mutated": of.mutated, "reason": "x"}
    return "[[accepted]]\n" + "".join(f"{name} = {json.dumps(text)}\n" for name, text in fields.items())


def test_accepted_survivors_match_the_sources(tmp_path: Path, every: dict[str, list[Site]]) -> None:
    """An accepted survivor names a mutation that the sources have; one that matches nothing is an error."""
    sites = {"a.py": find_sites("a.py", body("g(a < b)"))}
    first = sites["a.py"][1][0]
    file = tmp_path / "accepted.toml"
    file.write_text(an_entry(first))
    assert results.load_accepted(file, sites) == {first.key[:4]: "x"}
    for wrong in (an_entry(first).replace("<", "=="), an_entry(first).replace("reason", "why"), "accepted = 1 2"):
        file.write_text(wrong)
        with pytest.raises(UserError):
            results.load_accepted(file, sites)
    results.load_accepted(results.ACCEPTED_FILE, every)


@pytest.mark.parametrize(
    "words", [["--count", "0"], ["--jobs", "0"], ["--only", "b.py"], ["--rerun-survivors"], ["--timeout-factor", "nan"]]
)
def test_bad_arguments(words: list[str]) -> None:
    """Bad arguments end the program with exit code 2."""
    with pytest.raises(SystemExit) as ended:
        mutation.arguments(words)
    assert ended.value.code == 2


@pytest.mark.full
def test_mutants_of_a_small_module_are_tried(tmp_path: Path) -> None:
    """The program tries some mutants, keeps the results, runs none of them twice, and runs survivors again."""
    file = tmp_path / "results.jsonl"
    requested = [sys.executable, str(PROGRAM), "--only", "vehicle/dbw/crc8.py", "--out", str(file)]
    first, second = (
        subprocess.run([*requested, "--count", "3"], capture_output=True, text=True, check=True, timeout=250)
        for _ in "12"
    )
    kept = [json.loads(line) for line in file.read_text().splitlines()]
    assert len(kept) == 3
    assert any(each["caught"] for each in kept)
    assert first.stdout == second.stdout
    assert "| vehicle/dbw/crc8.py | 3 |" in first.stdout
    assert second.stderr == ""
    source = (REPOSITORY / "src/lavt/vehicle/dbw/crc8.py").read_text()
    assert all(each["line"] in source for each in kept)
    file.write_text(json.dumps({**kept[0], "caught": False, "by": ""}) + "\n")
    subprocess.run([*requested, "--rerun-survivors"], capture_output=True, text=True, check=True, timeout=250)
    assert [json.loads(line)["caught"] for line in file.read_text().splitlines()] == [False, kept[0]["caught"]]


class PretendedTree:
    """Passes the tests named in `passing` with a mutation, and all but those in `broken` without one."""

    passing: ClassVar[set[str]] = set()
    broken: ClassVar[set[str]] = set()
    mutated_runs: ClassVar[list[tuple[str, ...]]] = []

    def __init__(self, directory: Path, _repository: Path) -> None:
        self.directory = directory

    def run(self, tests: tuple[str, ...], _limit_s: float, *, unchanged: bool) -> Trial:
        """Pretend to run without a mutation."""
        assert unchanged
        return Trial(self.broken.isdisjoint(tests), "", 1.0)

    def run_mutated(self, _mutation: Mutation, tests: tuple[str, ...], limit_s: float) -> Trial:
        """Pretend to run with one."""
        assert limit_s >= 1.0
        self.mutated_runs.append(tests)
        return Trial(self.passing.issuperset(tests), "" if self.passing.issuperset(tests) else "a", 1.0)


@pytest.fixture
def pretended(monkeypatch: pytest.MonkeyPatch) -> type[PretendedTree]:
    for name, empty in (("passing", set()), ("broken", set()), ("mutated_runs", [])):
        monkeypatch.setattr(PretendedTree, name, empty)
    monkeypatch.setattr(mutation, "WorkTree", PretendedTree)
    return PretendedTree


@pytest.mark.parametrize("jobs", [1, 2])
def test_wider_tests_follow_when_those_of_the_module_pass(
    pretended: type[PretendedTree], tmp_path: Path, jobs: int
) -> None:
    """A mutant survives where its module's tests and then the rest of its area's pass."""
    own, rest = own_tests("transport/rtp/adaptive_hold.py"), rest_of_area("transport/rtp/adaptive_hold.py")
    of_one = mutation.sites_of(["transport/rtp/adaptive_hold.py"])["transport/rtp/adaptive_hold.py"][0][:1]
    for passing, expected in ((set(), [own]), ({*own}, [own, rest]), ({*own, *rest}, [own, rest])):
        pretended.passing, pretended.mutated_runs = passing, []
        (result,) = mutation.Runner(tmp_path, jobs, 10.0).run(of_one)
        assert pretended.mutated_runs == expected
        assert result.caught == (passing != {*own, *rest})


@pytest.mark.parametrize("broken", [own_tests("transport/rtp/adaptive_hold.py")[0], "tests/transport"])
def test_tests_that_fail_unmutated_end_the_run(
    pretended: type[PretendedTree], tmp_path: Path, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str], broken: str,
) -> None:  # fmt: skip
    """Tests that fail without a mutation end the program with one line and exit code 2."""
    pretended.broken = {broken}
    pretended.passing = {*own_tests("transport/rtp/adaptive_hold.py")}
    monkeypatch.setattr(sys, "argv", ["mutation.py", "--only", "transport/rtp/adaptive_hold.py", "--count", "1"])
    monkeypatch.chdir(tmp_path)
    assert mutation.main() == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.full
def test_a_mutant_is_tried_in_a_copy(tmp_path: Path) -> None:
    """Tests see the mutated module in a copy, which is put back after it; a loop without end is ended and caught."""
    repository = tmp_path / "repository"
    module = repository / "src" / "lavt" / "a.py"
    for directory in (module.parent, repository / "tests"):
        directory.mkdir(parents=True)
    source = "def f(a):\n    while a > 0:\n        a -= 1\n    return a\n"
    module.write_text(source)
    module.with_name("__init__.py").write_text("")
    profile = "import hypothesis\nhypothesis.settings.register_profile('mutation')\n"
    (repository / "conftest.py").write_text(profile)
    (repository / "tests" / "test_a.py").write_text("from lavt.a import f\n\ndef test_f():\n    assert f(3) == 0\n")
    tree = WorkTree(tmp_path / "tree", repository)
    assert tree.run(["tests/test_a.py"], 60.0, unchanged=True).passed
    of_operator = {site[0].operator: site[0] for site in find_sites("a.py", source)}
    for operator, limit_s, failed in (("return value", 60.0, "tests/test_a.py::test_f"), ("statement", 5.0, ENDLESS)):
        trial = tree.run_mutated(of_operator[operator], ["tests/test_a.py"], limit_s)
        assert trial.failed_test == failed
    assert module.read_text() == tree.source("a.py").read_text() == source
