"""The client's side of the session: asking for the vehicle, arming it, and knowing when it is lost."""

from __future__ import annotations

from typing import Literal

from lavt.domain import NS_PER_S, SessionReply, SessionRequest, State

Phase = Literal["seeking", "arming", "driving", "stopped"]
"""seeking: no epoch yet. arming: commands ask for arming. driving: the vehicle obeys. stopped: it has stopped for
safety, and only a person (or `rearm`) begins anew."""

ASK_PERIOD_NS = NS_PER_S


class ClientSession:
    """Asks for the vehicle until it is granted, and again until the vehicle is armed: asking twice changes nothing.

    With `rearm` it begins anew after a safe stop; with `clear_stop` it clears an emergency stop that it finds. With
    `waits` it does not arm the vehicle before the network's condition is in force.
    """

    def __init__(
        self, who: str, instance: int, *, rearm: bool, start_ns: int, clear_stop: bool = False, waits: bool = False
    ) -> None:
        self.phase: Phase = "seeking"
        self.epoch = 0
        self.emergency_stop = 0
        """Number of the emergency stop that every command carries; 0: none."""
        self.because = ""
        self.host = ""
        self.safety = ""
        self._who = who
        self._instance = instance
        self._rearm = rearm
        self._clear_stop = clear_stop
        self._waits_because = "the network's condition is not in force yet" if waits else ""
        self._ask_ns = start_ns
        self._highest_emergency_stop = 0

    @property
    def commanding(self) -> bool:
        """Whether commands make sense: there is an epoch to send them under, and the network is as it shall be."""
        return self.phase == "driving" or (self.phase == "arming" and not self._waits_because)

    def next_wake_ns(self) -> int | None:
        """When the next query is due."""
        return self._ask_ns if self.phase in ("seeking", "arming") else None

    def request_due(self, now_ns: int) -> SessionRequest | None:
        """Give the query that is due at `now_ns`."""
        due = self.next_wake_ns()
        if due is None or now_ns < due:
            return None
        self._ask_ns = now_ns + ASK_PERIOD_NS
        if self._clear_stop and self.phase == "arming" and self.safety == "emergency_stop":
            return SessionRequest("clear_emergency_stop", self._who, self._instance, self._highest_emergency_stop)
        return SessionRequest("hold", self._who, self._instance, 0)

    def note_condition(self, because: str) -> None:
        """The network's condition is in force, or `because` says why it is not; once it was, it is not waited for."""
        if self._waits_because:
            self._waits_because = self.because = because

    def note_reply(self, reply: SessionReply, _now_ns: int) -> None:
        """Take over what the server granted, or why it did not."""
        self.because = reply.because or self._waits_because
        self._highest_emergency_stop = max(self._highest_emergency_stop, reply.emergency_stop)
        if self.emergency_stop and reply.emergency_stop > self.emergency_stop:
            # The vehicle takes ours for an old one, as with a wall clock that is behind: raise it with a newer number.
            self.emergency_stop = self._highest_emergency_stop = reply.emergency_stop + 1
        if reply.granted and reply.token:
            self.host = reply.host
            self.epoch = reply.epoch
            if self.phase == "seeking":
                self.phase = "arming"

    def note_state(self, state: State, now_ns: int) -> None:
        """Follow the vehicle's safety state."""
        self.safety = state.safety
        if self.phase == "arming" and state.safety == "driving":
            self.phase = "driving"
        elif self.phase == "driving" and state.safety in ("disarmed", "safe_stop", "emergency_stop"):
            self.phase, self.because = "stopped", state.because
        elif self.phase == "stopped" and self._rearm and abs(state.speed_mps) < 0.05:
            self.phase, self._ask_ns = "seeking", now_ns

    def stop_now(self, wall_ns: int) -> SessionRequest:
        """Raise an emergency stop: every command carries its number from now on, and this query asks for an answer.

        The number is the wall clock's time or, where that has been seen, one more: it grows over restarts too.
        """
        self.emergency_stop = self._highest_emergency_stop = max(self._highest_emergency_stop + 1, wall_ns)
        return SessionRequest("emergency_stop", self._who, self._instance, self.emergency_stop)
