"""Which commands are obeyed, and what happens without one."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.safety.rig import MAX_BRAKING_MPS2, TICK_NS, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.safety.limits import LIMITS

DEGRADED_NS, STOP_NS = 300 * NS_PER_MS, 500 * NS_PER_MS


def reasons(rig: Rig) -> dict[str, int]:
    return {key.removeprefix("refused: "): n for key, n in rig.gate.counts.items() if key.startswith("refused: ")}


def test_a_sound_command_is_accepted_as_it_is() -> None:
    """A command within all rules and limits reaches the vehicle unchanged, and its sequence is told."""
    rig = Rig().armed()
    rig.go(TICK_NS)
    rig.picture()
    assert rig.drive(steering_rad=0.001, throttle=0.4).accepted
    assert rig.actuation() == Actuation(0.001, 0.4, 0.0)
    assert rig.gate.applied_sequence == rig.sequence
    assert rig.gate.rejected == ""


def test_each_reason_to_reject_is_named_and_counted() -> None:
    """Each refusal names its reason, is counted under it, and leaves the command in force as it was."""
    rig = Rig().driving(throttle=0.25)
    now_ns = rig.now_ns
    forgotten_ns = rig.stamp_ns
    for changes, reason in (
        ({"epoch": rig.epoch + 1}, "not the epoch in force"),
        ({"sequence": rig.sequence}, "not newer than the last command"),
        ({"emergency_stop": 0, "sequence": 0}, "not newer than the last command"),
        ({"stamp_ns": 0}, "a stamp that this server did not write lately"),
        ({"stamp_ns": forgotten_ns + 1}, "a stamp that this server did not write lately"),
        ({"mode": "arm", "throttle": 0.0}, "the vehicle is armed already"),
    ):
        before = reasons(rig).get(reason, 0)
        verdict = rig.drive(**changes)
        assert (verdict.accepted, verdict.reason) == (False, reason)
        assert rig.gate.rejected == reason
        assert reasons(rig)[reason] == before + 1
    assert rig.now_ns == now_ns
    assert rig.actuation().throttle == 0.25


def test_a_drive_command_is_rejected_until_the_vehicle_is_armed() -> None:
    """Disarmed and stopped, a drive command is refused and nothing moves."""
    rig = Rig().hold()
    rig.picture()
    assert rig.drive().reason == "the vehicle is not armed"
    assert rig.actuation() == Actuation(0.0, 0.0, 1.0)


@pytest.mark.parametrize(("late_ns", "accepted"), [(0, True), (1, False)])
def test_a_picture_may_be_500_ms_old_and_no_more(late_ns: int, *, accepted: bool) -> None:
    """A command from a picture of 500 ms is obeyed, from one a nanosecond older refused."""
    rig = Rig().hold()
    stamp_ns = rig.picture()
    rig.go(LIMITS.picture_age_limit_ns + late_ns)
    verdict = rig.send(stamp_ns=stamp_ns)
    assert verdict.accepted is accepted
    assert accepted or verdict.reason == "made from a picture that is too old"


@pytest.mark.parametrize(
    ("late_ns", "reason"),
    [(0, "made from a picture that is too old"), (1, "a stamp that this server did not write lately")],
)
def test_stamps_are_known_for_5_s(late_ns: int, reason: str) -> None:
    """After 5 s the server no longer knows what it wrote, whatever is written meanwhile."""
    rig = Rig().hold()
    stamp_ns = rig.picture()
    rig.go(5 * NS_PER_S + late_ns)
    assert rig.send(stamp_ns=stamp_ns).reason == reason
    rig.picture()
    assert rig.send(stamp_ns=stamp_ns).reason == reason


def test_a_simulated_vehicle_may_take_pictures_of_2_s() -> None:
    """With the limit set to 2 s a command from a picture of 2 s is obeyed, and the watchdog stays where it was."""
    rig = Rig(replace(LIMITS, picture_age_limit_ns=2 * NS_PER_S)).hold()
    stamp_ns = rig.picture()
    rig.go(2 * NS_PER_S)
    assert rig.send(stamp_ns=stamp_ns).accepted
    rig.go(1)
    assert rig.send(stamp_ns=stamp_ns).reason == "made from a picture that is too old"
    rig = Rig(replace(LIMITS, picture_age_limit_ns=2 * NS_PER_S)).driving()
    rig.go(STOP_NS)
    assert rig.state == "safe_stop"


@pytest.mark.parametrize(
    ("since_command_ns", "state"),
    [(DEGRADED_NS - 1, "driving"), (DEGRADED_NS, "degraded"), (STOP_NS - 1, "degraded"), (STOP_NS, "safe_stop")],
)
def test_silence_degrades_at_300_ms_and_stops_at_500_ms(since_command_ns: int, state: str) -> None:
    """Exactly 300 ms after the last command from a newer picture it is degraded, exactly after 500 ms it stops."""
    rig = Rig().driving()
    rig.go(since_command_ns)
    assert rig.state == state


def test_the_watchdog_needs_no_wake() -> None:
    """A command that comes 500 ms after the last one finds a stopped vehicle, also when nobody has looked meanwhile."""
    for since_command_ns, state in ((DEGRADED_NS - 1, "driving"), (STOP_NS, "safe_stop")):
        rig = Rig().driving()
        rig.picture()
        rig.now_ns += since_command_ns
        assert rig.drive().accepted == (state == "driving")
        assert rig.state == state


def test_repeated_stamps_do_not_keep_the_vehicle_alive() -> None:
    """A client that sends commands from one and the same picture is taken for silent."""
    rig = Rig().driving()
    for _ in range(STOP_NS // TICK_NS - 1):
        rig.go(TICK_NS)
        rig.drive()
    assert rig.state == "degraded"
    assert rig.actuation().throttle == 0.0
    rig.go(TICK_NS)
    assert rig.state == "safe_stop"


def test_an_older_picture_does_not_keep_the_vehicle_alive() -> None:
    """Going back and forth between pictures already used is as silent as repeating one."""
    rig = Rig().armed()
    stamps = []
    for _ in range(5):
        rig.go(TICK_NS)
        stamps.append(rig.picture())
    assert rig.drive(stamp_ns=stamps[-1]).accepted
    for number in range(STOP_NS // TICK_NS):
        rig.go(TICK_NS)
        rig.drive(stamp_ns=stamps[number % 5])
    assert rig.state == "safe_stop"


@pytest.mark.parametrize("step_ns", [-NS_PER_S, NS_PER_S])
def test_a_step_of_the_wall_clock_changes_nothing(step_ns: int) -> None:
    """Newer is a higher frame number: with stamps a second back or ahead it drives on, and stops as before."""
    rig = Rig().driving()
    rig.wall_step_ns = step_ns
    for _ in range(100):
        rig.go(TICK_NS)
        rig.picture()
        assert rig.drive().accepted
        assert rig.state == "driving"
    rig.go(STOP_NS)
    assert rig.state == "safe_stop"


def test_degraded_takes_the_throttle_away_and_brakes_gently() -> None:
    """Degraded: no throttle, 1 m/s2; a newer picture ends it."""
    rig = Rig().driving(steering_rad=0.0, throttle=1.0)
    rig.vehicle = vehicle_at(8.0)
    rig.go(DEGRADED_NS)
    assert rig.actuation().throttle == 0.0
    assert rig.actuation().brake == pytest.approx(1.0 / MAX_BRAKING_MPS2)
    rig.picture()
    assert rig.drive(throttle=0.75).accepted
    assert rig.state == "driving"
    assert rig.actuation().throttle == 0.75


def test_a_stop_harder_than_the_brakes_is_full_brake() -> None:
    """A stop that asks for more deceleration than the vehicle has presses the pedal fully and no further."""
    rig = Rig(replace(LIMITS, stop_deceleration_mps2=MAX_BRAKING_MPS2 + 1)).driving()
    rig.vehicle = vehicle_at(8.0)
    rig.go(STOP_NS)
    assert (rig.state, rig.actuation().brake) == ("safe_stop", 1.0)


def test_silence_never_eases_a_brake() -> None:
    """A client that was braking hard when it fell silent goes on braking as hard."""
    rig = Rig().driving(throttle=0.0, brake=0.9)
    rig.go(DEGRADED_NS)
    assert rig.state == "degraded"
    assert rig.actuation().brake == 0.9


def test_degraded_accepts_no_command_from_a_picture_already_used() -> None:
    """300 ms without a newer picture there is no command at all: what comes from an old one does not even steer."""
    rig = Rig().driving(steering_rad=0.02)
    rig.go(TICK_NS)
    rig.actuation()
    rig.go(TICK_NS)
    assert rig.actuation().steering_rad == 0.02
    rig.go(DEGRADED_NS)
    assert rig.drive(steering_rad=-0.3).reason == "not made from a newer picture"
    rig.go(TICK_NS)
    assert rig.actuation().steering_rad == 0.02


def test_safe_stop_is_latched_under_a_new_epoch() -> None:
    """500 ms: 4 m/s2, and whatever was sent under the old epoch is refused however fresh; only arming leads out."""
    rig = Rig().driving()
    rig.vehicle = vehicle_at(8.0)
    rig.go(STOP_NS)
    assert rig.actuation().throttle == 0.0
    assert rig.actuation().brake == pytest.approx(4.0 / MAX_BRAKING_MPS2)
    rig.picture()
    assert rig.drive().reason == "not the epoch in force"
    old_epoch = rig.epoch
    assert rig.ask("hold").epoch != old_epoch
    assert rig.drive().reason == "the vehicle is not armed"
    assert rig.send().reason == "arming needs standstill"
    for _ in range(50):
        rig.go(TICK_NS)
        rig.picture()
        rig.drive()
        rig.send(epoch=old_epoch)
    assert rig.state == "safe_stop"
    rig.vehicle = vehicle_at()
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"


def test_nothing_queued_in_an_outage_is_accepted_after_it() -> None:
    """Three seconds of commands that arrive in one burst after the outage are all refused."""
    rig = Rig().driving()
    queued = []
    for _ in range(150):
        rig.go(TICK_NS)
        rig.picture()
        queued.append(rig.command(mode="drive", throttle=1.0, brake=0.0))
    verdicts = [rig.gate.admit(command, rig.vehicle, rig.now_ns) for command in queued]
    assert not any(verdict.accepted for verdict in verdicts)
    assert rig.state == "safe_stop"


def test_the_client_can_ask_for_a_stop() -> None:
    """A command of mode stop leads from driving and from degraded to the safe stop."""
    for since_command_ns in (0, DEGRADED_NS):
        rig = Rig().driving()
        rig.go(since_command_ns)
        assert rig.send(mode="stop").accepted
        assert rig.state == "safe_stop"


def test_the_end_of_a_drive_stops_the_vehicle() -> None:
    """When the drive is over the vehicle stops for safety."""
    rig = Rig().driving()
    rig.gate.end_drive()
    assert rig.state == "safe_stop"


def test_of_two_commands_in_one_nanosecond_the_later_sequence_holds() -> None:
    """Commands that arrive together are taken by their sequence; the one that was overtaken is refused."""
    rig = Rig().armed()
    rig.picture()
    first, second = (rig.command(mode="drive", throttle=throttle, brake=0.0) for throttle in (0.2, 0.6))
    assert rig.gate.admit(second, rig.vehicle, rig.now_ns).accepted
    assert not rig.gate.admit(first, rig.vehicle, rig.now_ns).accepted
    assert rig.actuation().throttle == 0.6


@pytest.mark.parametrize("start", ["driving", "degraded"])
def test_five_equal_pictures_are_a_camera_fault(start: str) -> None:
    """Four equal pictures are an accident, the fifth stops the vehicle, though each has a stamp of its own."""
    rig = Rig().driving()
    rig.go(DEGRADED_NS if start == "degraded" else 0)
    for number in range(1, 6):
        assert rig.state == start
        rig.picture(crc=-1)
        rig.go(NS_PER_MS)
        assert (rig.state == "safe_stop") == (number == 5)
    assert "same picture" in rig.gate.reason


def test_nothing_wakes_the_gate_while_nobody_drives() -> None:
    """The gate wants the clock looked at while arming, driving and degraded, and not otherwise."""
    rig = Rig().hold()
    assert rig.gate.next_wake_ns() is None
    rig.arm_for(NS_PER_S)
    assert rig.gate.next_wake_ns() == rig.now_ns + DEGRADED_NS
    rig.go(DEGRADED_NS)
    assert rig.gate.next_wake_ns() == rig.now_ns + STOP_NS - DEGRADED_NS
    rig.go(STOP_NS)
    assert rig.gate.next_wake_ns() is None
