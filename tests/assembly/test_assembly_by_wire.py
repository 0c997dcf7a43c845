"""The inhibit reasons of a by-wire vehicle's config."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lavt.assembly.by_wire import inhibit_reason_of
from lavt.assembly.dbw import load_profile
from lavt.config.dbw import DbwConfig
from lavt.domain import NS_PER_S, State
from lavt.safety.gate import RejectionReason
from lavt.transport.messages import decode, encode
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.profile import Profile


@pytest.fixture
def known() -> Profile:
    return load_profile("dataspeed_gen1", steering_sign=1)


def test_unverified_signals_inhibit_arming_on_a_real_bus() -> None:
    """Unverified signals inhibit arming on any bus that is not known to be virtual."""
    unverified = load_profile("dataspeed_gen2")
    real = DbwConfig(interface="socketcan", channel="no_such_bus")
    assert "unverified" in inhibit_reason_of(real, unverified)
    virtual = DbwConfig(interface="udp_multicast", channel="239.74.163.2")
    assert "unverified" not in inhibit_reason_of(virtual, unverified)


def test_a_missing_sign_or_proof_inhibits_arming(known: Profile) -> None:
    """An unknown steering sign or a missing watchdog proof inhibits arming, even on a virtual bus."""
    config = DbwConfig(interface="virtual", channel="test")
    assert "vehicle.dbw.steering_sign" in inhibit_reason_of(config, load_profile("dataspeed_gen1"))
    assert "vehicle.dbw.watchdog_proof" in inhibit_reason_of(config, known)


@pytest.mark.parametrize(("limit", "is_enough"), [(0.66, False), (0.67, True)])
def test_a_brake_too_weak_for_a_safe_stop_inhibits_arming(known: Profile, limit: float, is_enough: bool) -> None:
    """A brake limit below the 4 m/s2 of a safe stop, on which all speed limits depend, inhibits arming."""
    reason = inhibit_reason_of(DbwConfig(), replace(known, limits=replace(known.limits, brake=limit)))
    assert ("limits.brake" in reason) is not is_enough


@pytest.mark.parametrize("name", ["dataspeed_gen1", "dataspeed_gen2"])
def test_a_kit_that_is_off_and_has_no_proof_has_a_readable_state(known: Profile, name: str) -> None:
    """A state can be decoded that says that the kit is off and that its watchdog has not been tested."""
    profile = load_profile(name, steering_sign=1)
    adapter = ByWireAdapter(profile, start_ns=0, inhibit_reason=inhibit_reason_of(DbwConfig(), known))
    adapter.frames_due(NS_PER_S)
    reason = adapter.state().inhibit_reason
    state = State(0, 0, 0.0, 0.0, "park", "disarmed", reason, -1, f"{RejectionReason.INHIBITED}: {reason}")
    read = decode(State, encode(state))
    assert (read.reason, read.rejected) == (state.reason, state.rejected)
