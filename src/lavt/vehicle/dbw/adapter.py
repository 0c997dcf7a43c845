"""The by-wire adapter, sans-IO: frames and `now` in, frames out. Its states are in `states.py`."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Iterable, Mapping
from typing import Final

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleEvent, VehicleState
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.dbw.profile import (
    AXES,
    CLEARING_PERIOD_NS,
    COMMAND_TIMEOUT_NS,
    LEAST_GAP_NS,
    PERIOD_NS,
    TICK_LIMIT_NS,
    Axis,
    Profile,
)
from lavt.vehicle.dbw.reports import NewestReports
from lavt.vehicle.dbw.sending import DriveCommand, FrameSender, KitCommands
from lavt.vehicle.dbw.states import ENABLING_LIMIT_NS, STATIONARY_BELOW_MPS, Situation, State, following
from lavt.vehicle.vehicle import ReachedCommand

SHIFT_NS: Final = NS_PER_S
"""Ours: a shift that was begun may be reported so late."""
STOOD_NS: Final = 300 * NS_PER_MS
"""Ours: the car is reported to stand for so long before PARK is asked for. One report may be wrong, or of wheels that
lock; at 4 m/s2 a car that still slides is 1.2 m/s slower by then."""
LOOK_NS: Final = 100 * NS_PER_MS
"""So often the adapter wants to be called when nothing else is due."""
ECHO_LIMIT_NS: Final = 200 * NS_PER_MS
"""A command that the kit has not reported for so long was overtaken by another."""
SEPARATOR: Final = "; "
NO_AXES: Final[frozenset[Axis]] = frozenset()


class ByWireAdapter:
    """Speaks to one by-wire kit by a profile.

    A tick is a call of `ask`; frames leave only while the newest is at most 60 ms old. `inhibit_reason` is of the
    installation: where it is not empty, the kit is never engaged.
    """

    def __init__(self, profile: Profile, *, start_ns: int, inhibit_reason: str = "") -> None:
        self._profile = profile
        self._reports, self._sender = NewestReports(profile, start_ns), FrameSender(profile, start_ns)
        signless = "the steering's sign is not known: set vehicle.dbw.steering_sign"
        self._installation = _joined([inhibit_reason, signless if profile.car.steering_sign is None else ""])
        self._state: State = "idle"
        self._entered_ns = self._now_ns = start_ns
        self._why = ""
        """Why the state is lost or overridden."""
        self._wanted, self._gone = False, ""
        self._kept: frozenset[Axis] = NO_AXES
        """Axes that were enabled when driving ended, and still are."""
        self._moved_ns = start_ns
        """When the car was last reported to move."""
        self._is_shifting = False
        """DRIVE was asked for, and is not reported yet: PARK that is reported is none to rely on."""
        self._requested = Actuation(0.0, 0.0, 0.0)
        self._requested_ns: int | None = None
        self._plan: KitCommands | None = None
        """What the last set said; None: nothing is being said."""
        self._is_late = False
        self._told: frozenset[str] = frozenset()
        self._events: list[VehicleEvent] = []
        self._echoes: deque[tuple[int, int]] = deque()
        """Steering commands sent and not yet seen in a report: in its steps, and when they were asked for."""
        self._expected: int | None = None
        """The steering command of the last set, in its steps; None: it had none."""
        self._reached: list[ReachedCommand] = []
        self._counts: Counter[str] = Counter()
        self._seen = self._situation(start_ns)
        """What the table of states looked at last."""

    @property
    def is_silent(self) -> bool:
        """Whether nothing is asked of the kit: it has let go, or a driver has the car."""
        return self._state in {"idle", "overridden"}

    # What comes in.

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Take a frame from the bus, whatever it is."""
        self._gone = ""
        before = self._reports.command
        self._reports.receive(frame, now_ns)
        if self._reports.command != before:
            self._echo(now_ns)
        self._settle(now_ns)

    def bus_gone(self, why: str, now_ns: int) -> None:
        """Hear from the port that the bus is gone; it is back when a frame comes."""
        self._gone = why
        self._settle(now_ns)

    def ask(self, actuation: Actuation, now_ns: int) -> None:
        """Take what the car is to do: a tick. What is no number is dropped and counted, and is no tick."""
        if not all(map(math.isfinite, (actuation.steering_rad, actuation.throttle, actuation.brake))):
            self._counts["actuations_rejected"] += 1
            return
        self._requested, self._requested_ns = actuation, now_ns

    def engage(self, wanted: bool, now_ns: int) -> None:
        """Hear whether somebody wants to drive."""
        if wanted != self._wanted:
            self._wanted = wanted
            self._settle(now_ns)

    # States.

    def _settle(self, now_ns: int) -> None:
        """Go from state to state until none follows."""
        self._now_ns = now_ns
        is_silent = now_ns - self._sender.sent_ns >= COMMAND_TIMEOUT_NS
        still_enabled = NO_AXES if is_silent else self._reports.enabled  # reports may have waited for us
        self._kept &= still_enabled
        self._is_shifting &= self._reports.gear != "drive"
        if not self._is_stationary():
            self._moved_ns = now_ns
        self._tell(now_ns)
        while True:
            self._seen = self._situation(now_ns)
            state, why = following(self._state, self._seen)
            if state == self._state:
                return
            if state in {"lost", "overridden"}:
                self._why = why
                if not self._told.issuperset(why.split(SEPARATOR)):
                    self._events.append(VehicleEvent(now_ns, "fault", why))
            if state in {"lost", "parking"}:
                self._kept = still_enabled
            self._state, self._entered_ns = state, now_ns

    def _is_stationary(self) -> bool:
        return abs(self._reports.speed_mps) < STATIONARY_BELOW_MPS

    def _situation(self, now_ns: int) -> Situation:
        reports = self._reports
        unheard = _joined([self._gone, *reports.missing(now_ns)])
        faults = _joined([reports.foreign(now_ns), *reports.said("fault")])
        return Situation(
            wanted=self._wanted,
            is_stationary=self._is_stationary(),
            inhibit_reason=_joined([self._installation, unheard, faults]),
            unheard=unheard,
            silent_ns=now_ns - self._sender.sent_ns,
            faults=faults,
            overrides=_joined(reports.said("override")),
            trips=_joined(reports.said("trip")),
            lapses=_joined(reports.said("lapse")),
            reasons=_joined(reports.said("reason")),
            enabled=reports.enabled,
            gear=reports.gear,
            since_ns=now_ns - self._entered_ns,
        )

    def _tell(self, now_ns: int) -> None:
        """Say once what the kit reports anew."""
        reports = self._reports
        told = [*reports.said("override"), *reports.said("trip"), *reports.said("fault")]
        self._events += [VehicleEvent(now_ns, "fault", words) for words in told if words not in self._told]
        self._told = frozenset(told)

    # What goes out.

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Give the frames that leave now: none where the newest tick is too old, or there is nothing to say."""
        self._settle(now_ns)
        plan = self._planned()
        if plan is None or self._gone:
            self._plan = None
            return []
        if not self._is_fresh(now_ns):
            if not self._is_late:
                self._counts["ticks_missed"] += 1
            self._is_late = True
            return []
        self._is_late = False
        requested = self._to_ask()
        is_new = plan != self._plan
        if not is_new and now_ns < self._due_ns(requested):
            return []
        self._plan = plan
        self._is_shifting |= plan.gear == "drive"
        frames = self._sender.frames(plan, requested, self._reports.wheel_deg, now_ns)
        self._expect_echo(plan)
        return frames

    def _is_fresh(self, now_ns: int) -> bool:
        return self._requested_ns is not None and now_ns - self._requested_ns <= TICK_LIMIT_NS

    def _due_ns(self, requested: DriveCommand) -> int:
        """Tell when the next set is due: soon where it brings something new."""
        if self._state == "clearing":
            return self._sender.sent_ns + CLEARING_PERIOD_NS
        return self._sender.sent_ns + (PERIOD_NS if requested == self._sender.sent else LEAST_GAP_NS)

    def _planned(self) -> KitCommands | None:
        """Give what each state says to the kit."""
        reports, everything = self._reports, frozenset(AXES)
        if self._state == "clearing":
            return KitCommands(NO_AXES, is_clearing=True)
        if self._state == "enabling":
            is_enabled = reports.enabled == everything
            return KitCommands(
                everything, gear="drive" if is_enabled and reports.gear != "drive" else None, system="enable"
            )
        if self._state == "engaged":
            return KitCommands(everything, system="enable")
        if self._state == "lost":
            return KitCommands(self._kept, system="enable" if self._kept else "")
        if self._state == "parking":
            return self._parking()
        return KitCommands(NO_AXES) if self._state == "overridden" else None

    def _parking(self) -> KitCommands:
        """Brake, then PARK, then let go: a kit that is let go of in gear trips."""
        is_shifting = self._is_shifting and self._now_ns - self._entered_ns < SHIFT_NS
        if self._reports.gear == "park" and not is_shifting:
            return KitCommands(NO_AXES, system="disable")
        has_stood = self._now_ns - self._moved_ns >= STOOD_NS
        return KitCommands(
            self._kept,
            gear="park" if has_stood and self._kept else None,
            system="enable" if self._kept else "",
        )

    def _to_ask(self) -> DriveCommand:
        """Give how the car is to drive in this state, before the limits."""
        requested, limits = self._requested, self._profile.limits
        wheel_deg = self._profile.wheel_deg(requested.steering_rad)
        if self._state == "engaged":
            return DriveCommand(wheel_deg, requested.throttle, requested.brake)
        is_held = self._state in {"enabling", "parking"}
        return DriveCommand(wheel_deg, 0.0, max(requested.brake, limits.holding_brake) if is_held else requested.brake)

    # What has reached the wheels.

    def _expect_echo(self, plan: KitCommands) -> None:
        if "steering" not in plan.enabled or self._requested_ns is None:
            self._echoes.clear()
            self._expected = None
            return
        while self._echoes and self._requested_ns - self._echoes[0][1] > ECHO_LIMIT_NS:
            self._echoes.popleft()
        number = round(self._sender.sent.wheel_deg / self._profile.command_step_deg)
        if number != (self._reports.command if self._expected is None else self._expected):
            self._echoes.append((number, self._requested_ns))
        self._expected = number

    def _echo(self, now_ns: int) -> None:
        """Find the newest report's command among those sent; those before it were overtaken."""
        if not any(number == self._reports.command for number, _ in self._echoes):
            return
        while self._echoes:
            number, requested_ns = self._echoes.popleft()
            if number == self._reports.command:
                self._reached.append(ReachedCommand(requested_ns, now_ns))
                return

    # What it tells.

    def state(self) -> VehicleState:
        """Tell the newest state; its time is that of the newest speed."""
        reports = self._reports
        return VehicleState(
            mono_ns=reports.speed_ns,
            speed_mps=reports.speed_mps,
            steering_rad=self._profile.road_rad(reports.wheel_deg),
            gear=reports.gear or "neutral",
            inhibit_reason=self._inhibit_reason(),
            is_engaged=self._state == "engaged",
            is_overridden=self._state == "overridden",
        )

    def _inhibit_reason(self) -> str:
        now = self._seen
        said = [self._why if self._state in {"lost", "overridden"} else "", now.inhibit_reason]
        if self._state == "parking" and now.is_stationary and now.since_ns >= ENABLING_LIMIT_NS:
            said.append(_joined(["the car stands and is not parked", now.reasons]))
        return _joined(said)

    def next_wake_ns(self) -> int:
        """Tell when `frames_due` is to be called at the latest."""
        wake_ns = self._now_ns + LOOK_NS
        if self._plan is not None and self._is_fresh(self._now_ns):
            wake_ns = min(wake_ns, max(self._due_ns(self._to_ask()), self._now_ns + 1))
        deadline_ns = self._reports.deadline_ns(self._now_ns)
        return wake_ns if deadline_ns is None else min(wake_ns, deadline_ns)

    def take_events(self) -> list[VehicleEvent]:
        """Take what has happened since the last call, in words."""
        events, self._events = self._events, []
        return events

    def take_reached(self) -> list[ReachedCommand]:
        """Take which changes of the steering the kit has reported since the last call to steer by."""
        reached, self._reached = self._reached, []
        return reached

    @property
    def tick_ns(self) -> int | None:
        """When the newest tick was: no frame may leave later than 60 ms after it."""
        return self._requested_ns

    @property
    def counts(self) -> Mapping[str, int]:
        """How often what was dropped, refused, limited or late."""
        return {**self._profile.codec.counts, **self._reports.counts, **self._sender.counts, **self._counts}


def _joined(words: Iterable[str]) -> str:
    """Put sentences together, each once."""
    said = [each for each in words if each]
    if not said:  # nearly always
        return ""
    return SEPARATOR.join(dict.fromkeys(part for each in said for part in each.split(SEPARATOR) if part))
