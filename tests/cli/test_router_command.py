from __future__ import annotations

import ctypes
import platform
import signal
import sys
from pathlib import Path

import pytest

from lavt.config_file import shipped
from lavt.experiment.runs.processes import Processes

TGKILL = 234
"""Linux's system call that sends a signal to one thread (x86-64)."""
EXIT_TIMEOUT_S = 60.0


@pytest.mark.skipif((sys.platform, platform.machine()) != ("linux", "x86_64"), reason="needs the number of tgkill")
def test_signal_to_another_thread(tmp_path: Path) -> None:
    """A router ends even if one of Zenoh's threads receives the signal, which does not wake Python's main thread."""
    with Processes(tmp_path) as processes:
        file = str(shipped("zenoh-configs/router-server.json5"))
        router = processes.start("router", "router", file, "--set", 'listen.endpoints=["tcp/127.0.0.1:0"]')
        router.wait_ready()
        pid = router.popen.pid
        thread = max(int(task.name) for task in Path(f"/proc/{pid}/task").iterdir())
        assert thread != pid
        assert ctypes.CDLL(None).syscall(TGKILL, pid, thread, int(signal.SIGINT)) == 0
        assert router.popen.wait(EXIT_TIMEOUT_S) == 0
