"""A test that a kit's watchdog brakes: enable the kit at standstill, stop sending, and check that it brakes.

The test does no I/O. It commands the kit through an adapter, but leaves out the adapter's gear commands, so the gear
does not change. The kit passes if it reports, at most `BRAKE_WITHIN_NS` after the last frame, that the brake is no
longer enabled and that the kit brakes nevertheless. All later reports must say the same.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal

from msgspec import Struct

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.crc8 import has_valid_checksum
from lavt.vehicle.dbw.profile import AXES, OwnBrake, Profile
from lavt.vehicle.dbw.reports import Kind, NewestReports
from lavt.vehicle.dbw.states import STATIONARY_BELOW_MPS

BRAKE: Final = 0.3
"""Brake that is requested as long as the kit is enabled."""
TICK_NS: Final = 20 * NS_PER_MS
"""Period of the adapter's ticks."""
OBSERVE_NS: Final = 500 * NS_PER_MS
"""The kit is observed for this long before anything is sent. During this time it must not brake on its own."""
REPORT_LIMIT_NS: Final = 3 * NS_PER_S
"""All reports must arrive before this time has passed."""
ENABLED_NS: Final = 500 * NS_PER_MS
"""The kit stays enabled for this long before sending stops."""
BRAKE_WITHIN_NS: Final = 500 * NS_PER_MS
"""The longest time between the last frame and the first report that the kit brakes on its own."""
MONITOR_NS: Final = NS_PER_S
"""The kit is monitored for this long after the last frame."""
LEAST_REPORTS: Final = 10
"""The smallest number of brake reports during `MONITOR_NS`; generation 2 sends 50."""
OBSERVED_KINDS: Final[tuple[Kind, ...]] = ("trip", "command_error", "fault", "reason")
"""The kinds of texts that are part of the observation."""

Phase = Literal["observing", "enabling", "monitoring", "done"]


class WatchdogObservation(Struct, frozen=True):
    """The kit's behaviour after sending stopped. Times are counted from the last frame."""

    released_ns: int
    """When the brake was first reported as not enabled."""
    braked_ns: int
    """When the kit was first reported to brake on its own."""
    reports: int
    """Number of brake reports after the last frame."""
    kit_messages: str
    """Texts of the kinds `OBSERVED_KINDS` from the kit's reports."""


