"""Command timeouts, invalid commands, and the watchdog that then brakes."""

from itertools import product

import pytest
from tests.vehicle.software_car.rig import (
    ALL_AXES,
    AXES,
    DEGREES_PER_RAD,
    STEERING_RATIO,
    CommandValues,
    KitRig,
    Sender2,
    both_generations,
    driving_rig,
    with_crc_broken,
)

from lavt.vehicle.software_car.authority import WATCHDOG_BRAKE
from lavt.vehicle.software_car.state import Gear, ReleaseReason, SystemState


@both_generations
def test_commands_time_out_after_100_ms(generation: int) -> None:
    """An actuator is disabled 100 ms after its last valid command, not 1 us earlier, and the kit brakes."""
    rig = driving_rig(generation)
    rig.command(throttle=0.5)
    rig.wait_ms(99.999)
    assert (rig.enabled(), rig.executed().throttle_and_brake) == (ALL_AXES, (0.5, 0.0))
    rig.wait_ms(0.001)
    assert (rig.enabled(), rig.executed().throttle_and_brake) == (set(), (0.0, WATCHDOG_BRAKE))
    assert all(actuator.has_timed_out for actuator in rig.kit.state.actuators.values())
    assert rig.kit.state.watchdog_reason == ReleaseReason.TIMEOUT


@both_generations
def test_late_calls_give_the_same_state(generation: int) -> None:
    """A kit that is advanced once after a second reaches the same state as a kit that is advanced each millisecond."""
    often, late = driving_rig(generation), driving_rig(generation)
    for rig in (often, late):
        rig.command(angle_deg=90.0, throttle=0.5, rate=25)
    for _ in range(1000):
        often.wait_ms(1)
    late.wait_ms(1000)
    often.kit.state.sent = late.kit.state.sent
    assert often.kit.state == late.kit.state
    assert often.executed() == late.executed()


@both_generations
@pytest.mark.parametrize("axis_index", [0, 1, 2])
def test_a_timeout_of_one_axis_trips_the_watchdog(generation: int, axis_index: int) -> None:
    """If commands to a single axis stop, the watchdog trips and all axes are released."""
    rig = driving_rig(generation)
    for _ in range(5):
        rig.wait_ms(20)
        frames = rig.sender.commands(CommandValues(throttle=0.5))
        rig.send(*(frame for index, frame in enumerate(frames) if index != axis_index))
    assert (rig.enabled(), rig.kit.state.watchdog_reason) == (set(), ReleaseReason.TIMEOUT)
    assert rig.kit.state.watchdog_axis == AXES[axis_index]


def test_without_a_watchdog_only_one_axis_is_released() -> None:
    """In generation 1 without watchdog only the axis that timed out is released, until commands enable it again."""
    rig = driving_rig(1, has_watchdog=False)
    for _ in range(5):
        rig.wait_ms(20)
        rig.send(*rig.sender.commands(CommandValues(throttle=0.5))[1:])
    assert (rig.enabled(), rig.kit.state.watchdog_brakes) == ({"brake", "throttle"}, False)
    rig.command()
    assert rig.enabled() == ALL_AXES


@both_generations
def test_a_repeated_counter_trips_the_watchdog(generation: int) -> None:
    """A command with the previous counter is rejected, and the kit brakes."""
    rig = driving_rig(generation)
    frames = rig.sender.commands(CommandValues(throttle=0.5))
    rig.send(*frames)
    assert rig.enabled() == ALL_AXES
    rig.wait_ms(20)
    rig.send(frames[2])
    assert (rig.enabled(), rig.kit.state.watchdog_reason, rig.executed().throttle_and_brake) == (
        set(),
        ReleaseReason.COUNTER,
        (0.0, WATCHDOG_BRAKE),
    )


@pytest.mark.parametrize(
    ("generation", "step", "is_right"), [(1, 1, True), (1, 2, False), (1, 255, False), (2, 5, True)]
)
def test_counter_rules(generation: int, step: int, is_right: bool) -> None:
    """The counter must increase by one in generation 1, and must only differ from the previous one in generation 2."""
    rig = driving_rig(generation)
    rig.sender.count += step - 1
    rig.command()
    assert rig.enabled() == (ALL_AXES if is_right else set())


