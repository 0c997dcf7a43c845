"""Accepted and rejected commands, and command timeouts."""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.safety.rig import COMMAND_PERIOD_NS, MAX_BRAKING_MPS2, Rig, vehicle_at

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.safety.gate import RejectionReason
from lavt.safety.limits import LIMITS

DEGRADED_NS, STOP_NS = 300 * NS_PER_MS, 500 * NS_PER_MS


def rejection_counts(rig: Rig) -> dict[str, int]:
    return {
        key.removeprefix("rejected: "): count for key, count in rig.gate.counts.items() if key.startswith("rejected: ")
    }


def test_a_valid_command_is_accepted_unchanged() -> None:
    """A valid command within all limits reaches the vehicle unchanged."""
    rig = Rig().arm()
    rig.pass_time(COMMAND_PERIOD_NS)
    rig.take_picture()
    assert rig.send_drive(steering_rad=0.001, throttle=0.4).accepted
    assert rig.actuation() == Actuation(0.001, 0.4, 0.0)
    assert rig.gate.epoch.sequence == rig.sequence
    assert rig.gate.last_rejection == ""


def test_a_rejected_command_has_a_reason_and_is_counted() -> None:
    """A rejected command has a reason, is counted under that reason, and does not replace the last command."""
    rig = Rig().start_driving(throttle=0.25)
    now_ns = rig.now_ns
    newest_stamp_ns = rig.stamp_ns
    for changes, reason in (
        ({"epoch": rig.epoch + 1}, RejectionReason.WRONG_EPOCH),
        ({"sequence": rig.sequence}, RejectionReason.OLD_SEQUENCE),
        ({"emergency_stop": 0, "sequence": 0}, RejectionReason.OLD_SEQUENCE),
        ({"stamp_ns": 0}, RejectionReason.UNKNOWN_STAMP),
        ({"stamp_ns": newest_stamp_ns + 1}, RejectionReason.UNKNOWN_STAMP),
        ({"mode": "arm", "throttle": 0.0}, RejectionReason.ALREADY_ARMED),
    ):
        before = rejection_counts(rig).get(reason, 0)
        verdict = rig.send_drive(**changes)
        assert (verdict.accepted, verdict.reason) == (False, reason)
        assert rig.gate.last_rejection == verdict.message == reason.value
        assert rejection_counts(rig)[reason] == before + 1
    assert rig.now_ns == now_ns
    assert rig.actuation().throttle == 0.25


def test_a_drive_command_is_rejected_until_the_vehicle_is_armed() -> None:
    """A drive command to a vehicle that is not armed is rejected, and the vehicle stays braked."""
    rig = Rig().acquire()
    rig.take_picture()
    assert rig.send_drive().reason == RejectionReason.NOT_ARMED
    assert rig.actuation() == Actuation(0.0, 0.0, 1.0)


@pytest.mark.parametrize(("late_ns", "accepted"), [(0, True), (1, False)])
def test_a_command_from_a_picture_older_than_500_ms_is_rejected(late_ns: int, *, accepted: bool) -> None:
    """A command from a picture older than 500 ms is rejected."""
    rig = Rig().acquire()
    stamp_ns = rig.take_picture()
    rig.pass_time(LIMITS.picture_age_limit_ns + late_ns)
    verdict = rig.send(stamp_ns=stamp_ns)
    assert verdict.accepted is accepted
    assert accepted or verdict.reason == RejectionReason.PICTURE_TOO_OLD


@pytest.mark.parametrize(("late_ns", "accepted"), [(0, True), (1, False)])
def test_the_age_of_a_picture_counts_from_its_capture(late_ns: int, *, accepted: bool) -> None:
    """A picture that was stamped 200 ms after its capture is too old 300 ms after its stamp."""
    rig = Rig().acquire()
    captured_ns = rig.now_ns
    rig.pass_time(200 * NS_PER_MS)
    stamp_ns = rig.take_picture(captured_ns=captured_ns)
    rig.pass_time(LIMITS.picture_age_limit_ns - 200 * NS_PER_MS + late_ns)
    verdict = rig.send(stamp_ns=stamp_ns)
    assert verdict.accepted is accepted
    assert accepted or verdict.reason == RejectionReason.PICTURE_TOO_OLD


def test_the_stopping_speed_limit_counts_from_the_capture() -> None:
    """The later the camera delivers a picture, the harder a vehicle above the stopping speed limit brakes."""
    pedals = []
    for sensor_delay_ns in (0, 400 * NS_PER_MS):
        rig = Rig().arm()
        rig.vehicle = vehicle_at(speed_mps=11.0)
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture(captured_ns=rig.now_ns - sensor_delay_ns)
        assert rig.send_drive().accepted
        pedals.append(rig.actuation().brake)
    undelayed, delayed = pedals
    assert undelayed < delayed


