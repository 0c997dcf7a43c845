"""The plausibility of reported speeds: faults are found in time, and normal driving raises no fault."""

from __future__ import annotations

import math
from collections.abc import Callable

import pytest

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.vehicle.dbw.speed_monitor import (
    FULL_BRAKE_NS,
    STANDSTILL_NS,
    Pedals,
    SpeedFault,
    SpeedMonitor,
    SpeedReport,
)

START_NS = 5 * NS_PER_S
PERIOD_NS = 10 * NS_PER_MS
SPEED_STEP_MPS = 0.01 / 3.6
"""Step of the kits' reports."""
NO_PEDAL, FULL_BRAKE, HALF_BRAKE, THROTTLE = Pedals(0.0, 0.0), Pedals(0.0, 1.0), Pedals(0.0, 0.5), Pedals(0.5, 0.0)
Course = Callable[[float], float]
"""A speed in m/s as a function of time in s."""


class MonitorRig:
    """A monitor that gets reports every 10 ms."""

    def __init__(self) -> None:
        self.monitor = SpeedMonitor(max_acceleration_mps2=2.0, max_braking_mps2=6.0)
        self.now_ns = START_NS
        self.faults: list[SpeedFault] = []

    def run(
        self, duration_s: float, pedals: Pedals, speed: Course, *wheels: Course, second: Course | None = None
    ) -> MonitorRig:
        """Report the courses for a time, each course from its beginning (0 s) on."""
        began_ns = self.now_ns
        while self.now_ns < began_ns + round(duration_s * NS_PER_S):
            self.now_ns += PERIOD_NS
            passed_s = (self.now_ns - began_ns) / NS_PER_S
            courses = {"speed": speed} | {f"wheel_{index}": wheel for index, wheel in enumerate(wheels, 1)}
            courses |= {} if second is None else {"second_speed": second}
            reports = {name: SpeedReport(quantised(course(passed_s)), self.now_ns) for name, course in courses.items()}
            fault = self.monitor.update(reports, pedals, self.now_ns)
            self.faults += [] if fault is None else [fault]
        return self


def quantised(speed_mps: float) -> float:
    return round(speed_mps / SPEED_STEP_MPS) * SPEED_STEP_MPS


def constant(speed_mps: float) -> Course:
    return lambda _: speed_mps


def ramp(from_mps: float, acceleration_mps2: float) -> Course:
    return lambda s: max(0.0, from_mps + acceleration_mps2 * s)


def noisy(course: Course, amplitude_mps: float = 0.05) -> Course:
    """Add the oscillation of a real car's speed."""
    return lambda s: max(0.0, course(s) + amplitude_mps * math.sin(7.0 * s))


# Faults.


def test_a_speed_that_drops_to_zero_is_a_fall() -> None:
    """A speed that drops from 8.3 m/s to 0 is implausible from the first report of 0 on."""
    rig = MonitorRig().run(1.0, NO_PEDAL, noisy(constant(8.3)))
    rig.run(0.01, NO_PEDAL, constant(0.0))
    assert rig.faults == [SpeedFault.FALL]