def test_counters_wrap() -> None:
    """Counters wrap from 255 to 0 in generation 1 and from 15 to 0 in generation 2 without tripping the watchdog."""
    for generation in (1, 2):
        rig = driving_rig(generation)
        rig.drive_ms(10_000)
        assert rig.enabled() == ALL_AXES


def test_a_wrong_checksum_trips_the_watchdog() -> None:
    """A command of generation 2 with a wrong checksum is rejected and reported as bad_crc, and the kit brakes."""
    for axis_index in range(3):
        rig = driving_rig(2)
        frames = rig.sender.commands(CommandValues(angle_deg=50.0, throttle=0.5))
        rig.send(with_crc_broken(frames[axis_index]))
        assert (rig.enabled(), rig.kit.state.watchdog_reason, rig.kit.state.system) == (
            set(),
            ReleaseReason.CRC,
            SystemState.FAULT,
        )
        assert [rig.kit.state.actuators[axis].is_crc_bad for axis in ("steering", "brake", "throttle")] == [
            index == axis_index for index in range(3)
        ]
        assert rig.executed().throttle_and_brake == (0.0, WATCHDOG_BRAKE)


def test_system_and_gear_requests_with_wrong_checksums_are_ignored() -> None:
    """In generation 2, requests to enable the system and to shift have no effect if the checksum is wrong."""
    rig = KitRig(2)
    rig.command(brake=0.5)
    assert isinstance(rig.sender, Sender2)
    rig.send(with_crc_broken(rig.sender.system(1)))
    assert rig.enabled() == set()
    rig.enable(in_drive=False)
    rig.send(with_crc_broken(rig.sender.gear(4)))
    assert rig.kit.state.gear == Gear.PARK


def test_disabling_in_gear_or_while_moving_trips_the_watchdog_of_generation_1() -> None:
    """In generation 1, disabling an actuator in gear or while the car moves trips the watchdog."""
    for in_gear, speed_mps in product((False, True), (0.0, 10.0)):
        rig = KitRig(1)
        rig.enable(in_drive=in_gear)
        rig.set_motion(speed_mps)
        rig.command(enable=False)
        assert rig.kit.state.watchdog_brakes == (in_gear or speed_mps > 0)


@both_generations
def test_the_watchdog_brakes_until_an_override(generation: int) -> None:
    """Whatever is commanded, the watchdog brakes until the driver overrides; after CLEAR the kit can be enabled."""
    rig = driving_rig(generation)
    rig.wait_ms(100)
    for _ in range(10):
        rig.command(throttle=1.0, clear=True)
        rig.request_system()
        rig.wait_ms(20)
        assert (rig.enabled(), rig.executed().throttle_and_brake) == (set(), (0.0, WATCHDOG_BRAKE))
    rig.wait_ms(100)
    rig.kit.driver_brakes(0.8, rig.now_ns)
    assert rig.executed().brake == 0.8
    rig.kit.driver_brakes(0.0, rig.now_ns)
    assert rig.executed().brake == 0.0
    rig.command()
    rig.request_system()
    assert rig.enabled() == set()
    rig.request_system(0)
    rig.command(clear=True)
    rig.request_system()
    assert rig.enabled() == ALL_AXES


@both_generations
def test_a_released_wheel_keeps_its_angle(generation: int) -> None:
    """When the kit disengages, the steering wheel keeps its actual angle, not the commanded angle."""
    rig = driving_rig(generation)
    rig.command(angle_deg=90.0)
    rig.wait_ms(50)
    rig.set_motion(10.0, steering_rad=0.05)
    rig.wait_ms(50)
    assert rig.executed().steering_wheel_deg == pytest.approx(0.05 * STEERING_RATIO * DEGREES_PER_RAD)
    rig.wait_ms(1000)
    assert rig.executed().steering_wheel_deg == pytest.approx(0.05 * STEERING_RATIO * DEGREES_PER_RAD)
