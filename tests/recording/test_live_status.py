from __future__ import annotations

from msgspec.structs import replace

from lavt.domain import NS_PER_MS, Now
from lavt.nodes.payloads import Admission
from lavt.recording.live_status import LiveStatus

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


def test_a_rejected_command_does_not_change_the_shown_control_latency() -> None:
    """The control latency is that of the last accepted command; a rejected one only adds its reason."""
    live = LiveStatus()
    forged = replace(ACCEPTED, sent_wall_ns=0, applied_mono_ns=None, verdict="rejected", reason="not the present epoch")
    live.write("admission", forged, NOW)
    assert "raw_tau_c_ms" not in live.status()
    live.write("admission", ACCEPTED, NOW)
    live.write("admission", forged, NOW)
    assert live.status()["raw_tau_c_ms"] == 9.0
    assert live.status()["rejected"] == forged.reason
