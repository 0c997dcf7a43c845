"""Output, exit codes and signal handling shared by all commands."""

from __future__ import annotations

import errno
import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.errors import LavtError, UserError, WorkError
from lavt.operating_system import ALARM, HANGUP
from lavt.recording.output_directory import disk_errors_named
from lavt.runtime.output import queue_output

BrowserOption = Annotated[
    bool, typer.Option("--browser/--no-browser", help="Open the page of a person, if this machine has a display.")
]
WatchOption = Annotated[
    bool, typer.Option("--watch", help="Serve a page that shows the video with the detected lane (docs/drive.md).")
]
PagePortOption = Annotated[
    int, typer.Option("--port", min=0, max=65535, help="TCP port of this page, which has its calibrations; 0: any.")
]
OutOption = Annotated[Path | None, typer.Option(help="Output directory.")]
SetOption = Annotated[
    list[str] | None, typer.Option("--set", help="Override a config value, as a.b=value; repeatable.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print JSON instead of text.")]

OS_REMEDIES = {
    errno.ENOSPC: "free space on the disk, or write to another one",
    errno.EDQUOT: "free space in your quota, or write to another disk",
    errno.EACCES: "get the permission, or name another place",
    errno.EPERM: "get the permission, or name another place",
    errno.EROFS: "name a place that can be written",
    errno.EADDRINUSE: "end the program that uses the port, or choose another port",
    errno.ENETUNREACH: "check the address and this machine's network",
    errno.EHOSTUNREACH: "check the address and the network",
    errno.EMFILE: "raise the limit of open files (`ulimit -n`)",
    errno.EISDIR: "remove this directory, or name another place",
    errno.ENOTDIR: "remove the file in the place of a directory, or name another place",
}
"""What to do about an error of the operating system."""
REPETITION_S = 0.01
"""The time after which an interrupt that Python has discarded is repeated."""
INPUT_ERRORS = (errno.EISDIR, errno.ENOTDIR)
"""The errors of the operating system that are about a name in the input."""


def print_message(text: str) -> None:
    """Print a message for the user to standard error."""
    print(f"{text}\n", end="", file=sys.stderr, flush=True)


def print_result(text: str) -> None:
    """Print a result to standard output; an error of the disk to which it is redirected names it."""
    with disk_errors_named("the standard output"):
        print(f"{text}\n", end="", flush=True)


def print_report(page: Path, content: Path, failed: Sequence[tuple[str, str]], *, as_json: bool) -> None:
    """Print the failed runs with their reasons, and the path of a report's page or, as JSON, its content.

    Raises `typer.Exit` with code 1 if a run has failed.
    """
    for name, reason in failed:
        print_message(f"failed: {name}: {reason}")
    if as_json:
        print_json(json.loads(content.read_text(encoding="utf-8")))
    else:
        print_result(f"the report is {page}")
    if failed:
        raise typer.Exit(1)


def print_json(value: Any) -> None:
    """Print a result to standard output as one line of JSON."""
    print_result(json.dumps(value, allow_nan=False))


def reserve_stdout() -> None:
    """Reserve standard output for results: redirect the output of libraries (Zenoh's log) to `sys.stderr`.

    The libraries write to a pipe that a thread always reads, so that they never block.
    """
    result_stream = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    read_end, write_end = os.pipe()
    os.dup2(write_end, sys.stdout.fileno())
    os.close(write_end)
    sys.stdout = result_stream
    threading.Thread(target=_copy_to_stderr, args=(read_end,), name="library output", daemon=True).start()


def _copy_to_stderr(descriptor: int) -> None:
    while data := os.read(descriptor, 65_536):
        print(data.decode(errors="replace"), end="", file=sys.stderr, flush=True)


def run_command(command: Callable[[], None]) -> None:
    """Run a command and map its errors to exit codes: 0 for success, 1 for failed work, 2 for invalid input."""
    try:
        command()
    except UserError as error:
        print_message(f"lavt: {error}")
        raise SystemExit(2) from None
    except LavtError as error:
        print_message(f"lavt: {error}")
        raise SystemExit(1) from None
    except OSError as error:  # such as a full disk or a missing permission that no check anticipated
        remedy = OS_REMEDIES.get(error.errno or 0)
        print_message(f"lavt: {error}" + (f": {remedy}" if remedy else ""))
        raise SystemExit(2 if error.errno in INPUT_ERRORS else 1) from None


