from __future__ import annotations

from typing import Any

from lavt.experiment.record import read_record

VIDEO_MS, CONTROL_MS = 225.0, 100.0
"""What L5 injects (netem/conditions.yaml); L0 injects nothing."""


def test_the_injected_delay_is_measured_as_it_was_asked(injected: dict[str, Any]) -> None:
    """From L0 to L5 the median tau_v grows by 225 ms and the median tau_c by 100 ms, each within 2 ms.

    The loop latency has the client's own time in it, too, which other work on the machine moves by some milliseconds.
    """
    without, with_delay = injected["L0"].result, injected["L5"].result
    grown_ms = {name: with_delay[name]["p50"] - without[name]["p50"] for name in ("tau_v_ms", "tau_c_ms", "loop_ms")}

    assert abs(grown_ms["tau_v_ms"] - VIDEO_MS) < 2
    assert abs(grown_ms["tau_c_ms"] - CONTROL_MS) < 2
    assert abs(grown_ms["loop_ms"] - VIDEO_MS - CONTROL_MS) < 10


def test_the_relay_tells_that_it_did_as_asked(injected: dict[str, Any]) -> None:
    """The relay held video and control for as long as was asked, within 1 ms in the median of what it timed itself."""
    assert [drive.relay_says for drive in injected.values()] == [[], []]


def test_both_records_of_a_drive_are_complete(injected: dict[str, Any]) -> None:
    """After a drive both records were finished, and nothing had no room in their queues."""
    for drive in injected.values():
        for side in ("server", "client"):
            record = read_record(drive.out / f"{side}.mcap", channels=("counts",))
            assert record.complete
            assert max(record.table("counts").ints("record_overflow")) == 0


def test_the_parts_of_the_loop_sum_to_the_whole(injected: dict[str, Any]) -> None:
    """tau_v, client time, tau_c and actuator time sum to the loop latency within 1 ms, under L0 and under L5."""
    assert all(drive.closure_p95_ms < 1 for drive in injected.values())


def test_without_injected_delay_the_road_is_driven_well(injected: dict[str, Any]) -> None:
    """Under L0 the key part of route A is completed in real time with a P95 cross-track below 0.3 m."""
    result = injected["L0"].result

    assert result["ending"] == "completed"
    assert result["p95_m"] < 0.3
