"""Whether the machine was quiet during a measurement."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Final

MAX_LOAD: Final = 0.5
"""Load average of the minute before the measurement."""
MAX_STOLEN_SHARE: Final = 0.01
STOLEN_COLUMN: Final = 8
"""Of the first line of /proc/stat, which begins with the name of the line."""


def processor_ticks() -> tuple[int, int]:
    """Return the ticks that the host took from this machine, and all ticks of its processors."""
    columns = Path("/proc/stat").read_text().splitlines()[0].split()
    ticks = [int(column) for column in columns[1 : STOLEN_COLUMN + 1]]
    return ticks[-1], sum(ticks)


class Quiet:
    """An observation of the machine from now on."""

    def __init__(self) -> None:
        self._load = os.getloadavg()[0]
        self._stolen, self._all = processor_ticks()

    def stolen_share(self) -> float:
        """Return the share of the processors' time that the host has taken."""
        stolen, all_ticks = processor_ticks()
        return (stolen - self._stolen) / max(1, all_ticks - self._all)

    def sentence(self) -> str:
        """Return load and stolen time, and whether the machine was too busy for results."""
        stolen = self.stolen_share()
        is_quiet = self._load <= MAX_LOAD and stolen <= MAX_STOLEN_SHARE
        warning = "" if is_quiet else "; LOADED MACHINE, not results"
        return f"load before {self._load:.1f}, stolen {100 * stolen:.1f} %{warning}"
