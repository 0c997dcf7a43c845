from __future__ import annotations

from dataclasses import replace
from typing import Any

from lavt.domain import NS_PER_MS, Now
from lavt.nodes.payloads import Admission
from lavt.recording.live_status import LiveTap

NOW = Now(10**9, 10**9)
ACCEPTED = Admission(
    epoch=1,
    sequence=1,
    stamp_ns=1,
    sent_wall_ns=NOW.wall_ns - 9 * NS_PER_MS,
    stamp_received_wall_ns=1,
    received_mono_ns=NOW.mono_ns,
    received_wall_ns=NOW.wall_ns,
    applied_mono_ns=NOW.mono_ns,
    verdict="accepted",
    reason="",
    limited="",
    mode="drive",
    steering_rad=0.0,
    throttle=0.0,
    brake=0.0,
)


class Nowhere:
    """A recorder that discards every entry."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Discard one entry."""


def test_a_rejected_command_does_not_change_the_shown_control_latency() -> None:
    """The control latency is that of the last accepted command; a rejected one only adds its reason."""
    tap = LiveTap(Nowhere())
    forged = replace(ACCEPTED, sent_wall_ns=0, applied_mono_ns=None, verdict="rejected", reason="not the present epoch")
    tap.write("admission", forged, NOW)
    assert "raw_tau_c_ms" not in tap.status()
    tap.write("admission", ACCEPTED, NOW)
    tap.write("admission", forged, NOW)
    assert tap.status()["raw_tau_c_ms"] == 9.0
    assert tap.status()["rejected"] == forged.reason
