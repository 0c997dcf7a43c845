"""The memory of a process that must never wait for a page from the disk."""

from __future__ import annotations

import ctypes
import mmap
import os
from typing import Final

MCL_CURRENT: Final = 1
MCL_FUTURE: Final = 2
"""Flags of mlockall(2) on x86 and ARM."""
M_TOP_PAD: Final = -2
HEAP_STEP_BYTES: Final = 64 * 1024
"""The heap grows by this much at a time (mallopt(3)). Locked memory is loaded when the heap grows, so a large step
would stop the caller for a while."""


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
    import resource  # noqa: PLC0415 (not on every system)

    limit_bytes, hard_limit_bytes = resource.getrlimit(resource.RLIMIT_MEMLOCK)
    try:
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (resource.RLIM_INFINITY, resource.RLIM_INFINITY))
    except (ValueError, OSError):
        resource.setrlimit(resource.RLIMIT_MEMLOCK, (0, hard_limit_bytes))
        try:
            is_exempt = _can_lock_page()
        finally:
            resource.setrlimit(resource.RLIMIT_MEMLOCK, (limit_bytes, hard_limit_bytes))
        if not is_exempt:
            return f"this user may lock only {limit_bytes // 1024} KiB (RLIMIT_MEMLOCK)"
    return ""


def _can_lock_page() -> bool:
    """Return whether a page can be locked.

    With a limit of 0 this needs the capability CAP_IPC_LOCK (mlock(2)). The capabilities that /proc shows do not tell:
    those of root in a user namespace do not count.
    """
    with mmap.mmap(-1, mmap.PAGESIZE) as page:
        address = ctypes.addressof(ctypes.c_char.from_buffer(page))
        is_locked: bool = ctypes.CDLL(None).mlock(ctypes.c_void_p(address), ctypes.c_size_t(1)) == 0
        return is_locked
