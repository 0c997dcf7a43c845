"""Which steering commands the kit is seen to have: reports with a command in them that each test chooses.

The reports are those of generation 1: a command in bytes 2 and 3, in steps of 0.1 degrees.
"""

from __future__ import annotations

from dataclasses import replace

import pytest
from tests.vehicle.dbw.rig import Rig, driving, started

from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.vehicle import ReachedCommand

COMMAND, REPORT = 0x064, 0x065
FIRST_RAD, SECOND_RAD = 0.012, 0.014
OTHER = bytes([0x77, 0x01])
"""A command that is never sent."""


class ChosenReports:
    """A car whose steering reports have the command that was chosen last, at first the one that they had before."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self._data, self._command = b"", b""
        rig.lose_report = self._replace
        rig.run_ms(500)
        self.before = self._command = self._data[2:4]
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
        """Where the wheel was reported to be."""
        return self._data[:2]

    def _report(self) -> CanFrame:
        return CanFrame(REPORT, self._data[:2] + self._command + self._data[4:])

    def steer(self, steering_rad: float) -> tuple[int, bytes]:
        """Let a tick ask for an angle; gives when that was, and the angle on the bus."""
        self.rig.actuation = replace(self.rig.actuation, steering_rad=steering_rad)
        self.rig.run_until(lambda rig: rig.adapter._requested == rig.actuation)
        return self.rig.now_ns, next(
            frame.data[:2] for _, frame in reversed(self.rig.sent) if frame.identifier == COMMAND
        )

    def choose(self, command: bytes) -> list[ReachedCommand]:
        """Report a command now; gives what has reached the kit by that. The same report again is no news."""
        self._command = command
        self.rig.adapter.receive(self._report(), self.rig.now_ns)
        reached = self.rig.adapter.take_reached()
        self.rig.adapter.receive(self._report(), self.rig.now_ns)
        assert self.rig.adapter.take_reached() == []
        return reached


@pytest.mark.parametrize(("age_ms", "is_known"), [(0, True), (180, True), (200, True), (220, False), (500, False)])
def test_a_command_that_is_not_reported_is_forgotten(age_ms: int, is_known: bool) -> None:
    """A command counts as reached where it is reported within 200 ms; later it is forgotten, even if repeated."""
    car = ChosenReports(driving(1))
    requested_ns, command = car.steer(FIRST_RAD)
    car.rig.run_ms(age_ms)
    assert car.choose(command) == [ReachedCommand(requested_ns, car.rig.now_ns)] * is_known


def test_only_old_commands_are_forgotten() -> None:
    """Where a command is forgotten a younger one is not."""
    car = ChosenReports(driving(1))
    _, first = car.steer(FIRST_RAD)
    car.rig.run_ms(100)
    requested_ns, second = car.steer(SECOND_RAD)
    car.rig.run_ms(120)
    assert car.choose(first) == []
    assert car.choose(second) == [ReachedCommand(requested_ns, car.rig.now_ns)]


def test_all_old_commands_are_forgotten() -> None:
    """Where two commands became too old before the next set of frames both are forgotten."""
    car = ChosenReports(driving(1))
    car.steer(FIRST_RAD)
    _, second = car.steer(SECOND_RAD)
    car.rig.run_ms(120)
    car.rig.is_ticking = False
    car.rig.run_ms(139)
    car.rig.is_ticking = True
    car.rig.run_ms(1)
    assert car.rig.state == "engaged"
    assert car.choose(second) == []


def test_a_command_that_is_given_again_reaches_the_kit_again() -> None:
    """To and fro: each of three commands is reached at its own report, also where the last is as the first."""
    car = ChosenReports(driving(1))
    requested = [car.steer(angle_rad) for angle_rad in (FIRST_RAD, SECOND_RAD, FIRST_RAD)]
    for requested_ns, command in requested:
        car.rig.run_ms(5)
        assert car.choose(command) == [ReachedCommand(requested_ns, car.rig.now_ns)]


def test_reordered_commands_reach_nothing() -> None:
    """Where the kit reports a command those before it were overtaken; those after it are still expected."""
    car = ChosenReports(driving(1))
    (_, first), (second_ns, second), (third_ns, _) = [car.steer(each) for each in (FIRST_RAD, SECOND_RAD, FIRST_RAD)]
    assert car.choose(second) == [ReachedCommand(second_ns, car.rig.now_ns)]
    assert car.choose(first) == [ReachedCommand(third_ns, car.rig.now_ns)]
    assert car.choose(second) == []


def test_a_command_that_was_not_sent_changes_nothing() -> None:
    """A report of a command that was not sent has reached nothing, and what was sent is still expected."""
    car = ChosenReports(driving(1))
    requested_ns, command = car.steer(FIRST_RAD)
    assert car.choose(OTHER) == []
    assert car.choose(command) == [ReachedCommand(requested_ns, car.rig.now_ns)]


def test_a_repeated_command_is_expected_once() -> None:
    """A command that is repeated, or that the kit has already, is no change and reaches nothing."""
    car = ChosenReports(driving(1))
    requested_ns, command = car.steer(FIRST_RAD)
    car.rig.run_ms(100)
    assert [each.applied_ns for each in car.choose(command)] == [requested_ns]
    car.rig.run_ms(100)
    assert car.choose(car.before) == []
    car.rig.run_ms(100)
    assert car.choose(command) == []


def test_nothing_is_expected_of_a_wheel_that_was_let_go_of() -> None:
    """A command that was sent before the driver took over is not reached by a report of after that."""
    car = ChosenReports(driving(1))
    _, command = car.steer(FIRST_RAD)
    car.rig.kit.driver_brakes(0.3, car.rig.now_ns)
    car.rig.run_until(lambda rig: rig.state == "overridden")
    car.rig.run_ms(20)
    assert car.choose(command) == []
    assert car.choose(car.wheel) == []


def enable(car: ChosenReports) -> None:
    """Let a car at rest be driven until its steering is commanded: first to where the wheel is."""
    car.rig.adapter.engage(True, car.rig.now_ns)
    car.rig.run_until(lambda rig: rig.state == "enabling")
    car.rig.run_ms(10)


def test_the_first_command_is_expected_where_the_kit_has_another() -> None:
    """The first command, to where the wheel is, is expected where the kit reports another one, and only there."""
    car = ChosenReports(started(1))
    enable(car)
    assert car.choose(OTHER) == []
    assert car.choose(car.before) == []
    car.rig.adapter.engage(False, car.rig.now_ns)
    car.rig.run_until(lambda rig: rig.state == "idle")
    assert car.choose(OTHER) == []
    enable(car)
    assert len(car.choose(car.before)) == 1
