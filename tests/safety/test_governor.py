from __future__ import annotations

import math
from itertools import pairwise
from typing import Any

import hypothesis
import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.safety.rig import (
    COMMAND_PERIOD_NS,
    MAX_BRAKING_MPS2,
    START_NS,
    Rig,
    new_limiter,
    vehicle_at,
)

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.safety.governor import Governor, GovernorSettings
from lavt.safety.limits import LIMITS
from lavt.safety.speed_limit import SpeedLimit, lowest

TOP_MPS = 40 / 3.6
SETTINGS = GovernorSettings(nominal_mps=TOP_MPS)
TABLE = ((3.0, 800 * NS_PER_MS), (5.0, 400 * NS_PER_MS), (8.0, 300 * NS_PER_MS))
PERIOD_NS = 33 * NS_PER_MS
ROUNDING = 1e-9


def near(value: float) -> Any:
    """Return what is equal to all values that differ from `value` by rounding only."""
    return pytest.approx(value)


def governed(settings: GovernorSettings = SETTINGS, *, age_ms: float = 100.0, pictures: int = 200) -> Governor:
    """Return a governor after an arming in which all pictures had this age when their command was applied."""
    governor = Governor(settings, TOP_MPS)
    for number in range(pictures):
        governor.note_age(age_ms * NS_PER_MS, number * PERIOD_NS)
    governor.begin_drive((pictures - 1) * PERIOD_NS)
    return governor


NOW_NS = 199 * PERIOD_NS
"""The time at which the governor of `governed` begins its drive."""


def formula_mps(age_s: float, tail_s: float, settings: GovernorSettings) -> float:
    """Return the limit of two ages by the formulas of docs/governor.md, each solved in another way than in the code."""
    blind_s = age_s + (settings.brake_delay_ns + settings.reaction_ns) / NS_PER_S
    half = settings.braking_mps2 * blind_s
    speeds = [TOP_MPS, -half + math.sqrt(half * half + 2 * settings.braking_mps2 * settings.sight_m)]
    if age_s > settings.latency_limit_ns / NS_PER_S:
        speeds.append(settings.nominal_mps * settings.latency_limit_ns / NS_PER_S / age_s)
    if settings.delay_margin:
        speeds.append(0.0)
        for speed_mps, delay_ns in settings.delay_margin:
            if tail_s <= delay_ns / NS_PER_S:
                speeds[-1] = speed_mps
    return min(speeds)


@pytest.mark.parametrize(
    ("settings", "age_ms", "expected"),
    [
        (SETTINGS, 100.0, SpeedLimit(TOP_MPS, "speed")),
        (SETTINGS, 400.0, SpeedLimit(TOP_MPS / 2, "latency")),
        (GovernorSettings(nominal_mps=5.0), 250.0, SpeedLimit(4.0, "latency")),
        (GovernorSettings(TOP_MPS, sight_m=10.0), 0.0, SpeedLimit(8.179_978, "sight")),
        (GovernorSettings(TOP_MPS, sight_m=10.0, reaction_ns=NS_PER_S), 0.0, SpeedLimit(5.350_862, "sight")),
        (GovernorSettings(TOP_MPS, delay_margin=TABLE), 100.0, SpeedLimit(8.0, "delay margin")),
        (GovernorSettings(TOP_MPS, delay_margin=TABLE), 301.0, SpeedLimit(5.0, "delay margin")),
        (GovernorSettings(TOP_MPS, delay_margin=TABLE), 801.0, SpeedLimit(0.0, "delay margin")),
    ],
)
def test_the_lowest_of_three_limits_is_allowed(settings: GovernorSettings, age_ms: float, expected: SpeedLimit) -> None:
    """The allowed speed is the lowest one by sight, latency and delay margin, with its reason."""
    governor = Governor(settings, TOP_MPS)
    governor.note_age(age_ms * NS_PER_MS, NS_PER_S)
    allowed = governor.allowed(NS_PER_S)
    assert (allowed.reason, allowed.mps) == (expected.reason, near(expected.mps))


def test_of_equal_limits_the_first_reason_of_the_table_is_reported() -> None:
    """Of equal limits, the one whose reason comes first in the table of reasons is reported."""
    assert lowest(SpeedLimit(5.0, "latency"), SpeedLimit(5.0, "sight")).reason == "sight"


