"""Which tests belong to which lane, and the results of the lane runner."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest
from tests.lanes import (
    ALL_LANES,
    LANES,
    QUICK,
    REPOSITORY,
    SEQUENTIAL_FOLDERS,
    TESTS,
    LaneSpec,
    runs_in_parallel,
    select_lanes,
)
from tests.support import lane_runner
from tests.support.lane_runner import LaneOutcome, closing_line, parse_counts, run_lanes, table

from lavt.domain import NS_PER_S

PYTEST_OPTIONS = tomllib.loads((REPOSITORY / "pyproject.toml").read_text())["tool"]["pytest"]["ini_options"]
PYTEST_LANES = {lane.name: lane.commands[0][3:] for lane in ALL_LANES if "pytest" in lane.commands[0]}
"""The arguments of pytest in each lane that is a single pytest command."""


@pytest.fixture(scope="module")
def collected(tmp_path_factory: pytest.TempPathFactory) -> dict[str, set[str]]:
    """Return the tests that each lane's command collects in a small project with LAVT's pytest options."""
    root = tmp_path_factory.mktemp("project")
    plain = "import pytest\n\ndef test_plain(): pass\n"
    marked = "".join(f"\n@pytest.mark.{marker}\ndef test_{marker}(): pass\n" for marker in ("full", "realtime"))
    for folder in ("", "cli", *SEQUENTIAL_FOLDERS):
        directory = root / "tests" / folder
        directory.mkdir(exist_ok=True, parents=True)
        (directory / f"test_{folder or 'root'}.py").write_text(
            plain if folder in SEQUENTIAL_FOLDERS else plain + marked
        )
    mark = "import pytest\n\ndef pytest_collection_modifyitems(items):\n    for item in items:\n"
    mark += "        if 'realtime' in item.path.parts: item.add_marker(pytest.mark.realtime)\n"
    (root / "tests" / "realtime" / "conftest.py").write_text(mark)
    options = {**PYTEST_OPTIONS, "addopts": PYTEST_OPTIONS["addopts"].replace("-n auto", "-n 0")}
    lines = [f"{key} = {value!r}" for key, value in options.items()]
    (root / "pyproject.toml").write_text("\n".join(["[tool.pytest.ini_options]", *lines, ""]))
    return {
        name: {line for line in collect_tests(root, arguments) if "::" in line}
        for name, arguments in PYTEST_LANES.items()
    }


def collect_tests(root: Path, arguments: tuple[str, ...]) -> list[str]:
    """Return the output lines of pytest's collection."""
    command = [sys.executable, "-m", "pytest", "--collect-only", "-q", "-p", "no:cacheprovider", *arguments]
    return subprocess.run(command, cwd=root, capture_output=True, text=True, check=False).stdout.splitlines()


@pytest.mark.full
def test_every_test_belongs_to_one_lane(collected: dict[str, set[str]]) -> None:
    """The pytest lanes together run every test exactly once, except the kernel tests, which the kernel lane runs."""
    tests = [f"tests/{folder}/test_{folder}.py::test_plain" for folder in ("cli", *SEQUENTIAL_FOLDERS)]
    tests += [f"tests/cli/test_cli.py::test_{marker}" for marker in ("full", "realtime")]
    tests += [f"tests/test_root.py::test_{marker}" for marker in ("plain", "full", "realtime")]
    tests.remove("tests/kernel/test_kernel.py::test_plain")
    assert Counter(test for lane in collected.values() for test in lane) == Counter(tests)


@pytest.mark.full
def test_folder_and_marker_select_the_lane(collected: dict[str, set[str]]) -> None:
    """A test is in the lane of its folder, else in the lane of its marker, else in quick."""
    assert collected["quick"] == {"tests/test_root.py::test_plain", "tests/cli/test_cli.py::test_plain"}
    assert collected["full"] == {"tests/test_root.py::test_full", "tests/cli/test_cli.py::test_full"}
    assert collected["realtime"] == {
        "tests/realtime/test_realtime.py::test_plain",
        "tests/test_root.py::test_realtime",
        "tests/cli/test_cli.py::test_realtime",
    }
    for folder in ("browser", "field", "interop"):
        assert collected[folder] == {f"tests/{folder}/test_{folder}.py::test_plain"}


def test_tests_in_lane_folders_have_no_lane_marker() -> None:
    """A test in a lane's folder has no lane marker, because it would then be in two lanes or in no lane."""
    marked = [
        path.relative_to(TESTS)
        for folder in SEQUENTIAL_FOLDERS
        for path in (TESTS / folder).rglob("test_*.py")
        if any(f"mark.{marker}" in path.read_text() for marker in ("full", "realtime"))
    ]
    assert marked == []


