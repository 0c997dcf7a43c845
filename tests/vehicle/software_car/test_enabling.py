import pytest
from tests.vehicle.software_car.rig import ALL, Asked, Hand2, Rig, both, driving, with_crc

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.state import ReleaseReason, SystemState


def test_generation_1_enables_each_axis_by_its_own_bit() -> None:
    """In generation 1 an axis obeys from its first command with EN on, and no other axis does."""
    rig = Rig(1)
    steering, _, _ = rig.hand.commands(Asked(angle_deg=10.0))
    assert rig.enabled() == set()
    rig.send(steering)
    assert rig.enabled() == {"steering"}


def test_generation_2_enables_when_requested_and_all_axes_are_commanded() -> None:
    """In generation 2 nothing obeys until the system is asked to enable and every axis is commanded with EN on."""
    rig = Rig(2)
    rig.command()
    assert (rig.enabled(), rig.kit.state.system) == (set(), SystemState.READY)
    rig.ask()
    assert (rig.enabled(), rig.kit.state.system) == (ALL, SystemState.ACTIVE)
    other = Rig(2)
    other.ask()
    steering, brake, throttle = other.hand.commands(Asked())
    other.send(steering, brake)
    assert other.enabled() == set()
    other.send(throttle)
    assert other.enabled() == ALL


def test_generation_2_forgets_a_request_to_enable_after_100_ms() -> None:
    """A request to enable holds for 100 ms: commands that come later enable nothing."""
    for wait_ms, enabled in ((99.999, ALL), (100, set())):
        rig = Rig(2)
        rig.ask()
        rig.wait_ms(wait_ms)
        rig.command()
        assert rig.enabled() == enabled


@both
def test_disabling_in_park_is_quiet(generation: int) -> None:
    """Who disables the kit in park at standstill gets it disabled, with no brake of the watchdog's."""
    rig = Rig(generation)
    rig.enable(in_drive=False)
    rig.ask(2)
    rig.command(enable=False)
    state = rig.kit.state
    assert (rig.enabled(), state.watchdog, state.watchdog_brakes) == (set(), ReleaseReason.NONE, False)


def test_generation_2_has_to_be_requested_anew() -> None:
    """Once the kit has let go, requests that were coming all along do not enable it: they have to begin anew."""
    rig = driving(2)
    rig.kit.driver_brakes(0.5, rig.now_ns)
    rig.kit.driver_brakes(0.0, rig.now_ns)
    rig.ask()
    rig.command(clear=True)
    rig.ask()
    assert (rig.enabled(), rig.kit.state.system) == (set(), SystemState.READY)
    rig.ask(2)
    rig.ask()
    assert rig.enabled() == ALL


def test_only_the_chosen_set_is_accepted() -> None:
    """A kit that obeys the remote's set does not hear the user's, and the other way round."""
    rig = Rig(2)
    rig.hand = Hand2(0x210)
    rig.command()
    rig.ask()
    assert rig.enabled() == set()
    user = Rig(2, commands="user")
    user.hand = Hand2(0x210)
    user.enable()
    assert user.enabled() == ALL


@both
def test_commands_reach_the_wheels(generation: int) -> None:
    """Angle, throttle and brake of a command reach the wheels as they were asked for."""
    rig = driving(generation)
    rig.drive_ms(1000, angle_deg=-123.4, throttle=0.3, brake=0.2)
    assert rig.wheels() == (-123.4, 0.3, 0.2)


@both
def test_the_wheel_turns_no_faster_than_requested(generation: int) -> None:
    """At 25 steps, 100 deg/s, the wheel is at 10 degrees after 100 ms; without a rate it turns at 17.5 rad/s."""
    rig = driving(generation)
    for _ in range(5):
        rig.command(angle_deg=90.0, rate=25)
        rig.wait_ms(20)
    assert rig.wheels()[0] == 10.0
    quick = driving(generation)
    quick.command(angle_deg=300.0)
    quick.wait_ms(20)
    assert quick.wheels()[0] == pytest.approx(0.02 * 17.5 * 57.29578)


@both
def test_the_wheel_begins_where_it_is(generation: int) -> None:
    """When the kit takes over it turns the wheel from where it is, not from the middle."""
    rig = Rig(generation)
    rig.is_moving_at(0.0, steering_rad=0.2)
    rig.enable()
    assert rig.wheels()[0] == pytest.approx(0.2 * 14.8 * 57.29578)


@both
def test_an_unknown_type_of_command_enables_nothing(generation: int) -> None:
    """A command of a type that the kit has not is like one without its enable bit."""
    rig = Rig(generation)
    rig.ask()
    rig.command(angle_deg=1.0)
    assert rig.enabled() == ALL
    _, brake, _ = rig.hand.commands(Asked(brake=0.5))
    data = bytearray(brake.data)
    data[2] = 7 << 4 if generation == 1 else 1 << 4 | 7
    rig.send(CanFrame(0x060, bytes(data)) if generation == 1 else with_crc(0x201, bytes(data[:-1])))
    assert rig.enabled() == (ALL - {"brake"} if generation == 1 else set())


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
    """Pedal (0.15 to 0.5), percent, torque (of 3412 Nm) and deceleration (of 6 m/s2) give that much brake."""
    rig = driving(1)
    _, brake, _ = rig.hand.commands(Asked(brake=raw))
    data = bytearray(brake.data)
    data[2] = kind << 4
    rig.send(CanFrame(brake.identifier, bytes(data)))
    assert rig.wheels()[2] == pytest.approx(fraction, abs=2e-4)


def test_a_request_with_a_counter_heard_before_is_not_heard() -> None:
    """Generation 2 does not hear a request to the system whose counter is that of the one before."""
    rig = Rig(2)
    rig.enable()
    rig.ask()
    rig.hand.count -= 1
    rig.ask(2)
    assert rig.enabled() == ALL
    rig.ask(2)
    assert rig.enabled() == set()
