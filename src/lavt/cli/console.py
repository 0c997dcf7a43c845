"""What all commands share: results on standard output, messages on standard error, exit codes, and a clean end."""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.errors import LavtError, UserError, WorkError

Out = Annotated[Path | None, typer.Option(help="Directory for what is written.")]
Set = Annotated[list[str] | None, typer.Option("--set", help="Change a config value: a.b=value, as often as needed.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON for programs.")]


def say(text: str) -> None:
    """Print a message for the user to standard error."""
    print(text, file=sys.stderr, flush=True)


def show(text: str) -> None:
    """Print a result to standard output."""
    print(text, flush=True)


def show_json(value: Any) -> None:
    """Print a result as one line of JSON."""
    show(json.dumps(value, allow_nan=False))


def keep_stdout_for_results() -> None:
    """Send what libraries print (Zenoh's log) to standard error; `show` still writes to standard output."""
    results = os.fdopen(os.dup(sys.stdout.fileno()), "w", encoding="utf-8")
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())
    sys.stdout = results


def run_command(command: Callable[[], None]) -> None:
    """Run a command and end the process: 0 it did its job, 2 the input was wrong, 1 the work failed."""
    try:
        command()
    except UserError as error:
        say(f"lavt: {error}")
        raise SystemExit(2) from None
    except LavtError as error:
        say(f"lavt: {error}")
        raise SystemExit(1) from None
    except OSError as error:  # a disk or a right that no check has foreseen
        say(f"lavt: {error}")
        raise SystemExit(1) from None


@contextmanager
def interruptible() -> Iterator[None]:
    """Let Ctrl-C, SIGTERM or a closed terminal in the middle of long work be an end that says so."""

    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    try:
        with _handled(interrupt, signal.SIGTERM):
            yield
    except KeyboardInterrupt:
        raise WorkError("stopped; what was finished is kept") from None


class StopEvent:
    """An event that a signal sets.

    Its handler interrupts whatever the main thread does, another handler as well: a second signal often comes with the
    first. `threading.Event.set` waits for a lock that the interrupted one may have, and so for ever; here nothing does.
    """

    def __init__(self) -> None:
        self._not_yet = threading.Lock()
        self._not_yet.acquire()

    def set(self) -> None:
        """Tell; to tell twice is to tell once."""
        with suppress(RuntimeError):  # it was told already
            self._not_yet.release()

    def is_set(self) -> bool:
        """Whether it was told."""
        return not self._not_yet.locked()

    def clear(self) -> None:
        """Forget that it was told."""
        self._not_yet.acquire(blocking=False)

    def wait(self, pause_s: float | None = None) -> bool:
        """Wait until told, and for `pause_s` at most; None: until told. Tells whether it was."""
        told = self._not_yet.acquire(timeout=-1 if pause_s is None else pause_s)
        if told:
            self.set()
        return told


@contextmanager
def until_told() -> Iterator[StopEvent]:
    """Give an event that Ctrl-C, SIGTERM or a closed terminal sets, for programs that run until told to stop."""
    told = StopEvent()
    with _handled(lambda *_: told.set(), signal.SIGINT, signal.SIGTERM):
        yield told


@contextmanager
def _handled(handler: Callable[..., None], *numbers: signal.Signals) -> Iterator[None]:
    """Handle these signals, and a closed terminal's SIGHUP but where it is ignored (by `nohup`): it stays ignored."""
    closed = [] if signal.getsignal(signal.SIGHUP) == signal.SIG_IGN else [signal.SIGHUP]
    before = {number: signal.signal(number, handler) for number in (*numbers, *closed)}
    try:
        yield
    finally:
        for number, former in before.items():
            signal.signal(number, former)
