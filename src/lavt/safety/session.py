"""The control session on the vehicle: the client that has control, its epoch, handover and emergency stops."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import ClassVar, Final

from lavt.domain import Command, Operation, SessionReply, SessionRequest, VehicleState
from lavt.safety.limits import Limits
from lavt.safety.state_machine import SafetyStateMachine
from lavt.safety.takeover_requests import TakeoverRequests

CLEARED_BEFORE = "this emergency stop was executed before, and has been cleared since"
RELEASED_BEFORE = "only the client that has control can release it"
"""The rejection of a release that is repeated, because the reply to the first one was lost."""
REMEMBERED_STOPS: Final = 1000
"""How many emergency stops are remembered by their numbers, so that none of them is executed a second time."""


class CommandEpoch:
    """The present epoch, and the last command accepted in it. Commands of an earlier epoch are never accepted again."""

    def __init__(self, new_number: Callable[[], int]) -> None:
        self.number = new_number()
        self.sequence = -1
        """Sequence number of the last accepted command; -1 if no command was accepted in this epoch."""
        self.command: Command | None = None
        """The last accepted drive command in this epoch and since arming began; None if there is none."""
        self._new_number = new_number

    def renew(self) -> None:
        """End the present epoch and begin a new one."""
        self.number = self._new_number()
        self.sequence = -1
        self.command = None


class VehicleSession:
    """The vehicle's side of the session. At most one client has control, but every client can stop the vehicle."""

    def __init__(
        self,
        limits: Limits,
        machine: SafetyStateMachine,
        epoch: CommandEpoch,
        counts: Counter[str],
        *,
        new_token: Callable[[], bytes],
        host: str,
        video_port: int,
        only_operator: str = "",
    ) -> None:
        self.active_operator: tuple[str, int] | None = None
        """Name and instance of the client that has control."""
        self.token = b""
        self.takeover_requests = TakeoverRequests(
            handover_request_timeout_ns=limits.handover_request_timeout_ns, reservation_ns=limits.reservation_ns
        )
        self._limits = limits
        self._machine = machine
        self._epoch = epoch
        self._counts = counts
        self._new_token = new_token
        self._host = host
        self._video_port = video_port
        self._only_operator = only_operator
        """The only operator who can acquire control; empty: any."""
        self._executed_stops: dict[int, None] = {}
        """Numbers of the emergency stops, in the order of their execution."""
        self._is_closed = False

    def answer(self, request: SessionRequest, vehicle: VehicleState, now_ns: int) -> SessionReply:
        """Execute a client's request and return the reply."""
        rejection = self._OPERATIONS[request.operation](self, request, vehicle, now_ns)
        granted = rejection == ""
        self._counts[f"session {request.operation} {'granted' if granted else 'rejected'}"] += 1
        # Epoch and token go to the active operator only, not to every client that stops the vehicle.
        has_control = granted and self._has_control(request)
        return SessionReply(
            granted,
            rejection,
            self._epoch.number if has_control else 0,
            self.token if has_control else b"",
            self._video_port,
            self._host,
            request.number if request.operation == "emergency_stop" else self._last_stop,
        )

    def close(self) -> None:
        """Stop the vehicle and end control permanently, because the server shuts down."""
        self._is_closed = True
        self._machine.trigger("server shutdown")
        self._end_control()

    def raise_emergency_stop(self, number: int) -> bool:
        """Stop the vehicle and return True; for the number of a remembered stop, return False and do not stop again.

        The order of numbers does not matter: if a stop needed a higher number than the last stop, a stop with a very
        high number would prevent all later ones.
        """
        if number in self._executed_stops:
            self._counts["emergency stop with an old number"] += self._machine.state != "emergency_stop"
            return False
        self._executed_stops[number] = None
        if len(self._executed_stops) > REMEMBERED_STOPS:
            self._executed_stops.pop(next(iter(self._executed_stops)))
        self._machine.trigger("emergency stop")
        return True

    @property
    def _last_stop(self) -> int:
        return next(reversed(self._executed_stops), 0)

    def _has_control(self, request: SessionRequest) -> bool:
        return (request.who, request.instance) == self.active_operator

    def _acquire(self, request: SessionRequest, vehicle: VehicleState, now_ns: int) -> str:
        if self._is_closed:
            return "the server is shutting down"
        if self._has_control(request):
            return ""
        if self._only_operator and request.who != self._only_operator:
            return f"the vehicle is in a run of {self._only_operator}"
        if self.active_operator is not None and not self._machine.is_at_rest(vehicle):
            return f"{self.active_operator[0]} has control, and the vehicle is not disarmed and stationary"
        reserved_for = self.takeover_requests.reserved_for(request, now_ns)
        if reserved_for:
            return f"reserved for {reserved_for} after a handover"
        self.takeover_requests.clear()
        self.active_operator = (request.who, request.instance)
        self.token = self._new_token()
        self._epoch.renew()
        return ""

    def _request_handover(self, request: SessionRequest, _vehicle: VehicleState, now_ns: int) -> str:
        if self._has_control(request):
            return "this client has control already"
        if self.active_operator is None:
            return "no client has control"
        return self.takeover_requests.add(request, now_ns)

    def _release(self, request: SessionRequest, _vehicle: VehicleState, now_ns: int) -> str:
        if not self._has_control(request):
            return RELEASED_BEFORE
        self._machine.trigger("control released")
        self.takeover_requests.reserve(now_ns)
        self._end_control()
        return ""

    def _end_control(self) -> None:
        self.active_operator = None
        self.token = b""
        self._epoch.renew()

    def _emergency_stop(self, request: SessionRequest, _vehicle: VehicleState, _now_ns: int) -> str:
        if self.raise_emergency_stop(request.number):
            self._machine.reason = f"emergency stop by {request.who}"
        elif self._machine.state != "emergency_stop":
            return CLEARED_BEFORE
        return ""  # also for a stop that was executed already: its client repeats the request until it is granted

    def _clear_emergency_stop(self, request: SessionRequest, vehicle: VehicleState, _now_ns: int) -> str:
        if not self._has_control(request):
            return "only the client that has control can clear the emergency stop"
        if request.number != self._last_stop:  # a late or repeated request must not clear a newer stop
            return "this is not the number of the last emergency stop"
        if not self._limits.is_stationary(vehicle):
            return "the vehicle is not stationary yet"
        self._machine.trigger("emergency stop cleared")
        return ""

    _OPERATIONS: ClassVar[dict[Operation, Callable[..., str]]] = {
        "acquire": _acquire,
        "request_handover": _request_handover,
        "release": _release,
        "emergency_stop": _emergency_stop,
        "clear_emergency_stop": _clear_emergency_stop,
    }
    """For each operation, a function that executes it and returns why it is rejected; empty if it is granted."""
