"""Stalls of the adapter's process, frames that were not written, and axes that the kit has released."""

from __future__ import annotations

from itertools import pairwise

import pytest
from tests.vehicle.dbw.rig import COARSE_MS, AdapterRig, driving_rig, mostly_generation_2

from lavt.domain import NS_PER_MS, Actuation
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import AXES, Axis
from lavt.vehicle.software_car.authority import WATCHDOG_BRAKE


@mostly_generation_2
def test_a_stall_while_parking_ends(generation: int) -> None:
    """If the kit disengages in a stall while parking, at whatever moment, parking ends, and the watchdog brakes."""
    parking_rig = driving_rig(generation)
    parking_rig.adapter.engage(False, parking_rig.now_ns)
    parking_rig.run_ms(50)
    for moment_ms in range(9):
        for duration_ms in (80, 98, 100, 102, 150, 1000):
            rig = parking_rig.copy()
            rig.run_ms(moment_ms)
            rig.stall_ms(duration_ms)
            rig.run_ms(250)
            assert rig.speed_mps > 1.0
            if duration_ms == 80:
                assert (rig.state, rig.enabled(), rig.kit.state.watchdog_reason) == ("parking", set(AXES), 0), moment_ms
            if duration_ms > 100:
                assert (rig.state, rig.kit.state.brake) == ("idle", WATCHDOG_BRAKE), (moment_ms, duration_ms)
                assert rig.events, (moment_ms, duration_ms)
                assert rig.adapter.state().inhibit_reason
            assert len(rig.events) == len({event.detail for event in rig.events})


def forge_enabled(rig: AdapterRig, axis: Axis, *, is_enabled: bool) -> None:
    """Forge the axis's reports, so that they say whether the axis is enabled."""
    codec = rig.profile.codec
    message, spec = next((name, spec) for name, spec in rig.profile.reports.items() if spec.part == axis)
    identifier = codec.messages[message].identifier

    def forge(frame: CanFrame) -> bool:
        decoded = codec.decode(frame) if frame.identifier == identifier else None
        if decoded is None:
            return False
        values = {name: value or 0.0 for name, value in decoded[1].items()}
        data = codec.encode(message, values | {spec.values["enabled"]: int(is_enabled)})
        if spec.checksum:
            data = data[:-1] + bytes([frame_crc8(identifier, data[:-1])])
        rig.adapter.receive(CanFrame(identifier, data), rig.now_ns)
        return True

    rig.lose_report = forge


@mostly_generation_2
@pytest.mark.parametrize("is_wanted", [False, True])
def test_axes_released_while_parking_are_a_reason(generation: int, is_wanted: bool) -> None:
    """If the kit releases all axes before PARK, there is an event with the reason. The state is then `lost` while
    driving is wanted again, and otherwise `idle`; in both, the inhibit reason says why the car cannot be engaged.
    """
    rig = driving_rig(generation)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(50)
    rig.adapter.engage(is_wanted, rig.now_ns)
    forges = []
    for axis in AXES:
        forge_enabled(rig, axis, is_enabled=False)
        forges.append(rig.lose_report)
    rig.lose_report = lambda frame: any(forge(frame) for forge in forges)
    rig.run_ms(90)
    assert "the kit released all axes before the car was parked" in {event.detail for event in rig.events}
    assert rig.state == ("lost" if is_wanted else "idle")
    assert rig.adapter.state().inhibit_reason


@mostly_generation_2
@pytest.mark.parametrize("axis", AXES)
@pytest.mark.parametrize("is_wanted", [True, False])
def test_the_car_brakes_without_an_axis(generation: int, axis: Axis, is_wanted: bool) -> None:
    """If one axis is reported as released while driving or parking, the kit's watchdog stops the car."""
    rig = driving_rig(generation)
    rig.actuation = Actuation(0.01, 0.0, 0.4)
    rig.adapter.engage(is_wanted, rig.now_ns)
    rig.run_ms(30)
    forge_enabled(rig, axis, is_enabled=False)
    rig.run_until(lambda rig: axis not in rig.adapter._reports.enabled, 21)
    rig.sent.clear()
    rig.run_ms(110)
    assert (rig.kit.state.brake, rig.enabled()) == (WATCHDOG_BRAKE, set())
    if axis == "brake" or generation == 2:
        assert rig.sent == []
    rig.run_ms(2000, step_ms=COARSE_MS)
    assert rig.speed_mps == 0.0


