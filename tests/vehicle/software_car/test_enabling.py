"""Enabling the axes of a kit, and commands of enabled axes."""

import pytest
from tests.vehicle.software_car.rig import (
    ALL_AXES,
    DEGREES_PER_RAD,
    STEERING_RATIO,
    CommandValues,
    KitRig,
    Sender2,
    both_generations,
    driving_rig,
    with_crc,
)

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.state import ReleaseReason, SystemState


def test_generation_1_enables_each_axis_by_its_own_bit() -> None:
    """In generation 1 a command with EN enables only the axis to which it is sent."""
    rig = KitRig(1)
    steering, _, _ = rig.sender.commands(CommandValues(angle_deg=10.0))
    assert rig.enabled() == set()
    rig.send(steering)
    assert rig.enabled() == {"steering"}


def test_generation_2_needs_a_request_and_commands_to_all_axes() -> None:
    """In generation 2 no axis is enabled until the system is requested to enable and all axes are commanded with EN."""
    rig = KitRig(2)
    rig.command()
    assert (rig.enabled(), rig.kit.state.system) == (set(), SystemState.READY)
    rig.request_system()
    assert (rig.enabled(), rig.kit.state.system) == (ALL_AXES, SystemState.ACTIVE)
    other = KitRig(2)
    other.request_system()
    steering, brake, throttle = other.sender.commands(CommandValues())
    other.send(steering, brake)
    assert other.enabled() == set()
    other.send(throttle)
    assert other.enabled() == ALL_AXES


def test_a_request_to_enable_expires() -> None:
    """A request to enable expires after 100 ms: later commands enable nothing."""
    for wait_ms, enabled in ((99.999, ALL_AXES), (100, set())):
        rig = KitRig(2)
        rig.request_system()
        rig.wait_ms(wait_ms)
        rig.command()
        assert rig.enabled() == enabled


@both_generations
def test_disabling_in_park_does_not_trip(generation: int) -> None:
    """Disabling the kit in park at standstill does not trip the watchdog."""
    rig = KitRig(generation)
    rig.enable(in_drive=False)
    rig.request_system(2)
    rig.command(enable=False)
    state = rig.kit.state
    assert (rig.enabled(), state.watchdog_reason, state.watchdog_brakes) == (set(), ReleaseReason.NONE, False)


def test_generation_2_needs_a_new_request() -> None:
    """After the kit has disengaged, continuing requests do not enable it: they must stop and begin again."""
    rig = driving_rig(2)
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.kit.driver_brakes(0.0, rig.now_ns)
    rig.request_system()
    rig.command(clear=True)
    rig.request_system()
    assert (rig.enabled(), rig.kit.state.system) == (set(), SystemState.READY)
    rig.request_system(2)
    rig.request_system()
    assert rig.enabled() == ALL_AXES


def test_only_the_chosen_set_is_accepted() -> None:
    """A kit accepts only commands of its command set: the remote commands or the user commands."""
    rig = KitRig(2)
    rig.sender = Sender2(first_identifier=0x210)
    rig.command()
    rig.request_system()
    assert rig.enabled() == set()
    user = KitRig(2, commands="user")
    user.sender = Sender2(first_identifier=0x210)
    user.enable()
    assert user.enabled() == ALL_AXES


@both_generations
def test_commands_reach_the_wheels(generation: int) -> None:
    """Angle, throttle and brake of a command reach the wheels unchanged."""
    rig = driving_rig(generation)
    rig.drive_ms(1000, angle_deg=-123.4, throttle=0.3, brake=0.2)
    assert rig.executed() == (-123.4, 0.3, 0.2)


@both_generations
def test_steering_rate(generation: int) -> None:
    """At rate 25 (100 deg/s) the steering wheel turns 10 degrees in 100 ms; without a rate it turns at 17.5 rad/s."""
    rig = driving_rig(generation)
    for _ in range(5):
        rig.command(angle_deg=90.0, rate=25)
        rig.wait_ms(20)
    assert rig.executed().steering_wheel_deg == 10.0
    quick = driving_rig(generation)
    quick.command(angle_deg=300.0)
    quick.wait_ms(20)
    assert quick.executed().steering_wheel_deg == pytest.approx(0.02 * 17.5 * DEGREES_PER_RAD)


@both_generations
def test_steering_starts_at_the_current_angle(generation: int) -> None:
    """Once enabled, the kit turns the wheel from its current angle, not from the centre."""
    rig = KitRig(generation)
    rig.set_motion(0.0, steering_rad=0.2)
    rig.enable()
    assert rig.executed().steering_wheel_deg == pytest.approx(0.2 * STEERING_RATIO * DEGREES_PER_RAD)


@both_generations
def test_an_unknown_command_type_enables_nothing(generation: int) -> None:
    """A command of an unknown type is treated as a command without the enable bit."""
    rig = KitRig(generation)
    rig.request_system()
    rig.command(angle_deg=1.0)
    assert rig.enabled() == ALL_AXES
    _, brake, _ = rig.sender.commands(CommandValues(brake=0.5))
    data = bytearray(brake.data)
    data[2] = 7 << 4 if generation == 1 else 1 << 4 | 7
    rig.send(CanFrame(0x060, bytes(data)) if generation == 1 else with_crc(0x201, bytes(data[:-1])))
    assert rig.enabled() == (ALL_AXES - {"brake"} if generation == 1 else set())


@pytest.mark.parametrize(
    ("kind", "raw", "fraction"),
    [
        (1, 0.15, 0.0),
        (1, 0.325, 0.5),
        (1, 0.5, 1.0),
        (1, 0.1, 0.0),
        (2, 0.4, 0.4),
        (3, 1706 / 65535, 0.5),
        (6, 3000 / 65535, 0.5),
    ],
)
def test_generation_1_types_of_brake_command(kind: int, raw: float, fraction: float) -> None:
    """Brake commands by pedal (0.15 to 0.5), percent, torque (of 3412 Nm) and deceleration (of 6 m/s2) are scaled."""
    rig = driving_rig(1)
    _, brake, _ = rig.sender.commands(CommandValues(brake=raw))
    data = bytearray(brake.data)
    data[2] = kind << 4
    rig.send(CanFrame(brake.identifier, bytes(data)))
    assert rig.executed().brake == pytest.approx(fraction, abs=2e-4)


def test_a_repeated_counter_invalidates_a_request() -> None:
    """Generation 2 ignores a request to the system with the counter of the previous request."""
    rig = KitRig(2)
    rig.enable()
    rig.request_system()
    rig.sender.count -= 1
    rig.request_system(2)
    assert rig.enabled() == ALL_AXES
    rig.request_system(2)
    assert rig.enabled() == set()
