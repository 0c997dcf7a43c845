from __future__ import annotations

import errno
import itertools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import yaml

import lavt.experiment.sweep
from lavt.clock import MachineClock, pause
from lavt.config import RunConfig, SweepConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.experiment.analysis.results import read_json
from lavt.experiment.runs.plan import PlannedRun, plan_run, plan_sweep
from lavt.experiment.runs.run import RESULT, run_once
from lavt.experiment.sweep.sweep import base_of, drive_sweep, recorded_base, run_all
from lavt.experiment.sweep.workers import Workers, drive_or_read, process_workers

CHANGES = ("fidelity=geometry", "conditions=[L0, L3]", "repetitions=1", "network.inherent=loopback")
END_LIMIT_S = 900
"""How long a sweep may take to begin or to end; the full lane runs at the lowest priority beside another lane."""


def wait_until(process: subprocess.Popen[Any], condition: Callable[[], bool]) -> None:
    """Wait until a condition is true, which a process must reach before it ends."""
    clock = MachineClock()
    limit_ns = clock.now().mono_ns + END_LIMIT_S * NS_PER_S
    while not condition():
        assert process.poll() is None, f"the process ended with {process.poll()}"
        assert clock.now().mono_ns < limit_ns, f"not within {END_LIMIT_S} s"
        pause(20 * NS_PER_MS)


def sweep_config(*changes: str) -> SweepConfig:
    return load_config(SweepConfig, shipped("configs/sweep.yaml"), [*CHANGES, *changes])


def two_runs() -> list[PlannedRun]:
    return plan_sweep(sweep_config())


@pytest.fixture(scope="module")
def sweep_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive a sweep of two runs in two processes, and return its directory."""
    out = tmp_path_factory.mktemp("sweep")
    drive_sweep(sweep_config(), two_runs(), out, jobs=2, on_progress=lambda _: None)
    return out


def test_a_sweep_writes_all_files(sweep_folder: Path) -> None:
    """A sweep writes a directory for each run with config, records and result, a summary, and a report."""
    for run in two_runs():
        names = {path.name for path in (sweep_folder / "runs" / run.name).iterdir()}
        assert names == {"config.yaml", "server.mcap", "client.mcap", "result.json"}
    assert load_config(SweepConfig, sweep_folder / "sweep.yaml") == sweep_config()
    assert (sweep_folder / "report" / "index.html").is_file()
    summary = json.loads((sweep_folder / "summary.json").read_text())
    assert list(summary["conditions"]) == ["L0", "L3"]
    assert summary["conditions"]["L3"]["injected_ms"] == {"video": 225.0, "control": 0.0}
    assert summary["speed"]["jobs"] == 2
    assert summary["real"] == {}


class ResumedSweep(NamedTuple):
    """The summaries of a sweep before and after its first run was driven again."""

    before: dict[str, Any]
    after: dict[str, Any]
    is_second_run_unchanged: bool


@pytest.fixture(scope="module")
def resumed(sweep_folder: Path) -> ResumedSweep:
    """Remove the result of the first run, and resume the sweep."""
    before = read_json(sweep_folder / "summary.json")
    first, second = (sweep_folder / "runs" / run.name / RESULT for run in two_runs())
    before_ns = second.stat().st_mtime_ns
    first.unlink()  # as if the sweep had been killed during this run
    drive_sweep(sweep_config(), two_runs(), sweep_folder, jobs=1, on_progress=lambda _: None)
    return ResumedSweep(before, read_json(sweep_folder / "summary.json"), second.stat().st_mtime_ns == before_ns)


def test_resuming_drives_only_missing_runs(resumed: ResumedSweep) -> None:
    """A sweep that lost a run drives only that run again, with the same digest and the same summary."""
    assert resumed.is_second_run_unchanged
    assert sorted(resumed.after["runs"], key=str) == sorted(resumed.before["runs"], key=str)
    assert resumed.after["conditions"] == resumed.before["conditions"]


@pytest.mark.full
def test_the_speed_is_that_of_the_last_drives(sweep_folder: Path, resumed: ResumedSweep) -> None:
    """A resumed sweep's speed includes only the runs that it drove; if it drove no run, the speed is kept."""
    speed = resumed.after["speed"]
    assert speed["simulated_s"] == read_json(sweep_folder / "runs" / two_runs()[0].name / RESULT)["duration_s"]
    drive_sweep(sweep_config(), two_runs(), sweep_folder, jobs=2, on_progress=lambda _: None)
    assert read_json(sweep_folder / "summary.json")["speed"] == speed


