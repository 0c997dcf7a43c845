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
def sites() -> dict[str, list[Site]]:
    """Return the sites of all modules."""
    return mutation.sites_of(list(MODULES))


def mutated_sources(source: str, operator: str) -> list[str]:
    """Return every source that an operator's mutations produce."""
    return [
        mutant.apply_to(source) for site in find_sites("a.py", source) for mutant in site if mutant.operator == operator
    ]


def body(*lines: str) -> str:
    return "\n".join(["def f(a, b, c):", *(f"    {line}" for line in lines), ""])


@pytest.mark.parametrize(
    ("operator", "line", "expected"),
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
def test_operators(operator: str, line: str, expected: list[str]) -> None:
    """Each mutation changes exactly one operator, value or statement of the source."""
    assert mutated_sources(body(line), operator) == [body(expected_line) for expected_line in expected]


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
def test_excluded_code_has_no_sites(source: str) -> None:
    """Docstrings, annotations, decorators, type aliases, name lists, log calls and TYPE_CHECKING have no sites."""
    assert find_sites("a.py", source) == []


def test_equivalent_mutations_are_left_out() -> None:
    """There is no mutation with the effect of another mutation or without any effect that a test could see."""
    assert mutated_sources(body("if a == b: g()", "while True: g()"), "not added") == []
    assert mutated_sources(body("return False"), "return value") == []
    assert mutated_sources(body('raise E("a" + f"{b}")'), "arithmetic") == []


def test_line_count_is_kept() -> None:
    """A mutation of several lines keeps the number of lines and all code after the mutation."""
    source = body("a = g(", "    b,", "    c,", ")", "return (", "    a", "    + b", ")")
    for site in find_sites("a.py", source):
        for mutation_of_site in site:
            mutant = mutation_of_site.apply_to(source)
            compile(mutant, "a.py", "exec")
            assert mutant.count("\n") == source.count("\n")
    assert mutated_sources(source, "statement")[0].split("\n")[1:6] == ["    pass", "", "", "", "    return ("]


def test_mutation_key_is_stable() -> None:
    """A mutation's key stays the same when lines are added above it."""
    source = "class A:\n    def f(self, a):\n        g(a + 1)\n        g(a + 1)\n"
    found, moved = (
        [mutant for site in find_sites("a.py", text) for mutant in site] for text in (source, f"import b\n\n{source}")
    )
    assert [mutant.key for mutant in found] == [mutant.key for mutant in moved]
    assert len({mutant.key for mutant in found}) == len(found)
    assert {mutant.function for mutant in found} == {"A.f"}
    assert [mutant.line_number + 2 for mutant in found] == [mutant.line_number for mutant in moved]


def test_every_path_of_the_table_exists() -> None:
    """Each module, its test files and its area's tests exist."""
    for module in MODULES:
        paths = [f"src/lavt/{module}", *own_tests(module), *area_of(module)]
        assert [path for path in paths if not (REPOSITORY / path).exists()] == []
        assert len(set(own_tests(module))) == len(own_tests(module))
        assert not rest_of_area(module)[0].startswith("-")


def test_sample_follows_from_the_seed() -> None:
    """The seed decides the mutants and their order; a smaller count gives the first of these mutants."""
    sites = mutation.sites_of(["safety/takeover_requests.py", "transport/rtp/adaptive_hold.py"])
    sampled = mutation.sample(sites, 1, 30)
    assert sampled == mutation.sample(sites, 1, 30)
    assert sampled[:10] == mutation.sample(sites, 1, 10)
    assert sampled != mutation.sample(sites, 2, 30)
    assert len({(mutant.module, mutant.begin, mutant.end, mutant.operator) for mutant in sampled}) == 30
    assert {mutant.module for mutant in sampled} == set(sites)


def test_sampled_mutants_compile(sites: dict[str, list[Site]]) -> None:
    """Every sampled mutant compiles and differs from the source."""
    for mutant in mutation.sample(sites, 1, 40):
        source = (REPOSITORY / "src" / "lavt" / mutant.module).read_text()
        compile(mutant.apply_to(source), mutant.module, "exec")
        assert mutant.line != mutant.mutated


def make_result(caught_by: str, module: str = "safety/takeover_requests.py") -> results.Result:
    """Return the result of a mutant; `caught_by` is a test or "timeout", and empty for a mutant that survived."""
    return results.Result(module, "f", "g(a < b)", "g(a <= b)", 0, 3, "comparison", bool(caught_by), caught_by, 1.0)


def test_results_are_saved(tmp_path: Path) -> None:
    """Of several saved results of a mutant the last is read, and an invalid line is a user error."""
    file = tmp_path / "results.jsonl"
    assert results.read_results(file) == {}
    for caught_by in ("", "tests/test_a.py::test_b"):
        results.append_result(file, make_result(caught_by))
    assert list(results.read_results(file).values()) == [make_result("tests/test_a.py::test_b")]
    for line in ("[]", '{"module": "a"}', "nothing"):
        file.write_text(line)
        with pytest.raises(UserError):
            results.read_results(file)


def test_report_counts_accepted_survivors_separately() -> None:
    """The table has a row for each module and a total, and the share excludes accepted survivors."""
    accepted = {make_result("", "a.py").place: "equivalent"}
    mutant_results = [make_result("", "a.py"), make_result("timeout", "b.py"), make_result("", "c.py")]
    lines = results.report(mutant_results, accepted).splitlines()
    assert [line.partition(":")[0] for line in lines[:2]] == ["survived", "accepted"]
    assert "src/lavt/c.py:3" in lines[0]
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in lines if line.startswith("|")]
    assert rows[2:] == [
        ["a.py", "1", "0", "0", "1"],
        ["b.py", "1", "1", "0", "0"],
        ["c.py", "1", "0", "1", "0"],
        ["all", "3", "1", "1", "1"],
    ]
    assert "50.0%" in lines[-1]


