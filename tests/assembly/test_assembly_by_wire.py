"""The inhibit reasons of a by-wire vehicle's config."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import replace

import pytest
from tests.support.clocks import ManualClock

from lavt.assembly import by_wire
from lavt.assembly.by_wire import inhibit_reason_of
from lavt.assembly.dbw import load_profile
from lavt.assembly.simulators import build_software_car
from lavt.config import DbwConfig, ServerConfig, ServerSecurityConfig, VehicleConfig
from lavt.domain import NS_PER_MS, NS_PER_S, State
from lavt.safety.gate import RejectionReason
from lavt.transport.messages import ELLIPSIS, decode, encode
from lavt.vehicle.can_frame import CanFrame, ReceivedCanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.sim.road.road import load_road
from lavt.vehicle.software_car.runner import SoftwareCarRunner


@pytest.fixture
def verified_profile() -> Profile:
    """Return a profile with a known steering sign and only verified signals."""
    return load_profile("dataspeed_gen1", steering_sign=1)


WALL_NS = 1_790_000_000 * NS_PER_S
REAL_BUS = DbwConfig(interface="socketcan", channel="no_such_bus", car="VIN 1")
KEYS = ServerSecurityConfig(key="vehicle.sign.key", operators={"alice": "alice.sign.pub"})


def reason_for(
    config: DbwConfig, profile: Profile, security: ServerSecurityConfig = KEYS, wall_ns: int = WALL_NS
) -> str:
    server = ServerConfig(vehicle=VehicleConfig(kind="dbw", dbw=config), security=security)
    return inhibit_reason_of(server, profile, wall_ns)


def test_a_real_bus_without_keys_inhibits_arming(verified_profile: Profile) -> None:
    """Arming needs signing keys on a bus that can have a real car, but not on a virtual bus."""
    assert "security.key" in reason_for(REAL_BUS, verified_profile, ServerSecurityConfig())
    assert "security.key" not in reason_for(REAL_BUS, verified_profile)
    virtual = DbwConfig(interface="udp_multicast", channel="239.74.163.2")
    assert "security.key" not in reason_for(virtual, verified_profile, ServerSecurityConfig())
    routed = virtual.model_copy(update={"options": {"hop_limit": 1}})
    assert "security.key" in reason_for(routed, verified_profile, ServerSecurityConfig())


def test_a_real_bus_without_a_car_inhibits_arming(verified_profile: Profile) -> None:
    """Arming on a bus that can have a real car needs the car's name and a watchdog proof."""
    assert "vehicle.dbw.car" in reason_for(REAL_BUS.model_copy(update={"car": ""}), verified_profile)
    assert "vehicle.dbw.watchdog_proof" in reason_for(REAL_BUS, verified_profile)


def test_unverified_signals_inhibit_arming_on_a_real_bus() -> None:
    """Unverified signals inhibit arming on any bus that is not known to be virtual."""
    unverified = load_profile("dataspeed_gen2")
    assert "unverified" in reason_for(REAL_BUS, unverified)
    virtual = DbwConfig(interface="udp_multicast", channel="239.74.163.2")
    assert "unverified" not in reason_for(virtual, unverified)


def test_a_missing_proof_inhibits_arming(verified_profile: Profile) -> None:
    """A missing watchdog proof inhibits arming, even on a virtual bus."""
    config = DbwConfig(interface="virtual", channel="test")
    assert "vehicle.dbw.watchdog_proof" in reason_for(config, verified_profile)


@pytest.mark.parametrize(("limit", "is_enough"), [(0.66, False), (0.67, True)])
def test_a_brake_too_weak_for_a_safe_stop_inhibits_arming(
    verified_profile: Profile, limit: float, is_enough: bool
) -> None:
    """A brake limit that allows less than the 4 m/s2 of a safe stop inhibits arming."""
    reason = reason_for(REAL_BUS, replace(verified_profile, limits=replace(verified_profile.limits, brake=limit)))
    assert ("limits.brake" in reason) is not is_enough


@pytest.mark.parametrize("name", ["dataspeed_gen1", "dataspeed_gen2"])
def test_a_kit_that_is_off_and_has_no_proof_has_a_readable_state(verified_profile: Profile, name: str) -> None:
    """The state of a kit that is off and has no watchdog proof can be decoded; at most its rejection is shortened."""
    profile = load_profile(name, steering_sign=1)
    adapter = ByWireAdapter(profile, start_ns=0, inhibit_reason=reason_for(REAL_BUS, verified_profile))
    adapter.frames_due(NS_PER_S)
    reason = adapter.state().inhibit_reason
    state = State(0, 0, 0.0, 0.0, "park", "disarmed", reason, -1, f"{RejectionReason.INHIBITED}: {reason}")
    decoded = decode(State, encode(state))
    assert decoded.reason == state.reason
    assert state.rejected.startswith(decoded.rejected.removesuffix(ELLIPSIS))


class CarOnABus:
    """A port to a bus with a software car that sends nothing from `silent_ns` on."""

    def __init__(self, config: ServerConfig, silent_ns: int) -> None:
        profile = load_profile(config.vehicle.dbw.profile, steering_sign=1)
        car = build_software_car(config, profile, load_road("a_key"), start_ns=0)
        self._runner, self._silent_ns = SoftwareCarRunner(car, self, start_ns=0), silent_ns
        self._sent: list[CanFrame] = []
        self.counts: Counter[str] = Counter()
        self._car_is_stepping = False

    def send(self, frames: Sequence[CanFrame], _made_ns: int) -> int:
        """Put frames of the car on the bus."""
        self._sent += frames
        return len(frames)

    def take(self, now_ns: int) -> list[ReceivedCanFrame]:
        """Return the car's frames; the car itself receives none."""
        if self._car_is_stepping or now_ns >= self._silent_ns:
            return []
        self._car_is_stepping = True
        self._runner.step(now_ns)
        self._car_is_stepping = False
        frames, self._sent = self._sent, []
        return [ReceivedCanFrame(frame, now_ns) for frame in frames]

    def next_wake_ns(self) -> None:
        """Return None: the arrival of frames cannot be predicted."""

    def close(self) -> None:
        """Do nothing."""


@pytest.mark.parametrize("silent_ns", [400 * NS_PER_MS, 2 * NS_PER_S])
def test_a_bus_that_became_silent_inhibits_driving(monkeypatch: pytest.MonkeyPatch, silent_ns: int) -> None:
    """A report that is too old when listening ends is named as missing, even if it arrived before."""
    dbw = DbwConfig(interface="virtual", channel="test", profile="dataspeed_gen1", steering_sign=1)
    config, clock = ServerConfig(vehicle=VehicleConfig(kind="dbw", dbw=dbw)), ManualClock()
    monkeypatch.setattr(by_wire, "CanPort", lambda *_, **__: CarOnABus(config, silent_ns))
    monkeypatch.setattr(by_wire, "pause", lambda pause_ns: clock.advance(pause_ns / NS_PER_MS))
    frame_count, reason = by_wire.listen(config, clock, NS_PER_S)
    assert frame_count > 0
    assert ("SteeringReport" in reason) == (silent_ns < NS_PER_S), reason