def test_an_error_of_one_run_does_not_stop_the_others(tmp_path: Path) -> None:
    """An unexpected error of one run is reported with its type and text, and all other runs are driven."""
    good, bad = two_runs()
    lines: list[str] = []
    driven, speed = run_all([replace(bad, seed=-1), good], tmp_path, jobs=1, on_progress=lines.append)
    ((name, reason),) = driven.failed
    assert name == bad.name
    assert reason.startswith("ValidationError: ")
    assert f"{name} failed: {reason}" in lines
    assert [result["run"] for result in driven.results] == [good.name]
    assert speed is not None


def test_the_config_of_a_run_reproduces_it(sweep_folder: Path, tmp_path: Path) -> None:
    """A new run with the config of a run directory has the digest of the run in that directory."""
    directory = sweep_folder / "runs" / two_runs()[0].name
    again = run_once(plan_run(load_config(RunConfig, directory / "config.yaml")), tmp_path / "again")
    assert again["digest"] == json.loads((directory / "result.json").read_text())["digest"]


def write_half(path: Path, text: str, **_options: Any) -> int:
    path.write_bytes(text.encode()[: len(text) // 2])
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_full_disk_leaves_the_recorded_config(sweep_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep that is resumed on a full disk keeps the config from which it can be resumed later."""
    files = {path.name: path.read_bytes() for path in sweep_folder.iterdir() if path.is_file()}
    monkeypatch.setattr(Path, "write_text", write_half)
    with pytest.raises(OSError, match="No space left"):
        drive_sweep(sweep_config(), two_runs(), sweep_folder, jobs=1, on_progress=lambda _: None)
    assert {path.name: path.read_bytes() for path in sweep_folder.iterdir() if path.is_file()} == files


def test_resuming_with_another_config_is_rejected(sweep_folder: Path) -> None:
    """A sweep that was driven with another config is not resumed."""
    changed, before = sweep_config("seed=2"), (sweep_folder / "sweep.yaml").read_bytes()
    with pytest.raises(UserError, match="another config"):
        drive_sweep(changed, plan_sweep(changed), sweep_folder, jobs=1, on_progress=lambda _: None)
    assert (sweep_folder / "sweep.yaml").read_bytes() == before


@pytest.mark.parametrize(
    ("key", "value"), [("conditions", "[L1]"), ("repetitions", "2"), ("axes", "{study.block: [1]}")]
)
def test_resuming_a_sweep_of_other_runs_is_rejected(sweep_folder: Path, key: str, value: str) -> None:
    """A sweep is not resumed with a config that has other runs."""
    changed, before = sweep_config(f"{key}={value}"), (sweep_folder / "sweep.yaml").read_bytes()
    with pytest.raises(UserError, match=rf"another config \({key}\)"):
        drive_sweep(changed, plan_sweep(changed), sweep_folder, jobs=1, on_progress=lambda _: None)
    assert (sweep_folder / "sweep.yaml").read_bytes() == before


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
    """The base of a sweep has, for each axis, the value of the sweep's config, in the axis or not."""
    config = sweep_config(*changes)
    assert base_of(config, plan_sweep(config)) == base
    assert recorded_base(tmp_path) is None
    (tmp_path / "sweep.yaml").write_text(yaml.safe_dump(config.model_dump(mode="json")))
    assert recorded_base(tmp_path) == base


@pytest.mark.full
@pytest.mark.parametrize(
    ("signal_number", "options"), [(signal.SIGINT, ()), (signal.SIGHUP, ()), (signal.SIGINT, ("--cluster", "local"))]
)
@pytest.mark.usefixtures("default_sighup_action")
def test_a_stopped_sweep_keeps_what_is_finished(signal_number: int, options: tuple[str, ...], tmp_path: Path) -> None:
    """Ctrl-C or a closed terminal ends a sweep with a message, exit code 1 and no traceback.

    The finished runs are kept, and runs in progress in local processes are finished.
    """
    if options:
        pytest.importorskip("distributed")
    out = tmp_path / "out"
    set_options = [part for change in ("fidelity=geometry", "repetitions=10") for part in ("--set", change)]
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "lavt", "sweep", str(shipped("configs/sweep.yaml")), *set_options),
            *("--jobs", "2"),
            *("--out", str(out), *options),
        ],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    wait_until(process, lambda: bool(list(out.glob("runs/*/result.json"))))
    os.killpg(process.pid, signal_number)  # to all processes of the group, as a terminal does
    _, stderr = process.communicate(timeout=END_LIMIT_S)
    assert process.returncode == 1
    assert "results are kept" in stderr
    assert "Traceback" not in stderr
    planned_runs = 6 * 10  # conditions x repetitions
    assert 0 < len(list(out.glob("runs/*/result.json"))) == len(list(out.glob("runs/*"))) < planned_runs


def test_runs_in_a_carla_server_are_driven_one_by_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A sweep with a CARLA server has one worker, whatever was asked, because only one client can tick a server."""
    used: list[int] = []

    def note_jobs(_attempt: object, _todo: object, jobs: int) -> list[object]:
        used.append(jobs)
        return []

    monkeypatch.setattr("lavt.experiment.sweep.sweep.attempt_in_processes", note_jobs)
    for kind in ("simulator", "carla"):
        planned = plan_sweep(sweep_config("fidelity=pixels", f"vehicle.kind={kind}"))
        run_all(planned, tmp_path, jobs=4, on_progress=lambda _: None)
    assert used == [4, 1]


@pytest.mark.full
def test_a_second_ctrl_c_ends_a_sweep_at_once(tmp_path: Path) -> None:
    """The first Ctrl-C announces that the runs in progress are finished; the second breaks them off."""
    out = tmp_path / "out"
    process = subprocess.Popen(
        [
            *(
                sys.executable,
                "-m",
                "lavt",
                "sweep",
                str(shipped("configs/sweep.yaml")),
                "--jobs",
                "2",
                "--out",
                str(out),
            )
        ],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    wait_until(process, lambda: len(list(out.glob("runs/*/*"))) > 1)
    assert process.stderr is not None
    os.killpg(process.pid, signal.SIGINT)
    printed = list(itertools.takewhile(lambda line: "Ctrl-C again" not in line, process.stderr))
    os.killpg(process.pid, signal.SIGINT)
    _, rest = process.communicate(timeout=END_LIMIT_S)
    assert process.returncode == 1
    assert "results are kept" in rest
    assert "Traceback" not in "".join(printed) + rest
    assert list(out.glob("runs/*"))
    assert not list(out.glob("runs/*/result.json"))


def test_ctrl_c_leaves_no_partial_remote_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If Ctrl-C interrupts writing the files of a remote run, no file of this run remains."""

    def write_one_and_stop(_files: Mapping[str, bytes], directory: Path) -> None:
        directory.mkdir()
        (directory / "server.mcap").touch()
        raise KeyboardInterrupt

    @contextmanager
    def remote_workers(_address: str, _jobs: int | None) -> Iterator[Workers]:
        with ThreadPoolExecutor(1) as executor:
            yield Workers(executor, 1, remote=True)

    monkeypatch.setattr("lavt.experiment.sweep.sweep.cluster_workers", remote_workers)
    monkeypatch.setattr("lavt.experiment.sweep.workers.write_files", write_one_and_stop)
    (tmp_path / "runs").mkdir()
    planned = plan_sweep(sweep_config("fidelity=geometry"))[:1]
    with pytest.raises(KeyboardInterrupt):
        run_all(planned, tmp_path / "runs", jobs=1, on_progress=lambda _: None, cluster_address="local")
    assert not list(tmp_path.glob("runs/*"))


SLOW_IMPORT = """
import sys, time
from pathlib import Path

class Finder:
    def find_spec(self, name, path=None, target=None):
        if name == "lavt.experiment.report.report":
            Path("importing").touch()
            exec("time.sleep(3)")

sys.meta_path.insert(0, Finder())
"""
"""A module that makes the import of the report slow while it executes a string, as a dataclass definition does."""


@pytest.mark.full
def test_ctrl_c_in_an_import_keeps_the_exit_code(tmp_path: Path) -> None:
    """Ctrl-C during the import of the report, which executes a string, ends a sweep with exit code 1."""
    (tmp_path / "sitecustomize.py").write_text(SLOW_IMPORT)
    path = os.pathsep.join(filter(None, (str(tmp_path), os.environ.get("PYTHONPATH"))))
    process = subprocess.Popen(
        [
            *(sys.executable, "-m", "lavt", "sweep", str(shipped("configs/sweep.yaml").resolve())),
            *("--set", "fidelity=geometry", "--set", "repetitions=10", "--out", "out"),
        ],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        start_new_session=True,
    )
    wait_until(process, (tmp_path / "importing").exists)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=END_LIMIT_S)
    assert "results are kept" in stderr
    assert process.returncode == 1


