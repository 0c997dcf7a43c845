"""The profile's limits are the last stage before encoding and hold for every request."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.vehicle.dbw.rig import (
    COARSE_MS,
    AdapterRig,
    both_generations,
    driving_rig,
    profile,
    stationary_rig,
    with_limits,
)

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import LEAST_GAP_NS, REPEAT_PERIOD_NS, TICK_LIMIT_NS, ByWireLimits
from lavt.vehicle.dbw.sending import DriveCommand, apply_limits
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ

LIMITS = ByWireLimits(
    steering_wheel_deg=400.0,
    steering_wheel_rate_degps=300.0,
    throttle=0.6,
    brake=0.8,
    throttle_rate_per_s=2.0,
    brake_rate_per_s=5.0,
    holding_brake=0.3,
)
STEERING = {1: 0x064, 2: 0x200}


def angles_deg(rig: AdapterRig) -> list[tuple[int, float]]:
    """Return (time, steering angle) of each steering command that was sent, decoded from bytes 0 and 1."""
    identifier = STEERING[rig.generation]
    return [
        (at_ns, int.from_bytes(frame.data[:2], "little", signed=True) / 10)
        for at_ns, frame in rig.sent
        if frame.identifier == identifier
    ]


@both_generations
def test_angle(generation: int) -> None:
    """The commanded steering angle stays within the limit on either side, and each limited command is counted."""
    rig = driving_rig(generation, profile=with_limits(generation, steering_wheel_deg=30.0))
    rig.actuation = Actuation(0.5, 0.0, 0.2)
    rig.run_ms(500)
    rig.actuation = Actuation(-0.5, 0.0, 0.2)
    rig.run_ms(500)
    requested = [angle_deg for _, angle_deg in angles_deg(rig)]
    assert (max(requested), min(requested)) == (30.0, -30.0)
    assert rig.adapter.counts["limited_wheel_deg"] > 20


@both_generations
def test_rate(generation: int) -> None:
    """The commanded steering angle changes no faster than the limit."""
    rig = driving_rig(generation, profile=with_limits(generation, steering_wheel_rate_degps=100.0))
    rig.actuation = Actuation(0.2, 0.0, 0.0)
    rig.run_ms(400)
    requested = angles_deg(rig)
    for (before_ns, before_deg), (after_ns, after_deg) in pairwise(requested):
        assert abs(after_deg - before_deg) <= 100.0 * (after_ns - before_ns) / NS_PER_S + 0.1
    _, last_deg = requested[-1]
    assert last_deg > 30


@both_generations
def test_a_limited_command_is_sent_faster(generation: int) -> None:
    """While the steering rate limits the angle, a set of frames is sent every 5 ms, and then every 20 ms."""
    rig = AdapterRig(generation, profile=with_limits(generation, steering_wheel_rate_degps=50.0))
    rig.engage()
    rig.run_ms(300, step_ms=COARSE_MS)
    rig.tick_ns = 50 * NS_PER_MS
    rig.actuation = Actuation(0.03, 0.0, 0.5)
    for wait_ms, period_ns in ((60, LEAST_GAP_NS), (700, REPEAT_PERIOD_NS)):
        rig.run_ms(wait_ms)
        rig.sent.clear()
        rig.run_ms(150)
        times = sorted({at_ns for at_ns, _ in rig.sent})
        assert {later - earlier for earlier, later in pairwise(times)} == {period_ns}


@both_generations
def test_nothing_is_sent_before_the_first_tick(generation: int) -> None:
    """Before the first tick nothing is sent, even if driving is wanted, and the missing tick is counted once."""
    rig = AdapterRig(generation, start_frames=False)
    rig.is_ticking = False
    rig.run_ms(400, step_ms=COARSE_MS)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(300, step_ms=COARSE_MS)
    assert (rig.sent, rig.adapter.tick_ns) == ([], None)
    assert rig.adapter.counts["ticks_missed"] == 1
    rig.is_ticking = True
    rig.adapter.engage(False, rig.now_ns)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(COARSE_MS, step_ms=COARSE_MS)
    assert rig.sent


def test_rate_of_the_kit() -> None:
    """The largest rate is sent in the kit's steps: 452 deg/s are 113 steps of 4 deg/s, in both generations."""
    for name, rate_byte in (("dataspeed_gen1", 3), ("dataspeed_gen2", 3)):
        rig = stationary_rig(int(name[-1]))
        rig.engage()
        rates = {
            frame.data[rate_byte] for _, frame in rig.sent if frame.identifier in (0x064, 0x200) and len(frame.data) > 4
        }
        assert 113 in rates
        assert rates <= {0, 113}


