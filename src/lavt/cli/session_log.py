"""The log lines of a session: changes of the vehicle's state and of the client's phase, and rejected commands."""

from __future__ import annotations

from collections import Counter

from msgspec.structs import replace

from lavt.domain import NS_PER_S, State
from lavt.nodes.client_session import Phase

REPEAT_NS = NS_PER_S
"""Rejections are logged at most once in this time. A limit is logged again only if it has changed no command for this
time."""
STATE_TIMEOUT_NS = NS_PER_S
"""A client logs that the state is missing after this time; the vehicle sends its state 50 times a second."""
FIRST_STATE_TIMEOUT_NS = 3 * NS_PER_S
"""The timeout before the first state; it is longer, because the routers need time to find each other."""
MAX_SERVERS = 8
"""The number of server processes whose last states are remembered."""
NO_STATE_YET = (
    "no state from the vehicle yet: is its server running, do the routers reach each other, and do the keys match? "
    "Run `lavt doctor CONFIG` to find out"
)
STATE_AGAIN = "vehicle state received again"

PHASES: dict[Phase, str] = {
    "seeking": "waiting for the vehicle: {reason}",
    "arming": "control granted: arming the vehicle{but_reason}",
    "driving": "",
    "stopped": "stopped: {reason}",
    "watching": "{reason}; this client now only watches",
}
"""The log line for each phase of the client; `driving` has none, because the line for the vehicle's state reports
it."""


def phase_line(phase: Phase, reason: str) -> str:
    """Return the log line for the client's phase; empty if the phase needs none."""
    if phase == "seeking" and not reason:
        return ""
    return PHASES[phase].format(reason=reason, but_reason=f", but {reason}" if reason else "")


def state_lines(before: State | None, after: State, *, operator: str) -> list[str]:
    """Return one log line for each difference between two vehicle states; if `before` is None, describe `after`.

    `operator` is the name of this side's client while it has control of the vehicle; empty otherwise.
    """
    lines = []
    if before is None:
        before = replace(after, safety="disarmed", reason="", active_operator="", requested_by="")
    elif after.instance != before.instance:
        lines.append("the server has restarted")
    if after.active_operator != before.active_operator:
        lines.append(
            f"{after.active_operator} has control" if after.active_operator else "no operator has control any more"
        )
    if (after.safety, after.reason) != (before.safety, before.reason):
        operator_name = after.active_operator or before.active_operator or "the client"
        lines.append(f"{after.safety}: {after.reason.replace('the client', operator_name)}")
    if after.requested_by and after.requested_by != before.requested_by:
        lines.append(
            f"{after.requested_by} requests control; SIGUSR2 hands the vehicle over"
            if after.active_operator == operator
            else f"{after.requested_by} requests control from {after.active_operator}"
        )
    if before.requested_by and not after.requested_by and after.active_operator == before.active_operator:
        lines.append(f"{before.requested_by} no longer requests control")
    return lines


def client_end_line(*, released: bool) -> str:
    """Return the last line of a client that had control; `released`: the server has confirmed the release."""
    if released:
        return "the client ends; the vehicle is released"
    return "the client ends; the release was not confirmed: the vehicle stops on command timeout"


def server_end_line(speed_mps: float | None) -> str:
    """Return the last line of a server; `speed_mps` is None if its vehicle is stationary."""
    if speed_mps is None:
        return "the vehicle is stationary; the server ends"
    return f"the server ends while the vehicle is still stopping, at {speed_mps:.1f} m/s"


class SessionLog:
    """A log that turns states, rejections and phases into lines, one line per change.

    Times are of this machine's monotonic clock. `client_name` is empty on the server.
    """

    def __init__(self, client_name: str = "") -> None:
        self._client_name = client_name
        self._lines: list[str] = []
        self._state: State | None = None
        self._states: dict[int, State] = {}
        """The last state of each server process, by its instance: if two have the same name, their states alternate."""
        self._logged_phase = ""
        self._logged_ending: str | None = None
        self._start_ns: int | None = None
        self._state_ns: int | None = None
        self._state_missing = False
        self._rejected: Counter[str] = Counter()
        self._logged_rejections_ns: int | None = None
        self._limit_applied_ns: dict[str, int] = {}

    def add_state(self, state: State, now_ns: int, *, has_control: bool = False) -> None:
        """Log the changes of a state received at `now_ns`; `has_control`: this client believes it has control."""
        if self._state_missing and self._state_ns is not None:
            self._lines.append(STATE_AGAIN)
        self._state_missing, self._state_ns = False, now_ns
        before, self._state = self._states.pop(state.instance, self._state), state
        self._states[state.instance] = state
        if len(self._states) > MAX_SERVERS:
            self._states.pop(next(iter(self._states)))
        self._lines += state_lines(before, state, operator=self._client_name if has_control else "")
        for limit in state.limited.split(", ") if state.limited else ():
            if now_ns - self._limit_applied_ns.get(limit, now_ns - REPEAT_NS) >= REPEAT_NS:
                self._lines.append(f"limited: {limit}")
            self._limit_applied_ns[limit] = now_ns
        if self._client_name and state.rejected and (before is None or state.rejected != before.rejected):
            self.add_rejection(state.rejected)

    def add_rejection(self, reason: str) -> None:
        """Count a rejected command."""
        self._rejected[reason] += 1

    def set_phase(self, phase: Phase, reason: str) -> None:
        """Log the client's phase if its line has changed."""
        line = phase_line(phase, reason)
        if line and line != self._logged_phase:
            self._lines.append(line)
        self._logged_phase = line

    def set_ending(self, ending: str | None) -> None:
        """Log how the last drive ended; `ending` is None before its end, and again after the start of another drive."""
        if ending is not None and ending != self._logged_ending:
            self._lines.append(f"the drive has ended: {ending}")
        self._logged_ending = ending

    def take_lines(self, now_ns: int) -> list[str]:
        """Return the lines since the last call; at `now_ns`, lines on rejections and on a missing state can be due."""
        self._add_rejection_counts(now_ns)
        self._add_missing_state(now_ns)
        lines, self._lines = self._lines, []
        return lines

    def _add_rejection_counts(self, now_ns: int) -> None:
        last_ns = self._logged_rejections_ns
        if self._rejected and (last_ns is None or now_ns - last_ns >= REPEAT_NS):
            self._logged_rejections_ns = now_ns
            for reason, count in self._rejected.items():
                commands = "a command was" if count == 1 else f"{count} commands were"
                self._lines.append(f"{commands} rejected: {reason}")
            self._rejected.clear()

    def _add_missing_state(self, now_ns: int) -> None:
        if self._start_ns is None:
            self._start_ns = now_ns
        if self._state_missing or not self._client_name:
            return
        if self._state_ns is None and now_ns - self._start_ns >= FIRST_STATE_TIMEOUT_NS:
            self._state_missing = True
            self._lines.append(NO_STATE_YET)
        elif self._state_ns is not None and now_ns - self._state_ns >= STATE_TIMEOUT_NS:
            self._state_missing = True
            self._lines.append(f"no state from the vehicle for {(now_ns - self._state_ns) / NS_PER_S:.1f} s")
