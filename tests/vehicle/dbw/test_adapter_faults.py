"""Faults while driving: how long commands still reach the wheels, and the reasons that are reported.

The kit reacts in the millisecond in which a frame reaches it; the adapter reacts to the next report. Times are those of
the rig, exact to its step of 1 ms.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
from tests.vehicle.dbw.rig import (
    COARSE_MS,
    SPEED_SOURCES,
    AdapterRig,
    both_generations,
    driving_rig,
    profile,
    stationary_rig,
)

from lavt.domain import NS_PER_MS, Actuation
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.adapter import SEPARATOR
from lavt.vehicle.software_car.authority import WATCHDOG_BRAKE
from lavt.vehicle.software_car.state import AXES, Gear

STEERING = {1: 0x064, 2: 0x200}


def last_sent_ns(rig: AdapterRig) -> int:
    return max(at_ns for at_ns, _ in rig.sent)


def is_lost(rig: AdapterRig) -> bool:
    return rig.state == "lost"


def stop_and_disengage(rig: AdapterRig) -> None:
    """Stop the car with the driver's brake pedal, and disengage it."""
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.run_until(lambda rig: rig.speed_mps == 0.0, 20_000, step_ms=COARSE_MS)
    rig.run_ms(50)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(150, step_ms=COARSE_MS)
    rig.kit.driver_brakes(0.0, rig.now_ns)
    rig.run_ms(150, step_ms=COARSE_MS)


# Lost and invalid commands.


@both_generations
def test_commands_lost(generation: int) -> None:
    """Without commands the kit disengages 100 ms after the last command, and the watchdog brakes."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: bool(rig.sent) and last_sent_ns(rig) == rig.now_ns)
    cut_ns = rig.now_ns
    rig.spoil = lambda _: None
    assert rig.run_until_released_ms(cut_ns) == 100
    assert rig.kit.state.brake == WATCHDOG_BRAKE
    assert rig.run_until(is_lost) <= 20
    rig.run_ms(150, step_ms=COARSE_MS)
    state = rig.adapter.state()
    assert not state.is_engaged
    assert "the kit released" in state.inhibit_reason or "watchdog" in state.inhibit_reason
    assert any("watchdog" in event.detail for event in rig.events)
    assert {event.kind for event in rig.events} == {"fault"}


@both_generations
def test_counter_stuck(generation: int) -> None:
    """At the first frame that repeats a counter, the kit releases all axes and brakes."""
    rig = driving_rig(generation)
    stuck: list[int] = []

    def spoil(frame: CanFrame) -> CanFrame:
        if frame.identifier != STEERING[generation]:
            return frame
        counter_byte = 7 if generation == 1 else 6
        stuck.append(frame.data[counter_byte])
        data = frame.data[:counter_byte] + bytes([stuck[0]]) + frame.data[counter_byte + 1 :]
        return with_crc(frame.identifier, data) if generation == 2 else CanFrame(frame.identifier, data)

    rig.spoil = spoil
    rig.run_until(lambda _: len(stuck) == 2)
    assert rig.run_until_released_ms(rig.now_ns) == 0
    assert rig.kit.state.brake == WATCHDOG_BRAKE
    assert rig.run_until(is_lost) <= 20
    assert not rig.adapter.state().is_engaged


def with_crc(identifier: int, data: bytes) -> CanFrame:
    """Return a frame with a CRC that is computed by bitwise division."""
    number = int.from_bytes(identifier.to_bytes(2, "big") + data[:-1], "big") << 8
    bits = 8 * (2 + len(data) - 1)
    number ^= 0xFF << bits
    for bit in range(bits + 7, 7, -1):
        if number >> bit & 1:
            number ^= 0x11D << bit - 8
    return CanFrame(identifier, data[:-1] + bytes([number ^ 0xFF]))


@pytest.mark.parametrize("part", [0, 1, 2])
def test_wrong_checksum_of_a_command(part: int) -> None:
    """At the first command with a wrong checksum, a kit of generation 2 releases all axes and brakes."""
    rig = driving_rig(2)
    spoiled: list[int] = []

    def spoil(frame: CanFrame) -> CanFrame:
        if frame.identifier != 0x200 + part or spoiled:
            return frame
        spoiled.append(rig.now_ns)
        return CanFrame(frame.identifier, frame.data[:-1] + bytes([frame.data[-1] ^ 0x40]))

    rig.spoil = spoil
    rig.run_until(lambda _: bool(spoiled))
    assert rig.run_until_released_ms(spoiled[0]) == 0
    assert rig.run_until(is_lost) <= 20
    rig.run_ms(100)
    assert "SystemReport: crc" in rig.adapter._reports.texts("reason")
    assert rig.kit.state.brake == WATCHDOG_BRAKE


@both_generations
def test_without_ticks_nothing_is_sent(generation: int) -> None:
    """Without ticks nothing is sent after 60 ms, and the kit disengages 100 ms after the last frame."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: rig.adapter._requested_ns == rig.now_ns)
    stopped_ns, rig.is_ticking = rig.now_ns, False
    took_ms = rig.run_until_released_ms(stopped_ns)
    sent_ms = (last_sent_ns(rig) - stopped_ns) // NS_PER_MS
    assert 40 < sent_ms <= 60
    assert took_ms == sent_ms + 100
    assert rig.adapter.counts["ticks_missed"] == 1
    assert any("no command was sent" in event.detail for event in rig.events)
    rig.is_ticking = True
    rig.run_ms(500, step_ms=COARSE_MS)
    assert rig.state == "lost"
    assert rig.enabled() == set()


