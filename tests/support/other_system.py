"""Run `lavt` as on a system that lacks what only Linux has: modules and names of Python's library are taken away.

    python tests/support/other_system.py run configs/demo.yaml ...
    python tests/support/other_system.py                            # only import all modules

This is no other system: the rest of Python's library still behaves as on Linux.
"""

from __future__ import annotations

import importlib
import multiprocessing.popen_spawn_posix
import multiprocessing.resource_tracker
import os
import pkgutil
import signal
import socket
import sys
import time  # noqa: TID251 (only to take a clock away)
from types import ModuleType
from typing import cast

import cv2  # noqa: F401 (libraries may use the names that are taken away)
import numpy as np  # noqa: F401
import zenoh  # noqa: F401

MODULES = ("fcntl", "resource", "termios", "pwd", "grp", "pty", "tty")
NAMES = {
    os: "setpriority getpriority PRIO_PROCESS sched_getaffinity sched_setaffinity killpg setsid getuid geteuid getsid",
    signal: "SIGHUP SIGUSR1 SIGUSR2 SIGCONT SIGSTOP SIGTTIN SIGALRM pthread_sigmask SIG_BLOCK SIG_UNBLOCK SIG_SETMASK",
    socket: "MSG_DONTWAIT AF_CAN AF_NETLINK AF_PACKET SO_BINDTODEVICE",
    time: "CLOCK_BOOTTIME CLOCK_MONOTONIC_RAW clock_gettime_ns",
}

for module, names in NAMES.items():
    for name in names.split():
        if hasattr(module, name):
            delattr(module, name)
for name in MODULES:
    sys.modules[name] = cast(ModuleType, None)  # then an import of it fails
multiprocessing.resource_tracker._HAVE_SIGMASK = False  # type: ignore[attr-defined]

if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.argv[0] = "lavt"
        importlib.import_module("lavt.cli.main").main()
    else:
        lavt = importlib.import_module("lavt")
        for found in pkgutil.walk_packages(lavt.__path__, "lavt."):
            if not found.name.endswith("__main__"):
                importlib.import_module(found.name)