def make_entry(mutant: Mutation) -> str:
    """Return a mutant's entry in the list of accepted survivors."""
    names = ("module", "function", "line", "mutated")
    fields = {**{name: getattr(mutant, name) for name in names}, "reason": "x"}
    return "[[accepted]]\n" + "".join(f"{name} = {json.dumps(text)}\n" for name, text in fields.items())


def test_accepted_survivors_match_the_sources(tmp_path: Path, sites: dict[str, list[Site]]) -> None:
    """An accepted survivor matches a mutation of the sources; an entry that matches no mutation is an error."""
    example = {"a.py": find_sites("a.py", body("g(a < b)"))}
    first = example["a.py"][1][0]
    file = tmp_path / "accepted.toml"
    file.write_text(make_entry(first))
    assert results.load_accepted(file, example) == {first.key[:4]: "x"}
    for wrong in (make_entry(first).replace("<", "=="), make_entry(first).replace("reason", "why"), "accepted = 1 2"):
        file.write_text(wrong)
        with pytest.raises(UserError):
            results.load_accepted(file, example)
    results.load_accepted(results.ACCEPTED_FILE, sites)


@pytest.mark.parametrize(
    "arguments",
    [["--count", "0"], ["--jobs", "0"], ["--only", "b.py"], ["--rerun-survivors"], ["--timeout-factor", "nan"]],
)
def test_invalid_arguments_are_rejected(arguments: list[str]) -> None:
    """Invalid arguments exit with code 2."""
    with pytest.raises(SystemExit) as exited:
        mutation.parse_arguments(arguments)
    assert exited.value.code == 2


@pytest.mark.full
def test_mutants_of_a_small_module_are_run(tmp_path: Path) -> None:
    """The program runs mutants, saves the results, runs no mutant twice, and runs survivors again on request."""
    file = tmp_path / "results.jsonl"
    requested = [sys.executable, str(PROGRAM), "--only", "vehicle/dbw/crc8.py", "--out", str(file)]
    first, second = (
        subprocess.run([*requested, "--count", "3"], capture_output=True, text=True, check=True, timeout=250)
        for _ in range(2)
    )
    saved = [json.loads(line) for line in file.read_text().splitlines()]
    assert len(saved) == 3
    assert any(saved_result["caught"] for saved_result in saved)
    assert first.stdout == second.stdout
    assert "| vehicle/dbw/crc8.py | 3 |" in first.stdout
    assert second.stderr == ""
    source = (REPOSITORY / "src/lavt/vehicle/dbw/crc8.py").read_text()
    assert all(saved_result["line"] in source for saved_result in saved)
    file.write_text(json.dumps({**saved[0], "caught": False, "by": ""}) + "\n")
    subprocess.run([*requested, "--rerun-survivors"], capture_output=True, text=True, check=True, timeout=250)
    assert [json.loads(line)["caught"] for line in file.read_text().splitlines()] == [False, saved[0]["caught"]]


