"""One machine's clocks, read against what both machines share: the processor's time stamp counter."""

from __future__ import annotations

import ctypes
import mmap
import time
from collections.abc import Callable
from ctypes import c_int, c_long, c_uint
from functools import cache

NS_PER_S = 1_000_000_000
RDTSC = bytes.fromhex("0fae e8 0f31 48c1e220 4809d0 c3")
"""lfence; rdtsc; shl rdx, 32; or rax, rdx; ret"""
CALIBRATION_S = 0.2

ADJ_FREQUENCY, ADJ_STATUS, ADJ_SETOFFSET, ADJ_NANO, ADJ_TICK = 0x2, 0x10, 0x100, 0x2000, 0x4000
STA_UNSYNC = 0x40
TICK_US = 10_000
PPM = 65_536
"""The kernel's unit of frequency is 2^-16 ppm."""


class Timex(ctypes.Structure):
    """The argument of adjtimex(2)."""

    _fields_ = [
        ("modes", c_uint),
        ("offset", c_long),
        ("frequency", c_long),
        ("maximum_error", c_long),
        ("estimated_error", c_long),
        ("status", c_int),
        ("constant", c_long),
        ("precision", c_long),
        ("tolerance", c_long),
        ("seconds", c_long),
        ("fraction", c_long),
        ("tick", c_long),
        ("rest", c_int * 32),
    ]


def counter() -> int:
    """Read the time stamp counter."""
    return _rdtsc()[1]()


def reading(attempts: int = 60) -> tuple[int, int]:
    """Read counter and wall clock (ns) together: of some attempts, the one that was interrupted least."""
    best: tuple[int, int, int] | None = None
    for _ in range(attempts):
        before = counter()
        wall_ns = time.time_ns()
        after = counter()
        if best is None or after - before < best[0]:
            best = after - before, (before + after) // 2, wall_ns
    assert best is not None
    return best[1:]


def monotonic_reading(attempts: int = 10) -> tuple[int, int]:
    """Read counter and CLOCK_MONOTONIC (ns) together: of some attempts, the one that was interrupted least."""
    tries = [(counter(), time.monotonic_ns(), counter()) for _ in range(attempts)]
    before, mono_ns, after = min(tries, key=lambda each: each[2] - each[0])
    return (before + after) // 2, mono_ns


def ahead_ns(one: tuple[int, int], other: tuple[int, int]) -> int:
    """Return how far one clock is ahead of another, from a reading of each together with the counter."""
    gone_ns = (one[0] - other[0]) / counter_hz() * NS_PER_S
    return one[1] - other[1] - round(gone_ns)


@cache
def counter_hz() -> float:
    """Tell how fast the counter runs, against a clock that nobody adjusts."""
    begin = _counter_and_raw()
    time.sleep(CALIBRATION_S)
    end = _counter_and_raw()
    return (end[0] - begin[0]) / (end[1] - begin[1]) * NS_PER_S


def raw_ns() -> int:
    """Read the clock that nobody adjusts."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def wall_less_raw_ns() -> int:
    """Tell how far the wall clock is from the one that nobody adjusts."""
    tries = [(raw_ns(), time.time_ns(), raw_ns()) for _ in range(60)]
    before_ns, wall_ns, after_ns = min(tries, key=lambda each: each[2] - each[0])
    return wall_ns - (before_ns + after_ns) // 2


def step(by_ns: int) -> None:
    """Set the wall clock ahead, or back, all at once."""
    seconds, fraction = divmod(by_ns, NS_PER_S)
    _adjust(Timex(modes=ADJ_SETOFFSET | ADJ_NANO, seconds=seconds, fraction=fraction))


def drift(by_ppm: float) -> None:
    """Let the wall clock run fast by so many ppm from now on (at most 500, either way)."""
    _adjust(Timex(modes=ADJ_FREQUENCY | ADJ_TICK, frequency=round(by_ppm * PPM), tick=TICK_US))


def restore(less_raw_ns: int) -> None:
    """Let the wall clock run as it did when it was so far from the one that nobody adjusts, and set it there."""
    drift(0)
    _adjust(Timex(modes=ADJ_STATUS, status=STA_UNSYNC))
    step(less_raw_ns - wall_less_raw_ns())


def _counter_and_raw() -> tuple[int, int]:
    tries = [(counter(), raw_ns(), counter()) for _ in range(60)]
    before, raw, after = min(tries, key=lambda each: each[2] - each[0])
    return (before + after) // 2, raw


def _adjust(change: Timex) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if library.adjtimex(ctypes.byref(change)) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex")


@cache
def _rdtsc() -> tuple[mmap.mmap, Callable[[], int]]:
    """Put the instruction into memory that may be executed; the memory must live as long as the function."""
    memory = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    memory.write(RDTSC)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    return memory, ctypes.CFUNCTYPE(ctypes.c_uint64)(address)