@both_generations
def test_pedals(generation: int) -> None:
    """Pedals are pressed no further and no faster than the limits, and released immediately."""
    limited_profile = with_limits(generation, throttle=0.4, brake=0.5, throttle_rate_per_s=1.0, brake_rate_per_s=2.0)
    rig = driving_rig(generation, profile=limited_profile)
    rig.actuation = Actuation(0.0, 1.0, 0.0)
    rig.run_ms(1000)
    assert rig.kit.state.throttle == pytest.approx(0.4, abs=1e-3)
    rig.actuation = Actuation(0.0, 0.0, 1.0)
    rig.moments.clear()
    rig.run_ms(400)
    assert rig.moments[25].wheels.throttle == 0.0
    assert rig.moments[-1].wheels.brake == pytest.approx(0.5, abs=1e-3)
    rising = [moment.wheels.brake for moment in rig.moments]
    assert rising[150] <= 2.0 * 0.151 + 2.0 * 0.02, "at 2 per s, in 0.151 s and one more set of frames"
    rig.actuation = Actuation(0.0, 0.0, 0.0)
    rig.run_ms(25)
    assert rig.kit.state.brake == 0.0


@both_generations
def test_steering_starts_at_the_reported_angle(generation: int) -> None:
    """The first angle after enabling differs from the reported angle by at most the turn allowed in 60 ms."""
    rig = driving_rig(generation)
    rig.actuation = Actuation(0.2, 0.0, 1.0)
    rig.run_until(lambda rig: rig.speed_mps == 0.0, step_ms=COARSE_MS)
    rig.run_ms(1000, step_ms=COARSE_MS)
    rig.adapter.engage(False, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "idle")
    rig.sent.clear()
    rig.actuation = Actuation(-0.2, 0.0, 1.0)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "enabling")
    assert rig.adapter._sender.last_set_ns == rig.now_ns
    rig.sent = [(at_ns, frame) for at_ns, frame in rig.sent if at_ns == rig.now_ns]
    (_, first_deg), *_ = angles_deg(rig)
    wheel_deg = math.degrees(0.2 * 14.8)
    assert abs(first_deg - wheel_deg) <= 452 * 0.06 + 0.1, "60 ms at 452 deg/s, and a step of 0.1 deg"


any_number = st.floats(allow_nan=False, allow_infinity=False)
requested = st.builds(DriveCommand, any_number, any_number, any_number)
allowed = st.builds(DriveCommand, st.floats(-400, 400), st.floats(0, 0.6), st.floats(0, 0.8))
any_wheel = st.builds(DriveCommand, st.floats(-3276, 3276), st.floats(0, 0.6), st.floats(0, 0.8))


@given(requested, any_wheel, st.integers(0, 10 * NS_PER_S))
def test_limits_hold_for_any_request(command: DriveCommand, before: DriveCommand, passed_ns: int) -> None:
    """For any request and any wheel angle, the limited command is in range and changes no faster than the limits."""
    limited = apply_limits(LIMITS, command, before, passed_ns)
    passed_s = min(passed_ns, TICK_LIMIT_NS) / NS_PER_S
    assert abs(limited.wheel_deg) <= 400.0
    nearest_deg = min(max(before.wheel_deg, -400.0), 400.0)
    assert abs(limited.wheel_deg - nearest_deg) <= 300.0 * passed_s + 1e-9
    assert 0.0 <= limited.throttle <= min(0.6, before.throttle + 2.0 * passed_s)
    assert 0.0 <= limited.brake <= min(0.8, before.brake + 5.0 * passed_s)


