"""Run `lavt` with a thread that blocks the Python interpreter for three seconds as soon as a file exists.

The environment variable `LAVT_HOG` names the directory of the file. The file is `hog_server` for the server's process
and `hog_actuator` for the actuator's. The server starts the actuator's process by multiprocessing's `spawn`. So the
actuator's process imports this file, too, under another `__name__`.
"""

from __future__ import annotations

import os
import threading
from itertools import repeat
from pathlib import Path

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S

BLOCKED_S = 3
CALIBRATION_COUNT = 3_000_000


def hog() -> None:
    """Wait for the file, then count in C code, which keeps the interpreter's lock."""
    clock, name = MachineClock(), "hog_server" if __name__ == "__main__" else "hog_actuator"
    trigger = Path(os.environ["LAVT_HOG"]) / name
    while not trigger.exists():
        pause(5 * NS_PER_MS)
    start_ns = clock.now().mono_ns
    sum(repeat(1, CALIBRATION_COUNT))
    sum(repeat(1, round(CALIBRATION_COUNT * BLOCKED_S * NS_PER_S / (clock.now().mono_ns - start_ns))))


threading.Thread(target=hog, daemon=True).start()

if __name__ == "__main__":
    from lavt.cli.main import main

    main()
