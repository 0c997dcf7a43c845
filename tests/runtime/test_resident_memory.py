"""Memory that is locked, with and without permission."""

from __future__ import annotations

import subprocess
import sys

import pytest

from lavt.runtime.resident_memory import lift_lock_limit

LOCKS = """
import ctypes, mmap, os, resource, sys
from pathlib import Path
from lavt.runtime.resident_memory import lock_memory

def locked_kib():
    return next(int(line.split()[1]) for line in Path("/proc/self/status").read_text().splitlines() if "VmLck" in line)

if sys.argv[1:] == ["limited"]:
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
    if os.getuid() == 0:
        os.setuid(65534)
if sys.argv[1:] == ["namespace"]:
    resource.setrlimit(resource.RLIMIT_MEMLOCK, (65536, 65536))
    clone_newuser = 0x10000000
    if ctypes.CDLL(None).unshare(clone_newuser) != 0:
        sys.exit("user namespaces are not permitted")
print(lock_memory())
before_kib = locked_kib()
later = mmap.mmap(-1, 10 * 1024 * 1024)
print(before_kib, locked_kib() - before_kib)
"""


def lock(*arguments: str) -> tuple[str, int, int]:
    """Lock a process's memory; return why not, and the KiB locked of its first memory and of 10 MiB mapped later."""
    command = [sys.executable, "-c", LOCKS, *arguments]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=280)
    if "namespaces are not permitted" in done.stderr:
        pytest.skip(done.stderr.strip())
    reason, sizes = done.stdout.splitlines()
    first, later = map(int, sizes.split())
    return reason, first, later


@pytest.mark.skipif(lift_lock_limit() != "", reason=f"needs permission to lock memory: {lift_lock_limit()}")
def test_present_and_later_memory_is_locked() -> None:
    """With permission, the memory that the process has is locked, and also what it maps later."""
    reason, first_kib, later_kib = lock()
    assert reason == ""
    assert first_kib > 1000
    assert later_kib >= 10 * 1024


@pytest.mark.parametrize("restriction", ["limited", "namespace"])
def test_without_permission_nothing_is_locked(restriction: str) -> None:
    """A process that may lock little memory locks none and can allocate more; the reason names the limit.

    This also holds for root in a user namespace, who has all capabilities, but only inside of it.
    """
    reason, *locked_kib = lock(restriction)
    assert "64 KiB" in reason
    assert "RLIMIT_MEMLOCK" in reason
    assert locked_kib == [0, 0]