@pytest.mark.parametrize(
    ("late_ns", "reason"),
    [(0, RejectionReason.PICTURE_TOO_OLD), (1, RejectionReason.UNKNOWN_STAMP)],
)
def test_stamps_are_known_for_5_s(late_ns: int, reason: str) -> None:
    """A stamp issued more than 5 s ago is unknown."""
    rig = Rig().acquire()
    stamp_ns = rig.take_picture()
    rig.pass_time(5 * NS_PER_S + late_ns)
    assert rig.send(stamp_ns=stamp_ns).reason == reason
    rig.take_picture()
    assert rig.send(stamp_ns=stamp_ns).reason == reason


def test_a_picture_age_limit_of_2_s() -> None:
    """With a limit of 2 s, commands from pictures of that age are accepted; the command timeout remains 500 ms."""
    rig = Rig(replace(LIMITS, picture_age_limit_ns=2 * NS_PER_S)).acquire()
    stamp_ns = rig.take_picture()
    rig.pass_time(2 * NS_PER_S)
    assert rig.send(stamp_ns=stamp_ns).accepted
    rig.pass_time(1)
    assert rig.send(stamp_ns=stamp_ns).reason == RejectionReason.PICTURE_TOO_OLD
    rig = Rig(replace(LIMITS, picture_age_limit_ns=2 * NS_PER_S)).start_driving()
    rig.pass_time(STOP_NS)
    assert rig.state == "safe_stop"


@pytest.mark.parametrize(
    ("since_command_ns", "state"),
    [(DEGRADED_NS - 1, "driving"), (DEGRADED_NS, "degraded"), (STOP_NS - 1, "degraded"), (STOP_NS, "safe_stop")],
)
def test_command_timeout_degrades_at_300_ms_and_stops_at_500_ms(since_command_ns: int, state: str) -> None:
    """The vehicle is degraded exactly 300 ms, and stops exactly 500 ms, after the last fresh command."""
    rig = Rig().start_driving()
    rig.pass_time(since_command_ns)
    assert rig.state == state


def test_the_watchdog_needs_no_wake() -> None:
    """A command that arrives 500 ms after the last one is rejected, even if the watchdog was not woken before."""
    for since_command_ns, state in ((DEGRADED_NS - 1, "driving"), (STOP_NS, "safe_stop")):
        rig = Rig().start_driving()
        rig.take_picture()
        rig.now_ns += since_command_ns
        assert rig.send_drive().accepted == (state == "driving")
        assert rig.state == state