def test_only_the_quick_and_the_full_lane_run_in_parallel() -> None:
    """The quick and the full lane run in parallel, unless single files are named; the other lanes run sequentially."""
    assert shlex.split(PYTEST_OPTIONS["addopts"])[-1] == QUICK
    assert runs_in_parallel(QUICK, [])
    assert runs_in_parallel("full", [TESTS, TESTS / "cli"])
    assert not runs_in_parallel("realtime", [TESTS])
    assert not runs_in_parallel(QUICK, [TESTS / "test_lanes.py"])
    assert not any(runs_in_parallel(QUICK, [TESTS / folder]) for folder in SEQUENTIAL_FOLDERS)
    assert not runs_in_parallel(QUICK, [TESTS / "kernel" / "lane"])


def test_every_lane_is_documented() -> None:
    """CONTRIBUTING.md names the command of each lane."""
    text = (REPOSITORY / "CONTRIBUTING.md").read_text()
    commands = [
        "pytest -m full",
        "pytest -m realtime",
        "pytest tests/field",
        "pytest tests/interop",
        "pytest tests/browser",
        "tests/kernel/run",
    ]
    assert [command for command in [*commands, "tests.lanes", ".ci/run"] if command not in text] == []


def test_lanes_can_be_selected_by_name() -> None:
    """Without names all lanes run, two of them only beside the last lanes; or else the named lanes."""
    assert select_lanes([]) == list(LANES)
    beside = {lane.name: lane.meanwhile and lane.meanwhile.name for lane in LANES}
    assert list(beside.items())[-3:] == [("kernel", "full"), ("interop", None), ("browser", "linters")]
    assert not any(list(beside.values())[:-3]), "times are judged there, and other work would change them"
    assert [(lane.name, lane.meanwhile) for lane in select_lanes(["full", "kernel"])] == [
        ("full", None),
        ("kernel", None),
    ]
    unknown = subprocess.run(
        [sys.executable, "-m", "tests.lanes", "quik"], cwd=REPOSITORY, capture_output=True, text=True, check=False
    )
    assert unknown.returncode == 2
    assert "quik" in unknown.stderr


def shell(script: str) -> tuple[str, ...]:
    return ("sh", "-c", script)


def run(*lanes: LaneSpec) -> tuple[int, str]:
    output: list[str] = []
    return run_lanes(lanes, write=output.append), "".join(output)


def groups_by_session() -> bool:
    setting = Path("/proc/sys/kernel/sched_autogroup_enabled")
    return setting.exists() and setting.read_text().strip() == "1"


def test_runner_adds_up_the_results_of_the_lanes() -> None:
    """If all lanes pass, the exit code is 0, their outputs appear in order, and the last line has the totals."""
    code, output = run(
        LaneSpec("quick", (shell("echo one; echo '== 2 passed, 1 skipped, 3 deselected in 1.20s =='"),), 1),
        LaneSpec(
            "kernel",
            (shell("sleep 0.3; echo '== 3 passed, 1 rerun in 62.10s (0:01:02) =='"),),
            1,
            meanwhile=LaneSpec("full", (shell("nice; echo '== 1 passed in 0.10s =='"),), 1),
        ),
    )
    assert code == 0
    assert (
        output.index("one")
        < output.index("3 passed, 1 rerun")
        < output.index(f"{min(os.nice(0) + 19, 19)}\n== 1 passed")
    )
    assert output.splitlines()[-1].startswith("6 passed, 0 failed, 1 skipped, 1 rerun in ")


def test_a_lane_at_the_same_time_starts_with_the_last_command(tmp_path: Path) -> None:
    """A lane that runs at the same time as another does not run during the other's first command, even if it fails."""
    began, ended = tmp_path / "began", tmp_path / "ended"
    other = LaneSpec("full", (shell(f"touch {began}; test -e {ended}"),), 1)
    first = shell(f"sleep 0.3; test ! -e {began} && touch {ended}; exit 4")
    code, output = run(LaneSpec("kernel", (first, shell(f"until test -e {began}; do sleep 0.1; done")), 1, other))
    assert code == 1
    assert output.count("ended with") == output.count("ended with 4") == 1


@pytest.mark.skipif(not groups_by_session(), reason="this kernel does not group processes by session")
def test_a_lane_at_the_same_time_gives_way_to_other_sessions() -> None:
    """The group of processes of a lane that runs at the same time as another has the lowest priority, too."""
    other = LaneSpec("full", (shell("sleep 0.2; cat /proc/self/autogroup"),), 1)
    code, output = run(LaneSpec("kernel", (shell("cat /proc/self/autogroup"),), 1, meanwhile=other))
    assert code == 0
    assert re.findall(r"/autogroup-\d+ nice (\d+)", output) == ["0", "19"]


