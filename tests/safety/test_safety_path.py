"""Steering without commands: along the path of the last command, by odometry."""

# ruff: noqa: D102 (a test helper with short methods)

from __future__ import annotations

from dataclasses import replace

import msgspec
import pytest
from tests.safety.rig import COMMAND_PERIOD_NS, WHEELBASE_M, Rig, vehicle_at

from lavt.control.pure_pursuit import steering_rad
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.safety.limits import LIMITS

DEGRADED_NS, STOP_NS = LIMITS.degraded_after_ns, LIMITS.stop_after_ns
LEFT = (0.02,) * 10
LEFT_RAD = steering_rad(0.02, WHEELBASE_M)
LATER_LEFT = (0.0,) * 5 + (0.02,) * 5
"""Straight for 10 m, then left."""


class MovingRig(Rig):
    """A rig whose vehicle moves at constant speed, with the wheel at its target."""

    def roll(self, duration_ns: int, speed_mps: float = 8.0) -> Actuation:
        """Let time pass with an actuation every `COMMAND_PERIOD_NS`, and return the last actuation."""
        requested = self.step(speed_mps)
        for _ in range(duration_ns // COMMAND_PERIOD_NS):
            self.pass_time(COMMAND_PERIOD_NS)
            requested = self.step(speed_mps)
        return requested

    def step(self, speed_mps: float) -> Actuation:
        angle_rad = self.gate.limiter.target_rad(self.vehicle)
        self.vehicle = msgspec.structs.replace(vehicle_at(speed_mps, angle_rad), mono_ns=self.now_ns)
        return self.actuation()

    def drive_on(self, path: tuple[float, ...], angle_rad: float = 0.0) -> MovingRig:
        """Drive at 8 m/s with one command whose path is `path`."""
        self.arm()
        self.roll(COMMAND_PERIOD_NS)
        self.take_picture()
        assert self.send_drive(steering_rad=angle_rad, path_curvature_per_m=path).accepted
        return self


def test_before_the_timeout_the_command_steers() -> None:
    """Before the timeout, steering follows the last command, whatever its path."""
    assert MovingRig().drive_on(LEFT, 0.01).roll(280 * NS_PER_MS).steering_rad == 0.01


@pytest.mark.parametrize(("since_command_ns", "state"), [(400 * NS_PER_MS, "degraded"), (600 * NS_PER_MS, "safe_stop")])
def test_a_command_timeout_steers_along_the_path(since_command_ns: int, state: str) -> None:
    """In the degraded state and in the safe stop, the vehicle steers along the last command's path."""
    rig = MovingRig().drive_on(LEFT)
    requested = rig.roll(since_command_ns)
    assert rig.state == state
    assert LEFT_RAD < requested.steering_rad < 3 * LEFT_RAD


def test_the_wheel_turns_where_the_path_bends() -> None:
    """On a path that bends after 10 m the wheel is straight before the bend and turned after it."""
    rig = MovingRig().drive_on(LATER_LEFT)
    assert abs(rig.roll(500 * NS_PER_MS).steering_rad) < 0.002
    assert rig.state == "safe_stop"
    assert rig.roll(2 * NS_PER_S).steering_rad == pytest.approx(LEFT_RAD, rel=0.1)


def test_an_emergency_stop_follows_the_path_at_full_brake() -> None:
    """An emergency stop applies full brake and follows the path."""
    rig = MovingRig().drive_on(LEFT)
    rig.roll(COMMAND_PERIOD_NS)
    assert rig.request("emergency_stop", who="bob", number=1).granted
    requested = rig.roll(500 * NS_PER_MS)
    assert rig.state == "emergency_stop"
    assert (requested.throttle, requested.brake) == (0.0, 1.0)
    assert requested.steering_rad == pytest.approx(LEFT_RAD, rel=0.1)


@pytest.mark.parametrize("stop", ["stop", "release", "end_drive"])
def test_every_stop_follows_the_path(stop: str) -> None:
    """A requested stop, a release and the end of the drive follow the path as well."""
    rig = MovingRig().drive_on(LEFT)
    if stop == "stop":
        rig.send(mode="stop")
    elif stop == "release":
        rig.request("release")
    else:
        rig.gate.machine.trigger("drive over")
    assert rig.roll(500 * NS_PER_MS).steering_rad == pytest.approx(LEFT_RAD, rel=0.1)


def test_without_a_path_the_wheel_is_held() -> None:
    """An armed vehicle that moves before any drive command stops with its wheel still."""
    rig = MovingRig()
    rig.vehicle = vehicle_at(0.0, 0.05)
    rig.arm()
    assert rig.roll(NS_PER_S).steering_rad == 0.05
    assert rig.state == "safe_stop"


def test_at_standstill_the_path_is_dropped() -> None:
    """Once the stopped vehicle is stationary, its wheel stays still, also when the vehicle is moved later."""
    rig = MovingRig().drive_on(LATER_LEFT)
    rig.roll(STOP_NS)
    before = rig.roll(COMMAND_PERIOD_NS, speed_mps=0.0).steering_rad
    assert rig.roll(2 * NS_PER_S).steering_rad == before


def test_a_new_drive_never_uses_an_old_path() -> None:
    """After arming again, a command timeout does not follow the path of the previous drive."""
    rig = MovingRig().drive_on(LEFT)
    rig.roll(STOP_NS)
    rig.request("acquire")
    rig.vehicle = msgspec.structs.replace(vehicle_at(0.0, 0.0), mono_ns=rig.now_ns)
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"
    assert rig.roll(NS_PER_S).steering_rad == 0.0
    assert rig.state == "safe_stop"


def test_the_path_of_a_command_begins_where_its_picture_was_taken() -> None:
    """A path begins where its picture was taken, not where its command arrived."""
    steering_rad_by_age = []
    for age_ns in (0, NS_PER_S):
        rig = MovingRig(replace(LIMITS, picture_age_limit_ns=2 * NS_PER_S, degraded_after_ns=2 * NS_PER_S))
        rig.arm()
        rig.roll(COMMAND_PERIOD_NS)
        stamp_ns = rig.take_picture()
        rig.roll(age_ns)
        assert rig.send_drive(stamp_ns=stamp_ns, steering_rad=0.0, path_curvature_per_m=LATER_LEFT).accepted
        rig.take_picture()
        assert rig.send(mode="stop").accepted
        steering_rad_by_age.append(rig.roll(200 * NS_PER_MS).steering_rad)
    from_new_picture_rad, from_old_picture_rad = steering_rad_by_age
    assert abs(from_new_picture_rad) < 0.002
    assert from_old_picture_rad > 0.01


def test_an_old_picture_slows_the_vehicle() -> None:
    """At 9.4 m/s a command keeps its throttle at a picture age of 0.24 s; at 0.28 s the vehicle brakes instead."""
    rig = MovingRig().drive_on((0.0,) * 10)
    assert rig.roll(240 * NS_PER_MS, 9.4).throttle == 0.5
    requested = rig.roll(40 * NS_PER_MS, 9.4)
    assert (rig.state, rig.gate.limiter.applied_limits) == ("driving", ("stopping distance",))
    assert requested.throttle == 0.0
    assert requested.brake > 0.0