@both_generations
def test_a_resumed_server_enables_nothing(generation: int) -> None:
    """A server that was frozen reads old frames from its buffers when it resumes, and sends nothing."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: bool(rig.sent) and last_sent_ns(rig) == rig.now_ns)
    frozen_ns, waiting = rig.now_ns, []
    rig.now_ns += 2000 * NS_PER_MS
    waiting = rig.car.advance(rig.now_ns)[:30]
    assert not rig.enabled()
    rig.sent.clear()
    for frame in waiting:  # the oldest frames
        rig.adapter.receive(frame, rig.now_ns)
        rig.adapter.set_actuation(rig.actuation, rig.now_ns)
        for sent in rig.adapter.frames_due(rig.now_ns):
            rig.sent.append((rig.now_ns, sent))
            rig.car.receive(sent, rig.now_ns)
    rig.run_ms(500, step_ms=COARSE_MS)
    assert rig.state == "lost"
    assert rig.now_ns > frozen_ns
    assert rig.sent == []
    assert rig.kit.state.brake == WATCHDOG_BRAKE


FOREIGN_COMMANDS = {
    1: [CanFrame(0x064, bytes(8)), CanFrame(0x060, bytes(4)), CanFrame(0x066, bytes(1))],
    2: [CanFrame(0x201, bytes(8)), CanFrame(0x203, bytes(4)), CanFrame(0x216, bytes(2))],
}
"""Commands to an axis, to the gearbox or to the system, some of unusual length; their data does not matter."""


@both_generations
@pytest.mark.parametrize("command_index", [0, 1, 2])
def test_foreign_commands_prevent_engaging(generation: int, command_index: int) -> None:
    """A kit is not engaged until 1 s after the last command of another sender, which may still be stopping the car."""
    rig = stationary_rig(generation)
    rig.adapter.receive(FOREIGN_COMMANDS[generation][command_index], rig.now_ns)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(999)
    assert (rig.state, rig.sent) == ("idle", [])
    assert "another sender" in rig.adapter.state().inhibit_reason
    assert rig.adapter.counts["foreign_commands"] == 1
    rig.run_ms(2)
    assert rig.state == "clearing"
    assert rig.adapter.state().inhibit_reason == ""


@both_generations
def test_foreign_commands_end_driving(generation: int) -> None:
    """The first frame of another sender ends driving: throttle 0 and the requested brake."""
    rig = driving_rig(generation)
    rig.adapter.receive(FOREIGN_COMMANDS[generation][0], rig.now_ns)
    assert rig.state == "lost"
    assert "another sender" in rig.adapter.state().inhibit_reason
    rig.actuation = Actuation(0.01, 0.5, 0.4)
    rig.run_ms(200, step_ms=COARSE_MS)
    assert (rig.moments[-1].wheels.throttle, round(rig.moments[-1].wheels.brake, 2)) == (0.0, 0.4)


# Override by the driver.

OVERRIDES: dict[str, Callable[[AdapterRig], None]] = {
    "steering": lambda rig: rig.kit.driver_steers(3.0, rig.now_ns),
    "brake": lambda rig: rig.kit.driver_brakes(0.3, rig.now_ns),
    "throttle": lambda rig: rig.kit.driver_throttles(0.3, rig.now_ns),
    "gear": lambda rig: rig.kit.driver_shifts(Gear.NEUTRAL, rig.now_ns),
}
HANDS_OFF: dict[str, Callable[[AdapterRig], None]] = {
    "steering": lambda rig: rig.kit.driver_steers(0.0, rig.now_ns),
    "brake": lambda rig: rig.kit.driver_brakes(0.0, rig.now_ns),
    "throttle": lambda rig: rig.kit.driver_throttles(0.0, rig.now_ns),
    "gear": lambda _: None,
}
OVERRIDE_TEXTS = {
    "steering": "the driver steers",
    "brake": "the driver brakes",
    "throttle": "the driver presses the throttle",
    "gear": "the driver has shifted",
}
PERIOD_MS = {"steering": 10, "brake": 20, "throttle": 20, "gear": 100}
"""Periods of the reports that contain the override."""


@both_generations
@pytest.mark.parametrize("part", OVERRIDES)
def test_override(generation: int, part: str) -> None:
    """An override releases all axes: in generation 2 immediately, in generation 1 when the override is reported."""
    rig = driving_rig(generation)
    override_ns = rig.now_ns
    OVERRIDES[part](rig)
    if part in AXES:
        assert part not in rig.enabled()
    took_ms = rig.run_until_released_ms(override_ns)
    assert took_ms == 0 if generation == 2 else took_ms <= PERIOD_MS[part]
    rig.run_until(lambda rig: rig.state == "overridden", PERIOD_MS[part] + 1)
    rig.run_ms(PERIOD_MS[part])
    state = rig.adapter.state()
    assert (state.is_overridden, state.is_engaged) == (True, False)
    assert "override by the driver" in state.inhibit_reason
    assert any(OVERRIDE_TEXTS[part] in event.detail for event in rig.events)
    assert rig.kit.state.watchdog_reason == 0


@both_generations
@pytest.mark.parametrize("part", OVERRIDES)
def test_override_is_latched(generation: int, part: str) -> None:
    """The adapter's override lasts until the stationary car is disengaged, the kit's until the car is engaged again."""
    rig = driving_rig(generation)
    OVERRIDES[part](rig)
    rig.run_until(lambda rig: rig.state == "overridden")
    HANDS_OFF[part](rig)
    rig.run_ms(300, step_ms=COARSE_MS)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(20)
    rig.adapter.engage(True, rig.now_ns)  # has no effect while the car moves
    rig.run_ms(300, step_ms=COARSE_MS)
    assert (rig.state, rig.enabled()) == ("overridden", set())
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.run_until(lambda rig: rig.speed_mps == 0.0, 20_000, step_ms=COARSE_MS)
    rig.kit.driver_brakes(0.0, rig.now_ns)
    rig.run_ms(500, step_ms=COARSE_MS)
    assert (rig.state, rig.adapter.state().is_overridden) == ("overridden", True)
    assert rig.kit.state.is_overridden
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(20)
    assert (rig.state, rig.adapter.state().inhibit_reason) == ("idle", "")
    assert rig.kit.state.is_overridden
    rig.engage()
    assert not rig.kit.state.is_overridden
    assert rig.enabled() == set(AXES)


@both_generations
def test_an_active_override_is_not_cleared(generation: int) -> None:
    """With hands on the wheel an override cannot be cleared: after 3 s this is reported, and no axis was enabled."""
    rig = driving_rig(generation)
    rig.kit.driver_steers(3.0, rig.now_ns)
    stop_and_disengage(rig)
    rig.moments.clear()
    rig.adapter.engage(True, rig.now_ns)
    took_ms = rig.run_until(lambda rig: rig.state == "overridden")
    assert 3000 <= took_ms <= 3010
    assert any("3 s: the driver steers" in event.detail for event in rig.events)
    assert not any(moment.is_enabled for moment in rig.moments)
    assert rig.adapter.state().is_overridden


# Faults of the kit.

FAULTS_1 = (
    *(f"steering.{bit}" for bit in ("FLTPWR", "FLTBUS1", "FLTBUS2", "FLTCAL")),
    *(f"{pedal}.{bit}" for pedal in ("brake", "throttle") for bit in ("FLT1", "FLT2", "FLTPWR")),
)
FAULTS = [(1, name) for name in FAULTS_1] + [(2, f"{part}.fault") for part in (*AXES, "gear")]


@pytest.mark.parametrize(("generation", "name"), FAULTS)
def test_fault(generation: int, name: str) -> None:
    """A fault makes the kit immediately release all axes and brake; the next report names the part."""
    rig = driving_rig(generation)
    rig.kit.set_fault(name, rig.now_ns)
    assert rig.run_until_released_ms(rig.now_ns) == 0
    assert rig.kit.state.brake == WATCHDOG_BRAKE
    assert rig.run_until(is_lost) <= 20
    rig.run_ms(100)
    part = "gearbox" if name.startswith("gear") else name.partition(".")[0]
    assert f"the {part}" in rig.adapter.state().inhibit_reason
    assert any(f"the {part}" in event.detail for event in rig.events)


def test_gear_fault_of_generation_1() -> None:
    """A gearbox fault, which generation 1 ignores, causes throttle 0 and the requested brake within 100 ms."""
    rig = driving_rig(1)
    rig.kit.set_fault("gear.FLTBUS", rig.now_ns)
    fault_ns = rig.now_ns
    rig.run_until(lambda rig: rig.kit.state.throttle == 0.0)
    assert (rig.now_ns - fault_ns) // NS_PER_MS <= 101
    assert rig.enabled() == set(AXES)
    rig.actuation = Actuation(0.0, 1.0, 0.6)
    rig.run_ms(200, step_ms=COARSE_MS)
    assert (rig.kit.state.throttle, round(rig.kit.state.brake, 3)) == (0.0, 0.6)
    assert rig.adapter.state().inhibit_reason == "the gearbox has a bus fault"


def test_fault_without_a_watchdog() -> None:
    """A fault on a kit of generation 1 without watchdog leaves the other axes enabled: requested brake, no throttle."""
    rig = driving_rig(1, has_watchdog=False)
    rig.kit.set_fault("steering.FLTPWR", rig.now_ns)
    fault_ns = rig.now_ns
    rig.run_until(lambda rig: rig.kit.state.throttle == 0.0)
    assert (rig.now_ns - fault_ns) // NS_PER_MS <= 11
    assert rig.enabled() == {"brake", "throttle"}
    rig.kit.set_fault("steering.FLTPWR", rig.now_ns, is_set=False)
    rig.actuation = Actuation(0.0, 0.5, 0.6)
    rig.run_ms(300, step_ms=COARSE_MS)
    assert rig.enabled() == {"brake", "throttle"}
    assert (rig.kit.state.throttle, round(rig.kit.state.brake, 3)) == (0.0, 0.6)
    rig.run_until(lambda rig: rig.speed_mps == 0.0, step_ms=COARSE_MS)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "idle")
    assert rig.kit.state.gear == Gear.PARK


@both_generations
def test_fault_latches(generation: int) -> None:
    """After a fault that disappears, `lost` lasts until driving is no longer wanted; then the car can be engaged."""
    name = "steering.FLTPWR" if generation == 1 else "steering.fault"
    rig = driving_rig(generation)
    rig.kit.set_fault(name, rig.now_ns)
    rig.run_ms(200, step_ms=COARSE_MS)
    rig.kit.set_fault(name, rig.now_ns, is_set=False)
    rig.run_ms(1000, step_ms=COARSE_MS)
    assert rig.state == "lost"
    assert rig.adapter.state().inhibit_reason != ""
    stop_and_disengage(rig)
    assert (rig.state, rig.adapter.state().inhibit_reason) == ("idle", "")
    rig.engage()
    assert rig.enabled() == set(AXES)


@both_generations
def test_fault_prevents_engaging(generation: int) -> None:
    """A fault before engaging is an inhibit reason, and nothing is sent."""
    name = "brake.FLT1" if generation == 1 else "brake.fault"
    rig = stationary_rig(generation)
    rig.kit.set_fault(name, rig.now_ns)
    rig.run_ms(50)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(500, step_ms=COARSE_MS)
    assert rig.sent == []
    assert "the brake has a fault" in rig.adapter.state().inhibit_reason


@both_generations
def test_watchdog_needs_an_override(generation: int) -> None:
    """After a watchdog trip the car can be engaged again only after an override by the driver."""
    rig = driving_rig(generation)
    rig.is_ticking = False
    rig.run_ms(300, step_ms=COARSE_MS)
    rig.is_ticking = True
    rig.run_until(lambda rig: rig.speed_mps == 0.0, 10_000, step_ms=COARSE_MS)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(500, step_ms=COARSE_MS)
    assert rig.kit.state.watchdog_brakes
    if generation == 1:
        assert "watchdog brakes" in rig.adapter.state().inhibit_reason
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(4000, step_ms=COARSE_MS)
    assert rig.enabled() == set()
    assert "watchdog" in rig.adapter.state().inhibit_reason
    rig.adapter.engage(False, rig.now_ns)
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.run_ms(100)
    rig.kit.driver_brakes(0.0, rig.now_ns)
    rig.run_ms(200, step_ms=COARSE_MS)
    rig.engage()
    assert rig.enabled() == set(AXES)
    assert rig.kit.state.watchdog_reason == 0


# The bus.


@both_generations
def test_bus_off(generation: int) -> None:
    """A kit off the bus disengages 100 ms after the last command; the adapter notices by the reports' timeout."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: bool(rig.sent) and last_sent_ns(rig) == rig.now_ns)
    rig.kit.set_bus_off(rig.now_ns)
    cut_ns = rig.now_ns
    assert rig.run_until_released_ms(cut_ns) == 100
    rig.run_until(is_lost)
    shortest_ms = min(report.timeout_ns for report in rig.profile.reports.values()) // NS_PER_MS
    assert shortest_ms - 10 <= (rig.now_ns - cut_ns) // NS_PER_MS <= shortest_ms
    rig.run_ms(400)
    assert rig.adapter.state().inhibit_reason.count("no ") == len(rig.profile.reports)
    rig.kit.set_bus_off(rig.now_ns, is_off=False)
    rig.run_ms(500, step_ms=COARSE_MS)
    assert rig.enabled() == set()
    assert not rig.adapter.state().is_engaged