def geometry_sweep(*changes: str) -> tuple[SweepConfig, list[PlannedRun]]:
    config = load_config(
        SweepConfig, shipped("configs/sweep.yaml"), ["fidelity=geometry", "conditions=[L0, L3, L5]", *changes]
    )
    return config, plan_sweep(config)


@pytest.mark.full
@pytest.mark.usefixtures("restored_environment")  # distributed sets variables for its workers
def test_digests_are_the_same_on_any_workers(tmp_path: Path) -> None:
    """Runs have the same digests when repeated, with one process, with two, and with Dask workers."""
    pytest.importorskip("distributed")
    _, planned = geometry_sweep("repetitions=1")
    workers = {"one": (1, None), "two": (2, None), "again": (2, None), "dask": (2, "local")}
    digests = {}
    for name, (jobs, cluster_address) in workers.items():
        driven, _ = run_all(
            planned, tmp_path / name, jobs=jobs, on_progress=lambda _: None, cluster_address=cluster_address
        )
        assert driven.failed == []
        digests[name] = {result["run"]: result["digest"] for result in driven.results}
    assert len(set(digests["one"].values())) == len(planned)
    assert digests["one"] == digests["two"] == digests["again"] == digests["dask"]
    files = {path.relative_to(tmp_path / "dask") for path in (tmp_path / "dask").rglob("*")}
    assert files == {path.relative_to(tmp_path / "two") for path in (tmp_path / "two").rglob("*")}


