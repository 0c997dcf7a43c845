"""The client's side of the session: asking for the vehicle, arming it, and knowing when it is lost."""

from __future__ import annotations

from typing import Literal

from lavt.domain import NS_PER_S, Now, Operation, SessionReply, SessionRequest, State

Phase = Literal["seeking", "arming", "driving", "stopped", "watching"]
"""seeking: no epoch yet. arming: commands ask for arming. driving: the vehicle obeys. stopped: it has stopped for
safety, and only a person (or `rearm`) begins anew. watching: released, or somebody else took it over; it is over."""

ASK_PERIOD_NS = NS_PER_S


class ClientSession:
    """Asks for the vehicle until it is granted, and again until the vehicle is armed: asking twice changes nothing.

    With `rearm` it begins anew after a safe stop and with a server that was started again, but not where a driver in
    the car has taken over, which disarms the vehicle. With `clear_stop` it clears an emergency stop that it finds. With
    `waits` it does not arm the vehicle before the network's condition is in force. With `take_over` it asks whoever
    holds the vehicle to hand it over.
    """

    def __init__(
        self,
        who: str,
        instance: int,
        *,
        rearm: bool,
        start_ns: int,
        clear_stop: bool = False,
        waits: bool = False,
        take_over: bool = False,
    ) -> None:
        self.phase: Phase = "seeking"
        self.epoch = 0
        self.emergency_stop = 0
        """Number of the emergency stop that every command carries; 0: none."""
        self.reason = ""
        self.host = ""
        self.safety = ""
        self.released = False
        """Whether the vehicle's side has confirmed that this client holds it no more."""
        self._who = who
        self._instance = instance
        self._rearm = rearm
        self._clear_stop = clear_stop
        self._waits_reason = "the network's condition is not in force yet" if waits else ""
        self._take_over = take_over
        self._asks: Operation = "hold"
        """What is asked next while seeking: with `take_over`, hold and ask in turn."""
        self._requested: Operation = "hold"
        self._said: dict[Operation, str] = {}
        """What was answered to either."""
        self._known_as_active_operator = False
        """Whether the vehicle's state has named this client as the one who holds it."""
        self._server = 0
        """Instance of the server's process that the last state came from."""
        self._was_disarmed = False
        """Whether the process that drove, or stopped for safety, has disarmed the vehicle since."""
        self._ask_ns = start_ns
        self._stop_ns: int | None = None
        """When the query of an emergency stop is sent again, as long as the vehicle does not know of it."""
        self._highest_emergency_stop = 0

    @property
    def commanding(self) -> bool:
        """Whether commands make sense: there is an epoch to send them under, and the network is as it shall be."""
        return self.phase == "driving" or (self.phase == "arming" and not self._waits_reason)

    @property
    def holds(self) -> bool:
        """Whether the vehicle was granted, and neither released since nor taken over by somebody else."""
        return self.epoch != 0 and self.phase != "watching"

    def next_wake_ns(self) -> int | None:
        """When the next query is due."""
        releasing = self.phase == "watching" and not self.released
        asks_ns = self._ask_ns if self.phase in ("seeking", "arming") or releasing else None
        return min((each for each in (asks_ns, self._stop_ns) if each is not None), default=None)

    def request_due(self, now_ns: int) -> SessionRequest | None:
        """Give the query that is due at `now_ns`."""
        due = self.next_wake_ns()
        if due is None or now_ns < due:
            return None
        if self._stop_ns is not None and now_ns >= self._stop_ns:
            self._stop_ns = now_ns + ASK_PERIOD_NS
            return SessionRequest("emergency_stop", self._who, self._instance, self.emergency_stop)
        self._ask_ns = now_ns + ASK_PERIOD_NS
        if self.phase == "watching":
            return SessionRequest("release", self._who, self._instance, 0)
        if self._clear_stop and self.phase == "arming" and self.safety == "emergency_stop":
            return SessionRequest("clear_emergency_stop", self._who, self._instance, self._highest_emergency_stop)
        self._requested, self._asks = self._asks, "hold"
        return SessionRequest(self._requested, self._who, self._instance, 0)

    def release(self, now_ns: int) -> None:
        """Give the vehicle up, and ask for it no more; the query is due at once, and again until it is answered."""
        if self.phase != "watching":
            self.phase, self.reason, self._ask_ns = "watching", "released", now_ns

    def note_condition(self, reason: str) -> None:
        """The network's condition is in force, or `reason` says why it is not; once it was, it is not waited for."""
        if self._waits_reason:
            self._waits_reason = self.reason = reason

    def note_reply(self, reply: SessionReply, now_ns: int) -> None:
        """Take over what the server granted, or why it did not."""
        self._note_reason(reply)
        self._highest_emergency_stop = max(self._highest_emergency_stop, reply.emergency_stop)
        if self.emergency_stop and reply.emergency_stop > self.emergency_stop:
            # The vehicle takes ours for an old one, as with a wall clock that is behind: raise it with a newer number.
            self.emergency_stop = self._highest_emergency_stop = reply.emergency_stop + 1
            self._stop_ns = None if self._stop_ns is None else now_ns
        elif self.emergency_stop == reply.emergency_stop:
            self._stop_ns = None
        if reply.granted and reply.token:
            self.host = reply.host
            self.epoch = reply.epoch
            if self.phase == "seeking":
                self.phase, self._known_as_active_operator = "arming", False
        elif self.phase == "seeking" and self._take_over and self._requested == "hold":
            self._asks, self._ask_ns = "ask", now_ns

    def _note_reason(self, reply: SessionReply) -> None:
        if self.phase == "watching":
            self.released = self.released or not reply.token  # a token answers what was asked before
            return
        if reply.token:
            self._said.clear()
        else:
            self._said[self._requested] = "asked for it" if reply.granted and self._requested == "ask" else reply.reason
        self.reason = "; ".join(each for each in self._said.values() if each) or self._waits_reason

    def note_state(self, state: State, now_ns: int) -> None:
        """Follow the vehicle's safety state."""
        if self.phase in ("driving", "stopped") and self.safety != "disarmed" and state.instance == self._server:
            self._was_disarmed |= state.safety == "disarmed"
        self.safety, self._server = state.safety, state.instance
        if state.safety == "emergency_stop":
            self._stop_ns = None
        own = (state.active_operator, state.active_operator_instance) == (self._who, self._instance)
        others = state.active_operator != "" and not own
        if self.phase == "arming" and state.safety == "driving" and not others:
            self.phase = "driving"
        elif self.phase == "driving" and state.safety in ("disarmed", "safe_stop", "emergency_stop"):
            self.phase, self.reason = "stopped", state.reason
        elif self.phase == "stopped" and self._rearm and abs(state.speed_mps) < 0.05 and not self._was_disarmed:
            self.phase, self._ask_ns = "seeking", now_ns
        if others and self._known_as_active_operator and self.phase not in ("seeking", "watching"):
            # Taking over at standstill needs no consent; whoever took it back would have it taken again.
            self.phase, self.reason, self.released = (
                "watching",
                f"{state.active_operator} has taken the vehicle over",
                True,
            )
        self._known_as_active_operator |= own

    def stop_now(self, now: Now) -> SessionRequest:
        """Raise an emergency stop: every command carries its number from now on, and this query asks for an answer.

        The query is due again until the vehicle has answered it or tells that it is stopped: who does not drive sends
        no commands. The number is the wall clock's time or, where that has been seen, one more: it grows over restarts
        too.
        """
        self.emergency_stop = self._highest_emergency_stop = max(self._highest_emergency_stop + 1, now.wall_ns)
        self._stop_ns = now.mono_ns + ASK_PERIOD_NS
        return SessionRequest("emergency_stop", self._who, self._instance, self.emergency_stop)