def test_a_lane_at_the_same_time_goes_on_beside_the_next_lanes(tmp_path: Path) -> None:
    """A lane that runs at the same time as another still runs during the next lane; its output follows at the end."""
    began = tmp_path / "began"
    other = LaneSpec("full", (shell(f"until test -e {began}; do sleep 0.1; done; echo other"),), 1)
    kernel = LaneSpec("kernel", (shell("true"),), 1, meanwhile=other)
    code, output = run(kernel, LaneSpec("browser", (shell(f"touch {began}; sleep 0.5; echo browser"),), 1))
    assert code == 0
    assert output.index("---- browser\nbrowser") < output.index("---- full\nother")


@pytest.mark.parametrize("meanwhile", [False, True])
def test_failing_lane_fails_the_run(meanwhile: bool) -> None:
    """A lane with an exit code other than 0 fails the run; all other lanes still run, and the output has the code."""
    bad = LaneSpec("bad", (shell("echo '== 1 passed in 0.10s =='; exit 3"),), 1)
    good = LaneSpec("good", (shell("echo '== 1 passed in 0.10s =='"),), 1, meanwhile=bad if meanwhile else None)
    code, output = run(*([good] if meanwhile else [bad, good]))
    assert code == 1
    assert "ended with 3" in output
    assert output.splitlines()[-1].startswith("2 passed, 1 failed in ")


HANGING_PROGRAM = """
import os, pathlib, time
try:
    pathlib.Path(os.environ["LAVT_PROGRESS"]).write_text("test_a")
    time.sleep(600)
except KeyboardInterrupt:
    print("failed so far", flush=True)
    time.sleep(600)
"""


def test_lane_is_interrupted_at_its_time_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    """A lane that exceeds its time limit is interrupted, so that pytest lists failures, and then killed."""
    monkeypatch.setattr(lane_runner, "GRACE_NS", 2 * NS_PER_S)
    hangs = LaneSpec("hangs", ((sys.executable, "-c", HANGING_PROGRAM), shell("echo never")), 1 / 12)
    code, output = run(hangs, LaneSpec("next", (shell("echo started"),), 1))
    assert code == 1
    assert "took longer than 0.0833333 min, and was at: test_a" in output
    assert "failed so far" in output
    assert "never" not in output
    assert "started" in output


def test_running_test_is_in_the_progress_file(tmp_path: Path) -> None:
    """The file that LAVT_PROGRESS names contains the name of the running test; after the last test it is empty."""
    progress_file = tmp_path / "progress"
    (tmp_path / "test_own.py").write_text(
        f"from pathlib import Path\n\ndef test_own(): assert 'test_own' in Path({str(progress_file)!r}).read_text()\n"
    )
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "tests.support.progress"]
    subprocess.run(
        [*command, f"--rootdir={tmp_path}", str(tmp_path)],
        cwd=REPOSITORY,
        check=True,
        capture_output=True,
        env={**os.environ, "LAVT_PROGRESS": str(progress_file)},
    )
    assert progress_file.read_text() == ""


def test_counts_are_parsed_from_pytest_output() -> None:
    """Counts are parsed with colours, long times and several sessions in one output."""
    output = (
        "== session starts ==\n\x1b[31m== \x1b[1m1 failed\x1b[0m, 2 passed, 2 errors in 70.00s (0:01:10) ==\x1b[0m\n"
    )
    assert parse_counts(output + "= 1 passed in 2.00s =\n") == {"failed": 1, "passed": 3, "error": 2}


def test_table_lists_lanes_and_failures() -> None:
    """The table has a line with time and counts for each lane, followed by the reasons for failures."""
    outcomes = [
        LaneOutcome("quick", 61.2, Counter(passed=5, rerun=1)),
        LaneOutcome("field", 5, Counter(failed=1), ["reason"]),
    ]
    lines = table(outcomes).splitlines()
    assert lines[1].split() == ["quick", "1:01", "5", "0", "0", "0", "1", "0"]
    assert lines[2].split()[-1] == "FAILED"
    assert lines[3] == "field: reason"
    assert closing_line(outcomes, 70) == "5 passed, 1 failed, 1 rerun in 70s"


def test_the_programs_in_the_ci_script_run() -> None:
    """The Python programs in `.ci/run` can import all names that they use; no linter checks these programs."""
    programs = re.findall(r"python -c '([^']*)'", (REPOSITORY / ".ci" / "run").read_text())
    assert len(programs) == 6
    for program in programs:
        completed = subprocess.run(
            [sys.executable, "-c", program], cwd=REPOSITORY, capture_output=True, text=True, check=False, timeout=60
        )
        assert completed.returncode == 0, completed.stderr