@both_generations
def test_bus_gone(generation: int) -> None:
    """A bus that is gone ends driving immediately; the kit disengages 100 ms after the last command."""
    rig = driving_rig(generation)
    rig.run_until(lambda rig: bool(rig.sent) and last_sent_ns(rig) == rig.now_ns)
    cut_ns, rig.is_cut = rig.now_ns, True
    rig.adapter.on_bus_gone("can0 is down", rig.now_ns)
    state = rig.adapter.state()
    assert (state.is_engaged, state.inhibit_reason) == (False, "can0 is down")
    assert rig.run_until_released_ms(cut_ns) == 100
    assert last_sent_ns(rig) == cut_ns
    assert rig.adapter.next_wake_ns() > rig.now_ns + NS_PER_MS, "the adapter spins while nothing can be sent"
    rig.is_cut = False
    rig.run_ms(500, step_ms=COARSE_MS)
    assert rig.state == "lost"
    assert rig.enabled() == set()
    stop_and_disengage(rig)
    rig.engage()


REPORTS: dict[int, tuple[str, ...]] = {
    1: ("SteeringReport", "BrakeReport", "ThrottleReport", "GearReport"),
    2: (
        "SteerReport1",
        "BrakeReport1",
        "ThrtlReport1",
        "GearReport1",
        "VehicleVelocity",
        "SystemReport",
        "RemoteReport",
    ),
}


