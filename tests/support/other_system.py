"""Run `lavt` as on macOS or Windows, which lack what only Linux has: names of Python's library are taken away.

    LAVT_LIKE=windows python tests/support/other_system.py run configs/demo.yaml ...
    LAVT_LIKE=macos python tests/support/other_system.py                                # only import all modules

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

NOT_ON_MACOS = {
    os: "sched_getaffinity sched_setaffinity sched_setscheduler",
    socket: "AF_CAN AF_NETLINK AF_PACKET SO_BINDTODEVICE",
    time: "CLOCK_BOOTTIME",
}
NOT_ON_WINDOWS = {
    os: "setpriority getpriority PRIO_PROCESS killpg setsid getuid geteuid getsid",
    signal: "SIGHUP SIGUSR1 SIGUSR2 SIGCONT SIGSTOP SIGTTIN SIGALRM pthread_sigmask SIG_BLOCK SIG_UNBLOCK SIG_SETMASK",
    socket: "MSG_DONTWAIT",
    time: "CLOCK_MONOTONIC_RAW clock_gettime_ns",
}
NO_MODULES_ON_WINDOWS = ("fcntl", "resource", "termios", "pwd", "grp", "pty", "tty")
IS_LIKE_WINDOWS = os.environ["LAVT_LIKE"] == "windows"

for missing in (NOT_ON_MACOS, NOT_ON_WINDOWS) if IS_LIKE_WINDOWS else (NOT_ON_MACOS,):
    for module, names in missing.items():
        for name in names.split():
            if hasattr(module, name):
                delattr(module, name)
if IS_LIKE_WINDOWS:
    for name in NO_MODULES_ON_WINDOWS:
        sys.modules[name] = cast(ModuleType, None)  # then an import of it fails
    multiprocessing.resource_tracker._HAVE_SIGMASK = False  # type: ignore[attr-defined]

if __name__ == "__main__":
    if len(sys.argv) > 1:
        sys.argv[0] = "lavt"
        if sys.argv[1] == "demo":
            demo = importlib.import_module("lavt.cli.demo")
            demo.ROADS = demo.ROADS[:1]  # type: ignore[attr-defined]  # six times as fast
        importlib.import_module("lavt.cli.main").main()
    else:
        lavt = importlib.import_module("lavt")
        for found in pkgutil.walk_packages(lavt.__path__, "lavt."):
            if not found.name.endswith("__main__"):
                importlib.import_module(found.name)
