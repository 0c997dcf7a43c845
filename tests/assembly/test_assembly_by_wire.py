"""The inhibit reasons of a by-wire vehicle's config."""

from __future__ import annotations

from dataclasses import replace

import pytest

from lavt.assembly.by_wire import inhibit_reason_of
from lavt.assembly.dbw import load_profile
from lavt.config.dbw import DbwConfig
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
