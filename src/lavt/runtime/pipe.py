"""One end of a pipe between two processes of this machine, for threads that must not wait."""

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
"""Entries that wait while the other process does not read: some ten seconds of a drive."""

CLOSE_S: Final = 1.0

log = logging.getLogger(__name__)


class Pipe:
    """Sends entries, any picklable objects, in order, and hands what comes to `take` in a thread of its own.

    Nobody waits for the other process: what does not fit is dropped and counted. `gone` is called once, when the other
    end is closed or its process has ended, or when an entry could not be sent or taken: half a pipe is none. Both ends
    are processes of one program, which trust each other.
    """

    def __init__(self, connection: Connection, take: Callable[[Any], None], gone: Callable[[], None]) -> None:
        self.dropped = 0
        self._connection = connection
        self._take, self._gone = take, gone
        self._entries: SimpleQueue[Any] = SimpleQueue()
        self._writer = threading.Thread(target=self._write, name="pipe writer", daemon=True)
        self._reader = threading.Thread(target=self._read, name="pipe reader", daemon=True)

    def start(self) -> None:
        """Begin to send and to take."""
        self._writer.start()
        self._reader.start()

    def send(self, entry: Any) -> None:
        """Send an entry as soon as may be."""
        if self._entries.qsize() < CAPACITY:
            self._entries.put(entry)
        else:
            self.dropped += 1

    def close(self, wait_s: float) -> None:
        """Send what waits, for so long at most, and close; once more does nothing."""
        if self._connection.closed:
            return
        self._entries.put(None)
        self._join(self._writer, wait_s)
        self._shut()
        for thread in (self._writer, self._reader):
            self._join(thread, CLOSE_S)
        self._connection.close()

    def wait_gone(self, wait_s: float) -> None:
        """Wait until the other end is closed and all that came was taken, for so long at most."""
        self._join(self._reader, wait_s)

    @staticmethod
    def _join(thread: threading.Thread, wait_s: float) -> None:
        """Wait for a thread, if it was started."""
        if thread.ident is not None:
            thread.join(wait_s)

    def _shut(self) -> None:
        """End what the threads wait for, here and there."""
        with socket.socket(fileno=os.dup(self._connection.fileno())) as end, suppress(OSError):
            end.shutdown(socket.SHUT_RDWR)

    def _write(self) -> None:
        ends = False
        while not ends:
            entries = [self._entries.get()]
            while not self._entries.empty():
                entries.append(self._entries.get())
            ends = None in entries
            try:
                self._connection.send_bytes(pickle.dumps([each for each in entries if each is not None]))
            except (OSError, ValueError):  # the other process has ended, or this end was closed
                return
            except Exception as error:  # of an entry that cannot be pickled
                log.critical("a pipe cannot be written to: %s", error, exc_info=error)
                self._shut()
                return

    def _read(self) -> None:
        try:
            while True:
                for entry in pickle.loads(self._connection.recv_bytes()):  # noqa: S301 (our own process wrote it)
                    self._take(entry)
        except (EOFError, OSError, ValueError):
            pass
        except Exception as error:  # of an entry that cannot be read or taken: nobody would hear the next one
            log.critical("a pipe cannot be read: %s", error, exc_info=error)
        self._gone()
