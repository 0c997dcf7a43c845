"""The safety states of the vehicle and the table of transitions between them."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

from lavt.domain import SafetyState, VehicleState
from lavt.safety.limits import Limits

Trigger = Literal[
    "arming begins",
    "arming interrupted",
    "arming complete",
    "command timeout",
    "fresh command",
    "command-timeout stop",
    "stop requested",
    "camera fault",
    "vehicle fault",
    "driver override",
    "emergency stop",
    "emergency stop cleared",
    "control released",
    "drive over",
    "server shutdown",
]

ACTIVE: tuple[SafetyState, ...] = ("arming", "driving", "degraded")
"""States in which the vehicle is driven or about to be driven."""

UNCOMMANDED: tuple[SafetyState, ...] = ("degraded", "safe_stop", "emergency_stop")
"""States in which the vehicle steers along the path of the last command."""

TRANSITIONS: dict[tuple[SafetyState, Trigger], SafetyState] = {
    ("disarmed", "arming begins"): "arming",
    ("safe_stop", "arming begins"): "arming",
    ("arming", "arming interrupted"): "disarmed",
    ("arming", "stop requested"): "disarmed",
    ("arming", "camera fault"): "disarmed",
    ("arming", "vehicle fault"): "disarmed",
    ("arming", "control released"): "disarmed",
    ("arming", "server shutdown"): "disarmed",
    ("arming", "arming complete"): "driving",
    ("driving", "command timeout"): "degraded",
    ("degraded", "fresh command"): "driving",
    ("degraded", "command-timeout stop"): "safe_stop",
    ("driving", "stop requested"): "safe_stop",
    ("driving", "camera fault"): "safe_stop",
    ("driving", "vehicle fault"): "safe_stop",
    ("driving", "control released"): "safe_stop",
    ("driving", "drive over"): "safe_stop",
    ("driving", "server shutdown"): "safe_stop",
    ("degraded", "stop requested"): "safe_stop",
    ("degraded", "camera fault"): "safe_stop",
    ("degraded", "vehicle fault"): "safe_stop",
    ("degraded", "control released"): "safe_stop",
    ("degraded", "drive over"): "safe_stop",
    ("degraded", "server shutdown"): "safe_stop",
    ("arming", "driver override"): "disarmed",
    ("driving", "driver override"): "disarmed",
    ("degraded", "driver override"): "disarmed",
    ("safe_stop", "driver override"): "disarmed",
    ("disarmed", "emergency stop"): "emergency_stop",
    ("arming", "emergency stop"): "emergency_stop",
    ("driving", "emergency stop"): "emergency_stop",
    ("degraded", "emergency stop"): "emergency_stop",
    ("safe_stop", "emergency stop"): "emergency_stop",
    ("emergency_stop", "emergency stop cleared"): "disarmed",
}
"""The next state by state and trigger. A trigger in a state without an entry changes nothing."""

TRIGGER_MESSAGES: dict[Trigger, str] = {
    "arming begins": "all arming conditions are met",
    "arming interrupted": "an arming condition was not met",
    "arming complete": "armed by the client",
    "command timeout": "no command from a newer picture",
    "fresh command": "commands from newer pictures again",
    "command-timeout stop": "no command from a newer picture for too long",
    "stop requested": "the client requested a stop",
    "camera fault": "the camera repeats the same picture",
    "vehicle fault": "the vehicle does not accept commands",
    "driver override": "the driver in the car has taken over",
    "emergency stop": "emergency stop",
    "emergency stop cleared": "the emergency stop was cleared",
    "control released": "the client released control",
    "drive over": "the drive is over",
    "server shutdown": "the server is shutting down",
}
"""The message of each trigger, for the vehicle's state and for records."""


class SafetyStateMachine:
    """The safety state and its reason, which only the transitions in `TRANSITIONS` change.

    `end_epoch` is called at each safe stop, emergency stop and driver override, so that earlier commands are rejected.
    """

    def __init__(self, limits: Limits, end_epoch: Callable[[], None]) -> None:
        self.state: SafetyState = "disarmed"
        self.reason = "nobody has armed the vehicle yet"
        self._limits = limits
        self._end_epoch = end_epoch
        self._transitions: list[tuple[SafetyState, SafetyState, str]] = []

    def trigger(self, trigger: Trigger, detail: str = "") -> None:
        """Make the transition of a trigger, if `TRANSITIONS` has one from the present state."""
        next_state = TRANSITIONS.get((self.state, trigger))
        if next_state is None:
            return
        message = TRIGGER_MESSAGES[trigger]
        reason = f"{message}: {detail}" if detail else message
        self._transitions.append((self.state, next_state, reason))
        self.state, self.reason = next_state, reason
        if next_state in ("safe_stop", "emergency_stop") or trigger == "driver override":
            self._end_epoch()

    def take_transitions(self) -> list[tuple[SafetyState, SafetyState, str]]:
        """Return the transitions since the last call: each as the state before, the state after, and the reason."""
        transitions, self._transitions = self._transitions, []
        return transitions

    def is_active(self) -> bool:
        """Return whether the vehicle is driven or about to be driven."""
        return self.state in ACTIVE

    def is_at_rest(self, vehicle: VehicleState) -> bool:
        """Return whether the vehicle is stationary and neither driven nor about to be driven."""
        return not self.is_active() and self._limits.is_stationary(vehicle)
