from __future__ import annotations

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import weakref
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
import yaml

import lavt.experiment.sweep
from lavt.clock import pause
from lavt.config import RunConfig, SweepConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.experiment.analysis.results import read_json
from lavt.experiment.runs.plan import PlannedRun, plan_run, plan_sweep
from lavt.experiment.runs.run import RESULT, run_once
from lavt.experiment.sweep.sweep import base_of, drive_sweep, open_sweep, recorded_base, run_all
from lavt.experiment.sweep.workers import Workers, processes

CHANGES = ("fidelity=geometry", "conditions=[L0, L3]", "repetitions=1", "network.inherent=loopback")


def requested(*changes: str) -> SweepConfig:
    return load_config(SweepConfig, shipped("configs/sweep.yaml"), [*CHANGES, *changes])


def two_runs() -> list[PlannedRun]:
    return plan_sweep(requested())


@pytest.fixture(scope="module")
def swept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of two runs, driven by two processes."""
    out = tmp_path_factory.mktemp("sweep") / "out"
    open_sweep(out, resume=False)
    drive_sweep(requested(), two_runs(), out, jobs=2, on_progress=lambda _: None)
    return out


def test_a_sweep_leaves_a_whole_directory(swept: Path) -> None:
    """A sweep leaves a directory for each run with config, both records and result, a summary, and a report."""
    for run in two_runs():
        names = {path.name for path in (swept / "runs" / run.name).iterdir()}
        assert names == {"config.yaml", "server.mcap", "client.mcap", "result.json"}
    assert load_config(SweepConfig, swept / "sweep.yaml") == requested()
    assert (swept / "report" / "index.html").is_file()
    summary = json.loads((swept / "summary.json").read_text())
    assert list(summary["conditions"]) == ["L0", "L3"]
    assert summary["conditions"]["L3"]["injected_ms"] == {"video": 225.0, "control": 0.0}
    assert summary["speed"]["jobs"] == 2
    assert summary["real"] == {}


@pytest.fixture(scope="module")
def resumed(swept: Path) -> tuple[dict[str, Any], dict[str, Any], bool]:
    """The summaries before and after the first run was lost and driven again; whether the second was left alone."""
    before = read_json(swept / "summary.json")
    first, second = (swept / "runs" / run.name / RESULT for run in two_runs())
    kept = second.stat().st_mtime_ns
    first.unlink()  # as if it had been killed while driving
    drive_sweep(requested(), two_runs(), swept, jobs=1, on_progress=lambda _: None)
    return before, read_json(swept / "summary.json"), second.stat().st_mtime_ns == kept


def test_resuming_drives_only_what_is_missing(resumed: tuple[dict[str, Any], dict[str, Any], bool]) -> None:
    """A sweep that lost a run drives that run alone again, with the same digest, and gives the same summary."""
    before, after, is_left_alone = resumed
    assert is_left_alone
    assert sorted(after["runs"], key=str) == sorted(before["runs"], key=str)
    assert after["conditions"] == before["conditions"]


def test_the_speed_is_that_of_what_was_driven(
    swept: Path, resumed: tuple[dict[str, Any], dict[str, Any], bool]
) -> None:
    """Runs that were driven before do not make a resumed sweep faster; where nothing is driven the speed is kept."""
    speed = resumed[1]["speed"]
    assert speed["simulated_s"] == read_json(swept / "runs" / two_runs()[0].name / RESULT)["duration_s"]
    drive_sweep(requested(), two_runs(), swept, jobs=2, on_progress=lambda _: None)
    assert read_json(swept / "summary.json")["speed"] == speed


def test_an_error_of_one_run_does_not_stop_the_others(tmp_path: Path) -> None:
    """A run that ends with an error that nobody foresaw is told by its kind and text, and the others are driven."""
    good, bad = two_runs()
    told: list[str] = []
    driven, speed = run_all([replace(bad, seed=-1), good], tmp_path, jobs=1, on_progress=told.append)
    ((name, why),) = driven.failed
    assert name == bad.name
    assert why.startswith("ValidationError: ")
    assert f"{name} failed: {why}" in told
    assert [result["run"] for result in driven.results] == [good.name]
    assert speed is not None


def test_a_run_directory_repeats_its_run(swept: Path, tmp_path: Path) -> None:
    """The config in a run directory, driven by itself, gives the same digest as the run of the sweep."""
    directory = swept / "runs" / two_runs()[0].name
    again = run_once(plan_run(load_config(RunConfig, directory / "config.yaml")), tmp_path / "again")
    assert again["digest"] == json.loads((directory / "result.json").read_text())["digest"]


def test_resuming_with_another_config_is_rejected(swept: Path) -> None:
    """A sweep that was driven with another config is not resumed: its runs would not belong together."""
    changed, before = requested("seed=2"), (swept / "sweep.yaml").read_bytes()
    with pytest.raises(UserError, match="another config"):
        drive_sweep(changed, plan_sweep(changed), swept, jobs=1, on_progress=lambda _: None)
    assert (swept / "sweep.yaml").read_bytes() == before


@pytest.mark.parametrize(
    ("key", "value"), [("conditions", "[L1]"), ("repetitions", "2"), ("axes", "{study.block: [1]}")]
)
def test_resuming_a_sweep_of_other_runs_is_rejected(swept: Path, key: str, value: str) -> None:
    """Nor one that asks for other runs, or more: the report would hold those that are there already, too."""
    changed, before = requested(f"{key}={value}"), (swept / "sweep.yaml").read_bytes()
    with pytest.raises(UserError, match=rf"another config \({key}\)"):
        drive_sweep(changed, plan_sweep(changed), swept, jobs=1, on_progress=lambda _: None)
    assert (swept / "sweep.yaml").read_bytes() == before


BASES: list[tuple[tuple[str, ...], dict[str, Any]]] = [
    ((), {}),
    (("axes={video.bit_rate_bps: [1000000, 4000000]}",), {"video.bit_rate_bps": 4_000_000}),
    (
        ("axes={video.bit_rate_bps: [1000000, 4000000]}", "video.bit_rate_bps=1000000"),
        {"video.bit_rate_bps": 1_000_000},
    ),
    (
        ("axes={video.bit_rate_bps: [1000000, 4000000]}", "video.bit_rate_bps=2000000"),
        {"video.bit_rate_bps": 2_000_000},
    ),
    (("axes={camera.rate_hz: [20, 30], study.block: [1, null]}",), {"camera.rate_hz": 30, "study.block": None}),
]


@pytest.mark.parametrize(("changes", "base"), BASES, ids=str)
def test_the_base_config_is_the_sweeps_own(changes: tuple[str, ...], base: dict[str, Any], tmp_path: Path) -> None:
    """The base of a sweep is what its config itself says at each axis, wherever that stands among the axis' values."""
    config = requested(*changes)
    assert base_of(config, plan_sweep(config)) == base
    assert recorded_base(tmp_path) is None
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(config.model_dump(mode="json")))
    assert recorded_base(tmp_path) == base


