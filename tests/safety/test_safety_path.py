"""How the vehicle steers by itself: along the path of the last command, from what it knows of its own way."""

# ruff: noqa: D102 (a bench for tests: short methods say themselves what they do)

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.safety.rig import TICK_NS, WHEELBASE_M, Rig, vehicle_at

from lavt.control.pure_pursuit import steering_rad
from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.safety.limits import LIMITS

DEGRADED_NS, STOP_NS = LIMITS.degraded_after_ns, LIMITS.stop_after_ns
LEFT = (0.02,) * 10
LEFT_RAD = steering_rad(0.02, WHEELBASE_M)
LATER_LEFT = (0.0,) * 5 + (0.02,) * 5
"""Straight for 10 m, then left."""


class Moving(Rig):
    """A rig whose vehicle goes on at one speed, with the wheel where it was asked to be."""

    def roll(self, duration_ns: int, speed_mps: float = 8.0) -> Actuation:
        """Let so much time pass, looked at every tick; tell the last actuation."""
        requested = self.see(speed_mps)
        for _ in range(duration_ns // TICK_NS):
            self.go(TICK_NS)
            requested = self.see(speed_mps)
        return requested

    def see(self, speed_mps: float) -> Actuation:
        angle_rad = self.gate.limiter.target_rad(self.vehicle)
        self.vehicle = replace(vehicle_at(speed_mps, angle_rad), mono_ns=self.now_ns)
        return self.actuation()

    def on(self, path: tuple[float, ...], angle_rad: float = 0.0) -> Moving:
        """Drive at 8 m/s with one command that means to follow `path`."""
        self.armed()
        self.roll(TICK_NS)
        self.picture()
        assert self.drive(steering_rad=angle_rad, path_curvature_per_m=path).accepted
        return self


def test_while_commanded_the_command_steers() -> None:
    """Until the silence is one, the wheel is where the command has it, whatever path it has with it."""
    assert Moving().on(LEFT, 0.01).roll(280 * NS_PER_MS).steering_rad == 0.01


@pytest.mark.parametrize(("since_command_ns", "state"), [(400 * NS_PER_MS, "degraded"), (600 * NS_PER_MS, "safe_stop")])
def test_silence_steers_along_the_path(since_command_ns: int, state: str) -> None:
    """Degraded and safe stop steer to where the last command's path bends: more than it does, being beside it."""
    rig = Moving().on(LEFT)
    requested = rig.roll(since_command_ns)
    assert rig.state == state
    assert LEFT_RAD < requested.steering_rad < 3 * LEFT_RAD


def test_the_wheel_turns_where_the_path_does() -> None:
    """On a path that bends after 10 m the wheel is straight while that is far, and at its angle 10 m after it."""
    rig = Moving().on(LATER_LEFT)
    assert abs(rig.roll(500 * NS_PER_MS).steering_rad) < 0.002
    assert rig.state == "safe_stop"
    assert rig.roll(2 * NS_PER_S).steering_rad == pytest.approx(LEFT_RAD, rel=0.1)


def test_an_emergency_stop_follows_the_path_at_full_brake() -> None:
    """An emergency stop brakes with all there is and steers as a safe stop does."""
    rig = Moving().on(LEFT)
    rig.roll(TICK_NS)
    assert rig.ask("emergency_stop", who="bob", number=1).granted
    requested = rig.roll(500 * NS_PER_MS)
    assert rig.state == "emergency_stop"
    assert (requested.throttle, requested.brake) == (0.0, 1.0)
    assert requested.steering_rad == pytest.approx(LEFT_RAD, rel=0.1)


@pytest.mark.parametrize("stop", ["stop", "release", "end_drive"])
def test_every_stop_follows_the_path(stop: str) -> None:
    """Asked to stop, released, or with the drive over, the vehicle goes along the last path too."""
    rig = Moving().on(LEFT)
    if stop == "stop":
        rig.send(mode="stop")
    elif stop == "release":
        rig.ask("release")
    else:
        rig.gate.end_drive()
    assert rig.roll(500 * NS_PER_MS).steering_rad == pytest.approx(LEFT_RAD, rel=0.1)


def test_without_a_path_the_wheel_is_held() -> None:
    """Armed and pushed before any drive command, the vehicle stops with the wheel where it is."""
    rig = Moving()
    rig.vehicle = vehicle_at(0.0, 0.05)
    rig.armed()
    assert rig.roll(NS_PER_S).steering_rad == 0.05
    assert rig.state == "safe_stop"


def test_at_standstill_the_path_is_over() -> None:
    """Once the stopped vehicle stands its wheel stays, and who moves it then does not find it steering by itself."""
    rig = Moving().on(LATER_LEFT)
    rig.roll(STOP_NS)
    before = rig.roll(TICK_NS, speed_mps=0.0).steering_rad
    assert rig.roll(2 * NS_PER_S).steering_rad == before


def test_a_new_drive_never_uses_an_old_path() -> None:
    """Armed anew and silent at once, the vehicle holds the wheel, though the gate never saw it stand in between."""
    rig = Moving().on(LEFT)
    rig.roll(STOP_NS)
    rig.ask("hold")
    rig.vehicle = replace(vehicle_at(0.0, 0.0), mono_ns=rig.now_ns)
    rig.arm_for(NS_PER_S)
    assert rig.state == "driving"
    assert rig.roll(NS_PER_S).steering_rad == 0.0
    assert rig.state == "safe_stop"


def test_the_path_lies_where_its_picture_was_taken() -> None:
    """A path that bends after 10 m, from a picture of 8 m ago, bends now; one from a picture of now is straight on."""
    said_rad = []
    for age_ns in (0, NS_PER_S):
        rig = Moving(replace(LIMITS, picture_age_limit_ns=2 * NS_PER_S, degraded_after_ns=2 * NS_PER_S))
        rig.armed()
        rig.roll(TICK_NS)
        stamp_ns = rig.picture()
        rig.roll(age_ns)
        assert rig.drive(stamp_ns=stamp_ns, steering_rad=0.0, path_curvature_per_m=LATER_LEFT).accepted
        rig.picture()
        assert rig.send(mode="stop").accepted
        said_rad.append(rig.roll(200 * NS_PER_MS).steering_rad)
    assert abs(said_rad[0]) < 0.002
    assert said_rad[1] > 0.01


def test_the_older_the_picture_the_slower() -> None:
    """At 10 m/s a command keeps its throttle until its picture is 0.25 s old, and is braked after that."""
    rig = Moving().on((0.0,) * 10)
    assert rig.roll(240 * NS_PER_MS, 10.0).throttle == 0.5
    requested = rig.roll(40 * NS_PER_MS, 10.0)
    assert (rig.state, rig.gate.limiter.changed) == ("driving", ("sight",))
    assert requested.throttle == 0.0
    assert requested.brake > 0.0
