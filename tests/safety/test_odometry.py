from __future__ import annotations

import math
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.safety.rig import START_NS, WHEELBASE_M, vehicle_at

from lavt.control.pure_pursuit import move_along_arc, steering_rad
from lavt.domain import NS_PER_MS, NS_PER_S, VehicleState
from lavt.safety.odometry import Odometry

MEMORY_NS = 5 * NS_PER_S
STEP_NS = NS_PER_S // 240


def report_at(passed_ns: int, speed_mps: float, angle_rad: float = 0.0) -> VehicleState:
    return replace(vehicle_at(speed_mps, angle_rad), mono_ns=START_NS + passed_ns)


def new_odometry() -> Odometry:
    return Odometry(WHEELBASE_M, MEMORY_NS)


def test_a_circle() -> None:
    """At constant speed and wheel angle the pose is on the kinematic car's circle, between and after the reports."""
    odometry = new_odometry()
    for passed_ns in range(0, NS_PER_S + 1, 50 * NS_PER_MS):
        odometry.update(report_at(passed_ns, 8.0, steering_rad(0.02, WHEELBASE_M)))
    for passed_s in (0.0, 0.33, 1.0, 1.2):
        fix = odometry.at(START_NS + round(passed_s * NS_PER_S))
        assert fix.travelled_m == pytest.approx(8 * passed_s)
        assert fix.pose == pytest.approx(move_along_arc((0.0, 0.0, 0.0), 8 * passed_s, 0.02))


def test_the_rate_of_reports_does_not_matter() -> None:
    """The pose after a stop in a tightening bend is the same within 2 cm for reports at 240 Hz and at 30 Hz."""

    def pose_after_stop(steps_per_report: int) -> tuple[float, float, float]:
        odometry = new_odometry()
        for step in range(0, 2 * 240 + 1, steps_per_report):
            passed_s = step / 240
            odometry.update(report_at(step * STEP_NS, 8.0 - 4.0 * passed_s, 0.1 * math.sin(passed_s)))
        return odometry.at(START_NS + 480 * STEP_NS).pose

    assert pose_after_stop(8) == pytest.approx(pose_after_stop(1), abs=0.02)


def test_a_report_that_is_not_newer_changes_nothing() -> None:
    """A repeated or older report changes nothing."""
    odometry = new_odometry()
    odometry.update(report_at(0, 8.0))
    odometry.update(report_at(NS_PER_S, 8.0))
    before = odometry.at(START_NS + NS_PER_S)
    for passed_ns in (NS_PER_S, 0):
        odometry.update(report_at(passed_ns, 50.0, 0.5))
    assert odometry.at(START_NS + NS_PER_S) == before


def test_memory_is_bounded() -> None:
    """Poses of the last 5 s are known exactly; for an older time the oldest known pose is returned."""
    odometry = new_odometry()
    for step in range(60 * 240):
        odometry.update(report_at(step * STEP_NS, 8.0))
    end_ns = START_NS + (60 * 240 - 1) * STEP_NS
    assert len(odometry._fixes) <= 5 * 240 + 2
    assert odometry.at(end_ns).travelled_m - odometry.at(end_ns - MEMORY_NS).travelled_m == pytest.approx(40)
    assert odometry.at(START_NS).pose == odometry.at(end_ns - MEMORY_NS - NS_PER_S).pose


def test_before_the_first_report_the_car_is_at_the_origin() -> None:
    """Before the first report the car is stationary at the origin."""
    assert new_odometry().at(START_NS).travelled_m == 0.0
    assert new_odometry().at(START_NS).pose == (0.0, 0.0, 0.0)


NUMBERS = st.one_of(st.floats(), st.sampled_from([math.nan, math.inf, -math.inf, 1e308, -1e308]))


@given(st.lists(st.tuples(NUMBERS, NUMBERS, st.integers(-NS_PER_S, 60 * NS_PER_S)), max_size=20))
def test_the_pose_is_always_finite(reports: list[tuple[float, float, int]]) -> None:
    """The pose is finite for any reported speeds and angles, and later valid reports add their distances to it."""
    odometry, passed_ns = new_odometry(), 0
    for speed_mps, angle_rad, later_ns in reports:
        passed_ns += later_ns
        odometry.update(report_at(passed_ns, speed_mps, angle_rad))
        assert all(map(math.isfinite, odometry.at(START_NS + passed_ns).pose))
    last_ns = odometry._fixes[-1].mono_ns if odometry._fixes else START_NS
    travelled_m = []
    for second in (1, 2):
        odometry.update(replace(report_at(0, 3.0), mono_ns=last_ns + second * NS_PER_S))
        travelled_m.append(odometry.at(last_ns + second * NS_PER_S).travelled_m)
    assert [after - before for before, after in pairwise(travelled_m)] == [pytest.approx(3.0, abs=1e-3)]