@pytest.mark.parametrize(("generation", "message"), [(n, name) for n, names in REPORTS.items() for name in names])
def test_report_missing(generation: int, message: str) -> None:
    """A missing report causes throttle 0 and the requested brake after its timeout."""
    rig = driving_rig(generation)
    identifier = rig.profile.codec.messages[message].identifier
    received_ns = rig.adapter._reports._received_ns[message]
    rig.lose_report = lambda frame: frame.identifier == identifier
    rig.run_until(lambda rig: rig.kit.state.throttle == 0.0)
    timeout_ms = rig.profile.reports[message].timeout_ns // NS_PER_MS
    assert timeout_ms <= (rig.now_ns - received_ns) // NS_PER_MS <= timeout_ms + 1
    assert rig.adapter.state().inhibit_reason == f"no {message} for {timeout_ms} ms"
    rig.actuation = Actuation(0.0, 0.0, 0.6)
    rig.run_ms(200, step_ms=COARSE_MS)
    assert rig.kit.state.brake == pytest.approx(0.6, abs=1e-3)


@both_generations
@pytest.mark.parametrize("name", ["angle", "speed"])
def test_value_unknown(generation: int, name: str) -> None:
    """An unknown speed or angle is treated as a missing report; the last known speed is kept with its time."""
    rig = driving_rig(generation)
    known_ns = rig.adapter.state().mono_ns
    speed_mps = rig.adapter.state().speed_mps
    rig.kit.set_unknown(name)
    rig.run_until(is_lost)
    took_ms = (rig.now_ns - known_ns) // NS_PER_MS
    assert took_ms <= 220
    state = rig.adapter.state()
    assert rig.adapter.counts["value_unknown"] > 0
    if name == "speed":
        assert (state.mono_ns, state.speed_mps) == (known_ns, speed_mps)


