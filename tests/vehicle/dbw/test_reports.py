"""Reports are converted to LAVT's units and expire after their timeout."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
from tests.vehicle.dbw.rig import START_NS, profile

from lavt.domain import NS_PER_MS
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.profile import IN_DEGREES, IN_METRES_PER_SECOND
from lavt.vehicle.dbw.reports import NewestReports

STEERING, BRAKE = 0x065, 0x061
ANGLE_AND_SPEED = CanFrame(STEERING, bytes.fromhex("64 00 00 00 E8 03 00 00"))
"""A SteeringReport of generation 1: 100 steps of 0.1 deg, and 1000 of 0.01 km/h."""


@pytest.mark.parametrize(("angle_unit", "wheel_deg"), [("deg", 10.0), ("rad", math.degrees(10.0))])
@pytest.mark.parametrize(("speed_unit", "speed_mps"), [("m/s", 10.0), ("km/h", 10.0 / 3.6)])
def test_units(angle_unit: str, wheel_deg: float, speed_unit: str, speed_mps: float) -> None:
    """A wheel angle in degrees or radians and a speed in m/s or km/h are converted to degrees and m/s."""
    # One degree in `angle_unit`, and 1 m/s in `speed_unit`.
    angle_per_deg, speed_per_mps = IN_DEGREES[angle_unit], IN_METRES_PER_SECOND[speed_unit]
    kit = replace(profile("dataspeed_gen1"), angle_per_deg=angle_per_deg, speeds_per_mps={"speed": speed_per_mps})
    reports = NewestReports(kit, START_NS)
    reports.receive(ANGLE_AND_SPEED, START_NS + 1)
    assert reports.wheel_deg == pytest.approx(wheel_deg)
    assert reports.speed_mps == pytest.approx(speed_mps)
    assert reports.speeds["speed"].mono_ns == START_NS + 1


def test_deadline() -> None:
    """The next deadline is when a report becomes 200 ms old; reports that are already older have no deadline."""
    reports = NewestReports(profile("dataspeed_gen1"), START_NS)
    assert reports.deadline_ns(START_NS) is None
    reports.receive(ANGLE_AND_SPEED, START_NS)
    later_ns = START_NS + 30 * NS_PER_MS
    reports.receive(CanFrame(BRAKE, bytes(8)), later_ns)
    first_ns, second_ns = START_NS + 200 * NS_PER_MS, later_ns + 200 * NS_PER_MS
    assert reports.deadline_ns(later_ns) == reports.deadline_ns(first_ns - 1) == first_ns
    assert reports.deadline_ns(first_ns) == second_ns
    assert reports.deadline_ns(second_ns) is None


def test_missing() -> None:
    """A report is missing until it has arrived with all its values, and again when it is 200 ms old."""
    reports = NewestReports(profile("dataspeed_gen1"), START_NS)
    all_reports = len(reports.missing(START_NS))
    assert all_reports == len(profile("dataspeed_gen1").reports)
    reports.receive(ANGLE_AND_SPEED, START_NS)
    assert len(reports.missing(START_NS + 200 * NS_PER_MS - 1)) == all_reports - 1
    assert len(reports.missing(START_NS + 200 * NS_PER_MS)) == all_reports


def test_foreign_commands() -> None:
    """Another sender is reported for one second after its last command."""
    reports = NewestReports(profile("dataspeed_gen1"), START_NS)
    assert reports.other_commander(START_NS) == ""
    reports.receive(CanFrame(0x064, b""), START_NS)
    assert reports.other_commander(START_NS + 1000 * NS_PER_MS - 1) != ""
    assert reports.other_commander(START_NS + 1000 * NS_PER_MS) == ""