def test_repeated_stamps_do_not_reset_the_command_timeout() -> None:
    """Commands that repeat the same stamp do not reset the command timeout."""
    rig = Rig().start_driving()
    for _ in range(STOP_NS // COMMAND_PERIOD_NS - 1):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.send_drive()
    assert rig.state == "degraded"
    assert rig.actuation().throttle == 0.0
    rig.pass_time(COMMAND_PERIOD_NS)
    assert rig.state == "safe_stop"


def test_older_pictures_do_not_reset_the_command_timeout() -> None:
    """Commands that alternate between pictures already used do not reset the command timeout."""
    rig = Rig().arm()
    stamps = []
    for _ in range(5):
        rig.pass_time(COMMAND_PERIOD_NS)
        stamps.append(rig.take_picture())
    assert rig.send_drive(stamp_ns=stamps[-1]).accepted
    for number in range(STOP_NS // COMMAND_PERIOD_NS):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.send_drive(stamp_ns=stamps[number % 5])
    assert rig.state == "safe_stop"


@pytest.mark.parametrize("step_ns", [-NS_PER_S, NS_PER_S])
def test_a_step_of_the_wall_clock_changes_nothing(step_ns: int) -> None:
    """After a wall clock step of 1 s in either direction, commands and timeouts work as before."""
    rig = Rig().start_driving()
    rig.wall_step_ns = step_ns
    for _ in range(100):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture()
        assert rig.send_drive().accepted
        assert rig.state == "driving"
    rig.pass_time(STOP_NS)
    assert rig.state == "safe_stop"


def test_degraded_removes_the_throttle_and_brakes_gently() -> None:
    """A degraded vehicle has no throttle and brakes with 1 m/s2; a fresh command ends this state."""
    rig = Rig().start_driving(steering_rad=0.0, throttle=1.0)
    rig.vehicle = vehicle_at(8.0)
    rig.pass_time(DEGRADED_NS)
    assert rig.actuation().throttle == 0.0
    assert rig.actuation().brake == pytest.approx(1.0 / MAX_BRAKING_MPS2)
    rig.take_picture()
    assert rig.send_drive(throttle=0.75).accepted
    assert rig.state == "driving"
    assert rig.actuation().throttle == 0.75


def test_a_stop_harder_than_the_brakes_is_full_brake() -> None:
    """A stop whose deceleration exceeds what the brakes can do applies full brake."""
    rig = Rig(replace(LIMITS, stop_deceleration_mps2=MAX_BRAKING_MPS2 + 1)).start_driving()
    rig.vehicle = vehicle_at(8.0)
    rig.pass_time(STOP_NS)
    assert (rig.state, rig.actuation().brake) == ("safe_stop", 1.0)


def test_a_command_timeout_never_releases_a_brake() -> None:
    """A command timeout never releases a brake that the last command applied."""
    rig = Rig().start_driving(throttle=0.0, brake=0.9)
    rig.pass_time(DEGRADED_NS)
    assert rig.state == "degraded"
    assert rig.actuation().brake == 0.9


def test_degraded_accepts_no_command_from_a_picture_already_used() -> None:
    """A degraded vehicle accepts no command from a picture already used, not even its steering."""
    rig = Rig().start_driving(steering_rad=0.02)
    rig.pass_time(COMMAND_PERIOD_NS)
    rig.actuation()
    rig.pass_time(COMMAND_PERIOD_NS)
    assert rig.actuation().steering_rad == 0.02
    rig.pass_time(DEGRADED_NS)
    assert rig.send_drive(steering_rad=-0.3).reason == RejectionReason.PICTURE_NOT_NEWER
    rig.pass_time(COMMAND_PERIOD_NS)
    assert rig.actuation().steering_rad == 0.02


def test_safe_stop_is_latched_under_a_new_epoch() -> None:
    """A safe stop brakes with 4 m/s2 under a new epoch; only arming ends the stop."""
    rig = Rig().start_driving()
    rig.vehicle = vehicle_at(8.0)
    rig.pass_time(STOP_NS)
    assert rig.actuation().throttle == 0.0
    assert rig.actuation().brake == pytest.approx(4.0 / MAX_BRAKING_MPS2)
    rig.take_picture()
    assert rig.send_drive().reason == RejectionReason.WRONG_EPOCH
    old_epoch = rig.epoch
    assert rig.request("acquire").epoch != old_epoch
    assert rig.send_drive().reason == RejectionReason.NOT_ARMED
    assert rig.send().reason == RejectionReason.NOT_STATIONARY
    for _ in range(50):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture()
        rig.send_drive()
        rig.send(epoch=old_epoch)
    assert rig.state == "safe_stop"
    rig.vehicle = vehicle_at()
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"


def test_nothing_queued_in_an_outage_is_accepted_after_it() -> None:
    """The commands that were sent in an outage of 3 s, and arrive in one burst after the outage, are all rejected."""
    rig = Rig().start_driving()
    queued = []
    for _ in range(150):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture()
        queued.append(rig.command(mode="drive", throttle=1.0, brake=0.0))
    verdicts = [rig.gate.admit(command, rig.vehicle, rig.now_ns, rig.now_ns) for command in queued]
    assert not any(verdict.accepted for verdict in verdicts)
    assert rig.state == "safe_stop"


def test_the_client_can_request_a_stop() -> None:
    """A stop command leads from driving and from degraded to the safe stop."""
    for since_command_ns in (0, DEGRADED_NS):
        rig = Rig().start_driving()
        rig.pass_time(since_command_ns)
        assert rig.send(mode="stop").accepted
        assert rig.state == "safe_stop"


def test_the_end_of_a_drive_stops_the_vehicle() -> None:
    """The end of a drive leads to the safe stop."""
    rig = Rig().start_driving()
    rig.gate.machine.trigger("drive over")
    assert rig.state == "safe_stop"


def test_a_reordered_command_is_rejected() -> None:
    """Of two commands that arrive in the wrong order, the one with the lower sequence number is rejected."""
    rig = Rig().arm()
    rig.take_picture()
    first, second = (rig.command(mode="drive", throttle=throttle, brake=0.0) for throttle in (0.2, 0.6))
    assert rig.gate.admit(second, rig.vehicle, rig.now_ns, rig.now_ns).accepted
    assert not rig.gate.admit(first, rig.vehicle, rig.now_ns, rig.now_ns).accepted
    assert rig.actuation().throttle == 0.6


@pytest.mark.parametrize("start", ["driving", "degraded"])
def test_five_equal_pictures_are_a_camera_fault(start: str) -> None:
    """Five equal pictures in a row stop the vehicle, though each has its own stamp; four do not."""
    rig = Rig().start_driving()
    rig.pass_time(DEGRADED_NS if start == "degraded" else 0)
    for number in range(1, 6):
        assert rig.state == start
        rig.take_picture(crc=-1)
        rig.pass_time(NS_PER_MS)
        assert (rig.state == "safe_stop") == (number == 5)
    assert "same picture" in rig.gate.machine.reason


def test_the_watchdog_requests_wakes_while_active_only() -> None:
    """The watchdog requests a wake in the states driving and degraded, and none when disarmed or stopped."""
    rig = Rig().acquire()
    assert rig.gate.watchdog.next_wake_ns() is None
    rig.arm_for(NS_PER_S)
    assert rig.gate.watchdog.next_wake_ns() == rig.now_ns + DEGRADED_NS
    rig.pass_time(DEGRADED_NS)
    assert rig.gate.watchdog.next_wake_ns() == rig.now_ns + STOP_NS - DEGRADED_NS
    rig.pass_time(STOP_NS)
    assert rig.gate.watchdog.next_wake_ns() is None