def test_wrong_checksum_of_a_report() -> None:
    """A report of generation 2 with a wrong checksum is dropped and counted."""
    rig = driving_rig(2)
    before = rig.adapter.state()
    count = (rig.kit.state.sent[0x107] + 5) % 16
    frame = with_crc(0x107, struct.pack("<hhBBBB", 1700, 1700, 0, 0, count << 4, 0))
    rig.adapter.receive(CanFrame(0x107, frame.data[:-1] + bytes([frame.data[-1] ^ 1])), rig.now_ns)
    assert rig.adapter.state() == before
    assert rig.adapter.counts["wrong_checksum"] == 1
    rig.adapter.receive(frame, rig.now_ns)
    assert rig.adapter.state().speed_mps == pytest.approx(17.0 / 3.6)


# Additional conditions of generation 2.


@pytest.mark.parametrize(("position", "name"), [(0, "e stop"), (1, "pause")])
def test_remote_switch(position: int, name: str) -> None:
    """If the remote is switched to stop or pause, the kit releases all axes immediately; the next report says so."""
    rig = driving_rig(2)
    rig.kit.switch_remote(position, rig.now_ns)
    assert rig.run_until_released_ms(rig.now_ns) == 0
    rig.run_until(is_lost, 101)
    rig.run_ms(100)
    assert f"RemoteReport has STATE {name}" in rig.adapter.state().inhibit_reason


