"""How busy this machine is: measurements in real time need a quiet one."""

from __future__ import annotations

from pathlib import Path

from lavt.clock import pause
from lavt.domain import NS_PER_S
from lavt.errors import WorkError

BUSY_LIMIT = 0.1
"""The largest allowed share of processor time that is used before a drive. A loop alone uses about half a processor."""
OBSERVED_NS = 3 * NS_PER_S


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


def _processor_ticks() -> list[int]:
    """Return user, nice, system, idle, wait, irq, softirq and steal of the first line of /proc/stat."""
    return [int(ticks) for ticks in Path("/proc/stat").read_text().partition("\n")[0].split()[1:9]]
