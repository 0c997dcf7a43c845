"""Panics of a native library written in Rust, which end only one thread or task of the process.

Zenoh can panic in one of its own threads. The process would then run on without receiving messages. A panic is printed
to the descriptor of standard error, and there is no other sign of it that Python can receive.
"""

from __future__ import annotations

import os
import re
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Final

from lavt.errors import WorkError
from lavt.runtime.output import finish_output

PANIC: Final = re.compile(r"^thread '.*panicked at (.*?):?$", re.MULTILINE)
MAX_LINE_BYTES: Final = 10_000
END_TIMEOUT_S: Final = 15.0
"""How long a program may take to end after a panic. A server disengages a by-wire kit in at most 10 s."""
READER_TIMEOUT_S: Final = 1.0
STDERR: Final = 2


class NativePanic(WorkError):
    """A native library panicked."""


@contextmanager
def fail_on_panics(fail: Callable[[BaseException], None]) -> Iterator[None]:
    """Call `fail` with a `NativePanic` for each panic during the `with` block.

    What native code and child processes write to standard error goes through a pipe to `sys.stderr`, which must have a
    descriptor of its own, as after `queue_output`.
    """
    real_stderr = os.dup(STDERR)
    read_end, write_end = os.pipe()
    os.dup2(write_end, STDERR)
    os.close(write_end)
    reader = threading.Thread(target=_read, args=(read_end, fail), name="native errors", daemon=True)
    reader.start()
    try:
        yield
    finally:
        os.dup2(real_stderr, STDERR)
        os.close(real_stderr)
        reader.join(READER_TIMEOUT_S)  # a child process that still has the pipe would keep the thread waiting


def end_in_any_case(exit_code: int, timeout_s: float = END_TIMEOUT_S) -> None:
    """End the process after a time, if it has not ended by then: after a panic, closing Zenoh can wait for ever."""

    def end() -> None:
        finish_output()
        os._exit(exit_code)

    timer = threading.Timer(timeout_s, end)
    timer.daemon = True
    timer.start()


def _read(descriptor: int, fail: Callable[[BaseException], None]) -> None:
    """Copy a pipe to `sys.stderr` until its end, and report each panic in it."""
    line = ""
    while data := os.read(descriptor, 65_536):
        text = data.decode(errors="replace")
        sys.stderr.write(text)
        sys.stderr.flush()
        *lines, line = (line + text).split("\n")
        line = line[-MAX_LINE_BYTES:]
        for panic in PANIC.finditer("\n".join(lines)):
            fail(NativePanic(f"a thread of Zenoh panicked at {panic[1]}"))
    os.close(descriptor)