class InlineRemoteExecutor(Executor):
    """An executor that drives remote runs inline, and tracks which of its futures are still referenced."""

    def __init__(self) -> None:
        self.referenced: weakref.WeakSet[Future[Any]] = weakref.WeakSet()

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Drive, and return a future with the files."""
        future: Future[Any] = Future()
        future.set_result(fn(*args, **kwargs))
        self.referenced.add(future)
        return future


def test_files_of_remote_runs_are_freed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """When a remote run is reported, the files of the runs before it are no longer in memory."""
    executor = InlineRemoteExecutor()
    workers = Workers(executor, 1, remote=True)
    monkeypatch.setattr(lavt.experiment.sweep.sweep, "cluster_workers", lambda _address, _jobs: nullcontext(workers))
    _, planned = geometry_sweep()
    counts: list[int] = []

    def count_referenced(_line: str) -> None:
        counts.append(len(executor.referenced))

    run_all(planned[:3], tmp_path, jobs=None, on_progress=count_referenced, cluster_address="remote")
    assert counts == [3, 2, 1]


@pytest.mark.full
def test_a_missing_scheduler_is_an_error(tmp_path: Path) -> None:
    """An address without a Dask scheduler, or `--jobs` beside an address, is a user error before anything is driven."""
    pytest.importorskip("distributed")
    _, planned = geometry_sweep()
    with pytest.raises(UserError, match="no Dask scheduler answers at"):
        run_all(planned, tmp_path, jobs=None, on_progress=lambda _: None, cluster_address="tcp://127.0.0.1:1")
    with pytest.raises(UserError, match="--jobs is for this machine"):
        run_all(planned, tmp_path, jobs=2, on_progress=lambda _: None, cluster_address="tcp://127.0.0.1:1")
    assert list(tmp_path.iterdir()) == []


def kill_a_worker(remaining: list[int]) -> None:
    """Kill the first child process if `remaining[0]` is not 0, and decrement `remaining[0]`."""
    children = multiprocessing.active_children()
    if remaining[0] and children:
        remaining[0] -= 1
        os.kill(int(children[0].pid or 0), signal.SIGKILL)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGHUP])
def test_a_new_worker_ignores_terminal_signals(number: signal.Signals) -> None:
    """A worker process ignores Ctrl-C and a closed terminal from its start on."""
    with process_workers(2) as workers:
        workers_at_start = multiprocessing.active_children()
        for worker in workers_at_start:
            os.kill(int(worker.pid or 0), number)
        assert workers.executor.submit(os.getpid).result(60) in {worker.pid for worker in workers_at_start}
        assert signal.pthread_sigmask(signal.SIG_BLOCK, ()) == set()
        assert workers.executor.submit(signal.pthread_sigmask, signal.SIG_BLOCK, ()).result(60) == set()


@pytest.mark.full
def test_runs_of_a_killed_process_are_repeated(tmp_path: Path) -> None:
    """The runs of a killed process are driven again, and all runs are finished."""
    _, planned = geometry_sweep()
    remaining = [1]
    driven, _ = run_all(planned, tmp_path, jobs=2, on_progress=lambda _: kill_a_worker(remaining))
    assert remaining == [0]
    assert driven.failed == []
    assert sorted(result["run"] for result in driven.results) == sorted(run.name for run in planned)


def kill_worker_when(moment: str, runs_dir: Path) -> None:
    """Kill a worker while it imports, or when the runs have the file that is named `moment`."""
    for _ in range(6000):
        children = multiprocessing.active_children()
        if len(children) == 2 and (moment == "importing" or list(runs_dir.glob(f"*/{moment}"))):
            os.kill(int(children[0].pid or 0), signal.SIGKILL)
            return
        pause(5 * NS_PER_MS)


@pytest.mark.full
@pytest.mark.parametrize("moment", ["importing", "server.mcap", "config.yaml"])
def test_a_worker_killed_before_the_first_result_costs_nothing(moment: str, sweep_folder: Path, tmp_path: Path) -> None:
    """If a worker is killed before any run has a result, all runs have the results of an undisturbed sweep."""
    killer = threading.Thread(target=kill_worker_when, args=(moment, tmp_path))
    killer.start()
    driven, _ = run_all(two_runs(), tmp_path, jobs=2, on_progress=lambda _: None)
    killer.join()
    assert driven.failed == []
    undisturbed = {run.name: read_json(sweep_folder / "runs" / run.name / RESULT) for run in two_runs()}
    assert {result["run"]: result for result in driven.results} == undisturbed


def test_a_run_whose_process_dies_after_it_is_kept(tmp_path: Path) -> None:
    """A run that had a result when its process died is read and not driven again."""
    run = two_runs()[0]
    driven = drive_or_read(run, tmp_path / run.name)
    written_ns = (tmp_path / run.name / RESULT).stat().st_mtime_ns
    read = drive_or_read(run, tmp_path / run.name)
    assert read.result == driven.result == read_json(tmp_path / run.name / RESULT)
    assert len(read.truth) == len(driven.truth) > 0
    assert (tmp_path / run.name / RESULT).stat().st_mtime_ns == written_ns


class DeadProcesses(Executor):
    """An executor whose processes die at once."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:  # noqa: ARG002 (protocol)
        """Return a future with `BrokenExecutor`."""
        future: Future[Any] = Future()
        future.set_exception(BrokenExecutor())
        return future


