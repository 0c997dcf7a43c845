"""Overrides by the driver, and shifting."""

import pytest
from tests.vehicle.software_car.rig import ALL_AXES, AXES, KitRig, both_generations, driving_rig

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.state import Gear, GearRejection, ReleaseReason


@both_generations
@pytest.mark.parametrize("axis", AXES)
def test_override(generation: int, axis: str) -> None:
    """An override releases its axis (in generation 2 all axes), trips no watchdog, and remains until it is cleared."""
    rig = driving_rig(generation)
    act = {"steering": rig.kit.driver_steers, "brake": rig.kit.driver_brakes, "throttle": rig.kit.driver_throttles}[
        axis
    ]
    act(3.0 if axis == "steering" else 0.3, rig.now_ns)
    released = ALL_AXES if generation == 2 else {axis}
    assert rig.enabled() == ALL_AXES - released
    act(0.0, rig.now_ns)
    rig.drive_ms(1000, throttle=0.1)
    rig.request_system()
    assert rig.enabled() == ALL_AXES - released
    assert rig.kit.state.watchdog_reason == ReleaseReason.NONE
    rig.request_system(0)
    rig.send(*rig.sender.clearing())
    rig.command()
    rig.request_system()
    assert rig.enabled() == ALL_AXES


@both_generations
def test_an_active_override_is_not_cleared(generation: int) -> None:
    """CLEAR has no effect while the driver still acts."""
    rig = driving_rig(generation)
    rig.kit.driver_steers(-3.0, rig.now_ns)
    rig.command(clear=True)
    assert rig.kit.state.actuators["steering"].is_overridden
    rig.kit.driver_steers(0.0, rig.now_ns)
    rig.command(clear=True)
    assert not rig.kit.state.actuators["steering"].is_overridden


@both_generations
def test_small_inputs_do_not_override(generation: int) -> None:
    """A torque of less than 2 Nm on the wheel, or less than a twentieth of a pedal's travel, is no override."""
    rig = driving_rig(generation)
    rig.kit.driver_steers(1.9, rig.now_ns)
    rig.kit.driver_brakes(0.04, rig.now_ns)
    rig.kit.driver_throttles(0.04, rig.now_ns)
    assert rig.enabled() == ALL_AXES


@both_generations
def test_ignore_prevents_an_override(generation: int) -> None:
    """With the ignore bit the driver cannot override."""
    rig = driving_rig(generation)
    rig.command(ignore_override=True)
    rig.kit.driver_steers(8.0, rig.now_ns)
    rig.kit.driver_brakes(1.0, rig.now_ns)
    rig.command(ignore_override=True)
    assert rig.enabled() == ALL_AXES


def test_clearing_frames_have_no_counter() -> None:
    """In generation 1 a clearing frame (4 bytes) trips no watchdog, enables nothing and prevents no timeout."""
    rig = driving_rig(1)
    for _ in range(4):
        rig.wait_ms(25)
        rig.send(*rig.sender.clearing())
    assert rig.kit.state.watchdog_reason == ReleaseReason.TIMEOUT
    other = KitRig(1)
    other.send(*(CanFrame(frame.identifier, b"\xff\xff\xff\xff") for frame in other.sender.clearing()))
    assert other.enabled() == set()


def test_a_full_clearing_frame_without_a_counter_trips() -> None:
    """In generation 1 a frame of 8 bytes with CLEAR and no counter trips the watchdog."""
    rig = driving_rig(1)
    rig.command()
    rig.send(*(CanFrame(frame.identifier, frame.data + bytes(4)) for frame in rig.sender.clearing()))
    assert (rig.enabled(), rig.kit.state.watchdog_reason) == (set(), ReleaseReason.COUNTER)


@both_generations
def test_a_shift_needs_the_brake(generation: int) -> None:
    """A shift without the brake is rejected with 5 (press the brake); with the brake it is executed."""
    rig = KitRig(generation)
    rig.enable(in_drive=False)
    rig.command(brake=0.0)
    rig.send(rig.sender.gear(4))
    assert (rig.kit.state.gear, rig.kit.state.gear_reject) == (Gear.PARK, GearRejection.BRAKE_OR_MOTION)
    rig.command(brake=0.5)
    rig.send(rig.sender.gear(4))
    assert (rig.kit.state.gear, rig.kit.state.gear_reject) == (Gear.DRIVE, GearRejection.NONE)


@both_generations
def test_reasons_for_rejected_gears(generation: int) -> None:
    """Gears are rejected with a reason: park while moving, reverse, after the driver's shift, or with a fault."""
    rig = driving_rig(generation)

    def rejection(gear: int) -> GearRejection:
        rig.command(brake=0.5)
        rig.send(rig.sender.gear(gear))
        return rig.kit.state.gear_reject

    assert [rejection(gear) for gear in (1, 2, 5, 0)] == [
        GearRejection.BRAKE_OR_MOTION,
        GearRejection.UNSUPPORTED,
        GearRejection.UNSUPPORTED,
        GearRejection.NONE,
    ]
    rig.kit.driver_shifts(Gear.NEUTRAL, rig.now_ns)
    assert rejection(4) == GearRejection.OVERRIDE
    rig.kit.set_fault(f"gear.{'FLTBUS' if generation == 1 else 'fault'}", rig.now_ns)
    assert rejection(4) == GearRejection.FAULT
    assert rig.kit.state.gear == Gear.NEUTRAL


@both_generations
def test_out_of_gear_the_throttle_has_no_effect(generation: int) -> None:
    """In park the car brakes; in park and in neutral, neither the kit's nor the driver's throttle has an effect."""
    rig = KitRig(generation)
    rig.enable(in_drive=False)
    rig.command(throttle=0.5)
    rig.kit.driver_throttles(0.02, rig.now_ns)
    assert rig.executed().throttle_and_brake == (0.0, 1.0)
    rig.command(brake=0.5)
    rig.send(rig.sender.gear(3))
    rig.command(throttle=0.5)
    assert rig.executed().throttle_and_brake == (0.0, 0.0)


def test_override_by_the_shifter() -> None:
    """Moving the shifter disengages generation 2; generation 1 only reports it, and the sender has to disengage."""
    rig = driving_rig(2)
    rig.kit.driver_shifts(Gear.NEUTRAL, rig.now_ns)
    assert (rig.enabled(), rig.kit.state.disengage_reason, rig.kit.state.watchdog_reason) == (
        set(),
        ReleaseReason.OVERRIDE,
        ReleaseReason.NONE,
    )
    rig_1 = driving_rig(1)
    rig_1.kit.driver_shifts(Gear.NEUTRAL, rig_1.now_ns)
    rig_1.command(enable=False)
    assert (rig_1.kit.state.is_gear_overridden, rig_1.kit.state.watchdog_reason) == (True, ReleaseReason.NONE)
    rig_1.send(rig_1.sender.gear(0, clear=True))
    assert not rig_1.kit.state.is_gear_overridden


@both_generations
def test_the_driver_prevents_enabling(generation: int) -> None:
    """A command to enable while the driver brakes is an override, which remains after the pedal is released."""
    rig = KitRig(generation)
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.command()
    rig.request_system()
    rig.kit.driver_brakes(0.0, rig.now_ns)
    rig.command()
    rig.request_system()
    assert rig.enabled() == (set() if generation == 2 else ALL_AXES - {"brake"})
