"""From the config's `clock` to what is asked, once a second, how far this machine's clock is off."""

from __future__ import annotations

from collections.abc import Callable

from lavt.clock import Clock
from lavt.config import ClockConfig
from lavt.transport.clock_sync.chrony import Chronyc, read_chrony
from lavt.transport.clock_sync.clock_report import ClockReport, host_addresses, kernel_identity, unknown_clock
from lavt.transport.clock_sync.persistent_process import PersistentProcess, Run, Shell
from lavt.transport.clock_sync.ptp import read_ptp

MS_PER_S = 1000.0


def interpreter(config: ClockConfig) -> PersistentProcess:
    """Give what runs the commands of the source that the config names; to be closed."""
    return Chronyc() if config.source == "chrony" else Shell()


def clock_source(config: ClockConfig, clock: Clock, run: Run) -> Callable[[], ClockReport | None]:
    """Give the function that asks the source which the config names; it gives None where no answer came in time.

    `run` is that of the source's `interpreter`.
    """

    def external() -> ClockReport:
        now = clock.now()
        correction_s, bound_s = (config.correction_ms or 0.0) / MS_PER_S, (config.bound_ms or 0.0) / MS_PER_S
        return ClockReport(
            now.mono_ns, now.wall_ns, kernel_identity(), "external", correction_s, bound_s, addresses=host_addresses()
        )  # fmt: skip

    def left_to_the_probe() -> ClockReport:
        return unknown_clock(clock.now(), kernel_identity(), "probe", "left to the probe by clock.source")

    sources: dict[str, Callable[[], ClockReport | None]] = {
        "chrony": lambda: read_chrony(clock, run),
        "ptp": lambda: read_ptp(clock, run),
        "external": external,
        "probe": left_to_the_probe,
    }
    return sources[config.source]
