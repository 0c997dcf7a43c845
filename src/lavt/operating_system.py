"""What only some operating systems have, and the error where it is missing.

Drives in virtual time, reports and replays need only what Python has everywhere. Everything in real time needs Linux:
kernel timestamps of datagrams, a clock that counts while the machine is suspended, signal masks, sessions.
"""

from __future__ import annotations

import os
import signal
import socket
from types import ModuleType
from typing import Final

from lavt.errors import UserError

HANGUP: Final[tuple[signal.Signals, ...]] = (signal.SIGHUP,) if hasattr(signal, "SIGHUP") else ()
"""The signal of a closed terminal, where there is one."""

ALARM: Final[tuple[signal.Signals, ...]] = (signal.SIGALRM,) if hasattr(signal, "SIGALRM") else ()
"""The signal of the process's timer, where there is one."""

LOOPBACK: Final = "127.0.0.1"

CAN_BLOCK_SIGNALS: Final = hasattr(signal, "pthread_sigmask")

NEEDED_IN_REAL_TIME: Final[tuple[tuple[ModuleType, str], ...]] = (
    (os, "sched_getaffinity"),
    (signal, "pthread_sigmask"),
    (socket, "MSG_DONTWAIT"),
)
"""Names of Python's library that exist on Linux. macOS lacks the first, Windows all of them."""


def missing_in_real_time() -> str:
    """Return the first name that real time needs and this system lacks; empty: it lacks none."""
    return next((f"{module.__name__}.{name}" for module, name in NEEDED_IN_REAL_TIME if not hasattr(module, name)), "")


def require_loopback() -> None:
    """Raise `UserError` if processes of this machine cannot reach each other over 127.0.0.1."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((LOOPBACK, 9))  # sends nothing
        except OSError as error:
            raise UserError(
                f"a run in real time needs the address {LOOPBACK} ({error.strerror}): enable the interface with "
                "`ip link set lo up`"
            ) from error


def require_real_time(what: str) -> None:
    """Raise `UserError` if this system cannot do `what`, which is in real time."""
    if missing := missing_in_real_time():
        raise UserError(
            f"{what} needs Linux (this system has no {missing}): use a machine with Linux, or drive in virtual time "
            "with `lavt run`, `lavt sweep` and `lavt boundary`"
        )
