"""Output that never blocks: even if nobody reads what a program prints, the program continues and can end."""

from __future__ import annotations

import atexit
import io
import os
import sys
import threading
from contextlib import suppress
from queue import Empty, SimpleQueue
from typing import Final, Literal

CAPACITY: Final = 1000
"""Largest number of texts that wait: the JSON lines of three minutes of a drive."""
FINISH_TIMEOUT_S: Final = 1.0
"""How long a program waits at its end for the reader of each stream."""

StreamName = Literal["stdout", "stderr"]


class QueuedOutput(io.TextIOBase):
    """A text stream whose texts a thread writes to a file descriptor.

    If nobody reads a pipe or terminal, an ordinary write blocks, and a signal handler interrupts it only for a moment.
    Here only the thread blocks. If the queue is full, the oldest text is dropped and counted, as are texts that cannot
    be written. Any thread and signal handler may write.
    """

    encoding = "utf-8"

    def __init__(self, descriptor: int, capacity: int = CAPACITY) -> None:
        self.dropped = 0
        self._descriptor = descriptor
        self._capacity = capacity
        self._texts: SimpleQueue[str | None] = SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="output", daemon=True)
        self._thread.start()

    def write(self, text: str) -> int:
        """Queue a text."""
        if self._texts.qsize() >= self._capacity:
            with suppress(Empty):
                self._texts.get_nowait()
                self.dropped += 1
        self._texts.put(text)
        return len(text)

    def fileno(self) -> int:
        """Return the file descriptor."""
        return self._descriptor

    def isatty(self) -> bool:
        """Return whether the output goes to a terminal."""
        return os.isatty(self._descriptor)

    def finish(self, timeout_s: float = FINISH_TIMEOUT_S) -> None:
        """Wait until all queued texts are written, for at most `timeout_s`; nothing is written after that."""
        self._texts.put(None)
        self._thread.join(timeout_s)

    def _run(self) -> None:
        while (text := self._texts.get()) is not None:
            data = text.encode(errors="backslashreplace")
            try:
                while data:
                    data = data[os.write(self._descriptor, data) :]
            except OSError:  # the reader has ended, or the terminal is closed
                self.dropped += 1


def queue_output(*names: StreamName) -> None:
    """Replace these standard streams by queued ones until the program ends.

    At exit, the queued texts are written after the interpreter has printed the traceback of an error.
    """
    atexit.unregister(finish_output)
    atexit.register(finish_output)
    for name in names:
        stream = getattr(sys, name)
        if not isinstance(stream, QueuedOutput):
            stream.flush()
            descriptor = os.dup(stream.fileno())  # a copy: the replaced stream closes the original
            setattr(sys, name, QueuedOutput(descriptor))


def finish_output() -> None:
    """Write the queued texts, within `FINISH_TIMEOUT_S` for each stream, and the number of dropped ones."""
    streams = [stream for stream in (sys.stdout, sys.stderr) if isinstance(stream, QueuedOutput)]
    for stream in streams:
        if stream is sys.stderr and (dropped := sum(queued.dropped for queued in streams)):
            stream.write(f"lavt: {dropped} texts were not printed, because they were not read in time\n")
        stream.finish()