def test_a_run_whose_processes_always_die_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A run whose processes die is driven three times, at last in a single process, and then listed as failed."""
    pools: list[int] = []

    def dead_workers(jobs: int) -> nullcontext[Workers]:
        pools.append(jobs)
        return nullcontext(Workers(DeadProcesses(), jobs, remote=False))

    monkeypatch.setattr("lavt.experiment.sweep.workers.process_workers", dead_workers)
    driven, _ = run_all(two_runs(), tmp_path, jobs=2, on_progress=lambda _: None)
    assert sorted(driven.failed) == [
        (name, "each of the processes that drove it died") for name in sorted(run.name for run in two_runs())
    ]
    assert pools == [2, 2, 1]


@pytest.mark.full
def test_a_killed_sweep_resumes_to_the_same_summary(tmp_path: Path) -> None:
    """A sweep that was killed (SIGKILL) and resumed has the summary of an undisturbed sweep."""
    set_options = [part for change in ("fidelity=geometry", "conditions=[L0, L3, L5]") for part in ("--set", change)]
    command = [sys.executable, "-m", "lavt", "sweep", str(shipped("configs/sweep.yaml")), *set_options, "--out"]
    undisturbed, killed = tmp_path / "whole", tmp_path / "killed"
    subprocess.run([*command, str(undisturbed)], check=True, capture_output=True)
    process = subprocess.Popen([*command, str(killed)], stderr=subprocess.DEVNULL, stdout=subprocess.DEVNULL)
    wait_until(process, lambda: bool(list(killed.glob("runs/*/result.json"))))
    process.kill()
    process.wait()
    assert 0 < len(list(killed.glob("runs/*/result.json"))) < 6
    subprocess.run([*command, str(killed), "--resume"], check=True, capture_output=True)
    summaries = [json.loads((out / "summary.json").read_text()) for out in (undisturbed, killed)]
    for summary in summaries:
        del summary["speed"]
    assert summaries[0] == summaries[1]