AGES_MS = st.one_of(
    st.floats(0.0, 1500.0), st.sampled_from([math.nan, math.inf, -math.inf, -1.0, 0.0, 200.0, 300.0, 1e30])
)
STEPS_MS = st.integers(0, 1000)
EVENTS = st.lists(st.tuples(st.sampled_from(["note", "look"]), AGES_MS, STEPS_MS), max_size=25)
ANY_SETTINGS = st.builds(
    GovernorSettings,
    nominal_mps=st.floats(1.0, 20.0),
    latency_limit_ns=st.integers(50, 600).map(lambda ms: ms * NS_PER_MS),
    sight_m=st.floats(1.0, 100.0),
    reaction_ns=st.integers(0, 2 * NS_PER_S),
    delay_margin=st.sampled_from([(), TABLE]),
    window_ns=st.integers(NS_PER_S // 2, 10 * NS_PER_S),
    tail=st.floats(0.5, 1.0),
    rise_mps2=st.floats(0.01, 5.0),
    hysteresis_mps=st.floats(0.0, 5.0),
)


class Oracle:
    """The ages that a governor must know after some events, each computed from all events."""

    def __init__(self, settings: GovernorSettings) -> None:
        self.settings = settings
        self.captured_ns: float | None = None
        self.replaced: list[tuple[int, float]] = []
        """Time of replacement and largest age of each picture."""

    def note(self, age_ns: float, now_ns: int) -> bool:
        """Note a newer picture; return whether it comes into force."""
        if not 0 <= age_ns < math.inf:
            self.captured_ns = None
            return False
        before_ns = self.captured_ns
        if now_ns - age_ns == before_ns:
            return False
        if before_ns is not None:
            self.replaced.append((now_ns, now_ns - before_ns))
        self.captured_ns = now_ns - age_ns
        return True

    def allowed_mps(self, now_ns: int) -> float:
        """Return the highest speed that is allowed now."""
        if self.captured_ns is None:
            return 0.0
        present_s = max(0.0, now_ns - self.captured_ns) / NS_PER_S
        since_ns = now_ns - self.settings.window_ns
        ages_ns = sorted(age_ns for at_ns, age_ns in self.replaced if at_ns >= since_ns)
        tail_s = present_s
        if ages_ns:
            needed = self.settings.tail * len(ages_ns)
            tail_s = next(age_ns for number, age_ns in enumerate(ages_ns, 1) if number >= needed) / NS_PER_S
        return formula_mps(max(present_s, tail_s), tail_s, self.settings)


def limits_after(settings: GovernorSettings, events: list[tuple[str, float, int]]) -> list[tuple[int, SpeedLimit]]:
    """Drive a governor through events, check its bounds at each one, and return times and limits."""
    governor, oracle = Governor(settings, TOP_MPS), Oracle(settings)
    governor.note_age(100.0 * NS_PER_MS, 0)
    oracle.note(100.0 * NS_PER_MS, 0)
    governor.begin_drive(0)
    found, now_ns, newer_ns = [(0, governor.limit(0))], 0, 0
    for kind, age_ms, step_ms in events:
        now_ns, before, may_rise_mps = now_ns + step_ms * NS_PER_MS, found[-1][1], 0.0
        if kind == "note":
            governor.note_age(age_ms * NS_PER_MS, now_ns)
            if oracle.note(age_ms * NS_PER_MS, now_ns):
                may_rise_mps = settings.rise_mps2 * (now_ns - newer_ns) / NS_PER_S
                newer_ns = now_ns
        limit = governor.limit(now_ns)
        assert limit.mps <= oracle.allowed_mps(now_ns) + ROUNDING
        assert limit.mps - before.mps <= may_rise_mps + ROUNDING
        assert (limit.reason == "no picture") == (oracle.captured_ns is None)
        found.append((now_ns, limit))
    return found


@hypothesis.settings(max_examples=20)
@given(ANY_SETTINGS, EVENTS)
def test_the_limit_is_never_above_the_formula_and_rises_only_slowly(
    settings: GovernorSettings, events: list[tuple[str, float, int]]
) -> None:
    """Whatever ages arrive, the limit is at most that of the present age, and rises with newer pictures only.

    It rises by at most the rate since the last picture. Repeated, the same events give the same limits.
    """
    assert limits_after(settings, events) == limits_after(settings, events)


@hypothesis.settings(max_examples=20)
@given(ANY_SETTINGS, st.floats(0.0, 3.0), st.floats(0.0, 3.0))
def test_a_larger_age_allows_no_higher_speed(settings: GovernorSettings, one_s: float, other_s: float) -> None:
    """The allowed speed never grows with the picture age."""
    speeds = []
    for age_s in sorted((one_s, other_s)):
        governor = Governor(settings, TOP_MPS)
        governor.note_age(age_s * NS_PER_S, 10 * NS_PER_S)
        speeds.append(governor.allowed(10 * NS_PER_S).mps)
    assert speeds[1] <= speeds[0]


def test_without_commands_the_limit_falls_with_the_age() -> None:
    """While no newer picture comes into force, the limit falls as its age grows, and never rises."""
    governor = governed()
    limits = [governor.limit(NOW_NS + step * 10 * NS_PER_MS).mps for step in range(100)]
    assert all(later <= earlier for earlier, later in pairwise(limits))
    assert limits[-1] == pytest.approx(TOP_MPS * 0.2 / 1.09)


def test_before_the_first_picture_no_speed_is_allowed() -> None:
    """Without a picture in force, the limit is 0."""
    governor = Governor(SETTINGS, TOP_MPS)
    assert governor.limit(0) == SpeedLimit(0.0, "no picture")
    governed_before = governed()
    governed_before.begin_arming()
    assert governed_before.limit(NOW_NS) == SpeedLimit(0.0, "no picture")


def test_a_repeated_picture_does_not_refresh_the_age() -> None:
    """A command from the picture in force changes no limit."""
    governor = governed()
    at_ns = NOW_NS + 300 * NS_PER_MS
    before = governor.limit(at_ns)
    governor.note_age(400 * NS_PER_MS, at_ns)
    assert governor.limit(at_ns) == before


def test_a_command_from_an_older_picture_lowers_the_limit() -> None:
    """From an older picture's command on, the age is that of the older picture, until a newer one than all comes."""
    rig = governed_rig()
    rig.pass_time(COMMAND_PERIOD_NS)
    old, new = rig.take_picture(), 0
    for _ in range(20):  # 400 ms
        rig.pass_time(COMMAND_PERIOD_NS)
        new = rig.take_picture()
        assert rig.send_drive().accepted
    for stamp_ns in (old, new) * 100:  # repeated pictures neither are young again nor fill the window with young ages
        assert rig.send_drive(stamp_ns=stamp_ns).accepted
        rig.actuation()
        assert rig.speed_limit == SpeedLimit(pytest.approx(TOP_MPS * 0.2 / 0.46), "latency")  # type: ignore[arg-type]
    rig.pass_time(COMMAND_PERIOD_NS)
    rig.take_picture()
    rig.send_drive()
    rig.actuation()
    assert rig.speed_limit == SpeedLimit(pytest.approx(TOP_MPS * 0.2 / 0.48 + 0.01), "recovery")  # type: ignore[arg-type]


def test_the_tail_of_the_window_counts() -> None:
    """Of the last hundred pictures, one late one counts only while it is in force; two count until the window is over.

    The pictures are 133 ms old at most; the two late ones reach 433 ms.
    """
    after_late: list[float] = []
    for late in (1, 2):
        governor, now_ns = governed(GovernorSettings(TOP_MPS, window_ns=100 * PERIOD_NS, tail=0.98)), NOW_NS
        for _ in range(late):
            now_ns += PERIOD_NS + 300 * NS_PER_MS
            governor.note_age(100 * NS_PER_MS, now_ns)
        for _ in range(15):
            now_ns += PERIOD_NS
            governor.note_age(100 * NS_PER_MS, now_ns)
        after_late.append(governor.age_s(now_ns) or 0.0)
    assert after_late == pytest.approx([0.133, 0.433])


def test_one_late_picture_is_no_delay_of_the_loop() -> None:
    """One late picture does not lower the limit of the delay margin; many late ones do."""
    settings = GovernorSettings(TOP_MPS, latency_limit_ns=2 * NS_PER_S, delay_margin=TABLE)
    governor, now_ns = governed(settings), NOW_NS + PERIOD_NS + 300 * NS_PER_MS
    governor.note_age(100 * NS_PER_MS, now_ns)
    assert governor.limit(now_ns) == SpeedLimit(8.0, "delay margin")
    for _ in range(20):
        now_ns += PERIOD_NS + 300 * NS_PER_MS
        governor.note_age(100 * NS_PER_MS, now_ns)
    assert governor.limit(now_ns) == SpeedLimit(3.0, "delay margin")


def test_time_that_goes_back_raises_no_limit() -> None:
    """Times that jump back and forth never raise the limit by more than the time that really passed allows."""
    governor = governed()
    governor.limit(NOW_NS + NS_PER_S)
    low = governor.limit(NOW_NS).mps
    for _ in range(20):
        for at_ns in (NOW_NS, NOW_NS + 10 * NS_PER_MS):
            governor.note_age(50 * NS_PER_MS, at_ns)
    assert governor.limit(NOW_NS + 10 * NS_PER_MS).mps <= low + 0.5 * 0.01 + ROUNDING


def test_the_limit_falls_at_once_and_rises_slowly() -> None:
    """A limit that fell stays until the window is over, and then rises at the rate until it is allowed again."""
    governor, now_ns = governed(), NOW_NS
    limits = []
    for number in range(900):
        now_ns += PERIOD_NS
        governor.note_age((400 if number < 100 else 100) * NS_PER_MS, now_ns)
        limits.append(governor.limit(now_ns))
    assert limits[10].mps == pytest.approx(TOP_MPS * 0.2 / 0.433)
    assert all(later.mps <= earlier.mps for earlier, later in pairwise(limits[:100]))
    reasons = [limit.reason for limit in limits]
    rising_from, reached = reasons.index("recovery"), len(reasons) - reasons[::-1].index("recovery")
    risen_s = (reached - rising_from + 1) * PERIOD_NS / NS_PER_S
    assert limits[-1] == SpeedLimit(TOP_MPS, "speed")
    assert 0.5 * risen_s == pytest.approx(TOP_MPS - TOP_MPS * 0.2 / 0.433, rel=0.02)


def test_a_limit_that_is_nearly_allowed_does_not_rise() -> None:
    """Jitter that would allow less than the hysteresis more does not change the limit."""
    settings = GovernorSettings(TOP_MPS, tail=0.5, window_ns=NS_PER_S, hysteresis_mps=1.0)
    governor, now_ns = governed(settings, age_ms=300.0), NOW_NS
    before = governor.limit(now_ns)
    for number in range(300):
        now_ns += PERIOD_NS
        governor.note_age((290 + number % 10) * NS_PER_MS, now_ns)
    assert governor.allowed(now_ns).mps > before.mps
    assert governor.limit(now_ns) == before


# The vehicle.


class GovernedRig(Rig):
    """A gate with a speed governor, whose pictures are captured `age_ms` before they are stamped."""

    def __init__(self) -> None:
        super().__init__(governor=Governor(SETTINGS, TOP_MPS))
        self.age_ms = 60

    def take_picture(self, crc: int | None = None, *, captured_ns: int | None = None) -> int:
        """Issue the stamp of a new picture, captured `age_ms` ago, and return the stamp."""
        return super().take_picture(crc, captured_ns=captured_ns or self.now_ns - self.age_ms * NS_PER_MS)

    def drive_for(self, duration_ns: int) -> Actuation:
        """Send a command with throttle from a new picture in each period, and return the last actuation."""
        for _ in range(duration_ns // COMMAND_PERIOD_NS):
            self.pass_time(COMMAND_PERIOD_NS)
            self.take_picture()
            self.send_drive()
            actuation = self.actuation()
        return actuation

    @property
    def speed_limit(self) -> SpeedLimit | None:
        """Return the limit that the vehicle reports."""
        return self.gate.watchdog.speed_limit


def governed_rig() -> GovernedRig:
    rig = GovernedRig()
    rig.start_driving()
    rig.actuation()
    return rig


def test_with_young_pictures_a_governed_vehicle_drives_as_others() -> None:
    """With young pictures the limit is the lowest one of the vehicle, and changes no command."""
    rig = governed_rig()
    rig.vehicle = vehicle_at(8.0)
    assert rig.drive_for(NS_PER_S).throttle == 0.5
    assert rig.gate.limiter.applied_limits == ()
    assert rig.speed_limit is not None
    assert rig.speed_limit.reason == "stopping distance"


def test_above_its_limit_a_governed_vehicle_brakes_comfortably() -> None:
    """Above the governor's limit there is no throttle, and the brake is at most that of 2 m/s2."""
    rig = governed_rig()
    rig.vehicle = vehicle_at(8.0)
    rig.age_ms = 380
    actuation = rig.drive_for(NS_PER_S)
    assert rig.speed_limit == SpeedLimit(near(TOP_MPS * 0.2 / 0.4), "latency")
    assert rig.gate.limiter.applied_limits == ("latency",)
    assert (actuation.throttle, actuation.brake) == (0.0, near(2.0 / MAX_BRAKING_MPS2))


def test_near_the_limit_the_pedals_are_moderate() -> None:
    """The throttle fades out below the limit, the brake begins softly above it, and a stronger brake is kept."""
    limit, limiter = SpeedLimit(5.0, "latency"), new_limiter()

    def pedals(speed_mps: float, throttle: float, brake: float) -> tuple[float, float]:
        actuation = limiter.limit(
            Actuation(0.0, throttle, brake), vehicle_at(speed_mps), NS_PER_S, 100 * NS_PER_MS, limit
        )
        return actuation.throttle, actuation.brake

    assert pedals(4.4, 1.0, 0.0) == (1.0, 0.0)
    assert pedals(4.75, 1.0, 0.0) == (near(0.5), 0.0)
    assert pedals(5.0, 1.0, 0.0) == (0.0, 0.0)
    assert pedals(5.125, 1.0, 0.0) == (0.0, near(0.5 / MAX_BRAKING_MPS2))
    assert pedals(-9.0, 1.0, 0.0) == (0.0, near(LIMITS.governor_deceleration_mps2 / MAX_BRAKING_MPS2))
    assert pedals(9.0, 0.0, 0.9) == (0.0, 0.9)


def test_the_stopping_distance_limit_still_applies() -> None:
    """A vehicle that is too fast for its path brakes for that, however high the governor's limit is."""
    limiter, vehicle = new_limiter(), vehicle_at(12.0)
    requested, limit = Actuation(0.0, 1.0, 0.0), SpeedLimit(100.0, "speed")
    with_governor = limiter.limit(requested, vehicle, NS_PER_S, 100 * NS_PER_MS, limit)
    assert limiter.applied_limits == ("speed", "stopping distance")
    assert with_governor == new_limiter().limit(requested, vehicle, NS_PER_S, 100 * NS_PER_MS)


def test_nothing_that_a_client_states_raises_the_limit() -> None:
    """The send time and the read time that a command states, and a step of the wall clock, change no limit."""
    rigs = [governed_rig() for _ in range(2)]
    rigs[1].wall_step_ns = 3600 * NS_PER_S
    limits = []
    for rig, lie in zip(rigs, ({}, {"sent_wall_ns": 2**63 - 1, "stamp_received_wall_ns": 0}), strict=True):
        rig.vehicle = vehicle_at(5.0)
        rig.age_ms = 300
        for _ in range(20):
            rig.pass_time(COMMAND_PERIOD_NS)
            rig.take_picture()
            assert rig.send_drive(**lie).accepted
            rig.actuation()
        limits.append(rig.speed_limit)
    assert limits[0] == limits[1]
    assert limits[0] is not None
    assert limits[0].reason == "latency"


def test_rejected_commands_do_not_refresh_the_age() -> None:
    """Commands that the gate rejects leave the limit to fall with the age of the picture in force."""
    rig = governed_rig()
    before = rig.speed_limit
    for _ in range(10):
        rig.pass_time(COMMAND_PERIOD_NS)
        rig.take_picture()
        assert not rig.send_drive(epoch=1).accepted
        rig.actuation()
    assert rig.speed_limit is not None
    assert before is not None
    assert rig.speed_limit == SpeedLimit(pytest.approx(TOP_MPS * 0.2 / 0.26), "latency")  # type: ignore[arg-type]
    assert rig.speed_limit.mps < before.mps


def test_while_degraded_the_limit_applies_and_then_ends_with_the_stop() -> None:
    """Degraded, the vehicle also keeps the governor's limit; in a safe stop there is no limit to report."""
    rig = governed_rig()
    rig.vehicle = vehicle_at(8.0)
    rig.pass_time(400 * NS_PER_MS)
    assert rig.state == "degraded"
    assert rig.actuation().brake == pytest.approx(2.0 / MAX_BRAKING_MPS2)
    assert rig.speed_limit is not None
    rig.pass_time(200 * NS_PER_MS)
    assert rig.state == "safe_stop"
    rig.actuation()
    assert rig.speed_limit is None


def test_a_vehicle_without_a_governor_reports_no_limit() -> None:
    """Without a governor, the vehicle has no limit to report, and its limits are the same as before."""
    rig = Rig().start_driving()
    rig.vehicle = vehicle_at(8.0)
    assert rig.actuation().throttle == 0.5
    assert rig.gate.watchdog.speed_limit is None


def test_a_new_drive_begins_with_the_limit_of_its_arming() -> None:
    """The time in which nobody drives is no picture age: after a rest, a drive begins with the limit of its arming."""
    rig = governed_rig()
    rig.send(mode="stop")
    rig.pass_time(60 * NS_PER_S)
    rig.vehicle = vehicle_at(0.0)
    rig.arm()
    rig.take_picture()
    assert rig.send_drive().accepted
    rig.actuation()
    assert rig.now_ns > START_NS
    assert rig.speed_limit is not None
    assert rig.speed_limit.reason == "stopping distance"
