"""The clocks of one machine, read together with the processor's time stamp counter, which both machines share."""

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
"""The kernel's default tick, with which the clock runs at its nominal rate."""
UNITS_PER_PPM = 65_536
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


def read_counter() -> int:
    """Return the time stamp counter."""
    return _rdtsc()[1]()


def read_wall_clock(attempts: int = 60) -> tuple[int, int]:
    """Return counter and wall clock (ns), read together in the attempt with the least interruption."""
    best: tuple[int, int, int] | None = None
    for _ in range(attempts):
        before = read_counter()
        wall_ns = time.time_ns()
        after = read_counter()
        if best is None or after - before < best[0]:
            best = after - before, (before + after) // 2, wall_ns
    assert best is not None
    return best[1:]


def read_monotonic_clock(attempts: int = 10) -> tuple[int, int]:
    """Return counter and CLOCK_MONOTONIC (ns), read together in the attempt with the least interruption."""
    readings = [(read_counter(), time.monotonic_ns(), read_counter()) for _ in range(attempts)]
    before, mono_ns, after = min(readings, key=_reading_took)
    return (before + after) // 2, mono_ns


def offset_ns(reading: tuple[int, int], reference: tuple[int, int]) -> int:
    """Return a clock minus a reference clock (ns), from a reading (counter, ns) of each."""
    counter, clock_ns = reading
    reference_counter, reference_ns = reference
    elapsed_ns = (counter - reference_counter) / counter_hz() * NS_PER_S
    return clock_ns - reference_ns - round(elapsed_ns)


@cache
def counter_hz() -> float:
    """Return the counter's frequency, measured with a clock that is never adjusted."""
    begin_counter, begin_ns = _counter_and_raw()
    time.sleep(CALIBRATION_S)
    end_counter, end_ns = _counter_and_raw()
    return (end_counter - begin_counter) / (end_ns - begin_ns) * NS_PER_S


def read_raw_clock_ns() -> int:
    """Return CLOCK_MONOTONIC_RAW, which is never adjusted."""
    return time.clock_gettime_ns(time.CLOCK_MONOTONIC_RAW)


def wall_minus_raw_ns() -> int:
    """Return the wall clock minus the raw clock (ns)."""
    readings = [(read_raw_clock_ns(), time.time_ns(), read_raw_clock_ns()) for _ in range(60)]
    before_ns, wall_ns, after_ns = min(readings, key=_reading_took)
    return wall_ns - (before_ns + after_ns) // 2


def step(by_ns: int) -> None:
    """Step the wall clock."""
    seconds, fraction = divmod(by_ns, NS_PER_S)
    _adjtimex(Timex(modes=ADJ_SETOFFSET | ADJ_NANO, seconds=seconds, fraction=fraction))


def set_drift(by_ppm: float) -> None:
    """Set the wall clock's frequency error, from -500 to 500 ppm."""
    _adjtimex(Timex(modes=ADJ_FREQUENCY | ADJ_TICK, frequency=round(by_ppm * UNITS_PER_PPM), tick=TICK_US))


def restore(difference_ns: int) -> None:
    """Reset the wall clock's frequency, and step the clock so that `wall_minus_raw_ns` is `difference_ns`."""
    set_drift(0)
    _adjtimex(Timex(modes=ADJ_STATUS, status=STA_UNSYNC))
    step(difference_ns - wall_minus_raw_ns())


def _reading_took(reading: tuple[int, int, int]) -> int:
    """Return the time between the first and last number of a reading; the middle number was read between these."""
    before, _, after = reading
    return after - before


def _counter_and_raw() -> tuple[int, int]:
    readings = [(read_counter(), read_raw_clock_ns(), read_counter()) for _ in range(60)]
    before, raw, after = min(readings, key=_reading_took)
    return (before + after) // 2, raw


def _adjtimex(change: Timex) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if library.adjtimex(ctypes.byref(change)) < 0:
        raise OSError(ctypes.get_errno(), "adjtimex")


@cache
def _rdtsc() -> tuple[mmap.mmap, Callable[[], int]]:
    """Put `RDTSC` into executable memory; return the memory, which must stay alive, and the function."""
    memory = mmap.mmap(-1, mmap.PAGESIZE, prot=mmap.PROT_READ | mmap.PROT_WRITE | mmap.PROT_EXEC)
    memory.write(RDTSC)
    address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
    return memory, ctypes.CFUNCTYPE(ctypes.c_uint64)(address)
