"""The agent of the client's machine, which calls functions there for tests that run on the server's machine."""

from __future__ import annotations

import os
import sys
import threading
import traceback
from multiprocessing.connection import Connection, Listener

PORT = 7700


def serve(address: str, key: bytes) -> None:
    """Receive (function, arguments, keywords), call the function, and answer (exception text or None, return value)."""
    with Listener((address, PORT), authkey=key) as listener:
        while True:
            threading.Thread(target=_answer, args=(listener.accept(),), daemon=True).start()


def _answer(connection: Connection) -> None:
    while True:
        try:
            function, arguments, keywords = connection.recv()
        except (EOFError, OSError):
            return
        try:
            connection.send((None, function(*arguments, **keywords)))
        except Exception:
            connection.send((traceback.format_exc(), None))


if __name__ == "__main__":
    serve(sys.argv[1], os.environ["LAVT_KERNEL_KEY"].encode())
