"""A child process that ends with its parent: when the parent dies, the pipe on the child's standard input closes."""

from __future__ import annotations

import os
import signal
import threading
from contextlib import suppress
from typing import Final

ENDS_WITH_STDIN: Final = "LAVT_ENDS_WITH_STDIN"
"""The environment variable that a parent sets for a child whose standard input is a pipe from it."""


def end_with_parent() -> None:
    """Stop this process by SIGTERM as soon as its parent is gone, if the parent has asked for it.

    Not by SIGINT, because the processes that a sweep's worker starts ignore it until they are ready.
    """
    if os.environ.pop(ENDS_WITH_STDIN, ""):
        threading.Thread(target=_stop_at_end_of_input, name="parent watch", daemon=True).start()


def _stop_at_end_of_input() -> None:
    with suppress(OSError):
        while os.read(0, 4096):
            pass
    os.kill(os.getpid(), signal.SIGTERM)
