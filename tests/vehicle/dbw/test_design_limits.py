"""The design's limits of driving by wire, in numbers of our own: whoever changes the code's must change these."""

from __future__ import annotations

import pytest

from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw import adapter, bus, codec, profile, proving, reports, sending, states

LIMITS_MS = [
    ("commands leave at least 5 ms apart", profile.LEAST_GAP_NS, 5),
    ("commands leave each 20 ms", profile.PERIOD_NS, 20),
    ("clearing frames leave each 50 ms", profile.CLEARING_PERIOD_NS, 50),
    ("a kit lets go after 100 ms", profile.COMMAND_TIMEOUT_NS, 100),
    ("an adapter sends nothing older than 60 ms", profile.TICK_LIMIT_NS, 60),
    ("a port writes nothing older than 60 ms", bus.TICK_LIMIT_NS, 60),
    ("a lost bus is opened again each second", bus.REOPEN_NS, 1000),
    ("a frame read later than 1 s is dropped", bus.LATEST_READ_NS, 1000),
    ("gears are asked for each 100 ms", sending.GEAR_PERIOD_NS, 100),
    ("enabling takes at most 3 s", states.ENABLING_LIMIT_NS, 3000),
    ("clearing takes at least 120 ms", states.PAUSE_NS, 120),
    ("a shift may be reported 1 s late", adapter.SHIFT_NS, 1000),
    ("the car stands 300 ms before PARK", adapter.STOOD_NS, 300),
    ("the adapter is called each 100 ms", adapter.LOOK_NS, 100),
    ("an echo counts for 200 ms", adapter.ECHO_LIMIT_NS, 200),
    ("another sender counts for 1 s", reports.FOREIGN_NS, 1000),
    ("the watchdog test has ticks each 20 ms", proving.TICK_NS, 20),
    ("the watchdog test looks for 500 ms", proving.LOOK_NS, 500),
    ("the watchdog test waits 3 s for reports", proving.HEAR_LIMIT_NS, 3000),
    ("the watchdog test keeps the kit enabled 500 ms", proving.HOLD_NS, 500),
    ("a watchdog brakes within 500 ms", proving.BRAKE_WITHIN_NS, 500),
    ("the watchdog test watches for 1 s", proving.WATCH_NS, 1000),
]


@pytest.mark.parametrize(
    ("limit_ns", "limit_ms"), [each[1:] for each in LIMITS_MS], ids=[each[0] for each in LIMITS_MS]
)
def test_times(limit_ns: int, limit_ms: int) -> None:
    """Each time limit of driving by wire is the whole number of milliseconds that the design says."""
    assert type(limit_ns) is int
    assert limit_ns == limit_ms * NS_PER_MS


def test_other_limits() -> None:
    """A car stands below 0.1 m/s, the watchdog test brakes with 0.3, and a value may be 1e-6 steps over its range."""
    assert (states.STATIONARY_BELOW_MPS, proving.BRAKE, codec.RANGE_SLACK_STEPS) == (0.1, 0.3, 1e-6)


def test_units() -> None:
    """A degree is 0.01745 rad, a whole pedal 100 %, a metre per second 3.6 km/h; no unit changes nothing."""
    assert pytest.approx({"deg": 1.0, "rad": 0.0174533}, rel=1e-5) == profile.IN_DEGREES
    assert profile.IN_FRACTIONS == {"": 1.0, "%": 100.0}
    assert profile.IN_METRES_PER_SECOND == {"m/s": 1.0, "km/h": 3.6}
    assert pytest.approx({"": 1.0, "deg/s": 1.0, "rad/s": 0.0174533}, rel=1e-5) == profile.IN_DEGREES_PER_SECOND