@given(allowed)
def test_requests_within_the_limits_are_unchanged(command: DriveCommand) -> None:
    """A request within the limits is unchanged, except that a brake request zeroes the throttle."""
    limited = apply_limits(LIMITS, command, command, 0)
    assert limited == (replace(command, throttle=0.0) if command.brake > 0 else command)


@both_generations
def test_one_pedal(generation: int) -> None:
    """A request for throttle and brake together becomes the brake alone."""
    rig = driving_rig(generation)
    rig.actuation = Actuation(0.0, 0.5, 0.2)
    rig.run_ms(50)
    wheels = rig.moments[-1].wheels
    assert (wheels.throttle, round(wheels.brake, 2)) == (0.0, 0.2)
    assert rig.adapter.counts["limited_throttle"] > 0


@pytest.mark.parametrize("name", ["dataspeed_gen1", "dataspeed_gen2"])
def test_limits_are_the_simulators(name: str) -> None:
    """With the shipped profiles the software car has the simulator's dimensions, angles and pedals."""
    shipped_profile = profile(name)
    assert shipped_profile.car.wheelbase_m == LINCOLN_MKZ.wheelbase_m
    assert shipped_profile.car.max_braking_mps2 == LINCOLN_MKZ.max_braking_mps2
    assert shipped_profile.car.max_acceleration_mps2 == LINCOLN_MKZ.max_acceleration_mps2
    assert shipped_profile.road_rad(shipped_profile.limits.steering_wheel_deg) == pytest.approx(
        LINCOLN_MKZ.max_steering_rad, abs=1e-3
    )
    rate_radps = shipped_profile.road_rad(shipped_profile.limits.steering_wheel_rate_degps)
    assert rate_radps == pytest.approx(LINCOLN_MKZ.max_steering_rate_radps, abs=2e-3)


@both_generations
@pytest.mark.parametrize("wheel_deg", [435.5, -540.0, 600.0])
def test_a_wheel_beyond_the_limit_inhibits(generation: int, wheel_deg: float) -> None:
    """A stationary car whose wheel is beyond the limit is not engaged until the wheel is turned back."""
    rig = stationary_rig(generation)
    turn_wheel(rig, wheel_deg)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_ms(300, step_ms=COARSE_MS)
    assert (rig.state, rig.sent) == ("idle", [])
    assert "beyond the limit" in rig.adapter.state().inhibit_reason
    rig.lose_report = lambda _: False
    rig.run_until(lambda rig: rig.state == "engaged")
    assert rig.adapter.state().inhibit_reason == ""


@both_generations
@pytest.mark.parametrize("wheel_deg", [-540.0, 600.0])
def test_a_wheel_beyond_the_limit_is_never_commanded(generation: int, wheel_deg: float) -> None:
    """A wheel that is turned too far while the kit is being engaged is never commanded to an angle beyond the limit."""
    rig = stationary_rig(generation)
    rig.adapter.engage(True, rig.now_ns)
    rig.run_until(lambda rig: rig.state == "clearing")
    turn_wheel(rig, wheel_deg)
    rig.run_until(lambda rig: rig.state == "engaged")
    rig.run_ms(100)
    angles = [abs(angle_deg) for _, angle_deg in angles_deg(rig)]
    assert 400.0 < max(angles) <= 435.0


def turn_wheel(rig: AdapterRig, wheel_deg: float) -> None:
    """Forge the steering reports, so that they have this angle."""
    tenths = round(wheel_deg * 10)

    def forge(frame: CanFrame) -> bool:
        if frame.identifier == 0x065:
            data = tenths.to_bytes(2, "little", signed=True) + frame.data[2:]
        elif frame.identifier == 0x100:
            data = (tenths & 0x3FFF | int.from_bytes(frame.data[:2], "little") & 0xC000).to_bytes(2, "little")
            data += frame.data[2:-1]
            data += bytes([frame_crc8(0x100, data)])
        else:
            return False
        rig.adapter.receive(CanFrame(frame.identifier, data), rig.now_ns)
        return True

    rig.lose_report = forge
    rig.run_ms(20)
