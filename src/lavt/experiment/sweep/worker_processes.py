"""An executor of processes in which a process that dies costs only its own call.

`concurrent.futures.ProcessPoolExecutor` ends all its processes if one of them dies, and does not know which call that
process had. Here each process has a pipe of its own, whose other end is closed when the process dies.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import BrokenExecutor, Executor, Future, ThreadPoolExecutor
from contextlib import contextmanager, suppress
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from typing import Any

from lavt.errors import WorkError, describe_error
from lavt.operating_system import CAN_BLOCK_SIGNALS, HANGUP

TERMINAL_SIGNALS = (signal.SIGINT, *HANGUP)
"""The signals that Ctrl-C and the closing of a terminal send."""


@contextmanager
def terminal_signals_blocked() -> Iterator[None]:
    """Block the terminal's signals inside the `with` block, if the system can.

    In processes that are started in the block, these signals are blocked until they call `ignore_terminal_signals`.
    """
    if not CAN_BLOCK_SIGNALS:
        yield
        return
    previous_mask = signal.pthread_sigmask(signal.SIG_BLOCK, TERMINAL_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, previous_mask)


def ignore_terminal_signals() -> None:
    """Ignore the terminal's signals: all processes of the terminal receive them, but only the parent handles them."""
    for number in TERMINAL_SIGNALS:
        signal.signal(number, signal.SIG_IGN)
    if CAN_BLOCK_SIGNALS:
        signal.pthread_sigmask(signal.SIG_UNBLOCK, TERMINAL_SIGNALS)


class WorkerProcess:
    """A process that executes calls, one after another. It ends when the parent process ends or is killed."""

    def __init__(self) -> None:
        context = multiprocessing.get_context("spawn")  # a fork would copy locks that are never released
        if CAN_BLOCK_SIGNALS:
            resource_tracker.ensure_running()  # before the signals are blocked, because its start unblocks SIGINT
        self._connection, remote_end = context.Pipe()
        self._process = context.Process(target=_execute_calls, args=(remote_end,), daemon=True)
        # Without the parent's copy of the remote end, the pipe ends when the process dies. An `OSError` means that the
        # process was killed during its start, or that there is no memory for it: then it is not alive.
        with remote_end, terminal_signals_blocked(), suppress(OSError):
            self._process.start()

    def is_alive(self) -> bool:
        """Return whether the process has not died."""
        return self._process.is_alive()

    def call(self, function: Callable[..., Any], arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        """Call `function` in the process; return its result or raise its error. Raise `BrokenExecutor` if it dies."""
        try:
            self._connection.send((function, arguments, keywords))
            result, error = self._connection.recv()
        except (EOFError, OSError) as ended:
            self.close()
            self.join()  # so that no other call is sent to it while it is dying
            raise BrokenExecutor from ended
        if error is not None:
            raise error
        return result

    def close(self) -> None:
        """Close the pipe, whereupon a process without a call ends."""
        self._connection.close()

    def kill(self) -> None:
        """Kill the process, and so break off its call."""
        if self._process.pid is not None:  # it was started
            self._process.kill()

    def join(self) -> None:
        """Wait for the end of the process."""
        if self.is_alive():
            self._process.join()


class WorkerProcesses(Executor):
    """`jobs` processes. The call of a process that dies has the error `BrokenExecutor`; a new process replaces it."""

    def __init__(self, jobs: int) -> None:
        self._idle = deque(WorkerProcess() for _ in range(jobs))
        self._busy: set[WorkerProcess] = set()
        self._is_broken_off = False
        self._threads = ThreadPoolExecutor(jobs)  # one thread for each process

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """Call `fn` in the next process that is idle."""
        return self._threads.submit(self._call, fn, args, kwargs)

    def _call(self, function: Callable[..., Any], arguments: tuple[Any, ...], keywords: dict[str, Any]) -> Any:
        worker = self._idle.popleft()
        try:
            if not worker.is_alive():
                worker = WorkerProcess()
            self._busy.add(worker)
            if self._is_broken_off:
                raise BrokenExecutor
            return worker.call(function, arguments, keywords)
        finally:
            self._busy.discard(worker)
            self._idle.append(worker)

    def shutdown(self, wait: bool = True, *, cancel_futures: bool = False) -> None:
        """Wait for the calls that were submitted, or with `cancel_futures` for those in progress, and end.

        Ctrl-C during the wait breaks off the calls in progress.
        """
        try:
            self._threads.shutdown(wait=wait, cancel_futures=cancel_futures)
        except KeyboardInterrupt:
            self._break_off()
            raise
        if wait:
            idle = tuple(self._idle)  # after an interrupted wait, threads may still add to it
            for worker in idle:
                worker.close()
            for worker in idle:
                worker.join()

    def _break_off(self) -> None:
        self._is_broken_off = True
        self._threads.shutdown(wait=False, cancel_futures=True)
        broken_off = tuple(self._busy)
        for worker in broken_off:
            worker.kill()
        for worker in broken_off:  # the threads do not wait for it: Ctrl-C in the wait for a thread marks it as ended
            worker.join()

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
        except Exception as error:  # the result or the error cannot be pickled
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
