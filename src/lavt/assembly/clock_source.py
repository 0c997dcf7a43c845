"""The construction of the time source, which reports the error of this machine's clock once a second."""

from __future__ import annotations

from collections.abc import Callable

from lavt.clock import Clock
from lavt.config import ClockConfig
from lavt.transport.clock_sync.chrony import Chronyc, read_chrony
from lavt.transport.clock_sync.clock_report import ClockReport, host_addresses, kernel_identity, unknown_clock
from lavt.transport.clock_sync.persistent_process import PersistentProcess, Run, Shell
from lavt.transport.clock_sync.ptp import read_ptp

MS_PER_S = 1000.0


def build_query_process(config: ClockConfig) -> PersistentProcess:
    """Return the process that runs the commands of the configured time source; the caller closes it."""
    return Chronyc() if config.source == "chrony" else Shell()


def clock_source(config: ClockConfig, clock: Clock, run: Run) -> Callable[[], ClockReport | None]:
    """Return a function that queries the configured time source and returns None on timeout.

    `run` is the method `run` of the process that `build_query_process` returns.
    """

    def external() -> ClockReport:
        now = clock.now()
        correction_s, bound_s = (config.correction_ms or 0.0) / MS_PER_S, (config.bound_ms or 0.0) / MS_PER_S
        return ClockReport(
            now.mono_ns, now.wall_ns, kernel_identity(), "external", correction_s, bound_s, addresses=host_addresses()
        )

    def probe_only() -> ClockReport:
        return unknown_clock(clock.now(), kernel_identity(), "probe", "clock.source leaves the offset to the probe")

    sources: dict[str, Callable[[], ClockReport | None]] = {
        "chrony": lambda: read_chrony(clock, run),
        "ptp": lambda: read_ptp(clock, run),
        "external": external,
        "probe": probe_only,
    }
    return sources[config.source]
