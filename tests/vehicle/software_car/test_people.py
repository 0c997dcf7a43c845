import pytest
from tests.vehicle.software_car.rig import ALL, AXES, Rig, both, driving

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.state import Gear, GearRejection, ReleaseReason


@both
@pytest.mark.parametrize("axis", AXES)
def test_the_driver_takes_over(generation: int, axis: str) -> None:
    """Hands or feet take their axis from the kit (generation 2: all), the watchdog does not brake, and it stays so."""
    rig = driving(generation)
    act = {"steering": rig.kit.driver_steers, "brake": rig.kit.driver_brakes, "throttle": rig.kit.driver_throttles}[
        axis
    ]
    act(3.0 if axis == "steering" else 0.3, rig.now_ns)
    lost = ALL if generation == 2 else {axis}
    assert rig.enabled() == ALL - lost
    act(0.0, rig.now_ns)
    rig.drive_ms(1000, throttle=0.1)
    rig.ask()
    assert rig.enabled() == ALL - lost
    assert rig.kit.state.watchdog == ReleaseReason.NONE
    rig.ask(0)
    rig.send(*rig.hand.clearing())
    rig.command()
    rig.ask()
    assert rig.enabled() == ALL


@both
def test_an_override_is_not_cleared_under_the_drivers_hands(generation: int) -> None:
    """Clearing does nothing while the driver still acts."""
    rig = driving(generation)
    rig.kit.driver_steers(-3.0, rig.now_ns)
    rig.command(clear=True)
    assert rig.kit.state.actuators["steering"].is_overridden
    rig.kit.driver_steers(0.0, rig.now_ns)
    rig.command(clear=True)
    assert not rig.kit.state.actuators["steering"].is_overridden


@both
def test_a_light_touch_is_no_override(generation: int) -> None:
    """Less than 2 Nm on the wheel or a twentieth of a pedal takes nothing over."""
    rig = driving(generation)
    rig.kit.driver_steers(1.9, rig.now_ns)
    rig.kit.driver_brakes(0.04, rig.now_ns)
    rig.kit.driver_throttles(0.04, rig.now_ns)
    assert rig.enabled() == ALL


@both
def test_ignore_lets_the_driver_push_in_vain(generation: int) -> None:
    """With the ignore bit the driver's hands and feet take nothing over."""
    rig = driving(generation)
    rig.command(ignore=True)
    rig.kit.driver_steers(8.0, rig.now_ns)
    rig.kit.driver_brakes(1.0, rig.now_ns)
    rig.command(ignore=True)
    assert rig.enabled() == ALL


def test_clearing_frames_have_no_counter() -> None:
    """Generation 1: a frame of 4 bytes neither trips the watchdog, nor enables, nor keeps an actuator awake."""
    rig = driving(1)
    for _ in range(4):
        rig.wait_ms(25)
        rig.send(*rig.hand.clearing())
    assert rig.kit.state.watchdog == ReleaseReason.TIMEOUT
    other = Rig(1)
    other.send(*(CanFrame(frame.identifier, b"\xff\xff\xff\xff") for frame in other.hand.clearing()))
    assert other.enabled() == set()


def test_a_full_clearing_frame_without_a_counter_trips() -> None:
    """Generation 1: 8 bytes with CLEAR and no counter trip the watchdog."""
    rig = driving(1)
    rig.command()
    rig.send(*(CanFrame(frame.identifier, frame.data + bytes(4)) for frame in rig.hand.clearing()))
    assert (rig.enabled(), rig.kit.state.watchdog) == (set(), ReleaseReason.COUNTER)


@both
def test_a_shift_needs_the_brake(generation: int) -> None:
    """A shift without the brake pressed is refused with 5 (press the brake); with it, it is done."""
    rig = Rig(generation)
    rig.enable(in_drive=False)
    rig.command(brake=0.0)
    rig.send(rig.hand.gear(4))
    assert (rig.kit.state.gear, rig.kit.state.gear_reject) == (Gear.PARK, GearRejection.VEHICLE)
    rig.command(brake=0.5)
    rig.send(rig.hand.gear(4))
    assert (rig.kit.state.gear, rig.kit.state.gear_reject) == (Gear.DRIVE, GearRejection.NONE)


@both
def test_why_gears_are_rejected(generation: int) -> None:
    """Park while moving 5, reverse 6, after the driver's shift 2, with a fault 7, and no gear at all is no request."""
    rig = driving(generation)

    def rejection(gear: int) -> GearRejection:
        rig.command(brake=0.5)
        rig.send(rig.hand.gear(gear))
        return rig.kit.state.gear_reject

    assert [rejection(gear) for gear in (1, 2, 5, 0)] == [
        GearRejection.VEHICLE,
        GearRejection.UNSUPPORTED,
        GearRejection.UNSUPPORTED,
        GearRejection.NONE,
    ]
    rig.kit.driver_shifts(Gear.NEUTRAL, rig.now_ns)
    assert rejection(4) == GearRejection.OVERRIDE
    rig.kit.set_fault(f"gear.{'FLTBUS' if generation == 1 else 'fault'}", rig.now_ns)
    assert rejection(4) == GearRejection.FAULT
    assert rig.kit.state.gear == Gear.NEUTRAL


@both
def test_without_a_gear_nothing_drives(generation: int) -> None:
    """In park the car is held and in neutral the throttle does nothing, whoever presses it."""
    rig = Rig(generation)
    rig.enable(in_drive=False)
    rig.command(throttle=0.5)
    rig.kit.driver_throttles(0.02, rig.now_ns)
    assert rig.wheels()[1:] == (0.0, 1.0)
    rig.command(brake=0.5)
    rig.send(rig.hand.gear(3))
    rig.command(throttle=0.5)
    assert rig.wheels()[1:] == (0.0, 0.0)


def test_the_shifter_takes_over() -> None:
    """Moving the shifter lets generation 2 go as a whole, and is told in generation 1, whose sender has to let go."""
    rig = driving(2)
    rig.kit.driver_shifts(Gear.NEUTRAL, rig.now_ns)
    assert (rig.enabled(), rig.kit.state.disengaged, rig.kit.state.watchdog) == (
        set(),
        ReleaseReason.OVERRIDE,
        ReleaseReason.NONE,
    )
    first = driving(1)
    first.kit.driver_shifts(Gear.NEUTRAL, first.now_ns)
    first.command(enable=False)
    assert (first.kit.state.is_gear_overridden, first.kit.state.watchdog) == (True, ReleaseReason.NONE)
    first.send(first.hand.gear(0, clear=True))
    assert not first.kit.state.is_gear_overridden


@both
def test_nothing_is_enabled_under_the_drivers_foot(generation: int) -> None:
    """A command to enable while the driver's foot is on the brake is an override that stays after the foot has gone."""
    rig = Rig(generation)
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.command()
    rig.ask()
    rig.kit.driver_brakes(0.0, rig.now_ns)
    rig.command()
    rig.ask()
    assert rig.enabled() == (set() if generation == 2 else ALL - {"brake"})