def test_a_released_axis_is_not_enabled_again() -> None:
    """An axis that was released once is not enabled again while parking, even if it is reported as enabled again."""
    rig = driving_rig(1, has_watchdog=False)
    rig.actuation = Actuation(0.01, 0.0, 0.4)
    forge_enabled(rig, "steering", is_enabled=False)
    rig.run_until(lambda rig: rig.state == "lost")
    forge_enabled(rig, "steering", is_enabled=True)
    rig.run_ms(100)
    assert "steering" in rig.adapter._reports.enabled
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(100)
    assert (rig.state, rig.enabled()) == ("parking", {"brake", "throttle"})
    assert round(rig.kit.state.brake, 2) == 0.4


@mostly_generation_2
@pytest.mark.parametrize("dropped", [1, 2, 3, 4])
def test_dropped_frames_leave_no_gap_in_the_counters(generation: int, dropped: int) -> None:
    """If the last frames of a set are not written, the next frames get their counters, and driving continues."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: bool(rig.sent) and rig.sent[-1][0] == rig.now_ns)
    for _ in range(5):
        sets = rig.adapter.counts["sets"]
        rig.dropped_frames = dropped
        rig.run_until(lambda rig: rig.adapter.counts["sets"] > sets)  # noqa: B023 (called in the loop)
        rig.dropped_frames = 0
        rig.run_ms(40)
    assert (rig.state, rig.enabled(), rig.kit.state.watchdog_reason) == ("engaged", set(AXES), 0)
    codec = rig.profile.codec
    counts: dict[str, list[float]] = {}
    for _, frame in rig.sent:
        decoded = codec.decode(frame)
        assert decoded is not None
        name, values = decoded
        counts.setdefault(name, []).append(values["COUNT" if generation == 1 else "RC"] or 0.0)
    modulus = 256 if generation == 1 else 16
    for found in counts.values():
        assert len(found) > 10
        assert {(after - before) % modulus for before, after in pairwise(found)} == {1}


@mostly_generation_2
def test_sets_that_are_never_written_are_no_commands(generation: int) -> None:
    """If no frame is written for 100 ms, driving ends as if no frame had been due."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: bool(rig.sent) and rig.sent[-1][0] == rig.now_ns)
    rig.dropped_frames = 9
    rig.run_ms(99)
    assert rig.state == "engaged"
    rig.run_ms(1)
    assert rig.state == "lost"
    assert any("no command was sent" in event.detail for event in rig.events)


@mostly_generation_2
@pytest.mark.parametrize("dropped", [1, 2, 9])
def test_frames_that_were_not_written_are_due_at_the_next_tick(generation: int, dropped: int) -> None:
    """A set that was not written completely is due again at the next call, and not earlier."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: bool(rig.sent) and rig.sent[-1][0] == rig.now_ns)
    rig.dropped_frames = dropped
    sets = rig.adapter.counts["sets"]
    rig.run_until(lambda rig: rig.adapter.counts["sets"] > sets)
    assert rig.adapter.next_wake_ns() - rig.now_ns > 10 * NS_PER_MS
    rig.dropped_frames, written = 0, len(rig.sent)
    rig.run_ms(1)
    assert len(rig.sent) - written >= 3


@mostly_generation_2
def test_a_buffer_with_room_for_one_frame_at_a_time_ends_driving(generation: int) -> None:
    """If only the first frame of each set is written, the kit releases the other axes, which ends driving."""
    rig = driving_rig(generation)
    rig.dropped_frames = 2 if generation == 1 else 3
    rig.run_ms(150)
    assert rig.state == "lost"
    assert rig.kit.state.brake == WATCHDOG_BRAKE
