from itertools import product

import pytest
from tests.vehicle.software_car.rig import ALL, AXES, Asked, Hand2, Rig, both, driving, with_crc_broken

from lavt.vehicle.software_car.authority import WATCHDOG_BRAKE
from lavt.vehicle.software_car.state import Gear, ReleaseReason, SystemState


@both
def test_commands_time_out_after_100_ms(generation: int) -> None:
    """100 ms after its last valid command an actuator lets go, not 1 us earlier, and the kit brakes."""
    rig = driving(generation)
    rig.command(throttle=0.5)
    rig.wait_ms(99.999)
    assert (rig.enabled(), rig.wheels()[1:]) == (ALL, (0.5, 0.0))
    rig.wait_ms(0.001)
    assert (rig.enabled(), rig.wheels()[1:]) == (set(), (0.0, WATCHDOG_BRAKE))
    assert all(actuator.has_timed_out for actuator in rig.kit.state.actuators.values())
    assert rig.kit.state.watchdog == ReleaseReason.TIMEOUT


@both
def test_a_late_look_finds_the_same(generation: int) -> None:
    """Whether one looks at the kit each millisecond or once a second later, it is in the same state."""
    often, late = driving(generation), driving(generation)
    for rig in (often, late):
        rig.command(angle_deg=90.0, throttle=0.5, rate=25)
    for _ in range(1000):
        often.wait_ms(1)
    late.wait_ms(1000)
    often.kit.state.sent = late.kit.state.sent
    assert often.kit.state == late.kit.state
    assert often.wheels() == late.wheels()


@both
@pytest.mark.parametrize("part", [0, 1, 2])
def test_one_axis_without_commands_is_enough(generation: int, part: int) -> None:
    """When commands to one axis stop while those to the others go on, the watchdog trips and everything lets go."""
    rig = driving(generation)
    for _ in range(5):
        rig.wait_ms(20)
        frames = rig.hand.commands(Asked(throttle=0.5))
        rig.send(*(frame for index, frame in enumerate(frames) if index != part))
    assert (rig.enabled(), rig.kit.state.watchdog) == (set(), ReleaseReason.TIMEOUT)
    assert rig.kit.state.watchdog_axis == AXES[part]


def test_without_a_watchdog_only_the_axis_lets_go() -> None:
    """Generation 1 without watchdog: an axis times out alone, nothing brakes, and new commands are obeyed."""
    rig = driving(1, has_watchdog=False)
    for _ in range(5):
        rig.wait_ms(20)
        rig.send(*rig.hand.commands(Asked(throttle=0.5))[1:])
    assert (rig.enabled(), rig.kit.state.watchdog_brakes) == ({"brake", "throttle"}, False)
    rig.command()
    assert rig.enabled() == ALL


@both
def test_a_stuck_counter_trips_the_watchdog(generation: int) -> None:
    """A command with the counter of the one before is not obeyed, and the kit brakes."""
    rig = driving(generation)
    frames = rig.hand.commands(Asked(throttle=0.5))
    rig.send(*frames)
    assert rig.enabled() == ALL
    rig.wait_ms(20)
    rig.send(frames[2])
    assert (rig.enabled(), rig.kit.state.watchdog, rig.wheels()[1:]) == (
        set(),
        ReleaseReason.COUNTER,
        (0.0, WATCHDOG_BRAKE),
    )


@pytest.mark.parametrize(
    ("generation", "step", "is_right"), [(1, 1, True), (1, 2, False), (1, 255, False), (2, 5, True)]
)
def test_how_counters_count(generation: int, step: int, is_right: bool) -> None:
    """Generation 1's counter goes up by one each time; generation 2's has only to differ."""
    rig = driving(generation)
    rig.hand.count += step - 1
    rig.command()
    assert rig.enabled() == (ALL if is_right else set())


def test_a_counter_runs_over() -> None:
    """After 255 comes 0 (generation 1), and after 15 (generation 2): ten seconds of driving show nothing."""
    for generation in (1, 2):
        rig = driving(generation)
        rig.drive_ms(10_000)
        assert rig.enabled() == ALL


def test_a_wrong_checksum_trips_the_watchdog() -> None:
    """Each command of generation 2 with a wrong checksum is not obeyed, is told as bad_crc, and the kit brakes."""
    for part in range(3):
        rig = driving(2)
        frames = rig.hand.commands(Asked(angle_deg=50.0, throttle=0.5))
        rig.send(with_crc_broken(frames[part]))
        assert (rig.enabled(), rig.kit.state.watchdog, rig.kit.state.system) == (
            set(),
            ReleaseReason.CRC,
            SystemState.FAULT,
        )
        assert [rig.kit.state.actuators[axis].is_crc_bad for axis in ("steering", "brake", "throttle")] == [
            index == part for index in range(3)
        ]
        assert rig.wheels()[1:] == (0.0, WATCHDOG_BRAKE)


def test_wrong_checksums_do_not_keep_a_kit_awake() -> None:
    """A request or a shift with a wrong checksum does nothing."""
    rig = Rig(2)
    rig.command(brake=0.5)
    assert isinstance(rig.hand, Hand2)
    rig.send(with_crc_broken(rig.hand.system(1)))
    assert rig.enabled() == set()
    rig.enable(in_drive=False)
    rig.send(with_crc_broken(rig.hand.gear(4)))
    assert rig.kit.state.gear == Gear.PARK


def test_generation_1_disabled_in_gear_or_moving_brakes() -> None:
    """In generation 1 an actuator that is disabled in gear or while the car moves trips the watchdog."""
    for in_gear, speed_mps in product((False, True), (0.0, 10.0)):
        rig = Rig(1)
        rig.enable(in_drive=in_gear)
        rig.is_moving_at(speed_mps)
        rig.command(enable=False)
        assert rig.kit.state.watchdog_brakes == (in_gear or speed_mps > 0)


@both
def test_the_watchdog_brakes_until_somebody_takes_over(generation: int) -> None:
    """The watchdog brakes, whatever is commanded, until the driver acts; cleared then, the kit can be enabled."""
    rig = driving(generation)
    rig.wait_ms(100)
    for _ in range(10):
        rig.command(throttle=1.0, clear=True)
        rig.ask()
        rig.wait_ms(20)
        assert (rig.enabled(), rig.wheels()[1:]) == (set(), (0.0, WATCHDOG_BRAKE))
    rig.wait_ms(100)
    rig.kit.driver_brakes(0.8, rig.now_ns)
    assert rig.wheels()[2] == 0.8
    rig.kit.driver_brakes(0.0, rig.now_ns)
    assert rig.wheels()[2] == 0.0
    rig.command()
    rig.ask()
    assert rig.enabled() == set()
    rig.ask(0)
    rig.command(clear=True)
    rig.ask()
    assert rig.enabled() == ALL


@both
def test_the_wheel_stays_where_it_is(generation: int) -> None:
    """When the kit lets go the steering wheel stays where it really is, not where it was to go."""
    rig = driving(generation)
    rig.command(angle_deg=90.0)
    rig.wait_ms(50)
    rig.is_moving_at(10.0, steering_rad=0.05)
    rig.wait_ms(50)
    assert rig.wheels()[0] == pytest.approx(0.05 * 14.8 * 57.29578)
    rig.wait_ms(1000)
    assert rig.wheels()[0] == pytest.approx(0.05 * 14.8 * 57.29578)
