"""What a by-wire vehicle's config lacks before it may be armed."""

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


def test_unverified_signals_are_for_virtual_buses() -> None:
    """With unverified signals nothing is armed on a bus that may be real, and one that nobody knows may be."""
    unverified = load_profile("dataspeed_gen2")
    real = DbwConfig(interface="socketcan", channel="no_such_bus")
    assert inhibit_reason_of(real, unverified).startswith("dataspeed_gen2 has unverified signals, ")
    virtual = DbwConfig(interface="udp_multicast", channel="239.74.163.2")
    assert "unverified" not in inhibit_reason_of(virtual, unverified)


def test_the_sign_and_the_proof(known: Profile) -> None:
    """Without the steering's sign, or without the proof of the watchdog, on a virtual bus too, nothing is armed."""
    config = DbwConfig(interface="virtual", channel="test")
    assert inhibit_reason_of(config, load_profile("dataspeed_gen1")).startswith("which sign steers left")
    assert inhibit_reason_of(config, known).startswith("that the kit's watchdog brakes")


@pytest.mark.parametrize(("limit", "is_enough"), [(0.66, False), (0.67, True)])
def test_a_brake_that_is_limited_below_a_safe_stop(known: Profile, limit: float, is_enough: bool) -> None:
    """A profile whose brake cannot give the 4 m/s2 of a safe stop is not armed: every speed limit counts on them."""
    said = inhibit_reason_of(DbwConfig(), replace(known, limits=replace(known.limits, brake=limit)))
    assert ("a safe stop needs 4" in said) is not is_enough