def test_the_fault_lasts_until_all_speeds_agree_on_standstill() -> None:
    """The fault ends after the car was braked for long enough, and every speed was 0 for a second."""
    rig = MonitorRig().run(1.0, NO_PEDAL, *[noisy(constant(8.3))] * 5)
    rig.run(FULL_BRAKE_NS / NS_PER_S + 5.0, FULL_BRAKE, constant(0.0), *[constant(8.3)] * 4)
    assert rig.monitor.fault is SpeedFault.FALL
    assert rig.monitor.speed_mps == pytest.approx(8.3, abs=0.01)
    rig.run(STANDSTILL_NS / NS_PER_S - 0.02, FULL_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.fault is SpeedFault.FALL
    rig.run(0.1, FULL_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.fault is None


def test_a_fault_of_the_only_source_lasts_as_long_as_the_car_may_need() -> None:
    """Without another speed, the fault lasts until the brake has stopped a car of any speed within the limits."""
    rig = MonitorRig().run(1.0, NO_PEDAL, noisy(constant(5.0)))
    rig.run(FULL_BRAKE_NS / NS_PER_S - 0.02, FULL_BRAKE, constant(0.0))
    assert rig.monitor.fault is SpeedFault.FALL
    rig.run(0.1, FULL_BRAKE, constant(0.0))
    assert rig.monitor.fault is None


@pytest.mark.parametrize("other", ["wheels", "second"])
@pytest.mark.parametrize("stuck_mps", [0.0, 3.0])
def test_a_stuck_speed_disagrees(other: str, stuck_mps: float) -> None:
    """A speed that is stuck while the car accelerates at 2 m/s2 is implausible before the car is 3 m/s faster."""
    course = ramp(stuck_mps, 2.0)
    others = {"second": course} if other == "second" else {}
    rig = MonitorRig().run(1.5, THROTTLE, constant(stuck_mps), *[course] * (0 if others else 4), **others)
    assert rig.faults == [SpeedFault.DISAGREEMENT]


def test_a_scaled_speed_disagrees() -> None:
    """A speed that is half the wheel speeds is implausible."""
    rig = MonitorRig().run(4.0, THROTTLE, ramp(0.0, 1.0), *[ramp(0.0, 2.0)] * 4)
    assert rig.faults == [SpeedFault.DISAGREEMENT]


@pytest.mark.parametrize("sources", [1, 5])
def test_a_frozen_speed_under_throttle(sources: int) -> None:
    """A moving car's speed that does not change under throttle is implausible, even if all sources agree."""
    rig = MonitorRig().run(2.1, THROTTLE, *[constant(3.0)] * sources)
    assert rig.faults == [SpeedFault.FROZEN]


@pytest.mark.parametrize("sources", [1, 5])
@pytest.mark.parametrize("throttle", [0.06, 0.1, 0.2, 0.3, 0.45, 0.5, 1.0])
def test_a_speed_that_stays_zero_under_throttle(throttle: float, sources: int) -> None:
    """Whatever the throttle, a speed of 0 is implausible before a car on a level road is faster than 2.75 m/s."""
    acceleration_mps2 = throttle * 2.0 - 0.1
    rig = MonitorRig().run(0.1, NO_PEDAL, *[constant(0.0)] * sources)
    rig.run(2.6 / acceleration_mps2, Pedals(throttle, 0.0), *[constant(0.0)] * sources)
    assert rig.faults == []
    rig.run(0.15 / acceleration_mps2, Pedals(throttle, 0.0), *[constant(0.0)] * sources)
    assert rig.faults == [SpeedFault.NO_START]


def test_pulses_of_throttle_add_up() -> None:
    """A throttle that is pressed for a second at a time does not hide a speed that is stuck at 0."""
    rig = MonitorRig()
    for _ in range(5):
        rig.run(1.0, Pedals(0.4, 0.0), constant(0.0)).run(1.0, NO_PEDAL, constant(0.0))
    assert rig.faults == [SpeedFault.NO_START]


def test_a_report_that_is_processed_late_does_not_reduce_the_unanswered_speed() -> None:
    """After reports with earlier times, a speed that stays 0 is found after as much throttle as without them."""
    rig = MonitorRig().run(0.1, NO_PEDAL, constant(0.0)).run(1.3, Pedals(1.0, 0.0), constant(0.0))
    for late_ns in (900 * NS_PER_MS, 50 * NS_PER_MS):
        report_ns = rig.now_ns - late_ns
        rig.monitor.update({"speed": SpeedReport(0.0, report_ns)}, Pedals(1.0, 0.0), report_ns)
    rig.run(0.1, Pedals(1.0, 0.0), constant(0.0))
    assert rig.faults == []
    rig.run(0.05, Pedals(1.0, 0.0), constant(0.0))
    assert rig.faults == [SpeedFault.NO_START]


def test_a_car_that_did_not_answer_the_throttle_is_not_stationary() -> None:
    """After throttle without an answer the car may move, until braking as on ice would have stopped it.

    Rolling without a brake does not count.
    """
    rig = MonitorRig().run(2.0, Pedals(0.5, 0.0), *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(1.0, NO_PEDAL, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(1.6, FULL_BRAKE, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(0.2, FULL_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary
    assert rig.faults == []


WEAK_BRAKE = Pedals(0.0, 0.3)
"""A quarter of it decelerates by 0.45 m/s2."""


def test_only_sure_braking_counts() -> None:
    """A brake counts with a quarter of its configured deceleration; a car whose kit has released the brake rolls."""
    rig = MonitorRig().run(1.0, Pedals(0.5, 0.0), *[constant(0.0)] * 5)
    rig.run(1.7, WEAK_BRAKE, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(0.4, WEAK_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary
    rig.run(1.0, Pedals(0.5, 0.0), *[constant(0.0)] * 5)
    rig.run(7.9, Pedals(0.0, 0.0, is_brake_axis_released=True), *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(1.2, Pedals(0.0, 0.0, is_brake_axis_released=True), *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary


def test_a_car_that_is_not_braked_does_not_stop_sliding() -> None:
    """If all speeds drop to 0 without a brake, the car counts as moving until it was braked for long enough."""
    rig = MonitorRig().run(1.0, NO_PEDAL, *[noisy(constant(2.0), 0.01)] * 5)
    rig.run(5.0, NO_PEDAL, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(4.3, WEAK_BRAKE, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(0.3, WEAK_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary
    assert rig.faults == []


def test_throttle_adds_to_the_speed_at_which_a_speed_was_lost() -> None:
    """If all speeds drop to 0 and throttle is applied after that, the car may be faster than before the drop."""
    rig = MonitorRig().run(1.0, NO_PEDAL, *[noisy(constant(2.0), 0.01)] * 5)
    rig.run(1.0, Pedals(0.5, 0.0), *[constant(0.0)] * 5)
    rig.run(6.2, WEAK_BRAKE, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(0.5, WEAK_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary
    assert rig.faults == []


def test_wheels_that_roll_again_end_the_doubt() -> None:
    """After anti-lock brakes, wheels that are not braked show the speed; a later stop is believed at once."""
    rig = MonitorRig().run(1.0, NO_PEDAL, *[noisy(constant(2.4), 0.01)] * 5)
    rig.run(0.1, FULL_BRAKE, *[constant(0.0)] * 5).run(0.5, NO_PEDAL, *[constant(1.8)] * 5)
    rig.run(2.0, WEAK_BRAKE, *[ramp(1.8, -1.5)] * 5)
    assert rig.monitor.is_stationary


def test_a_speed_that_answers_the_throttle_is_believed() -> None:
    """A car that starts late and stops again is stationary as soon as its speed is 0."""
    rig = MonitorRig().run(1.0, THROTTLE, *[constant(0.0)] * 5).run(1.0, THROTTLE, *[ramp(0.0, 0.8)] * 5)
    rig.run(1.0, HALF_BRAKE, *[ramp(0.8, -3.0)] * 5)
    assert rig.monitor.is_stationary
    assert rig.faults == []


@pytest.mark.parametrize("speed_mps", [1.5, 2.4])
def test_locked_wheels_on_ice_are_no_standstill(speed_mps: float) -> None:
    """A car whose wheels lock is not stationary for as long as it can slide with a deceleration of 1 m/s2."""
    rig = MonitorRig().run(1.0, NO_PEDAL, *[noisy(constant(speed_mps), 0.01)] * 5)
    rig.run(speed_mps - 0.1, FULL_BRAKE, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(0.2, FULL_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary
    assert rig.faults == []


def test_wheels_that_lock_in_a_stop_may_have_slipped_before() -> None:
    """If wheels lock at the end of hard braking, the car can be as fast as if it had slid from the beginning."""
    rig = MonitorRig().run(1.0, NO_PEDAL, *[noisy(constant(8.0), 0.01)] * 5)
    rig.run(0.6, FULL_BRAKE, *[ramp(8.0, -10.0)] * 5)
    rig.run(7.2, FULL_BRAKE, *[constant(0.0)] * 5)
    assert not rig.monitor.is_stationary
    rig.run(0.4, FULL_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary


@pytest.mark.parametrize(("speed_mps", "is_noticed"), [(0.61, False), (0.65, True)])
def test_slow_wheels_lock_unnoticed(speed_mps: float, is_noticed: bool) -> None:
    """With reports every 10 ms, wheels that lock are noticed at more than 0.62 m/s: 0.5 m/s and 12 m/s2 for 10 ms."""
    rig = MonitorRig().run(1.0, NO_PEDAL, constant(speed_mps))
    rig.run(0.05, FULL_BRAKE, constant(0.0))
    assert rig.monitor.is_stationary != is_noticed


def test_the_fault_of_a_fast_car_lasts_as_long_as_it_may_slide() -> None:
    """If all speeds drop to 0 at 11.1 m/s, as with locked wheels on ice, the fault lasts until such a car is stationary
    for a second.
    """
    rig = MonitorRig().run(1.0, NO_PEDAL, *[noisy(constant(11.1), 0.01)] * 5)
    rig.run(12.0, FULL_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.fault is SpeedFault.FALL
    rig.run(0.2, FULL_BRAKE, *[constant(0.0)] * 5)
    assert rig.monitor.fault is None


@pytest.mark.parametrize("sources", [1, 5])
def test_a_speed_that_does_not_answer_the_brake(sources: int) -> None:
    """A speed that does not fall while the brake is pressed is implausible."""
    rig = MonitorRig().run(1.6, HALF_BRAKE, *[noisy(constant(5.0))] * sources)
    assert rig.faults == [SpeedFault.NO_BRAKING]


# No false alarms.


def stop_and_go(s: float) -> float:
    return 2.5 * (1 - math.cos(s))


NORMAL: dict[str, Callable[[MonitorRig], object]] = {
    "an emergency stop on dry asphalt": lambda rig: rig.run(2.0, FULL_BRAKE, *[ramp(11.1, -10.5)] * 5),
    "anti-lock brakes on gravel: wheels slip by a fifth, and each locks for 0.1 s": lambda rig: rig.run(
        3.0,
        FULL_BRAKE,
        ramp(11.1, -4.0),
        *[lambda s, wheel=wheel: 0.0 if (10 * s + wheel) % 4 < 1 else 0.8 * ramp(11.1, -4.0)(s) for wheel in range(4)],
    ),
    "all wheels lock on gravel at 2 m/s": lambda rig: (
        rig.run(1.0, NO_PEDAL, *[noisy(constant(2.0))] * 5),
        rig.run(1.0, FULL_BRAKE, *[constant(0.0)] * 5),
    ),
    "ice: full brakes, 1 m/s2": lambda rig: rig.run(11.0, FULL_BRAKE, *[ramp(11.1, -1.0)] * 5),
    "front wheels spin at the start": lambda rig: rig.run(
        3.0, THROTTLE, ramp(0.0, 0.8), *[ramp(0.0, 3.0)] * 2, *[ramp(0.0, 0.8)] * 2
    ),
    "spinning wheels regain grip": lambda rig: (
        rig.run(1.0, THROTTLE, *[ramp(1.0, 4.0)] * 5),
        rig.run(1.0, THROTTLE, *[ramp(3.0, 1.0)] * 5),
    ),
    "a tight curve: wheels differ by a fifth": lambda rig: rig.run(
        5.0, THROTTLE, noisy(constant(5.0)), *[noisy(constant(4.5))] * 2, *[noisy(constant(5.5))] * 2
    ),
    "stop and go": lambda rig: [
        rig.run(2 * math.pi, pedals, *[stop_and_go] * 5) for pedals in (NO_PEDAL, Pedals(0.2, 0.0), NO_PEDAL)
    ],
    "waiting with the brake": lambda rig: rig.run(20.0, FULL_BRAKE, *[constant(0.0)] * 5),
    "holding on a hill by throttle for a moment": lambda rig: rig.run(5.0, Pedals(0.3, 0.0), *[constant(0.0)] * 5),
    "a throttle that moves no car": lambda rig: rig.run(60.0, Pedals(0.05, 0.0), *[constant(0.0)] * 5),
    "holding by turns of throttle and brake": lambda rig: [
        rig.run(2.0, pedals, *[constant(0.0)] * 5) for pedals in [Pedals(0.3, 0.0), FULL_BRAKE] * 5
    ],
    "a late start at full throttle": lambda rig: rig.run(
        3.0, Pedals(1.0, 0.0), *[lambda s: ramp(0.0, 1.5)(max(0.0, s - 1.0))] * 5
    ),
    "rolling back on a hill under throttle": lambda rig: rig.run(4.0, THROTTLE, *[lambda s: -0.2 * s] * 5),
    "climbing at a constant speed": lambda rig: rig.run(10.0, Pedals(0.9, 0.0), *[noisy(constant(5.0), 0.02)] * 5),
    "cruising at an exactly constant speed on the level": lambda rig: rig.run(
        20.0, Pedals(0.1, 0.0), *[constant(8.3)] * 5
    ),
    "braking down a hill of 20 % with half the pedal": lambda rig: rig.run(
        4.0, HALF_BRAKE, *[lambda s: 5.0 + 2.0 * min(s, 0.3) - max(0.0, s - 0.3)] * 5
    ),
    "standstill reported with noise": lambda rig: rig.run(10.0, NO_PEDAL, *[lambda s: 0.04 * math.sin(50 * s)] * 5),
}


@pytest.mark.parametrize("situation", NORMAL)
def test_normal_driving_raises_no_fault(situation: str) -> None:
    """Slip, locked wheels, hills, quantisation and stop-and-go are plausible."""
    rig = MonitorRig()
    NORMAL[situation](rig)
    assert rig.faults == []


def test_any_moving_source_means_not_stationary() -> None:
    """A car is stationary only if every source says so; until then, the largest speed is the car's speed."""
    rig = MonitorRig().run(0.1, NO_PEDAL, constant(0.0), *[constant(0.0)] * 3, constant(0.4))
    assert not rig.monitor.is_stationary
    assert rig.monitor.speed_mps == pytest.approx(0.4, abs=0.01)
    rig.run(0.01, NO_PEDAL, *[constant(0.0)] * 5)
    assert rig.monitor.is_stationary
    assert rig.faults == []


def test_an_old_report_is_not_compared() -> None:
    """A source that sends no new reports is not compared with other sources."""
    monitor = SpeedMonitor(max_acceleration_mps2=2.0, max_braking_mps2=6.0)
    wheel = SpeedReport(8.0, START_NS)
    for index in range(300):
        now_ns = START_NS + index * PERIOD_NS
        speeds = {"speed": SpeedReport(ramp(8.0, -4.0)(index / 100), now_ns), "wheel_1": wheel}
        assert monitor.update(speeds, FULL_BRAKE, now_ns) is None
