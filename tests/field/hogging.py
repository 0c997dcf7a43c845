"""`lavt`, with a thread that holds the interpreter for three seconds when a file says so.

`LAVT_HOG` names a directory. A file `hog_server` in it is for the server's process, `hog_actuator` for the actuator's,
which is started from this program and so runs this too.
"""

from __future__ import annotations

import os
import threading
from itertools import repeat
from pathlib import Path

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S

HELD_S = 3
TRIAL = 3_000_000


def hog() -> None:
    """Wait for the file, then count in C, which lets no other thread of the interpreter run."""
    clock, name = MachineClock(), "hog_server" if __name__ == "__main__" else "hog_actuator"
    sign = Path(os.environ["LAVT_HOG"]) / name
    while not sign.exists():
        pause(5 * NS_PER_MS)
    start_ns = clock.now().mono_ns
    sum(repeat(1, TRIAL))
    sum(repeat(1, round(TRIAL * HELD_S * NS_PER_S / (clock.now().mono_ns - start_ns))))


threading.Thread(target=hog, daemon=True).start()

if __name__ == "__main__":
    from lavt.cli.main import main

    main()
