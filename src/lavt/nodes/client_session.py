"""The client's side of the session: it acquires control, arms the vehicle, and notices the loss of control."""

from __future__ import annotations

from collections import deque
from typing import Literal

from lavt.domain import NS_PER_S, Now, Operation, SessionReply, SessionRequest, State
from lavt.safety.limits import LIMITS
from lavt.safety.session import CLEARED_BEFORE, RELEASED_BEFORE
from lavt.safety.state_machine import TRIGGER_MESSAGES

Phase = Literal["seeking", "arming", "driving", "stopped", "watching"]
"""seeking: no control yet. arming: commands request arming. driving: the vehicle executes drive commands. stopped:
the vehicle has stopped, and drives again only if a person or `rearm` requests it. watching: control was released or
lost for good."""

REQUEST_PERIOD_NS = NS_PER_S
RESTART_HINT = "; restart this client to drive"
MAX_SERVERS = 8
"""How many former server processes a client remembers."""
SAME_NAME = "several servers have this vehicle's name: end all but one, or give each another vehicle_id"


class ClientSession:
    """A client session that requests control until it is granted and the vehicle armed; repeated requests are harmless.

    With `rearm`, it requests control again after a safe stop and from a restarted server. With `clear_stop`, it clears
    the emergency stop that the first reply reports, and no other one. After any other emergency stop, and after a
    driver override, it never arms the vehicle again: not if it has not driven yet, if somebody clears the stop, or if
    the server restarts and has forgotten the stop. The same holds if states of several servers alternate: they have
    the same name, and each has another vehicle. With `waits_for_condition`, it arms the vehicle only when the network
    condition is in force. With `take_over`, it requests a handover from the active operator.
    """

    def __init__(
        self,
        who: str,
        instance: int,
        *,
        rearm: bool,
        start_ns: int,
        clear_stop: bool = False,
        waits_for_condition: bool = False,
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
        """The vehicle has confirmed that this client no longer has control."""
        self._who = who
        self._instance = instance
        self._rearm = rearm
        self._looks_for_stop = clear_stop
        """The first reply reports the emergency stop that is to be cleared."""
        self._saw_stop_before_reply = False
        """A state reported the emergency stop that the first reply is expected to name."""
        self._stop_to_clear: int | None = None
        """Number of the emergency stop that this client clears; None: none."""
        self._last_stop: int | None = None
        """Number of the vehicle's last emergency stop, as replies report it; None: no reply yet. 0: none."""
        self._wait_reason = "the network condition is not in force yet" if waits_for_condition else ""
        """Why this client must not arm the vehicle yet; empty: it can."""
        self._take_over = take_over
        self._next_operation: Operation = "acquire"
        """The next request while seeking; with `take_over`, "acquire" and "request_handover" alternate."""
        self._last_operation: Operation = "acquire"
        self._rejections: dict[Operation, str] = {}
        """The last reply to each operation that requests control, as text."""
        self._was_active_operator = False
        """A state has named this client as the active operator."""
        self._server = 0
        """Instance of the server process that sent the last state."""
        self._former_servers: deque[int] = deque(maxlen=MAX_SERVERS)
        """Instances of the server processes that sent states before that one."""
        self._has_several_servers = False
        """States of several servers have alternated."""
        self._state_reason = ""
        """Reason in the last state."""
        self._awaits_person = False
        """There was an emergency stop or a driver override, or the same server process has disarmed the vehicle since
        this client drove."""
        self._request_ns = start_ns
        self._stop_ns: int | None = None
        """When the request of the emergency stop is repeated; None: there is no stop, or the vehicle has answered."""

    @property
    def may_command(self) -> bool:
        """Return whether commands may be sent: there is an epoch, and the network condition is in force."""
        return self.phase == "driving" or (self.phase == "arming" and not self._wait_reason)

    @property
    def has_control(self) -> bool:
        """Return whether this client has control of the vehicle."""
        return self.epoch != 0 and self.phase != "watching"

    @property
    def is_stop_confirmed(self) -> bool:
        """Return whether the vehicle has answered the emergency stop of this client."""
        return self.emergency_stop != 0 and self._stop_ns is None

    def next_wake_ns(self) -> int | None:
        """Return when the next request is due."""
        releasing = self.phase == "watching" and not self.released
        request_ns = self._request_ns if self.phase in ("seeking", "arming") or releasing else None
        return min((time_ns for time_ns in (request_ns, self._stop_ns) if time_ns is not None), default=None)

    def take_request(self, now_ns: int) -> SessionRequest | None:
        """Return the request that is due at `now_ns`; None: none is due."""
        due_ns = self.next_wake_ns()
        if due_ns is None or now_ns < due_ns:
            return None
        if self._stop_ns is not None and now_ns >= self._stop_ns:
            self._stop_ns = now_ns + REQUEST_PERIOD_NS
            return SessionRequest("emergency_stop", self._who, self._instance, self.emergency_stop)
        self._request_ns = now_ns + REQUEST_PERIOD_NS
        if self.phase == "watching":
            return SessionRequest("release", self._who, self._instance, 0)
        is_stopped = self.phase == "arming" and self.safety == "emergency_stop"
        if self._stop_to_clear is not None and is_stopped and self._last_operation != "clear_emergency_stop":
            self._last_operation = "clear_emergency_stop"  # alternates with "acquire": control may have been lost
            return SessionRequest("clear_emergency_stop", self._who, self._instance, self._stop_to_clear)
        self._last_operation, self._next_operation = self._next_operation, "acquire"
        return SessionRequest(self._last_operation, self._who, self._instance, 0)

    def release(self, now_ns: int) -> None:
        """Release control for good; the request is due at once, and again until it is answered."""
        if self.phase != "watching":
            self.phase, self.reason, self._request_ns = "watching", "released", now_ns

    def handle_condition(self, reason: str) -> None:
        """Store why the network condition is not in force; an empty `reason` ends the wait for good."""
        if self._wait_reason:
            self._wait_reason = self.reason = reason

    def handle_reply(self, reply: SessionReply, now_ns: int) -> None:
        """Process the server's reply to a request."""
        self._update_reason(reply)
        is_new_stop = reply.emergency_stop not in (0, self._last_stop) and self._last_stop is not None
        if reply.emergency_stop or self._last_stop is None:
            self._last_stop = reply.emergency_stop
        if self._looks_for_stop:
            self._looks_for_stop, self._stop_to_clear = False, reply.emergency_stop or None
            is_new_stop = self._saw_stop_before_reply and self._stop_to_clear is None  # the server has restarted
        elif reply.emergency_stop != self._stop_to_clear:  # there was another stop since: a person must decide again
            self._stop_to_clear = None
        if is_new_stop:  # the states that reported this stop may have been lost
            self._await_person("there was an emergency stop")
        if self._stop_ns is not None and reply.emergency_stop == self.emergency_stop:
            if reply.reason == CLEARED_BEFORE:
                self.emergency_stop += 1
            else:
                self._stop_ns = None
        if reply.granted and reply.token:
            self.host = reply.host
            self.epoch = reply.epoch
            if self.phase == "seeking":
                self.phase, self._was_active_operator = "arming", False
        elif self.phase == "seeking" and self._take_over and self._last_operation == "acquire":
            self._next_operation, self._request_ns = "request_handover", now_ns

    def _update_reason(self, reply: SessionReply) -> None:
        if self.phase == "watching":
            # A reply with a token, or with another rejection, belongs to an earlier request.
            self.released |= not reply.token and (reply.granted or reply.reason == RELEASED_BEFORE)
            return
        if self.phase == "stopped":
            return
        if reply.token:
            self._rejections.clear()
        else:
            is_handover_requested = reply.granted and self._last_operation == "request_handover"
            self._rejections[self._last_operation] = "handover requested" if is_handover_requested else reply.reason
        self.reason = "; ".join(reason for reason in self._rejections.values() if reason) or self._wait_reason

    def handle_state(self, state: State, now_ns: int) -> None:
        """Process a state of the vehicle."""
        self._notice_stop(state)
        self._notice_other_server(state)
        self.safety, self._server, self._state_reason = state.safety, state.instance, state.reason
        names_this_client = (state.active_operator, state.active_operator_instance) == (self._who, self._instance)
        names_other_client = state.active_operator != "" and not names_this_client
        if names_other_client and self._was_active_operator and self.phase != "watching":
            # A takeover at standstill needs no consent: two clients that took control back would alternate for ever.
            self.phase, self.released = "watching", True
            self.reason = f"{state.active_operator} has taken control"
        elif self.phase == "arming" and state.safety == "driving" and not names_other_client:
            self.phase, self._stop_to_clear = "driving", None
        elif self.phase == "driving" and state.safety in ("disarmed", "safe_stop", "emergency_stop"):
            self.phase, self.reason = "stopped", state.reason + RESTART_HINT * (self._awaits_person or not self._rearm)
        elif (
            self.phase == "stopped"
            and self._rearm
            and abs(state.speed_mps) < LIMITS.standstill_mps
            and not self._awaits_person
        ):
            self.phase, self._request_ns = "seeking", now_ns
        self._was_active_operator |= names_this_client

    def _notice_stop(self, state: State) -> None:
        """Notice an emergency stop that this client does not clear, and the end of a drive by disarming."""
        if self._looks_for_stop:
            self._saw_stop_before_reply |= state.safety == "emergency_stop"
        elif state.safety != "emergency_stop":
            self._stop_to_clear = None  # it has been cleared: another stop is a person's decision
        elif self._stop_to_clear is None:
            self._await_person(state.reason)
        if self.safety == "":  # the first state can tell of what happened before this client started
            return
        is_restarted = state.instance != self._server
        forgets_stop = is_restarted and not self._has_several_servers
        if forgets_stop and self.safety == "emergency_stop" and not self._looks_for_stop:
            self._await_person("the server has restarted in an emergency stop")
        if state.safety == "disarmed":
            is_new = is_restarted or (self.safety, self._state_reason) != ("disarmed", state.reason)
            is_override = is_new and state.reason == TRIGGER_MESSAGES["driver override"]
            ends_drive = not is_restarted and self.safety != "disarmed" and self.phase in ("driving", "stopped")
            if is_override or ends_drive:
                self._await_person(state.reason)

    def _notice_other_server(self, state: State) -> None:
        """Notice that several servers have the same name: after a restart, the former process sends no states."""
        if self.safety == "" or state.instance == self._server:
            return
        if state.instance in self._former_servers and not self._has_several_servers:
            self._has_several_servers = True
            self._await_person(SAME_NAME)
        self._former_servers.append(self._server)

    def _await_person(self, reason: str) -> None:
        """Do not arm the vehicle from now on: a person must decide what follows, and restart this client."""
        self._awaits_person = True
        if self.phase in ("seeking", "arming", "stopped"):
            self.phase, self.reason = "stopped", reason + RESTART_HINT

    def raise_emergency_stop(self, now: Now) -> SessionRequest:
        """Raise an emergency stop and return its request; every later command carries its number.

        The request is repeated until the vehicle answers it, because a client that does not drive sends no commands.
        This client clears no stop any more. The number is the wall clock time, at least one more than that of this
        client's last stop, so no other stop has it.
        """
        self.emergency_stop = max(self.emergency_stop + 1, now.wall_ns)
        self._stop_ns = now.mono_ns + REQUEST_PERIOD_NS
        self._looks_for_stop, self._stop_to_clear = False, None
        return SessionRequest("emergency_stop", self._who, self._instance, self.emergency_stop)
