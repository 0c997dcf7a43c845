from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import BrokenExecutor
from contextlib import suppress
from pathlib import Path

import pytest

from lavt.clock import pause
from lavt.domain import NS_PER_MS
from lavt.errors import UserError, WorkError
from lavt.experiment.sweep.worker_processes import WorkerProcess, WorkerProcesses
from lavt.operating_system import CAN_BLOCK_SIGNALS


@pytest.fixture
def workers() -> Iterator[WorkerProcesses]:
    with WorkerProcesses(2) as executor:
        yield executor


def kill(process_id: int) -> None:
    os.kill(process_id, signal.SIGKILL)


def die() -> None:
    """Kill the own process."""
    kill(os.getpid())


def wait_for(file: Path) -> int:
    """Wait until `file` exists; return the number of the process."""
    while not file.exists():
        pause(5 * NS_PER_MS)
    return os.getpid()


def begin_and_wait(directory: Path) -> int:
    """Write the file `begun`, and wait for the file `never`; hold memory, so that the process dies slowly."""
    _held = b"x" * 300_000_000
    (directory / "begun").touch()
    return wait_for(directory / "never")


class UnpicklableError(Exception):
    """An error that cannot be sent to the parent process."""

    def __reduce__(self) -> str:
        raise ValueError("this error has no bytes")


def fail(error: type[Exception]) -> None:
    """Raise the error."""
    raise error("the input is wrong")


@pytest.mark.parametrize("moment", ["importing", "idle"])
def test_a_process_that_died_gets_no_call(workers: WorkerProcesses, moment: str) -> None:
    """If processes died while they imported or waited for work, new processes execute the next calls."""
    if moment == "idle":
        assert workers.submit(os.getppid).result(60) == os.getpid()
    dead = multiprocessing.active_children()
    for process in dead:
        kill(int(process.pid or 0))
        process.join()
    numbers = {workers.submit(os.getpid).result(60) for _ in range(4)}
    assert len(numbers) == 2
    assert not numbers & {process.pid for process in dead}


def test_a_process_that_dies_costs_only_its_own_call(workers: WorkerProcesses, tmp_path: Path) -> None:
    """The call of a process that dies has an error, a new process replaces it, and the other process continues."""
    at_start = {process.pid for process in multiprocessing.active_children()}
    undisturbed = workers.submit(wait_for, tmp_path / "go on")
    for _ in range(3):
        with pytest.raises(BrokenExecutor):
            workers.submit(die).result(60)
    assert workers.submit(os.getpid).result(60) not in at_start
    (tmp_path / "go on").touch()
    assert undisturbed.result(60) in at_start


def test_after_ctrl_c_no_further_call_begins(tmp_path: Path) -> None:
    """If Ctrl-C interrupts the `with` block anywhere, calls that have not begun are cancelled."""
    (tmp_path / "go on").touch()
    with suppress(KeyboardInterrupt), WorkerProcesses(1) as executor:
        calls = [executor.submit(wait_for, tmp_path / "go on") for _ in range(20)]
        raise KeyboardInterrupt
    assert calls[-1].cancelled()


@pytest.mark.skipif(not CAN_BLOCK_SIGNALS, reason="no thread can be sent a signal")
def test_a_second_ctrl_c_breaks_off_the_call(tmp_path: Path) -> None:
    """Ctrl-C during the wait for a call kills the call's process and waits until it is dead; no other call begins."""

    def interrupt_the_wait(main_thread: int) -> None:
        for file in ("begun", "waiting"):
            wait_for(tmp_path / file)
        signal.pthread_kill(main_thread, signal.SIGINT)

    interrupter = threading.Thread(target=interrupt_the_wait, args=(threading.get_ident(),))
    interrupter.start()
    with suppress(KeyboardInterrupt), WorkerProcesses(1) as executor:
        worker = executor.submit(os.getpid).result(60)
        calls = [executor.submit(begin_and_wait, tmp_path) for _ in range(2)]
        wait_for(tmp_path / "begun")
        (tmp_path / "waiting").touch()
        executor.shutdown(cancel_futures=True)
    with pytest.raises(ProcessLookupError):
        os.kill(worker, 0)
    interrupter.join()
    assert isinstance(calls[0].exception(60), BrokenExecutor)
    assert calls[1].cancelled()


class WorkerBesideAnEndingCall(WorkerProcess):
    """A worker; whenever it is closed, the call of another worker ends."""

    def __init__(self, executor: WorkerProcesses) -> None:
        self._executor = executor

    def close(self) -> None:
        """Let another worker become idle."""
        self._executor._idle.append(self._executor._idle[-1])

    def join(self) -> None:
        """Wait for nothing, because there is no process."""


def test_a_call_that_ends_during_the_end_does_not_disturb_it(workers: WorkerProcesses) -> None:
    """After a wait that Ctrl-C has interrupted, a call may end while the workers are closed: they are all closed."""
    workers._idle.appendleft(WorkerBesideAnEndingCall(workers))
    at_start = multiprocessing.active_children()
    workers.shutdown()
    workers._idle.popleft()
    assert not any(process.is_alive() for process in at_start)


def test_errors_of_a_call_are_raised(workers: WorkerProcesses) -> None:
    """An error of a call is raised as it is, or as a `WorkError` with its text if it or the result cannot be sent."""
    with pytest.raises(UserError, match="the input is wrong"):
        workers.submit(fail, UserError).result(60)
    with pytest.raises(WorkError, match="UnpicklableError: the input is wrong"):
        workers.submit(fail, UnpicklableError).result(60)
    with pytest.raises(WorkError, match="cannot pickle"):
        workers.submit(threading.Lock).result(60)
