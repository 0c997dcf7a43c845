"""What a side tells a person, in words: one line for each change, made of states, refusals and the client's phase."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

from lavt.domain import NS_PER_S, State
from lavt.nodes.client_session import Phase

OFTEN_NS = NS_PER_S
"""What happens again and again is told at most so often, and is over when it has not happened for so long."""
QUIET_NS = NS_PER_S
"""A vehicle that has not told its state for so long is said to be quiet; it tells it 50 times a second."""
FIRST_STATE_NS = 3 * NS_PER_S
"""Before the first state there is this much patience: routers find each other meanwhile."""
NO_STATE_YET = (
    "no state from the vehicle yet: does its server run, do the routers reach each other, and do the keys fit? "
    "`lavt doctor CONFIG` finds out"
)
STATE_AGAIN = "the vehicle tells its state again"

PHASES: dict[Phase, str] = {
    "seeking": "waiting for the vehicle: {because}",
    "arming": "the vehicle was granted to this client: arming{waits}",
    "driving": "",
    "stopped": "this client does not drive any more: {because}",
    "watching": "{because}; this client only watches now",
}
"""The client's own phases; of driving the vehicle's state tells."""


def phase_words(phase: Phase, reason: str) -> str:
    """Say the client's phase; empty where there is nothing to say."""
    if phase == "seeking" and not reason:
        return ""
    return PHASES[phase].format(reason=reason, waits=f", but {reason}" if reason else "")


def state_words(before: State | None, after: State, *, this_client: str) -> list[str]:
    """Say what has changed from one state of the vehicle to another, or how it is, where there was none before.

    `this_client` is the name of the client for whose person this is, while it holds the vehicle; empty elsewhere.
    """
    words = []
    if before is None:
        before = replace(after, safety="disarmed", reason="", active_operator="", requested_by="")
    elif after.instance != before.instance:
        words.append("the server was started anew")
    if after.active_operator != before.active_operator:
        words.append(
            f"{after.active_operator} holds the vehicle"
            if after.active_operator
            else "nobody holds the vehicle any more"
        )
    if (after.safety, after.reason) != (before.safety, before.reason):
        who = after.active_operator or before.active_operator or "the client"
        words.append(f"{after.safety}: {after.reason.replace('the client', who)}")
    if after.requested_by and after.requested_by != before.requested_by:
        hands_over = after.active_operator == this_client
        words.append(
            f"{after.requested_by} asks for the vehicle; SIGUSR2 hands it over"
            if hands_over
            else f"{after.requested_by} asks {after.active_operator} for the vehicle"
        )
    if before.requested_by and not after.requested_by and after.active_operator == before.active_operator:
        words.append(f"{before.requested_by} does not ask for the vehicle any more")
    return words


def release_words(*, released: bool) -> str:
    """Say how a client that held the vehicle leaves it."""
    if released:
        return "the client ends; the vehicle is released"
    return "the client ends; nobody confirms that the vehicle is released: it stops for want of commands"


def end_words(speed_mps: float | None) -> str:
    """Say how a server that ends leaves its vehicle; None: it stands."""
    if speed_mps is None:
        return "the vehicle stands; the server ends"
    return f"the server ends while the vehicle is still stopping, at {speed_mps:.1f} m/s"


class SessionLog:
    """Remembers what was told, and so tells each change once. Times are of this machine's monotonic clock.

    `client` is the client's name; empty on the server.
    """

    def __init__(self, client: str = "") -> None:
        self._client = client
        self._lines: list[str] = []
        self._state: State | None = None
        self._told_phase = ""
        self._told_ending: str | None = None
        self._start_ns: int | None = None
        self._state_ns: int | None = None
        self._quiet = False
        self._rejected: Counter[str] = Counter()
        self._told_rejections_ns: int | None = None
        self._limited_ns: dict[str, int] = {}

    def state(self, state: State, now_ns: int, *, holds: bool = False) -> None:
        """The vehicle told its state at `now_ns`; `holds`: this client holds the vehicle, as far as it knows."""
        if self._quiet and self._state_ns is not None:
            self._lines.append(STATE_AGAIN)
        self._quiet, self._state_ns = False, now_ns
        before, self._state = self._state, state
        self._lines += state_words(before, state, this_client=self._client if holds else "")
        for limit in state.limited.split(", ") if state.limited else ():
            if now_ns - self._limited_ns.get(limit, now_ns - OFTEN_NS) >= OFTEN_NS:
                self._lines.append(f"limited: {limit}")
            self._limited_ns[limit] = now_ns
        if self._client and state.rejected and (before is None or state.rejected != before.rejected):
            self.rejection(state.rejected)

    def rejection(self, reason: str) -> None:
        """A command was refused."""
        self._rejected[reason] += 1

    def phase(self, phase: Phase, reason: str) -> None:
        """The client's phase is this."""
        words = phase_words(phase, reason)
        if words and words != self._told_phase:
            self._lines.append(words)
        self._told_phase = words

    def ending(self, ending: str | None) -> None:
        """The last drive has ended so; None: none has, or another has begun."""
        if ending is not None and ending != self._told_ending:
            self._lines.append(f"the drive is over: {ending}")
        self._told_ending = ending

    def take(self, now_ns: int) -> list[str]:
        """Take what there is to tell at `now_ns`."""
        self._look_at_the_clock(now_ns)
        lines, self._lines = self._lines, []
        return lines

    def _look_at_the_clock(self, now_ns: int) -> None:
        if self._rejected and (self._told_rejections_ns is None or now_ns - self._told_rejections_ns >= OFTEN_NS):
            self._told_rejections_ns = now_ns
            for reason, count in self._rejected.items():
                many = "a command was" if count == 1 else f"{count} commands were"
                self._lines.append(f"{many} refused: {reason}")
            self._rejected.clear()
        if self._start_ns is None:
            self._start_ns = now_ns
        if self._quiet or not self._client:
            return
        if self._state_ns is None and now_ns - self._start_ns >= FIRST_STATE_NS:
            self._quiet = True
            self._lines.append(NO_STATE_YET)
        elif self._state_ns is not None and now_ns - self._state_ns >= QUIET_NS:
            self._quiet = True
            self._lines.append(f"no state from the vehicle for {(now_ns - self._state_ns) / NS_PER_S:.1f} s")