def test_remote_switch_of_the_other_commands() -> None:
    """If the remote is switched to control allowed, which the kit ignores, the adapter requests throttle 0."""
    rig = driving_rig(2)
    rig.kit.switch_remote(3, rig.now_ns)
    switched_ns = rig.now_ns
    rig.run_until(lambda rig: rig.kit.state.throttle == 0.0)
    assert (rig.now_ns - switched_ns) // NS_PER_MS <= 101
    assert rig.adapter.state().inhibit_reason == "RemoteReport has STATE control allowed"
    rig.kit.switch_remote(2, rig.now_ns)
    rig.run_ms(200, step_ms=COARSE_MS)
    assert rig.state == "lost"


@pytest.mark.parametrize(
    ("name", "text"),
    [("seat belt", "a seat belt is open"), ("door", "a door is open"), ("speed", "the kit is locked out by speed")],
)
def test_kit_not_ready(name: str, text: str) -> None:
    """A kit of generation 2 that is not ready releases all axes immediately, and reports the reason."""
    rig = driving_rig(2)
    rig.kit.inhibit(name, rig.now_ns)
    assert rig.run_until_released_ms(rig.now_ns) == 0
    rig.run_until(is_lost)
    rig.run_ms(100)
    assert text in rig.adapter.state().inhibit_reason


