"""Tests of the steering commands that the adapter returns as reached, for reported commands that each test chooses.

The reports are those of generation 1: a command in bytes 2 and 3, in steps of 0.1 degrees.
"""

from __future__ import annotations

import pytest
from msgspec.structs import replace
from tests.vehicle.dbw.rig import AdapterRig, driving_rig, stationary_rig

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.vehicle import ReachedCommand

COMMAND, REPORT = 0x064, 0x065
FIRST_RAD, SECOND_RAD = 0.012, 0.014
UNSENT_COMMAND = bytes([0x77, 0x01])
"""A command that is never sent."""


class ChosenReports:
    """A car whose steering reports contain the command chosen last; at first, the command before the test."""

    def __init__(self, rig: AdapterRig) -> None:
        self.rig = rig
        self._data, self._command = b"", b""
        rig.lose_report = self._replace
        rig.run_ms(500)
        self.initial_command = self._command = self._data[2:4]
        rig.adapter.take_reached()

    def _replace(self, frame: CanFrame) -> bool:
        if frame.identifier != REPORT:
            return False
        self._data = frame.data
        if self._command:
            self.rig.adapter.receive(self._report(), self.rig.now_ns)
        return bool(self._command)

    @property
    def wheel(self) -> bytes:
        """The reported angle of the wheel."""
        return self._data[:2]

    def _report(self) -> CanFrame:
        return CanFrame(REPORT, self._data[:2] + self._command + self._data[4:])

    def steer(self, steering_rad: float) -> tuple[int, bytes]:
        """Request an angle; return the time of the tick and the angle as encoded on the bus."""
        self.rig.actuation = replace(self.rig.actuation, steering_rad=steering_rad)
        self.rig.run_until(lambda rig: rig.adapter._requested == rig.actuation)
        return self.rig.now_ns, next(
            frame.data[:2] for _, frame in reversed(self.rig.sent) if frame.identifier == COMMAND
        )

    def report_command(self, command: bytes) -> list[ReachedCommand]:
        """Report a command and return the reached commands; the same report again reaches none."""
        self._command = command
        self.rig.adapter.receive(self._report(), self.rig.now_ns)
        reached = self.rig.adapter.take_reached()
        self.rig.adapter.receive(self._report(), self.rig.now_ns)
        assert self.rig.adapter.take_reached() == []
        return reached


@pytest.mark.parametrize(("age_ms", "is_known"), [(0, True), (180, True), (200, True), (220, False), (500, False)])
def test_a_command_that_is_not_reported_is_forgotten(age_ms: int, is_known: bool) -> None:
    """A command is reached if it is reported at most 200 ms after its tick; later reports of it are ignored."""
    car = ChosenReports(driving_rig(1))
    requested_ns, command = car.steer(FIRST_RAD)
    car.rig.run_ms(age_ms)
    assert car.report_command(command) == [ReachedCommand(requested_ns, car.rig.now_ns)] * is_known


def test_only_old_commands_are_forgotten() -> None:
    """When an expired command is discarded, later commands are kept."""
    car = ChosenReports(driving_rig(1))
    _, first = car.steer(FIRST_RAD)
    car.rig.run_ms(100)
    requested_ns, second = car.steer(SECOND_RAD)
    car.rig.run_ms(120)
    assert car.report_command(first) == []
    assert car.report_command(second) == [ReachedCommand(requested_ns, car.rig.now_ns)]


def test_all_old_commands_are_forgotten() -> None:
    """Two commands that expire before the next set of frames are both discarded."""
    car = ChosenReports(driving_rig(1))
    car.steer(FIRST_RAD)
    _, second = car.steer(SECOND_RAD)
    car.rig.run_ms(120)
    car.rig.is_ticking = False
    car.rig.run_ms(139)
    car.rig.is_ticking = True
    car.rig.run_ms(1)
    assert car.rig.state == "engaged"
    assert car.report_command(second) == []


def test_a_repeated_angle_is_reached_again() -> None:
    """Each of three commands is reached at the report of this command, even if the last command equals the first."""
    car = ChosenReports(driving_rig(1))
    requested = [car.steer(angle_rad) for angle_rad in (FIRST_RAD, SECOND_RAD, FIRST_RAD)]
    for requested_ns, command in requested:
        car.rig.run_ms(5)
        assert car.report_command(command) == [ReachedCommand(requested_ns, car.rig.now_ns)]


def test_superseded_commands_are_not_reached() -> None:
    """A report of a command discards all earlier commands; later commands are still awaited."""
    car = ChosenReports(driving_rig(1))
    (_, first), (second_ns, second), (third_ns, _) = [
        car.steer(angle_rad) for angle_rad in (FIRST_RAD, SECOND_RAD, FIRST_RAD)
    ]
    assert car.report_command(second) == [ReachedCommand(second_ns, car.rig.now_ns)]
    assert car.report_command(first) == [ReachedCommand(third_ns, car.rig.now_ns)]
    assert car.report_command(second) == []


def test_a_command_that_was_not_sent_is_ignored() -> None:
    """A report of a command that was not sent reaches nothing, and commands that were sent are still awaited."""
    car = ChosenReports(driving_rig(1))
    requested_ns, command = car.steer(FIRST_RAD)
    assert car.report_command(UNSENT_COMMAND) == []
    assert car.report_command(command) == [ReachedCommand(requested_ns, car.rig.now_ns)]


def test_a_repeated_command_is_reached_once() -> None:
    """A command that is repeated, or that the kit already reports, is reached only once."""
    car = ChosenReports(driving_rig(1))
    requested_ns, command = car.steer(FIRST_RAD)
    car.rig.run_ms(100)
    assert [reached.applied_ns for reached in car.report_command(command)] == [requested_ns]
    car.rig.run_ms(100)
    assert car.report_command(car.initial_command) == []
    car.rig.run_ms(100)
    assert car.report_command(command) == []


def test_an_override_discards_awaited_commands() -> None:
    """A command sent before an override by the driver is not reached by a report after it."""
    car = ChosenReports(driving_rig(1))
    _, command = car.steer(FIRST_RAD)
    car.rig.kit.driver_brakes(0.3, car.rig.now_ns)
    car.rig.run_until(lambda rig: rig.state == "overridden")
    car.rig.run_ms(20)
    assert car.report_command(command) == []
    assert car.report_command(car.wheel) == []


def enable(car: ChosenReports) -> None:
    """Engage a stationary car until its steering is commanded, first to the reported angle."""
    car.rig.adapter.engage(True, car.rig.now_ns)
    car.rig.run_until(lambda rig: rig.state == "enabling")
    car.rig.run_ms(10)


def test_the_first_command_is_awaited_if_it_differs() -> None:
    """The first command, which has the reported angle, is awaited only if the kit reports another command."""
    car = ChosenReports(stationary_rig(1))
    enable(car)
    assert car.report_command(UNSENT_COMMAND) == []
    assert car.report_command(car.initial_command) == []
    car.rig.adapter.engage(False, car.rig.now_ns)
    car.rig.run_until(lambda rig: rig.state == "idle")
    assert car.report_command(UNSENT_COMMAND) == []
    enable(car)
    assert len(car.report_command(car.initial_command)) == 1