@pytest.mark.full
@pytest.mark.parametrize(
    ("number", "options"), [(signal.SIGINT, ()), (signal.SIGHUP, ()), (signal.SIGINT, ("--cluster", "local"))]
)
@pytest.mark.usefixtures("hangup_ends")
def test_a_stopped_sweep_keeps_what_is_finished(number: int, options: tuple[str, ...], tmp_path: Path) -> None:
    """Ctrl-C or a closed terminal ends a sweep with a sentence, exit code 1 and no traceback.

    The finished runs are kept and, on this machine's processes, those that are under way are finished.
    """
    if options:
        pytest.importorskip("distributed")
    out = tmp_path / "out"
    sets = [part for change in ("fidelity=geometry", "repetitions=10") for part in ("--set", change)]
    started = subprocess.Popen(
        [
            *(sys.executable, "-m", "lavt", "sweep", str(shipped("configs/sweep.yaml")), *sets, "--jobs", "2"),
            *("--out", str(out), *options),
        ],
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True,
    )  # fmt: skip
    for _ in range(3000):
        if list(out.glob("runs/*/result.json")):
            break
        pause(20 * NS_PER_MS)
    os.killpg(started.pid, number)  # as a terminal does: to all processes
    _, said = started.communicate(timeout=60)
    assert started.returncode == 1
    assert "what was finished is kept" in said
    assert "Traceback" not in said
    assert 0 < len(list(out.glob("runs/*/result.json"))) == len(list(out.glob("runs/*"))) < 60


