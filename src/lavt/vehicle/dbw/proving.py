"""Proves that a kit's watchdog brakes: the kit is enabled at standstill, then nothing is sent, and it has to brake.

Sans-IO, as the adapter that it uses. The gear stays as it is: what the adapter says about it is left out. What counts
is what the kit reports: the brake is not enabled any more, and yet it brakes, within `BRAKE_WITHIN_NS` of the last
frame and in every report from then on.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, Literal

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation
from lavt.value import value
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.adapter import ByWireAdapter
from lavt.vehicle.dbw.crc8 import frame_crc8
from lavt.vehicle.dbw.profile import AXES, OwnBrake, Profile
from lavt.vehicle.dbw.reports import Kind, NewestReports
from lavt.vehicle.dbw.states import STATIONARY_BELOW_MPS

BRAKE: Final = 0.3
"""What is asked of the brake while the kit is enabled."""
TICK_NS: Final = 20 * NS_PER_MS
LOOK_NS: Final = 500 * NS_PER_MS
"""Before anything is sent the kit is looked at for so long: it must not brake by itself already."""
HEAR_LIMIT_NS: Final = 3 * NS_PER_S
"""In so long all reports have to be there."""
HOLD_NS: Final = 500 * NS_PER_MS
"""The kit is held enabled for so long before the silence begins."""
BRAKE_WITHIN_NS: Final = 500 * NS_PER_MS
WATCH_NS: Final = NS_PER_S
"""After the last frame the kit is watched for so long."""
SAID: Final[tuple[Kind, ...]] = ("trip", "lapse", "fault", "reason")
"""What a kit that was left alone says of it."""

Phase = Literal["looking", "enabling", "watching", "done"]


@value
class WatchdogObservation:
    """What was seen of a kit that was left alone, in ns after the last frame that it got."""

    released_ns: int
    """Its brake was reported not enabled."""
    braked_ns: int
    """It was reported to brake by itself."""
    reports: int
    """So many reports of the brake came in the silence."""
    words: str
    """What else the kit said about it."""


class WatchdogTest:
    """One attempt; call `receive` for each frame heard and `frames_due` each few milliseconds, until it `is_done`.

    In the end `failure` says why nothing is proved, or `seen` what was.
    """

    def __init__(self, profile: Profile, watchdog: OwnBrake, *, start_ns: int) -> None:
        self._profile, self._watchdog = profile, watchdog
        self._adapter = ByWireAdapter(profile, start_ns=start_ns)
        self._reports = NewestReports(profile, start_ns)
        self._phase: Phase = "looking"
        self._since_ns = self._tick_ns = self._last_ns = start_ns
        self._enabled_ns: int | None = None
        self._released_ns: int | None = None
        self._braked_ns: int | None = None
        self._watched = 0
        messages = profile.codec.messages
        commands = [profile.gear.message, *(axis.message for axis in profile.axes.values())]
        commands += [profile.system.message] if profile.system else []
        self._commands = {messages[message].identifier for message in commands}
        self._gear_command = messages[profile.gear.message].identifier
        self.failure = ""
        self.seen: WatchdogObservation | None = None

    @property
    def is_done(self) -> bool:
        """Whether there is a result."""
        return self._phase == "done"

    @property
    def gear(self) -> str:
        """The gear that the car was left in."""
        return self._reports.gear or "unknown"

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Take a frame that was heard."""
        if frame.identifier in self._commands:
            self._fail(f"somebody else commands the kit (0x{frame.identifier:03X}): leave the bus to this program")
            return
        self._adapter.receive(frame, now_ns)
        self._reports.receive(frame, now_ns)
        brakes = self._brakes_itself(frame)
        if brakes is None:
            return
        if self._phase == "looking" and brakes:
            self._fail("the kit brakes by itself, or somebody does, before anything was sent: take over, and let go")
        elif self._phase == "watching":
            self._watch(brakes, now_ns)

    def bus_gone(self, why: str) -> None:
        """Hear from the port that the bus is gone."""
        self._fail(f"the bus is gone: {why}")

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Give the frames that leave now."""
        steps: dict[Phase, Callable[[int], list[CanFrame]]] = {
            "looking": self._look,
            "enabling": self._enable,
            "watching": self._wait,
            "done": lambda _: [],
        }
        return steps[self._phase](now_ns)

    def _look(self, now_ns: int) -> list[CanFrame]:
        """Wait until the kit is heard, and make sure that it may be enabled."""
        passed_ns, missing = now_ns - self._since_ns, self._reports.missing(now_ns)
        if missing:
            if passed_ns >= HEAR_LIMIT_NS:
                self._fail(f"the kit is not heard: {', '.join(missing)}")
            return []
        self._adapter.ask(self._requested(), now_ns)  # nobody wants to drive yet: nothing leaves
        inhibit_reason = self._adapter.state().inhibit_reason
        if passed_ns < LOOK_NS:
            return []
        if abs(self._reports.speed_mps) >= STATIONARY_BELOW_MPS:
            self._fail("the car does not stand: let it stand, its wheels off the ground")
        elif self._reports.gear not in {"park", "neutral"}:
            self._fail(f"the gear is {self.gear}: put it into park or neutral")
        elif inhibit_reason:
            self._fail(f"the kit cannot be enabled: {inhibit_reason}")
        else:
            self._enter("enabling", now_ns)
            self._adapter.engage(True, now_ns)
        return []

    def _enable(self, now_ns: int) -> list[CanFrame]:
        """Have the kit enabled, and hold it so for a while."""
        if now_ns - self._tick_ns >= TICK_NS:
            self._tick_ns = now_ns
            self._adapter.ask(self._requested(), now_ns)
        if self._reports.enabled == frozenset(AXES):
            self._enabled_ns = now_ns if self._enabled_ns is None else self._enabled_ns
            if now_ns - self._enabled_ns >= HOLD_NS:
                self._enter("watching", now_ns)
                return []
        frames = [each for each in self._adapter.frames_due(now_ns) if each.identifier != self._gear_command]
        state = self._adapter.state()
        if state.inhibit_reason or state.is_overridden:
            self._fail(f"the kit did not stay enabled: {state.inhibit_reason}")
            return []
        if frames:
            self._last_ns = now_ns
        return frames

    def _wait(self, now_ns: int) -> list[CanFrame]:
        """Send nothing, and tell what came of it."""
        if now_ns - self._last_ns < WATCH_NS:
            return []
        reports = self._reports
        overrides = reports.said("override")
        if self._released_ns is None:
            self._fail("the kit did not let go of the brake: somebody else may command it, or its time-out is off")
        elif self._braked_ns is None or self._braked_ns - self._last_ns > BRAKE_WITHIN_NS:
            late = "" if self._braked_ns is None else f", but only after {self._ms(self._braked_ns)} ms"
            self._fail(
                f"the kit did not brake within {BRAKE_WITHIN_NS // NS_PER_MS} ms of the last frame{late}, in gear "
                f"{self.gear}: have its watchdog with brake action switched on"
            )
        elif overrides:
            self._fail(f"the driver braked or steered: {', '.join(overrides)}")
        else:
            words = "; ".join(words for kind in SAID for words in reports.said(kind))
            released_ns, braked_ns = self._released_ns - self._last_ns, self._braked_ns - self._last_ns
            self.seen = WatchdogObservation(released_ns, braked_ns, self._watched, words)
            self._phase = "done"
        return []

    def _watch(self, brakes: bool, now_ns: int) -> None:
        self._watched += 1
        if "brake" in self._reports.enabled:
            return
        if self._released_ns is None:
            self._released_ns = now_ns
        if brakes and self._braked_ns is None:
            self._braked_ns = now_ns
        if not brakes and self._braked_ns is not None:
            self._fail(f"the kit braked for {(now_ns - self._braked_ns) // NS_PER_MS} ms only, and let go again")

    def _brakes_itself(self, frame: CanFrame) -> bool | None:
        """Whether a report of the brake says that the kit brakes by itself; None for any other frame."""
        decoded = self._profile.codec.decode(frame)
        if decoded is None or decoded[0] != self._watchdog.message:
            return None
        report = self._profile.reports[decoded[0]]
        if report.checksum and frame.data[-1] != frame_crc8(
            frame.identifier, frame.data[:-1], extended=frame.is_extended
        ):
            return None
        amount = decoded[1][self._watchdog.signal]
        return amount is not None and amount > self._watchdog.above

    def _requested(self) -> Actuation:
        """The wheel where it is, and the brake."""
        return Actuation(self._adapter.state().steering_rad, 0.0, BRAKE)

    def _enter(self, phase: Phase, now_ns: int) -> None:
        self._phase, self._since_ns = phase, now_ns

    def _fail(self, why: str) -> None:
        if not self.is_done:
            self.failure, self._phase = why, "done"

    def _ms(self, at_ns: int) -> int:
        return (at_ns - self._last_ns) // NS_PER_MS