class WatchdogTest:
    """One test of a kit. Call `receive` for each frame, and `frames_due` every few milliseconds, until `is_done`.

    If the test failed, `failure` then has the reason. Otherwise `observation` has the kit's behaviour.
    """

    def __init__(self, profile: Profile, watchdog: OwnBrake, *, start_ns: int) -> None:
        self._profile, self._watchdog = profile, watchdog
        self._adapter = ByWireAdapter(profile, start_ns=start_ns)
        self._reports = NewestReports(profile, start_ns)
        self._phase: Phase = "observing"
        self._phase_start_ns = self._tick_ns = self._last_frame_ns = start_ns
        self._enabled_ns: int | None = None
        self._released_ns: int | None = None
        self._braked_ns: int | None = None
        self._monitored_reports = 0
        messages = profile.codec.messages
        commands = [profile.gear.message, *(axis.message for axis in profile.axes.values())]
        commands += [profile.system.message] if profile.system else []
        self._commands = {messages[message].identifier for message in commands}
        self._gear_command = messages[profile.gear.message].identifier
        self.failure = ""
        self.observation: WatchdogObservation | None = None

    @property
    def is_done(self) -> bool:
        """Whether the test has a result."""
        return self._phase == "done"

    @property
    def gear(self) -> str:
        """The car's gear, which the test does not change."""
        return self._reports.gear or "unknown"

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Process a frame from the bus."""
        if frame.identifier in self._commands:
            self._fail(f"another sender commands the kit (0x{frame.identifier:03X}): leave the bus to this program")
            return
        self._adapter.receive(frame, now_ns)
        self._reports.receive(frame, now_ns)
        brakes = self._is_self_braking(frame)
        if brakes is None:
            return
        if self._phase == "observing" and brakes:
            self._fail("the kit or a driver brakes before anything was sent: press the brake pedal and release it")
        elif self._phase == "monitoring":
            self._monitor(brakes, now_ns)

    def on_bus_gone(self, reason: str) -> None:
        """Fail the test because the bus is gone."""
        self._fail(f"the bus is gone: {reason}")

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Return the frames to send now."""
        phases: dict[Phase, Callable[[int], list[CanFrame]]] = {
            "observing": self._observe,
            "enabling": self._enable,
            "monitoring": self._await_result,
            "done": lambda _: [],
        }
        return phases[self._phase](now_ns)

    def _observe(self, now_ns: int) -> list[CanFrame]:
        """Wait for all reports, and check that the kit can be enabled."""
        passed_ns, missing = now_ns - self._phase_start_ns, self._reports.missing(now_ns)
        if missing:
            if passed_ns >= REPORT_LIMIT_NS:
                self._fail(f"the kit's reports are missing: {', '.join(missing)}")
            return []
        self._adapter.set_actuation(self._actuation(), now_ns)  # sends nothing: driving is not wanted yet
        inhibit_reason = self._adapter.state().inhibit_reason
        if passed_ns < OBSERVE_NS:
            return []
        if abs(self._reports.speed_mps) >= STATIONARY_BELOW_MPS:
            self._fail("the car is moving: let it come to a standstill, its wheels off the ground")
        elif self._reports.gear not in {"park", "neutral"}:
            self._fail(f"the gear is {self.gear}: put it into park or neutral")
        elif inhibit_reason:
            self._fail(f"the kit cannot be enabled: {inhibit_reason}")
        else:
            self._enter("enabling", now_ns)
            self._adapter.engage(True, now_ns)
        return []

    def _enable(self, now_ns: int) -> list[CanFrame]:
        """Enable the kit, and keep it enabled for `ENABLED_NS`."""
        if now_ns - self._tick_ns >= TICK_NS:
            self._tick_ns = now_ns
            self._adapter.set_actuation(self._actuation(), now_ns)
        if self._reports.enabled == frozenset(AXES):
            self._enabled_ns = now_ns if self._enabled_ns is None else self._enabled_ns
            if now_ns - self._enabled_ns >= ENABLED_NS:
                self._enter("monitoring", now_ns)
                return []
        frames = [frame for frame in self._adapter.frames_due(now_ns) if frame.identifier != self._gear_command]
        state = self._adapter.state()
        if state.inhibit_reason or state.is_overridden:
            self._fail(f"the kit did not stay enabled: {state.inhibit_reason}")
            return []
        if frames:
            self._last_frame_ns = now_ns
        return frames

    def _await_result(self, now_ns: int) -> list[CanFrame]:
        """Send nothing, and evaluate the kit's behaviour at the end of the phase."""
        if now_ns - self._last_frame_ns < MONITOR_NS:
            return []
        reports = self._reports
        overrides = reports.texts("override")
        if self._released_ns is None:
            self._fail("the kit did not release the brake: another sender may command it, or its timeout is off")
        elif self._braked_ns is None or self._braked_ns - self._last_frame_ns > BRAKE_WITHIN_NS:
            late = "" if self._braked_ns is None else f", but only after {self._ms(self._braked_ns)} ms"
            self._fail(
                f"the kit did not brake within {BRAKE_WITHIN_NS // NS_PER_MS} ms of the last frame{late}, in gear "
                f"{self.gear}: switch on its watchdog with brake action"
            )
        elif self._monitored_reports < LEAST_REPORTS:
            self._fail(f"the kit reported its brake only {self._monitored_reports} times, not {LEAST_REPORTS}")
        elif overrides:
            self._fail(f"override by the driver: {', '.join(overrides)}")
        else:
            kit_messages = "; ".join(text for kind in OBSERVED_KINDS for text in reports.texts(kind))
            released_ns, braked_ns = self._released_ns - self._last_frame_ns, self._braked_ns - self._last_frame_ns
            self.observation = WatchdogObservation(released_ns, braked_ns, self._monitored_reports, kit_messages)
            self._phase = "done"
        return []

    def _monitor(self, brakes: bool, now_ns: int) -> None:
        self._monitored_reports += 1
        if "brake" in self._reports.enabled:
            return
        if self._released_ns is None:
            self._released_ns = now_ns
        if brakes and self._braked_ns is None:
            self._braked_ns = now_ns
        if not brakes and self._braked_ns is not None:
            self._fail(f"the kit released the brake again after {(now_ns - self._braked_ns) // NS_PER_MS} ms")

    def _is_self_braking(self, frame: CanFrame) -> bool | None:
        """Return whether a brake report shows that the kit brakes on its own; None for any other frame."""
        decoded = self._profile.codec.decode(frame)
        if decoded is None:
            return None
        message, values = decoded
        if message != self._watchdog.message:
            return None
        if self._profile.reports[message].checksum and not has_valid_checksum(frame):
            return None
        amount = values[self._watchdog.signal]
        return amount is not None and amount > self._watchdog.above

    def _actuation(self) -> Actuation:
        """Return an actuation that brakes and keeps the steering angle."""
        return Actuation(self._adapter.state().steering_rad, 0.0, BRAKE)

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self._phase, self._phase_start_ns = phase, now_ns

    def _fail(self, reason: str) -> None:
        if not self.is_done:
            self.failure, self._phase = reason, "done"

    def _ms(self, at_ns: int) -> int:
        return (at_ns - self._last_frame_ns) // NS_PER_MS
