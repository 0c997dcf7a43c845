"""One end of a pipe between two processes of this machine. Sending never blocks."""

from __future__ import annotations

import logging
import os
import pickle
import socket
import threading
from collections.abc import Callable
from contextlib import suppress
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any, Final

CAPACITY: Final = 8192
"""Number of entries that are queued if the other process does not read: about ten seconds of a drive."""

CLOSE_TIMEOUT_S: Final = 1.0
"""How long closing waits for each thread to end."""

log = logging.getLogger(__name__)


class Pipe:
    """A pipe end that sends any picklable entries in order, and calls `receive` for each entry in its own thread.

    `send` never waits for the other process: entries that do not fit into the queue are dropped and counted.
    `on_closed` is called once, when the other end is closed, the other process has ended, or an entry could not be sent
    or received. An error in one direction closes both directions. The processes belong to one program and trust each
    other.
    """

    def __init__(self, connection: Connection, receive: Callable[[Any], None], on_closed: Callable[[], None]) -> None:
        self.dropped = 0
        self._connection = connection
        self._receive, self._on_closed = receive, on_closed
        self._entries: SimpleQueue[Any] = SimpleQueue()
        self._writer = threading.Thread(target=self._write, name="pipe writer", daemon=True)
        self._reader = threading.Thread(target=self._read, name="pipe reader", daemon=True)

    def start(self) -> None:
        """Start to send and to receive."""
        self._writer.start()
        self._reader.start()

    def send(self, entry: Any) -> None:
        """Queue an entry to be sent; drop it if the queue is full."""
        if self._entries.qsize() < CAPACITY:
            self._entries.put(entry)
        else:
            self.dropped += 1

    def close(self, wait_s: float) -> None:
        """Send the queued entries within `wait_s`, and close; a second call does nothing."""
        if self._connection.closed:
            return
        self._entries.put(None)
        self._join(self._writer, wait_s)
        self._shut()
        for thread in (self._writer, self._reader):
            self._join(thread, CLOSE_TIMEOUT_S)
        self._connection.close()

    def wait_closed(self, wait_s: float) -> None:
        """Wait for at most `wait_s` until the other end is closed and all its entries were received."""
        self._join(self._reader, wait_s)

    @staticmethod
    def _join(thread: threading.Thread, wait_s: float) -> None:
        """Join a thread, if it was started."""
        if thread.ident is not None:
            thread.join(wait_s)

    def _shut(self) -> None:
        """Shut the connection down, which ends the reads at both ends."""
        with socket.socket(fileno=os.dup(self._connection.fileno())) as end, suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)

    def _write(self) -> None:
        is_last = False
        while not is_last:
            entries = [self._entries.get()]
            while not self._entries.empty():
                entries.append(self._entries.get())
            is_last = None in entries
            try:
                self._connection.send_bytes(pickle.dumps([entry for entry in entries if entry is not None]))
            except (OSError, ValueError):  # the other process has ended, or this end was closed
                return
            except Exception as error:  # an entry cannot be pickled
                log.critical("cannot write to a pipe: %s", error, exc_info=error)
                self._shut()
                return

    def _read(self) -> None:
        try:
            while True:
                for entry in pickle.loads(self._connection.recv_bytes()):  # noqa: S301 (our own process wrote it)
                    self._receive(entry)
        except (EOFError, OSError, ValueError):
            pass
        except Exception as error:  # an entry cannot be read or processed: the pipe ends
            log.critical("cannot read from a pipe: %s", error, exc_info=error)
        self._on_closed()
