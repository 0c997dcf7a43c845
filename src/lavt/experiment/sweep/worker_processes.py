"""An executor of processes in which a process that dies costs only its own call, which is repeated in a new process.

`concurrent.futures.ProcessPoolExecutor` ends all its processes if one of them dies, and does not know which call that
process had. Here each process has a pipe of its own, whose end is closed when the process dies.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pickle import PicklingError
from queue import SimpleQueue
from typing import Any

from lavt.errors import WorkError, describe_error

TERMINAL_SIGNALS = (signal.SIGINT, signal.SIGHUP)
"""The signals that Ctrl-C and the closing of a terminal send."""

_TRIES = 2
"""The number of processes in which a call is tried."""


@contextmanager
def terminal_signals_blocked() -> Iterator[None]:
    """Block the terminal's signals inside the `with` block.

    In processes that are started in the block, these signals are blocked until they call `ignore_terminal_signals`.
    """
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def ignore_terminal_signals() -> None:
    """Ignore the terminal's signals: all processes of the terminal receive them, but only the parent handles them."""
    for number in TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, TERMINAL_SIGNALS)


class ProcessDied(Exception):
    """The process ended before it returned the result of a call."""


class WorkerProcess:
    """A process that executes calls, one after another. It ends when the parent process ends or is killed."""

    def __init__(self) -> None:
        self._connection: Connection | None = None
        self._process: SpawnProcess | None = None
        self.start()

    def start(self) -> None:
        """Start a process in place of the one that died; if it cannot be started, the next call raises the error."""
        self.close()
        context = multiprocessing.get_context("spawn")  # a fork would copy locks that are never released
        resource_tracker.ensure_running()  # before the signals are blocked, because its start unblocks SIGINT
        self._connection, remote_end = context.Pipe()
        self._process = context.Process(target=_execute_calls, args=(remote_end,), daemon=True)
        try:
            with terminal_signals_blocked():
                self._process.start()
        except OSError:  # it was killed before it had read what to do, or there is no memory for it
            self._process = None
        remote_end.close()  # so that the pipe ends when the process dies

    def call(self, function: Callable[..., Any], arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        """Call `function` in the process; return its result or raise its error, or `ProcessDied`."""
        if self._connection is None or self._process is None:
            raise ProcessDied
        try:
            self._connection.send((function, arguments, keywords))
            result, error = self._connection.recv()
        except (EOFError, OSError) as ended:
            raise ProcessDied from ended
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """End the process, which has no call, and wait for its end."""
        if self._connection is not None:
            self._connection.close()  # the process ends at the end of the pipe
        if self._process is not None:
            self._process.join()


class WorkerProcesses(Executor):
    """`jobs` processes. A call whose process died is repeated once; if it died again, the call has `BrokenExecutor`."""

    def __init__(self, jobs: int) -> None:
        self._idle: SimpleQueue[WorkerProcess] = SimpleQueue()
        self._jobs, self._stopping = jobs, False
        for _ in range(jobs):
            self._idle.put(WorkerProcess())
        self._threads = ThreadPoolExecutor(jobs)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call `fn` in the next process that is idle."""
        return self._threads.submit(self._call, fn, args, kwargs)

    def _call(self, function: Callable[..., Any], arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        worker = self._idle.get()
        try:
            for _ in range(_TRIES):
                try:
                    return worker.call(function, arguments, keywords)
                except ProcessDied:
                    if self._stopping:
                        break
                    worker.start()
            raise BrokenExecutor
        finally:
            self._idle.put(worker)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the calls that were submitted, or with `cancel_futures` for those in progress, and end."""
        self._stopping = cancel_futures
        self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        while wait and self._jobs:
            self._idle.get().close()
            self._jobs -= 1

    def __exit__(self, error_type: type[BaseException] | None, *_: object) -> None:
        """Wait for all calls; after an error or Ctrl-C in the `with` block, only for those in progress."""
        self.shutdown(cancel_futures=error_type is not None)


def _execute_calls(connection: Connection) -> None:
    ignore_terminal_signals()
    threading.Thread(target=_end_with_parent, daemon=True).start()
    while True:
        try:
            function, arguments, keywords = connection.recv()
        except EOFError:
            return
        result: Any = None
        failure: Exception | None = None
        try:
            result = function(*arguments, **keywords)
        except Exception as error:  # an error of one call does not end the process
            failure = error
        try:
            connection.send((result, failure))
        except (AttributeError, TypeError, PicklingError) as error:  # the result or the error cannot be pickled
            connection.send((None, WorkError(describe_error(failure or error))))
        del result, failure  # they may be large, and the next call needs memory


def _end_with_parent() -> None:
    """Exit when the parent process has ended, so that no process of an old sweep writes into a resumed sweep."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        try:
            parent.join()
        finally:
            os._exit(1)
