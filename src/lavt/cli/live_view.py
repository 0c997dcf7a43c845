"""The live status of a drive: one line that is updated on a terminal, a line every few seconds elsewhere."""

from __future__ import annotations

import sys
from types import TracebackType
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.text import Text

UPDATES_PER_LINE = 25
"""Without a terminal, one line is printed per this many updates (5 s)."""


class LiveView:
    """A view of speed, latencies and cross-track error of a drive whose two sides run on one machine.

    The sides share a clock, so the latencies need no correction for a clock offset.
    """

    def __init__(self, title: str) -> None:
        self._title = title
        self._console = Console(stderr=True)
        self._live = Live(Text(title), console=self._console, refresh_per_second=5) if sys.stderr.isatty() else None
        self._updates = 0

    def __enter__(self) -> LiveView:
        if self._live is not None:
            self._live.start()
        else:
            self._console.print(self._title, highlight=False)
        return self

    def __exit__(
        self, _kind: type[BaseException] | None, _error: BaseException | None, _trace: TracebackType | None
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def update(self, server: dict[str, Any], client: dict[str, Any]) -> None:
        """Show the newest status of both sides."""
        text = f"{self._title}: {_status_line(server, client)}"
        if self._live is not None:
            self._live.update(Text(text))
        elif self._updates % UPDATES_PER_LINE == 0:
            self._console.print(text, highlight=False, soft_wrap=True)
        self._updates += 1


def _status_line(server: dict[str, Any], client: dict[str, Any]) -> str:
    if "speed_mps" not in server:
        return "starting"
    values = (
        ("", server["speed_mps"] * 3.6, "5.1f", "km/h"),
        ("tau_v", client.get("raw_tau_v_ms"), "6.1f", "ms"),
        ("tau_c", server.get("raw_tau_c_ms"), "6.1f", "ms"),
        ("cross-track", server.get("cross_track_m"), "+6.2f", "m"),
    )
    shown = (
        f"{name} {value:{number_format}} {unit}".strip()
        for name, value, number_format, unit in values
        if value is not None
    )
    return f"{server.get('safety', ''):<10} " + "  ".join((*shown, *_lane(client.get("lane_confidence"))))


def _lane(confidence: float | None) -> list[str]:
    """Return what the driver detects in the newest picture."""
    if confidence is None:
        return []
    return [f"lane seen {confidence * 100:3.0f} %" if confidence > 0 else "no lane seen"]
