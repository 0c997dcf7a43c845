"""Faults of a kit, conditions that inhibit it, and loss of the bus."""

import pytest
from tests.vehicle.software_car.rig import ALL_AXES, KitRig, both_generations, driving_rig

from lavt.errors import UserError
from lavt.vehicle.software_car.authority import WATCHDOG_BRAKE
from lavt.vehicle.software_car.state import Gear, ReleaseReason, SystemState

FAULTS = [
    (1, "steering.FLTPWR"),
    (1, "steering.FLTCAL"),
    (1, "brake.FLT1"),
    (1, "throttle.FLTPWR"),
    (2, "steering.fault"),
    (2, "brake.fault"),
    (2, "gear.fault"),
]


@pytest.mark.parametrize(("generation", "name"), FAULTS)
def test_a_fault_disengages_and_brakes(generation: int, name: str) -> None:
    """A fault while driving makes the kit release all axes and brake."""
    rig = driving_rig(generation)
    rig.kit.set_fault(name, rig.now_ns)
    assert (rig.enabled(), rig.kit.state.watchdog_reason, rig.executed().brake) == (
        set(),
        ReleaseReason.FAULT,
        WATCHDOG_BRAKE,
    )


@pytest.mark.parametrize(("generation", "name"), FAULTS)
def test_a_faulty_axis_is_not_enabled(generation: int, name: str) -> None:
    """A fault prevents enabling of its axis (in generation 2, of all axes) until it is cleared."""
    rig = KitRig(generation)
    rig.kit.set_fault(name, rig.now_ns)
    rig.command()
    rig.request_system()
    assert rig.enabled() == (set() if generation == 2 else ALL_AXES - {name.split(".", maxsplit=1)[0]})
    rig.kit.set_fault(name, rig.now_ns, is_set=False)
    rig.command()
    assert rig.enabled() == ALL_AXES


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("seat belt", ReleaseReason.SEAT_BELT),
        ("door", ReleaseReason.DOOR),
        ("speed", ReleaseReason.LOCKOUT_SPEED),
        ("acceleration", ReleaseReason.LOCKOUT_ACCELERATION),
        ("reverse", ReleaseReason.LOCKOUT_REVERSE),
    ],
)
def test_an_inhibit_reason_of_generation_2_disengages(name: str, reason: ReleaseReason) -> None:
    """Belt, door and lockouts keep generation 2 in manual, with the reason; an enabled kit disengages and brakes."""
    rig = KitRig(2)
    rig.kit.inhibit(name, rig.now_ns)
    rig.command()
    rig.request_system()
    assert (rig.enabled(), rig.kit.state.system, rig.kit.state.not_ready_reason) == (set(), SystemState.MANUAL, reason)
    rig.kit.inhibit(None, rig.now_ns)
    assert rig.enabled() == ALL_AXES
    rig.kit.inhibit(name, rig.now_ns)
    assert (rig.enabled(), rig.kit.state.watchdog_brakes) == (set(), True)


@pytest.mark.parametrize("remote_state", [0, 1])
def test_the_remote_control_stops_the_car(remote_state: int) -> None:
    """If the remote control is switched to emergency stop or pause, a kit of generation 2 disengages and brakes."""
    rig = driving_rig(2)
    rig.kit.switch_remote(remote_state, rig.now_ns)
    assert (rig.enabled(), rig.executed().brake, rig.kit.state.watchdog_reason) == (
        set(),
        WATCHDOG_BRAKE,
        ReleaseReason.REMOTE,
    )


@both_generations
def test_bus_off(generation: int) -> None:
    """Off the bus the kit sends and receives nothing, so that commands time out; back on the bus it sends again."""
    rig = driving_rig(generation)
    rig.wait_ms(20)
    rig.kit.set_bus_off(rig.now_ns)
    rig.newest_reports.clear()
    rig.drive_ms(80, throttle=0.5)
    assert rig.newest_reports == {}
    assert (rig.enabled(), rig.kit.state.watchdog_reason) == (set(), ReleaseReason.TIMEOUT)
    rig.kit.set_bus_off(rig.now_ns, is_off=False)
    rig.wait_ms(100)
    assert len(rig.newest_reports) == (5 if generation == 1 else 8)


@both_generations
def test_unknown_names_are_rejected(generation: int) -> None:
    """An unknown fault, inhibit reason, value or gear is rejected with an error that quotes it."""
    kit = KitRig(generation).kit
    with pytest.raises(UserError, match=r"no fault 'brake\.smoke': the known ones are brake"):
        kit.set_fault("brake.smoke", 10**12)
    with pytest.raises(UserError, match=r"'rain': the known ones are acceleration"):
        kit.inhibit("rain", 10**12)
    with pytest.raises(UserError, match="no reported value 'mood'"):
        kit.set_unknown("mood")
    with pytest.raises(UserError, match="no available gear 'REVERSE'"):
        kit.driver_shifts(Gear.REVERSE, 10**12)
