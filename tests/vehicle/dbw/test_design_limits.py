"""The design's limits of driving by wire, repeated here, so that nobody changes a limit by mistake."""

from __future__ import annotations

import pytest

from lavt.domain import NS_PER_MS
from lavt.vehicle.dbw import adapter, bus, codec, profile, reports, sending, states, watchdog_test

LIMITS_MS = [
    ("sets of frames are at least 5 ms apart", profile.LEAST_GAP_NS, 5),
    ("commands are sent every 20 ms", profile.REPEAT_PERIOD_NS, 20),
    ("clearing frames are sent every 50 ms", profile.CLEARING_PERIOD_NS, 50),
    ("a kit disengages after 100 ms", profile.COMMAND_TIMEOUT_NS, 100),
    ("nothing older than 60 ms is sent or written", profile.TICK_LIMIT_NS, 60),
    ("a lost bus is reopened every second", bus.REOPEN_NS, 1000),
    ("a frame read later than 1 s is dropped", bus.READ_AGE_LIMIT_NS, 1000),
    ("gears are requested every 100 ms", sending.GEAR_PERIOD_NS, 100),
    ("enabling takes at most 3 s", states.KIT_RESPONSE_LIMIT_NS, 3000),
    ("clearing takes at least 120 ms", states.PAUSE_NS, 120),
    ("a shift is reported at most 1 s late", adapter.SHIFT_REPORT_LIMIT_NS, 1000),
    ("the car is stationary 300 ms before PARK", adapter.STATIONARY_BEFORE_PARK_NS, 300),
    ("the adapter is called every 100 ms", adapter.IDLE_PERIOD_NS, 100),
    ("an echo is awaited for 200 ms", adapter.ECHO_LIMIT_NS, 200),
    ("another sender inhibits for 1 s", reports.OTHER_COMMANDER_NS, 1000),
    ("the watchdog test has ticks every 20 ms", watchdog_test.TICK_NS, 20),
    ("the watchdog test observes the kit for 500 ms", watchdog_test.OBSERVE_NS, 500),
    ("the watchdog test waits 3 s for reports", watchdog_test.REPORT_LIMIT_NS, 3000),
    ("the watchdog test keeps the kit enabled for 500 ms", watchdog_test.ENABLED_NS, 500),
    ("a watchdog brakes within 500 ms", watchdog_test.BRAKE_WITHIN_NS, 500),
    ("the watchdog test monitors the kit for 1 s", watchdog_test.MONITOR_NS, 1000),
]


@pytest.mark.parametrize(
    ("limit_ns", "limit_ms"), [pytest.param(limit_ns, limit_ms, id=text) for text, limit_ns, limit_ms in LIMITS_MS]
)
def test_times(limit_ns: int, limit_ms: int) -> None:
    """Each time limit of driving by wire is the design's number of milliseconds, as an integer."""
    assert type(limit_ns) is int
    assert limit_ns == limit_ms * NS_PER_MS


def test_other_limits() -> None:
    """Standstill is below 0.1 m/s, the watchdog test brakes with 0.3, and values can exceed ranges by 1e-6 steps."""
    assert (states.STATIONARY_BELOW_MPS, watchdog_test.BRAKE, codec.RANGE_SLACK_STEPS) == (0.1, 0.3, 1e-6)


def test_units() -> None:
    """One degree is 0.01745 rad, a full pedal 100 %, 1 m/s is 3.6 km/h, and no unit means no conversion."""
    assert pytest.approx({"deg": 1.0, "rad": 0.0174533}, rel=1e-5) == profile.IN_DEGREES
    assert profile.IN_FRACTIONS == {"": 1.0, "%": 100.0}
    assert profile.IN_METRES_PER_SECOND == {"m/s": 1.0, "km/h": 3.6}
    assert pytest.approx({"": 1.0, "deg/s": 1.0, "rad/s": 0.0174533}, rel=1e-5) == profile.IN_DEGREES_PER_SECOND