@contextmanager
def interruptible(in_progress: str = "") -> Iterator[None]:
    """Raise `WorkError` when Ctrl-C, SIGTERM or a closed terminal interrupts long work.

    If the work finishes what is in progress first, `in_progress` names it ("runs"), and the first interrupt says so.
    From the beginning of the block on, no message to standard error blocks the program.
    """
    notices = [f"lavt: finishing the {in_progress} in progress; Ctrl-C again ends at once"] if in_progress else []

    def interrupt(*_: object) -> None:
        if notices:
            print_message(notices.pop())
        raise KeyboardInterrupt

    queue_output("stderr")
    is_ignored = signal.getsignal(signal.SIGINT) == signal.SIG_IGN  # as in the background of a shell script
    try:
        with (
            _signal_handlers(interrupt, signal.SIGTERM, *(() if is_ignored else (signal.SIGINT,))),
            _lost_interrupts_repeated(interrupt),
        ):
            yield
    except KeyboardInterrupt:
        raise WorkError("stopped; the finished results are kept") from None


@contextmanager
def closing_on_signals() -> Iterator[None]:
    """Raise `KeyboardInterrupt` also when SIGTERM or a closed terminal ends a program that starts or ends.

    So what it has opened is closed: an actor in a CARLA server, for example, would outlive the process.
    """
    with _signal_handlers(signal.default_int_handler, signal.SIGTERM):
        yield


@contextmanager
def _lost_interrupts_repeated(interrupt: Callable[..., None]) -> Iterator[None]:
    """Call `interrupt` again if Python has discarded its error, as it does in the callbacks of weak references.

    A timer does it, because it needs no lock: the interrupted code can own any.
    """
    former_hook, former_handlers = sys.unraisablehook, dict[signal.Signals, Any]()

    def repeat_or_report(discarded: Any) -> None:
        if discarded.exc_type is not KeyboardInterrupt or not ALARM:
            former_hook(discarded)
            return
        for number in ALARM:
            former_handlers.setdefault(number, signal.signal(number, interrupt))
        signal.setitimer(signal.ITIMER_REAL, REPETITION_S)

    sys.unraisablehook = repeat_or_report
    try:
        yield
    finally:
        sys.unraisablehook = former_hook
        for number, former_handler in former_handlers.items():
            signal.setitimer(signal.ITIMER_REAL, 0.0)
            signal.signal(number, former_handler)


class StopEvent:
    """An event that a signal handler can set without a deadlock.

    A signal handler interrupts the main thread anywhere, even inside another handler: a second signal often follows the
    first immediately. `threading.Event.set` waits for a lock. If the interrupted code owns that lock, the handler waits
    for ever. The method `set` of this class waits for nothing.
    """

    def __init__(self) -> None:
        self._clear_lock = threading.Lock()
        """A lock that is held while the event is clear."""
        self._clear_lock.acquire()

    def set(self) -> None:
        """Set the event; setting it again changes nothing."""
        with suppress(RuntimeError):  # the event was already set
            self._clear_lock.release()

    def is_set(self) -> bool:
        """Return whether the event is set."""
        return not self._clear_lock.locked()

    def clear(self) -> None:
        """Clear the event."""
        self._clear_lock.acquire(blocking=False)

    def wait(self, timeout_s: float | None = None) -> bool:
        """Wait until the event is set or `timeout_s` has passed (None: no timeout); return whether it is set."""
        is_set = self._clear_lock.acquire(timeout=-1 if timeout_s is None else timeout_s)
        if is_set:
            self.set()
        return is_set


@contextmanager
def stop_on_signals() -> Iterator[StopEvent]:
    """Yield an event that Ctrl-C, SIGTERM or a closed terminal sets, for programs that run until they are stopped.

    From the beginning of the block on, no output blocks the program.
    """
    queue_output("stdout", "stderr")
    stop = StopEvent()
    with _signal_handlers(lambda *_: stop.set(), signal.SIGINT, signal.SIGTERM):
        yield stop


@contextmanager
def _signal_handlers(handler: Callable[..., None], *signals: signal.Signals) -> Iterator[None]:
    """Install `handler` for these signals and for SIGHUP (a closed terminal); restore the former handlers at the end.

    SIGHUP stays ignored if it was ignored before, as under `nohup`.
    """
    hangup = [number for number in HANGUP if signal.getsignal(number) != signal.SIG_IGN]
    former_handlers = {number: signal.signal(number, handler) for number in (*signals, *hangup)}
    try:
        yield
    finally:
        for number, former_handler in former_handlers.items():
            signal.signal(number, former_handler)
