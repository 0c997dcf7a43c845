"""The by-wire adapter, without I/O: it takes frames and times, and returns frames. Its states are in `states.py`."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from msgspec.structs import replace

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleEvent, VehicleState
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.profile import (
    AXES,
    CLEARING_PERIOD_NS,
    COMMAND_TIMEOUT_NS,
    LEAST_GAP_NS,
    REPEAT_PERIOD_NS,
    TICK_LIMIT_NS,
    Axis,
    Gear,
    Profile,
)
from lavt.vehicle.dbw.reports import NewestReports
from lavt.vehicle.dbw.sending import DriveCommand, FrameSender, KitCommands
from lavt.vehicle.dbw.speed_monitor import Pedals, SpeedMonitor
from lavt.vehicle.dbw.states import KIT_RESPONSE_LIMIT_NS, Situation, State, states_after
from lavt.vehicle.vehicle import ReachedCommand

SHIFT_REPORT_LIMIT_NS: Final = NS_PER_S
"""Our assumption: a kit needs at most this long to report a requested shift to DRIVE."""
STATIONARY_BEFORE_PARK_NS: Final = 300 * NS_PER_MS
"""Our choice: PARK is requested when the car has been reported stationary for this long. A single report can be wrong,
or come from locked wheels. A car that slides at 4 m/s2 loses 1.2 m/s in this time."""
IDLE_PERIOD_NS: Final = 100 * NS_PER_MS
"""Period at which `frames_due` should be called if nothing is due earlier."""
ECHO_LIMIT_NS: Final = 200 * NS_PER_MS
"""A command that the kit has not echoed after this time is regarded as superseded by another command."""
SEPARATOR: Final = "; "
"""Separates the texts that `_join` joins."""
MAY_MOVE: Final = "the car moves, or may move"
NO_AXES: Final[frozenset[Axis]] = frozenset()


class ByWireAdapter:
    """A controller for the by-wire kit that a profile describes.

    Each call of `set_actuation` is a tick. Frames are sent only if the newest tick is at most 60 ms old.
    The kit is never engaged if `inhibit_reason`, which does not change, is not empty.
    """

    def __init__(self, profile: Profile, *, start_ns: int, inhibit_reason: str = "") -> None:
        self._profile = profile
        self._reports, self._sender = NewestReports(profile, start_ns), FrameSender(profile, start_ns)
        self._speed = SpeedMonitor(
            max_acceleration_mps2=profile.car.max_acceleration_mps2, max_braking_mps2=profile.car.max_braking_mps2
        )
        unknown_sign = "the steering's sign is not known: set vehicle.dbw.steering_sign"
        self._permanent_inhibit = _join([inhibit_reason, unknown_sign if profile.car.steering_sign is None else ""])
        self._state: State = "idle"
        self._entered_ns = self._now_ns = start_ns
        self._stop_reason = ""
        """Reason for the state `lost` or `overridden`."""
        self._wanted, self._bus_error = False, ""
        self._still_enabled: frozenset[Axis] = NO_AXES
        """In `lost` and `parking` the axes enabled ever since driving ended; otherwise all enabled axes."""
        self._expects_no_release = False
        """Whether the kit has no reason to release its axes: an axis was enabled when `parking` began, and no
        command to disable it has been sent since then."""
        self._needed_axes = frozenset({"brake"}) if profile.system is None else frozenset(AXES)
        """If the kit releases one of these axes, no command is sent any more, so that its watchdog brakes. With a
        system command these are all axes: a command that leaves the released axis disabled would disable the brake,
        too, and keep the watchdog from braking."""
        self._moved_ns = start_ns
        """Time of the last report that the car moves."""
        self._is_shifting = False
        """Whether DRIVE was requested and is not reported yet. A report of PARK is then unreliable."""
        self._requested = Actuation(0.0, 0.0, 0.0)
        self._requested_ns: int | None = None
        self._last_commands: KitCommands | None = None
        """Commands of the last set of frames; None if nothing is being sent, or if not all of the set was written."""
        self._is_tick_late = False
        self._known_problems: frozenset[str] = frozenset()
        self._events: list[VehicleEvent] = []
        self._awaited_echoes: deque[tuple[int, int]] = deque()
        """Steering commands sent and not yet echoed: angle in units of the kit's resolution, and time of the tick."""
        self._last_steering_units: int | None = None
        """The steering command of the last set of frames, in the same unit; None if steering was not enabled."""
        self._reached: list[ReachedCommand] = []
        self._counts: Counter[str] = Counter()
        self._situation = self._current_situation(start_ns)
        """The last input of the state machine."""

    @property
    def is_idle_or_overridden(self) -> bool:
        """Whether no actuation is requested of the kit."""
        return self._state in {"idle", "overridden"}

    # Inputs.

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Process any frame from the bus."""
        self._bus_error = ""
        before = self._reports.steering_echo
        self._reports.receive(frame, now_ns)
        if self._reports.steering_echo != before:
            self._match_echo(now_ns)
        self._update_state(now_ns)

    def on_bus_gone(self, reason: str, now_ns: int) -> None:
        """Handle the loss of the bus, which lasts until the next received frame."""
        self._bus_error = reason
        self._update_state(now_ns)

    def set_actuation(self, actuation: Actuation, now_ns: int) -> None:
        """Set the requested actuation; each call is a tick. A call with a value that is not finite is only counted."""
        if not all(map(math.isfinite, (actuation.steering_rad, actuation.throttle, actuation.brake))):
            self._counts["actuations_rejected"] += 1
            return
        self._requested, self._requested_ns = actuation, now_ns

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Set whether driving is wanted."""
        if wanted != self._wanted:
            self._wanted = wanted
            self._update_state(now_ns)

    # State machine.

    def _update_state(self, now_ns: int) -> None:
        """Apply the transitions of this instant."""
        self._now_ns = now_ns
        self._check_speed(now_ns)
        enabled = self._surely_enabled(now_ns)
        self._still_enabled = enabled & self._still_enabled if self._state in {"lost", "parking"} else enabled
        self._is_shifting &= self._reports.gear != "drive"
        if not self._is_stationary():
            self._moved_ns = now_ns
        self._record_new_problems(now_ns)
        self._situation = self._current_situation(now_ns)
        for state, reason in states_after(self._state, self._situation):
            if state in {"lost", "overridden"}:
                self._stop_reason = reason
                if not self._known_problems.issuperset(reason.split(SEPARATOR)):
                    self._events.append(VehicleEvent(now_ns, "fault", reason))
            self._state, self._entered_ns = state, now_ns
            self._expects_no_release = state == "parking" and bool(enabled)
            self._situation = replace(self._situation, in_state_ns=0, expects_no_release=self._expects_no_release)

    def _surely_enabled(self, now_ns: int) -> frozenset[Axis]:
        """Return the enabled axes; none if the kit's watchdog may have tripped since the last report."""
        is_watchdog_due = now_ns - self._sender.last_set_ns >= COMMAND_TIMEOUT_NS
        return NO_AXES if is_watchdog_due else self._reports.enabled

    def _is_stationary(self) -> bool:
        return self._speed.is_stationary and self._speed.fault is None

    def _check_speed(self, now_ns: int) -> None:
        """Check the reported speeds, given the pedals that the kit applies: those sent last, on enabled axes."""
        sent, enabled = self._sender.last_command, self._surely_enabled(now_ns)
        pedals = Pedals(
            throttle=sent.throttle if "throttle" in enabled else 0.0,
            brake=sent.brake if "brake" in enabled else 0.0,
            is_brake_axis_released="brake" not in enabled,
        )
        if (fault := self._speed.update(self._reports.speeds, pedals, now_ns)) is not None:
            self._counts[fault.code] += 1

    @property
    def _speed_fault(self) -> str:
        return self._speed.fault or ""

    def _current_situation(self, now_ns: int) -> Situation:
        reports = self._reports
        missing_reports = _join([self._bus_error, *reports.missing(now_ns)])
        faults = _join([reports.other_commander(now_ns), self._speed_fault, *reports.texts("fault")])
        return Situation(
            wanted=self._wanted,
            is_stationary=self._is_stationary(),
            inhibit_reason=_join([self._permanent_inhibit, missing_reports, faults, self._wheel_limit_text()]),
            missing_reports=missing_reports,
            since_sent_ns=now_ns - self._sender.last_set_ns,
            faults=faults,
            overrides=_join(reports.texts("override")),
            watchdog_trips=_join(reports.texts("trip")),
            command_errors=_join(reports.texts("command_error")),
            kit_reasons=_join(reports.texts("reason")),
            enabled=reports.enabled,
            gear=reports.gear,
            in_state_ns=now_ns - self._entered_ns,
            expects_no_release=self._expects_no_release,
        )

    def _wheel_limit_text(self) -> str:
        """Return a text if the steering wheel is beyond its limit, except when engaged: then commands turn it back."""
        limit_deg, wheel_deg = self._profile.limits.steering_wheel_deg, self._reports.wheel_deg
        if self._state == "engaged" or abs(wheel_deg) <= limit_deg:
            return ""
        return f"the steering wheel is at {wheel_deg:.1f} deg, beyond the limit of {limit_deg:g} deg"

    def _record_new_problems(self, now_ns: int) -> None:
        """Emit an event for each newly reported problem."""
        reports = self._reports
        problems = [*reports.texts("override"), *reports.texts("trip"), *reports.texts("fault")]
        problems += [self._speed_fault] if self._speed_fault else []
        self._events += [VehicleEvent(now_ns, "fault", text) for text in problems if text not in self._known_problems]
        self._known_problems = frozenset(problems)

    # Frames to send.

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Return the frames to send now: none if the newest tick is too old or nothing is due."""
        self._update_state(now_ns)
        commands = self._kit_commands()
        if commands is None or self._bus_error:
            self._last_commands = None
            return []
        if not self._is_fresh(now_ns):
            if not self._is_tick_late:
                self._counts["ticks_missed"] += 1
            self._is_tick_late = True
            return []
        self._is_tick_late = False
        requested = self._drive_command()
        if commands == self._last_commands and now_ns < self._due_ns(requested):
            return []
        self._last_commands = commands
        self._is_shifting |= commands.gear == "drive"
        self._expects_no_release &= bool(commands.enabled)
        frames = self._sender.frames(commands, requested, self._reports.wheel_deg, now_ns)
        self._expect_echo(commands)
        return frames

    def on_dropped(self, frames: Sequence[CanFrame]) -> None:
        """Record that `frames`, the last ones of those that `frames_due` returned, were not written.

        A complete set of frames is then due at the next tick.
        """
        if frames:
            self._sender.take_back(frames)
            self._last_commands = None

    def _is_fresh(self, now_ns: int) -> bool:
        return self._requested_ns is not None and now_ns - self._requested_ns <= TICK_LIMIT_NS

    def _due_ns(self, requested: DriveCommand) -> int:
        """Return when the next set of frames is due; it is due earlier if the drive command has changed."""
        if self._state == "clearing":
            return self._sender.last_set_ns + CLEARING_PERIOD_NS
        return self._sender.last_set_ns + (REPEAT_PERIOD_NS if requested == self._sender.last_command else LEAST_GAP_NS)

    def _kit_commands(self) -> KitCommands | None:
        """Return the commands to the kit in the current state."""
        reports, all_axes = self._reports, frozenset(AXES)
        if self._state == "clearing":
            return KitCommands(NO_AXES, is_clearing=True)
        if self._state == "enabling":
            may_shift = self._wanted and reports.enabled == all_axes and reports.gear != "drive"
            return KitCommands(all_axes, gear="drive" if may_shift else None, system="enable")
        if self._state == "engaged":
            return KitCommands(all_axes, system="enable")
        if self._state == "lost":
            return self._commands_to_still_enabled_axes()
        if self._state == "parking":
            return self._parking_commands()
        return KitCommands(NO_AXES) if self._state == "overridden" else None

    def _parking_commands(self) -> KitCommands | None:
        """Return the commands to brake, then to shift to PARK, and then to disengage.

        Disengaging in another gear would trip the watchdog.
        """
        is_shifting = self._is_shifting and self._now_ns - self._entered_ns < SHIFT_REPORT_LIMIT_NS
        if self._reports.gear == "park" and not is_shifting:
            return KitCommands(NO_AXES, system="disable")
        may_park = self._now_ns - self._moved_ns >= STATIONARY_BEFORE_PARK_NS
        return self._commands_to_still_enabled_axes("park" if may_park else None)

    def _commands_to_still_enabled_axes(self, gear: Gear | None = None) -> KitCommands | None:
        """Return the commands to the axes that are still enabled.

        Return None if an axis that is needed to brake is released. Without commands the kit's watchdog brakes.
        """
        if not self._needed_axes <= self._still_enabled:
            return None
        return KitCommands(self._still_enabled, gear=gear, system="enable")

    def _drive_command(self) -> DriveCommand:
        """Return the drive command of the current state, before the limits."""
        requested, limits = self._requested, self._profile.limits
        wheel_deg = self._profile.wheel_deg(requested.steering_rad)
        if self._speed.fault is not None:
            return DriveCommand(wheel_deg, 0.0, 1.0)
        if self._state == "engaged":
            return DriveCommand(wheel_deg, requested.throttle, requested.brake)
        needs_brake = self._state in {"enabling", "parking"}
        brake = max(requested.brake, limits.holding_brake) if needs_brake else requested.brake
        return DriveCommand(wheel_deg, 0.0, brake)

    # Echoes of the steering commands.

    def _expect_echo(self, commands: KitCommands) -> None:
        """Expect the kit to echo the steering command just sent, if it differs from the previous one."""
        if "steering" not in commands.enabled or self._requested_ns is None:
            self._awaited_echoes.clear()
            self._last_steering_units = None
            return
        while self._awaited_echoes and self._requested_ns - self._awaited_echoes[0][1] > ECHO_LIMIT_NS:
            self._awaited_echoes.popleft()
        units = round(self._sender.last_command.wheel_deg / self._profile.command_step_deg)
        if units != (self._reports.steering_echo if self._last_steering_units is None else self._last_steering_units):
            self._awaited_echoes.append((units, self._requested_ns))
        self._last_steering_units = units

    def _match_echo(self, now_ns: int) -> None:
        """Match the newest echo with a sent command; the commands sent before it were superseded."""
        if not any(units == self._reports.steering_echo for units, _ in self._awaited_echoes):
            return
        while self._awaited_echoes:
            units, requested_ns = self._awaited_echoes.popleft()
            if units == self._reports.steering_echo:
                self._reached.append(ReachedCommand(requested_ns, now_ns))
                return

    # Outputs.

    def state(self) -> VehicleState:
        """Return the newest state; its time is that of the newest report of `speed`."""
        reports = self._reports
        return VehicleState(
            mono_ns=reports.speeds["speed"].mono_ns,
            speed_mps=self._speed.speed_mps,
            steering_rad=self._profile.road_rad(reports.wheel_deg),
            gear=reports.gear or "neutral",
            inhibit_reason=self._inhibit_reason(),
            is_engaged=self._state == "engaged",
            is_overridden=self._state == "overridden",
            is_speed_plausible=self._speed.fault is None,
        )

    def _inhibit_reason(self) -> str:
        situation = self._situation
        reasons = [self._stop_reason if self._state in {"lost", "overridden"} else "", situation.inhibit_reason]
        if self._state == "idle" and not situation.is_stationary:
            reasons.append(MAY_MOVE)
        if self._state == "parking" and situation.in_state_ns >= KIT_RESPONSE_LIMIT_NS:
            reasons.append("the car is stationary but not in park" if situation.is_stationary else MAY_MOVE)
            reasons.append(situation.kit_reasons)
        return _join(reasons)

    def next_wake_ns(self) -> int:
        """Return the time by which `frames_due` should be called next."""
        wake_ns = self._now_ns + IDLE_PERIOD_NS
        if self._last_commands is not None and self._is_fresh(self._now_ns):
            wake_ns = min(wake_ns, max(self._due_ns(self._drive_command()), self._now_ns + 1))
        deadline_ns = self._reports.deadline_ns(self._now_ns)
        return wake_ns if deadline_ns is None else min(wake_ns, deadline_ns)

    def take_events(self) -> list[VehicleEvent]:
        """Return the events since the last call."""
        events, self._events = self._events, []
        return events

    def take_reached(self) -> list[ReachedCommand]:
        """Return the steering commands that the kit reported as reached since the last call."""
        reached, self._reached = self._reached, []
        return reached

    @property
    def tick_ns(self) -> int | None:
        """Time of the newest tick; no frame is sent more than 60 ms after it."""
        return self._requested_ns

    @property
    def counts(self) -> Mapping[str, int]:
        """Counters of inputs and frames that were dropped, rejected, limited or late."""
        return {**self._profile.codec.counts, **self._reports.counts, **self._sender.counts, **self._counts}


def _join(texts: Iterable[str]) -> str:
    """Join texts and keep each part once; a text can consist of parts that were joined already."""
    present = [text for text in texts if text]
    if not present:  # nearly always
        return ""
    return SEPARATOR.join(dict.fromkeys(part for text in present for part in text.split(SEPARATOR) if part))
