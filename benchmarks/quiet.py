"""How busy this machine is: measurements in real time need a quiet one."""

from __future__ import annotations

import os
from pathlib import Path

from lavt.clock import pause
from lavt.domain import NS_PER_S
from lavt.errors import WorkError

BUSY_LIMIT = 0.1
"""The largest allowed share of processor time that is used before a drive. A loop alone uses about half a processor."""
OBSERVED_NS = 3 * NS_PER_S
MAX_LOAD = 0.5
"""The largest load average of the minute before a measurement."""
MAX_STOLEN_SHARE = 0.01
"""The largest share of processor time that the host takes during a measurement."""


def busy_share() -> float:
    """Observe the machine; return the share of processor time that was used, at any priority, or stolen."""
    before = _processor_ticks()
    pause(OBSERVED_NS)
    differences = [after - earlier for earlier, after in zip(before, _processor_ticks(), strict=True)]
    _user, _nice, _system, idle, wait, *_others = differences
    return 1 - (idle + wait) / max(sum(differences), 1)


def require_quiet(*, allow_busy: bool) -> float:
    """Return the busy share; raise `WorkError` if it is over the limit, unless `allow_busy`."""
    share = busy_share()
    if share > BUSY_LIMIT and not allow_busy:
        raise WorkError(
            f"the machine is {share:.0%} busy (limit {BUSY_LIMIT:.0%}): end other programs, or give --allow-busy"
        )
    return share


class Quiet:
    """An observation of the machine from now on."""

    def __init__(self) -> None:
        self._load = os.getloadavg()[0]
        self._before = _processor_ticks()

    def stolen_share(self) -> float:
        """Return the share of the processors' time that the host has taken."""
        *_, stolen = differences = [
            after - earlier for earlier, after in zip(self._before, _processor_ticks(), strict=True)
        ]
        return stolen / max(sum(differences), 1)

    def sentence(self) -> str:
        """Return load and stolen time, and whether the machine was too busy for results."""
        stolen = self.stolen_share()
        is_quiet = self._load <= MAX_LOAD and stolen <= MAX_STOLEN_SHARE
        warning = "" if is_quiet else "; LOADED MACHINE, not results"
        return f"load before {self._load:.1f}, stolen {stolen:.1%}{warning}"


def _processor_ticks() -> list[int]:
    """Return user, nice, system, idle, wait, irq, softirq and steal of the first line of /proc/stat."""
    return [int(ticks) for ticks in Path("/proc/stat").read_text().partition("\n")[0].split()[1:9]]