def test_a_sweep_that_is_stopped_while_files_come_in_keeps_no_half_of_a_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A run whose files come from far is there as a whole, or not at all, when Ctrl-C comes between them."""

    def put_one_and_stop(_files: Mapping[str, bytes], directory: Path) -> None:
        directory.mkdir()
        (directory / "server.mcap").touch()
        raise KeyboardInterrupt

    @contextmanager
    def far(_address: str, _jobs: int | None) -> Iterator[Workers]:
        with ThreadPoolExecutor(1) as executor:
            yield Workers(executor, 1, far=True)

    monkeypatch.setattr("lavt.experiment.sweep.sweep.cluster", far)
    monkeypatch.setattr("lavt.experiment.sweep.workers.put_files", put_one_and_stop)
    (tmp_path / "runs").mkdir()
    planned = plan_sweep(requested("fidelity=geometry"))[:1]
    with pytest.raises(KeyboardInterrupt):
        run_all(planned, tmp_path / "runs", jobs=1, on_progress=lambda _: None, cluster_address="local")
    assert not list(tmp_path.glob("runs/*"))


IMPORT_FOR_LONG = """
import sys, time
from pathlib import Path

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "lavt.experiment.report.report":
            Path("importing").touch()
            exec("time.sleep(3)")

sys.meta_path.insert(0, Finder())
"""
"""Makes the import of the report a place to interrupt: it executes a string, as the definition of a dataclass does."""


@pytest.mark.full
def test_a_sweep_that_is_stopped_in_an_import_ends_with_its_own_exit_code(tmp_path: Path) -> None:
    """`python -m` dies of a signal that finds the main thread executing a string, although it was handled."""
    (tmp_path / "sitecustomize.py").write_text(IMPORT_FOR_LONG)
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    started = subprocess.Popen(
        [
            *(sys.executable, "-m", "lavt", "sweep", str(shipped("configs/sweep.yaml").resolve())),
            *("--set", "fidelity=geometry", "--set", "repetitions=10", "--out", "out"),
        ],
        cwd=tmp_path, env={**os.environ, "PYTHONPATH": path},
        stderr=subprocess.PIPE, stdout=subprocess.DEVNULL, text=True, start_new_session=True,
    )  # fmt: skip
    for _ in range(3000):
        if (tmp_path / "importing").exists():
            break
        pause(20 * NS_PER_MS)
    os.killpg(started.pid, signal.SIGINT)
    _, said = started.communicate(timeout=60)
    assert "what was finished is kept" in said
    assert started.returncode == 1


def geometry(*changes: str) -> tuple[SweepConfig, list[PlannedRun]]:
    config = load_config(
        SweepConfig, shipped("configs/sweep.yaml"), ["fidelity=geometry", "conditions=[L0, L3, L5]", *changes]
    )
    return config, plan_sweep(config)


@pytest.mark.full
@pytest.mark.usefixtures("own_environment")  # distributed sets variables for its workers
def test_digests_are_the_same_on_any_workers(tmp_path: Path) -> None:
    """The same runs have the same digests on a repeat, with one process, with two, and on Dask's workers."""
    pytest.importorskip("distributed")
    _, planned = geometry()
    ways = {"one": (1, None), "two": (2, None), "again": (2, None), "dask": (2, "local")}
    digests = {}
    for name, (jobs, cluster_address) in ways.items():
        driven, _ = run_all(
            planned, tmp_path / name, jobs=jobs, on_progress=lambda _: None, cluster_address=cluster_address
        )
        assert driven.failed == []
        digests[name] = {result["run"]: result["digest"] for result in driven.results}
    assert len(set(digests["one"].values())) == len(planned)
    assert digests["one"] == digests["two"] == digests["again"] == digests["dask"]
    files = {path.relative_to(tmp_path / "dask") for path in (tmp_path / "dask").rglob("*")}
    assert files == {path.relative_to(tmp_path / "two") for path in (tmp_path / "two").rglob("*")}


class FarAway(Executor):
    """Drives here, at once, what is driven elsewhere, and knows which of what it gave is still held by somebody."""

    def __init__(self) -> None:
        self.held: weakref.WeakSet[Future[Any]] = weakref.WeakSet()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Drive, and give the files."""
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        self.held.add(future)
        return future


def test_files_from_far_are_let_go_once_they_are_written(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When a run that came from far is told, the files of those before it are no longer in memory."""
    away = FarAway()
    workers = Workers(away, 1, far=True)
    monkeypatch.setattr(lavt.experiment.sweep.sweep, "cluster", lambda _address, _jobs: nullcontext(workers))
    _, planned = geometry()
    held: list[int] = []
    run_all(planned[:3], tmp_path, jobs=None, on_progress=lambda _: held.append(len(away.held)), cluster_address="far")
    assert held == [3, 2, 1]