# The gearbox.


@both_generations
def test_drive_rejected(generation: int) -> None:
    """A rejected gear is reported with the kit's reason after 3 s, and the car is disengaged in PARK."""
    base_profile = profile(f"dataspeed_gen{generation}")
    gear = replace(base_profile.gear, codes={**base_profile.gear.codes, "drive": 5})
    rig = AdapterRig(generation, profile=replace(base_profile, gear=gear))
    rig.adapter.engage(True, rig.now_ns)
    took_ms = rig.run_until(is_lost)
    assert 3120 <= took_ms <= 3160
    reason = rig.adapter.state().inhibit_reason
    assert "3 s: the gear is park instead of drive" in reason
    if generation == 1:
        assert reason.endswith("GearReport: unsupported")
    assert rig.kit.state.throttle == 0.0
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "idle")
    assert rig.enabled() == set()
    assert rig.kit.state.watchdog_reason == 0


def test_a_shift_in_progress_is_awaited() -> None:
    """If DRIVE was requested but not reported, the axes stay enabled for 1 s before the car is disengaged in PARK."""
    base_profile = profile("dataspeed_gen1")
    rig = AdapterRig(
        1, profile=replace(base_profile, gear=replace(base_profile.gear, codes={**base_profile.gear.codes, "drive": 5}))
    )
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "enabling" and rig.adapter._is_shifting)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "parking")
    rig.run_ms(999)
    assert (rig.state, rig.enabled()) == ("parking", set(AXES))
    rig.run_ms(1)
    assert (rig.state, rig.enabled()) == ("parking", set())


def test_park_rejected() -> None:
    """If PARK is rejected, the brake keeps the car stationary, and the reason is reported."""
    rig = driving_rig(1)
    rig.kit.set_fault("gear.FLTBUS", rig.now_ns)
    rig.actuation = Actuation(0.0, 0.0, 0.5)
    rig.run_until(lambda rig: rig.speed_mps == 0.0, step_ms=COARSE_MS)
    rig.actuation = Actuation(0.0, 0.0, 0.0)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(5000, step_ms=COARSE_MS)
    assert rig.speed_mps == 0.0
    assert rig.kit.state.brake == pytest.approx(rig.profile.limits.holding_brake, abs=1e-3)
    assert rig.enabled() == set(AXES)
    reason = rig.adapter.state().inhibit_reason
    assert "not in park" in reason
    assert "GearReport: fault" in reason


def rig_without_park() -> AdapterRig:
    """Return a stationary car whose kit rejects the number that the profile has for PARK."""
    base_profile = profile("dataspeed_gen1")
    rig = AdapterRig(
        1, profile=replace(base_profile, gear=replace(base_profile.gear, codes={**base_profile.gear.codes, "park": 5}))
    )
    rig.engage()
    return rig


