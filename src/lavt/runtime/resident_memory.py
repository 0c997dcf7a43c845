"""The memory of a process that must never wait for a page from the disk."""

from __future__ import annotations

import ctypes
import os
import resource
from pathlib import Path
from typing import Final

MCL_CURRENT: Final = 1
MCL_FUTURE: Final = 2
"""Flags of mlockall(2) on x86 and ARM."""
M_TOP_PAD: Final = -2
HEAP_STEP_BYTES: Final = 64 * 1024
"""The heap grows by this much at a time (mallopt(3)). Locked memory is loaded when the heap grows, so a large step
would stop the caller for a while."""
CAP_IPC_LOCK: Final = 14
"""With this capability, the limit on locked memory does not apply (capabilities(7))."""


def lock_memory() -> str:
    """Load all memory of this process, also that which it maps later, and keep it in RAM; return why not, or "".

    Otherwise Linux may drop or swap out its pages while memory is scarce, program code included, and the next access
    waits until the disk has delivered the page.
    """
    reason = lift_lock_limit()
    if reason:
        return reason
    library = ctypes.CDLL(None, use_errno=True)
    if hasattr(library, "mallopt"):  # glibc
        library.mallopt(M_TOP_PAD, HEAP_STEP_BYTES)
    if library.mlockall(MCL_CURRENT | MCL_FUTURE) != 0:
        return f"mlockall failed: {os.strerror(ctypes.get_errno())}"
    return ""


def lift_lock_limit() -> str:
    """Lift the limit on this process's locked memory; return why not, or "".

    Under a limit, memory is better not locked: each allocation beyond it would fail.
    """
    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    except (ValueError, OSError):
        if not _has_capability(CAP_IPC_LOCK):
            return f"this user may lock only {limit_bytes // 1024} KiB (RLIMIT_MEMLOCK)"
    return ""


def _has_capability(capability: int) -> bool:
    status = Path("/proc/self/status").read_text()
    effective = next((line.split()[1] for line in status.splitlines() if line.startswith("CapEff:")), "0")
    return bool(int(effective, 16) >> capability & 1)