@pytest.mark.full
def test_without_a_scheduler_there_is_a_sentence(tmp_path: Path) -> None:
    """An address at which no Dask scheduler answers is an error of the user's, before anything is driven."""
    pytest.importorskip("distributed")
    _, planned = geometry()
    with pytest.raises(UserError, match="no Dask scheduler answers at"):
        run_all(planned, tmp_path, jobs=None, on_progress=lambda _: None, cluster_address="tcp://127.0.0.1:1")
    with pytest.raises(UserError, match="--jobs is for this machine"):
        run_all(planned, tmp_path, jobs=2, on_progress=lambda _: None, cluster_address="tcp://127.0.0.1:1")
    assert list(tmp_path.iterdir()) == []


def kill_a_worker(left: list[int]) -> None:
    """Kill the first process of this one's that is left to be killed, `left[0]` times."""
    children = multiprocessing.active_children()
    if left[0] and children:
        left[0] -= 1
        os.kill(int(children[0].pid or 0), signal.SIGKILL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_process_that_begins_does_not_hear_the_terminal(number: signal.Signals) -> None:
    """Ctrl-C and a closed terminal are nothing to a process from its first moment on."""
    with processes(2) as workers:
        begun = multiprocessing.active_children()
        for each in begun:
            os.kill(int(each.pid or 0), number)
        assert workers.executor.submit(os.getpid).result(60) in {each.pid for each in begun}
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == set()
        assert workers.executor.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result(60) == set()


@pytest.mark.full
def test_a_process_that_dies_costs_no_run(tmp_path: Path) -> None:
    """When a process is killed from outside, what it was at is driven again, and all runs are there in the end."""
    _, planned = geometry()
    left = [1]
    driven, _ = run_all(planned, tmp_path, jobs=2, on_progress=lambda _: kill_a_worker(left))
    assert left == [0]
    assert driven.failed == []
    assert sorted(result["run"] for result in driven.results) == sorted(each.name for each in planned)


class DiesAfterwards(Executor):
    """Drives here, and says what is said of a process that died before it could tell: a real one hardly ever does."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Drive, and break."""
        fn(*args, **kwargs)
        future: Future[Any] = Future()
        future.set_exception(BrokenExecutor())
        return future


def test_a_run_whose_process_dies_after_it_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run that had its result when its process died counts as it is, and is not driven again."""
    workers = Workers(DiesAfterwards(), 1, far=False)
    monkeypatch.setattr(lavt.experiment.sweep.sweep, "processes", lambda _jobs: nullcontext(workers))
    _, planned = geometry()
    driven, _ = run_all(planned[:1], tmp_path, jobs=1, on_progress=lambda _: None)
    assert driven.failed == []
    assert (
        [drive.result for drive in driven.drives] == driven.results == [read_json(tmp_path / planned[0].name / RESULT)]
    )
    assert len(driven.drives[0].truth) > 0


@pytest.mark.full
def test_a_killed_sweep_resumes_to_the_same_summary(tmp_path: Path) -> None:
    """A sweep killed (SIGKILL) in its middle and resumed gives the summary of one that nobody disturbed."""
    sets = [part for change in ("fidelity=geometry", "conditions=[L0, L3, L5]") for part in ("--set", change)]
    command = [sys.executable, "-m", "lavt", "sweep", str(shipped("configs/sweep.yaml")), *sets, "--out"]
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run([*command, str(whole)], check=True, capture_output=True)
    started = subprocess.Popen([*command, str(killed)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    for _ in range(600):
        if list(killed.glob("runs/*/result.json")):
            break
        pause(50 * NS_PER_MS)
    started.kill()
    started.wait()
    assert 0 < len(list(killed.glob("runs/*/result.json"))) < 6
    subprocess.run([*command, str(killed), "--resume"], check=True, capture_output=True)
    summaries = [json.loads((out / "summary.json").read_text()) for out in (whole, killed)]
    for summary in summaries:
        del summary["speed"]
    assert summaries[0] == summaries[1]