def test_park_must_be_reported_within_3_s() -> None:
    """A stationary car that is not in PARK has an inhibit reason from 3 s after the end of driving on."""
    rig = rig_without_park()
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(2999)
    assert (rig.state, rig.adapter.state().inhibit_reason) == ("parking", "")
    rig.run_ms(1)
    assert "unsupported" in rig.adapter.state().inhibit_reason
    assert len(rig.adapter.state().inhibit_reason.split(SEPARATOR)) == 2


def test_a_moving_car_need_not_park() -> None:
    """A car that still moves 3 s after driving ended is not shifted to PARK, and the inhibit reason says so."""
    rig = rig_without_park()

    for source in SPEED_SOURCES[1]:
        rig.kit.stick_speed(source, 2.8)
    rig.actuation = Actuation(0.0, 0.0, 0.0)
    rig.run_ms(20)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_ms(4000, step_ms=COARSE_MS)
    assert rig.adapter.state().speed_mps > 1.0
    assert (rig.state, rig.adapter.state().inhibit_reason) == ("parking", "the car moves, or may move")


@pytest.mark.parametrize("state", ["idle", "engaged", "lost", "overridden"])
def test_park_is_required_only_after_driving(state: str) -> None:
    """A stationary car need not be in PARK in a state that does not park it."""
    rig = stationary_rig(1)
    if state != "idle":
        rig.engage()
    if state == "lost":
        rig.adapter.on_bus_gone("can0 is down", rig.now_ns)
    if state == "overridden":
        rig.kit.driver_brakes(0.3, rig.now_ns)
    rig.run_ms(500, step_ms=COARSE_MS)
    assert rig.state == state
    before = rig.adapter.state().inhibit_reason
    rig.run_ms(3500, step_ms=COARSE_MS)
    assert (rig.state, rig.adapter.state().inhibit_reason) == (state, before)


@both_generations
def test_a_car_that_moves_in_idle_says_why_it_cannot_be_engaged(generation: int) -> None:
    """While the car moves or may move, driving cannot begin, and the inhibit reason says so until it is stationary."""
    rig = stationary_rig(generation)
    rig.kit.driver_shifts(Gear.DRIVE, rig.now_ns)
    rig.kit.driver_throttles(0.2, rig.now_ns)
    rig.run_until(lambda rig: rig.speed_mps > 1.0, step_ms=COARSE_MS)
    for wanted in (False, True):
        rig.adapter.engage(wanted, rig.now_ns)
        assert (rig.state, rig.adapter.state().inhibit_reason) == ("idle", "the car moves, or may move")
    rig.kit.driver_throttles(0.0, rig.now_ns)
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.run_until(lambda rig: rig.state != "idle", step_ms=COARSE_MS)
    assert rig.adapter.state().inhibit_reason == ""


@both_generations
def test_out_of_gear(generation: int) -> None:
    """A reported gear other than DRIVE ends driving, even without an override."""
    rig = driving_rig(generation)
    rig.kit.state.gear = Gear.NEUTRAL
    assert rig.run_until(is_lost) <= 101
    assert rig.adapter.state().inhibit_reason == "the gear is neutral instead of drive"


@both_generations
def test_every_end_of_driving_is_an_event(generation: int) -> None:
    """Every cause that ends driving emits events with texts, each once."""
    causes: list[Callable[[AdapterRig], Any]] = [
        lambda rig: rig.adapter.on_bus_gone("can0 is down", rig.now_ns),
        lambda rig: rig.kit.set_bus_off(rig.now_ns),
        lambda rig: rig.kit.driver_steers(3.0, rig.now_ns),
        lambda rig: setattr(rig, "is_ticking", False),
    ]
    for cause in causes:
        rig = driving_rig(generation)
        cause(rig)
        rig.run_ms(500, step_ms=COARSE_MS)
        assert rig.events, cause
        assert all(event.kind == "fault" and event.detail for event in rig.events)
        details = [event.detail for event in rig.events]
        assert len(details) == len(set(details))