class FakeTree:
    """A fake tree in which `passing_tests` pass with a mutation, and `broken_tests` fail without one."""

    passing_tests: ClassVar[set[str]] = set()
    broken_tests: ClassVar[set[str]] = set()
    mutated_runs: ClassVar[list[tuple[str, ...]]] = []

    def __init__(self, directory: Path, _repository: Path) -> None:
        self.directory = directory

    def run(self, tests: tuple[str, ...], _limit_s: float, *, unchanged: bool) -> Trial:
        """Return the result of a run without a mutation."""
        assert unchanged
        return Trial(self.broken_tests.isdisjoint(tests), "", 1.0)

    def run_mutated(self, _mutation: Mutation, tests: tuple[str, ...], limit_s: float) -> Trial:
        """Record a run with a mutation, and return its result."""
        assert limit_s >= 1.0
        self.mutated_runs.append(tests)
        return Trial(self.passing_tests.issuperset(tests), "" if self.passing_tests.issuperset(tests) else "a", 1.0)


@pytest.fixture
def fake_tree(monkeypatch: pytest.MonkeyPatch) -> type[FakeTree]:
    for name, empty in (("passing_tests", set()), ("broken_tests", set()), ("mutated_runs", [])):
        monkeypatch.setattr(FakeTree, name, empty)
    monkeypatch.setattr(mutation, "WorkTree", FakeTree)
    return FakeTree


@pytest.mark.parametrize("jobs", [1, 2])
def test_area_tests_run_after_module_tests_pass(fake_tree: type[FakeTree], tmp_path: Path, jobs: int) -> None:
    """A mutant survives if its module's tests and then the rest of its area's tests pass."""
    own, rest = own_tests("transport/rtp/adaptive_hold.py"), rest_of_area("transport/rtp/adaptive_hold.py")
    mutations = mutation.sites_of(["transport/rtp/adaptive_hold.py"])["transport/rtp/adaptive_hold.py"][0][:1]
    for passing_tests, expected in ((set(), [own]), ({*own}, [own, rest]), ({*own, *rest}, [own, rest])):
        fake_tree.passing_tests, fake_tree.mutated_runs = passing_tests, []
        (result,) = mutation.MutantRunner(tmp_path, jobs, 10.0).run(mutations)
        assert fake_tree.mutated_runs == expected
        assert result.caught == (passing_tests != {*own, *rest})


@pytest.mark.parametrize("broken_tests", [own_tests("transport/rtp/adaptive_hold.py")[0], "tests/transport"])
def test_failing_unmutated_tests_end_the_run(
    fake_tree: type[FakeTree],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    broken_tests: str,
) -> None:
    """Tests that fail without a mutation end the program with one message and exit code 2."""
    fake_tree.broken_tests = {broken_tests}
    fake_tree.passing_tests = {*own_tests("transport/rtp/adaptive_hold.py")}
    monkeypatch.setattr(sys, "argv", ["mutation.py", "--only", "transport/rtp/adaptive_hold.py", "--count", "1"])
    monkeypatch.chdir(tmp_path)
    assert mutation.main() == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


@pytest.mark.full
def test_mutant_runs_in_a_copy(tmp_path: Path) -> None:
    """Tests run on a copy whose mutated module is restored; a mutant with an endless loop is killed and caught."""
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
    site_by_operator = {site[0].operator: site[0] for site in find_sites("a.py", source)}
    for operator, limit_s, failed in (("return value", 60.0, "tests/test_a.py::test_f"), ("statement", 5.0, ENDLESS)):
        trial = tree.run_mutated(site_by_operator[operator], ["tests/test_a.py"], limit_s)
        assert trial.failed_test == failed
    assert module.read_text() == tree.source("a.py").read_text() == source
