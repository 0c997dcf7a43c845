"""Reports of a kit: their periods and their contents."""

import math
import struct

import pytest
from tests.vehicle.software_car.rig import (
    START_NS,
    CommandValues,
    KitRig,
    both_generations,
    crc_by_division,
    driving_rig,
    with_crc_broken,
)

from lavt.domain import NS_PER_MS

PERIODS_MS = {
    1: {0x061: 20, 0x063: 20, 0x065: 10, 0x067: 100, 0x06A: 10},
    2: {0x100: 10, 0x101: 20, 0x102: 20, 0x103: 100, 0x106: 100, 0x107: 20, 0x2A4: 10, 0x2D8: 100},
}


def collect_reports(rig: KitRig) -> dict[int, bytes]:
    """Let the longest period pass; return the newest report of each identifier."""
    rig.newest_reports.clear()
    for _ in range(10):
        rig.wait_ms(10)
        if rig.kit.state.actuators["steering"].is_enabled:
            rig.command(angle_deg=-45.0, throttle=0.25, brake=0.125)
    return rig.newest_reports


@both_generations
def test_reports_have_their_periods(generation: int) -> None:
    """Each report is sent once per period, exact to the nanosecond."""
    kit = KitRig(generation).kit
    times: dict[int, list[int]] = {identifier: [] for identifier in PERIODS_MS[generation]}
    while (wake_ns := kit.next_wake_ns()) <= START_NS + 1000 * NS_PER_MS:
        for frame in kit.frames_due(wake_ns):
            times[frame.identifier].append(wake_ns - START_NS)
    for identifier, period_ms in PERIODS_MS[generation].items():
        assert times[identifier] == list(range(period_ms * NS_PER_MS, 1001 * NS_PER_MS, period_ms * NS_PER_MS))


@both_generations
def test_a_late_call_returns_each_report_once(generation: int) -> None:
    """A call that is one second late returns each report once, and the next reports keep their regular times."""
    kit = KitRig(generation).kit
    late_ns = START_NS + 1_003 * NS_PER_MS
    assert sorted(frame.identifier for frame in kit.frames_due(late_ns)) == sorted(PERIODS_MS[generation])
    assert kit.frames_due(late_ns) == []
    assert kit.next_wake_ns() == START_NS + 1_010 * NS_PER_MS


def test_generation_1_reports_of_a_drive() -> None:
    """Reports contain angle, command, speed, torque, the pedals' input, command and output, the gear, and ENABLED."""
    rig = driving_rig(1)
    rig.command(angle_deg=-45.0)
    rig.set_motion(10.0, steering_rad=math.radians(10.0))
    rig.kit.driver_steers(-1.5, rig.now_ns)
    found = collect_reports(rig)
    # Angle and command in 0.1 degrees at the steering wheel, speed in 1/360 m/s, torque in 1/16 Nm, flags.
    assert found[0x065] == struct.pack("<hHhbB", 1480, -450 & 0x7FFF, 3600, -24, 0b00000001)
    assert found[0x061] == struct.pack("<HHHBB", 0, 8192, 8192, 0, 0b00000001)
    assert found[0x063] == struct.pack("<HHHBB", 0, 16384, 16384, 0, 0b00000001)
    assert found[0x067] == bytes([4 | 4 << 4, 0x80])
    assert found[0x06A] == struct.pack("<4h", 3030, 3030, 3030, 3030)


def test_generation_2_reports_of_a_drive() -> None:
    """In generation 2 the reports contain the same values, and also the state "active", a counter and a checksum."""
    rig = driving_rig(2)
    rig.command(angle_deg=-45.0)
    rig.set_motion(10.0, steering_rad=math.radians(10.0))
    rig.kit.driver_steers(-1.5, rig.now_ns)
    found = collect_reports(rig)
    flags = 0b10_0000_0011
    assert found[0x100][:6] == struct.pack("<HHBB", 1480, -450 & 0x3FFF, -24 & 0xFF, flags & 0xFF)
    assert found[0x100][6] & 0x0F == flags >> 8
    assert int.from_bytes(found[0x101][:5], "little") == 0 | 500 << 12 | 500 << 24
    assert int.from_bytes(found[0x102][:5], "little") == 0 | 1000 << 12 | 1000 << 24
    assert found[0x103][0] == 4 | 4 << 4
    assert found[0x106][:3] == bytes([2 | 2 << 4, 0, 0])
    assert found[0x107][:4] == struct.pack("<hh", 3600, 3600)
    assert found[0x2A4] == struct.pack("<4h", 3030, 3030, 3030, 3030)
    assert found[0x2D8][0] == 2 << 4
    for identifier in set(found) - {0x2A4}:
        assert found[identifier][7] == crc_by_division(identifier, found[identifier][:7])
    before = found[0x100][6] >> 4
    rig.wait_ms(10)
    assert rig.newest_reports[0x100][6] >> 4 == (before + 1) % 16


def test_generation_1_reports_a_timeout() -> None:
    """After a timeout every axis reports TMOUT and FLTWDC, not ENABLED, and the brake reports the watchdog."""
    rig = driving_rig(1)
    rig.newest_reports.clear()
    for _ in range(20):
        rig.wait_ms(10)
    assert (rig.newest_reports[0x061][7], rig.newest_reports[0x063][7], rig.newest_reports[0x065][7]) == (
        0b10001000,
        0b10001000,
        0b10001000,
    )
    assert rig.newest_reports[0x061][6] & 0b1000
    assert rig.newest_reports[0x061][6] >> 4 == rig.newest_reports[0x063][6] >> 4 != 0
    assert struct.unpack_from("<H", rig.newest_reports[0x061], 4) == (32768,)


