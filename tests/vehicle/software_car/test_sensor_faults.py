"""Faults of the speed reports and of the brake."""

from __future__ import annotations

import struct

import pytest
from tests.vehicle.software_car.rig import KitRig, driving_rig

SPEED, WHEELS = {1: (0x065, 4), 2: (0x107, 0)}, {1: 0x06A, 2: 0x2A4}
"""By generation: (identifier, position) of the speed, and the identifier of the wheel speeds."""
both_generations = pytest.mark.parametrize("generation", [1, 2])


def reported_mps(rig: KitRig) -> tuple[float, float]:
    """Return the speed and the speed of a wheel in the newest reports."""
    identifier, place = SPEED[rig.generation]
    (speed,) = struct.unpack_from("<h", rig.newest_reports[identifier], place)
    (wheel,) = struct.unpack_from("<h", rig.newest_reports[WHEELS[rig.generation]], 0)
    return speed / 360, wheel / 100 * 0.33


def collect_identifiers(rig: KitRig) -> set[int]:
    """Wait 200 ms, and return the identifiers that were sent."""
    rig.newest_reports.clear()
    rig.wait_ms(200)
    return set(rig.newest_reports)


@both_generations
def test_a_stuck_and_a_scaled_speed(generation: int) -> None:
    """A stuck or scaled source reports a speed other than the car's speed, until it is restored."""
    rig = driving_rig(generation)
    rig.set_motion(5.0)
    rig.kit.stick_speed("speed", 3.0)
    rig.kit.scale_speed("wheel_speed", 0.5)
    collect_identifiers(rig)
    assert reported_mps(rig) == pytest.approx((3.0, 2.5), abs=0.01)
    for source in ("speed", "wheel_speed"):
        rig.kit.restore_speed(source)
    collect_identifiers(rig)
    assert reported_mps(rig) == pytest.approx((5.0, 5.0), abs=0.01)


@both_generations
@pytest.mark.parametrize("source", ["speed", "wheel_speed"])
def test_a_dropped_speed(generation: int, source: str) -> None:
    """The message of a dropped source is not sent; all other messages are."""
    rig = driving_rig(generation)
    before = collect_identifiers(rig)
    rig.kit.drop_speed(source)
    missing = SPEED[generation][0] if source == "speed" else WHEELS[generation]
    assert collect_identifiers(rig) == before - {missing}


@both_generations
def test_a_weak_brake(generation: int) -> None:
    """A weak brake acts on the wheels with only a share of the brake that its report contains."""
    rig = driving_rig(generation)
    rig.command(brake=0.8)
    rig.kit.weaken_brake(0.25)
    assert rig.kit.state.brake == pytest.approx(0.8, abs=0.001)
    assert rig.kit.actuation(rig.now_ns).brake == pytest.approx(0.2, abs=0.001)