def test_generation_1_reports_an_override() -> None:
    """OVERRIDE remains after the driver has released the pedal; DRIVER and the input follow the pedal."""
    rig = driving_rig(1)
    rig.kit.driver_brakes(1.0, rig.now_ns)
    found = collect_reports(rig)
    assert (found[0x061][7], found[0x061][:2]) == (0b00000110, b"\xff\xff")
    rig.kit.driver_brakes(0.0, rig.now_ns)
    found = collect_reports(rig)
    assert (found[0x061][7], found[0x061][:2]) == (0b00000010, b"\x00\x00")


@pytest.mark.parametrize(
    ("name", "identifier", "byte", "bit"),
    [
        ("steering.FLTPWR", 0x065, 7, 2),
        ("steering.FLTBUS1", 0x065, 7, 4),
        ("steering.FLTBUS2", 0x065, 7, 5),
        ("steering.FLTCAL", 0x065, 7, 6),
        ("brake.FLT1", 0x061, 7, 4),
        ("brake.FLT2", 0x061, 7, 5),
        ("brake.FLTPWR", 0x061, 7, 6),
        ("throttle.FLT1", 0x063, 7, 4),
        ("throttle.FLT2", 0x063, 7, 5),
        ("throttle.FLTPWR", 0x063, 7, 6),
        ("gear.FLTBUS", 0x067, 0, 7),
        ("steering.fault", 0x100, 5, 2),
        ("brake.fault", 0x101, 5, 2),
        ("throttle.fault", 0x102, 5, 2),
        ("gear.fault", 0x103, 5, 2),
    ],
)
def test_faults_have_their_bits(name: str, identifier: int, byte: int, bit: int) -> None:
    """A fault changes only its own bit and the bit "ready"."""
    rig = KitRig(1 if identifier < 0x100 else 2)
    before = dict(collect_reports(rig))[identifier]
    rig.kit.set_fault(name, rig.now_ns)
    after = dict(collect_reports(rig))[identifier]
    changed = [old ^ new for old, new in zip(before, after, strict=True)]
    ready = 1 if identifier >= 0x100 else 0
    expected = [0] * len(before)
    expected[byte] = 1 << bit | ready
    if identifier == 0x067:
        expected[1] = 0x80  # the bit "ready" of generation 1's gear report
    assert changed[:6] == expected[:6]
    if identifier < 0x100:
        assert changed == expected


def test_generation_2_reports_why_it_disengaged() -> None:
    """Timeout, wrong checksum, repeated counter and override are reported by state, reason and bits."""
    found = {}
    for name, reason in (("timeout", 1), ("crc", 2), ("counter", 3), ("override", 4)):
        rig = driving_rig(2)
        frames = rig.sender.commands(CommandValues())
        if name == "crc":
            rig.send(with_crc_broken(frames[0]))
        elif name == "counter":
            rig.send(frames[0], frames[0])
        elif name == "override":
            rig.kit.driver_steers(5.0, rig.now_ns)
        for _ in range(20):
            rig.wait_ms(10)
        state = 0 if name == "override" else 7
        assert rig.newest_reports[0x106][:3] == bytes([state | 2 << 4, reason, reason])
        found[name] = rig.newest_reports[0x100][5] | (rig.newest_reports[0x100][6] & 0x0F) << 8
    ready, timeout, bad_crc, bad_count, override_active, override_latched = 1, 1 << 3, 1 << 4, 1 << 5, 1 << 6, 1 << 8
    assert found == {
        "timeout": ready | timeout,
        "crc": ready | timeout | bad_crc,
        "counter": ready | timeout | bad_count,
        "override": timeout | override_active | override_latched,
    }


def test_generation_2_reports_an_override_of_another_axis() -> None:
    """In generation 2 each axis reports that another axis is overridden."""
    rig = driving_rig(2)
    rig.kit.driver_brakes(0.5, rig.now_ns)
    found = collect_reports(rig)
    other, latched = 1 << 7, 1
    assert (found[0x100][5] & other, found[0x102][5] & other, found[0x101][5] & other) == (other, other, 0)
    assert (found[0x100][6] & latched, found[0x101][6] & latched) == (0, latched)


def test_unknown_values() -> None:
    """An unknown angle, speed or wheel speed is reported as 0x8000."""
    rig = KitRig(1)
    for name in ("angle", "speed", "wheel_speed"):
        rig.kit.set_unknown(name)
    found = collect_reports(rig)
    assert (found[0x065][0:2], found[0x065][4:6], found[0x06A]) == (b"\x00\x80", b"\x00\x80", b"\x00\x80" * 4)
    rig.kit.set_unknown("speed", is_unknown=False)
    assert collect_reports(rig)[0x065][4:6] == b"\x00\x00"
    second = KitRig(2)
    second.kit.set_unknown("speed")
    assert collect_reports(second)[0x107][:4] == b"\x00\x80\x00\x80"


def test_a_rejected_gear_is_reported() -> None:
    """Generation 1 reports the reason of a rejected gear: 5, press the brake."""
    rig = KitRig(1)
    rig.send(rig.sender.gear(4))
    assert collect_reports(rig)[0x067] == bytes([1 | 4 << 4, 5 | 0x80])
