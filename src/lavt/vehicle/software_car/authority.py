"""Who drives: which axes of a kit obey, why it lets go of them, and the watchdog that brakes then."""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS
from lavt.vehicle.software_car.generations import Generation
from lavt.vehicle.software_car.state import AXES, Axis, KitState, ReleaseReason, SystemOrder, SystemState

COMMAND_TIMEOUT_NS: Final = 100 * NS_PER_MS
"""An actuator disables itself this long after its last valid command; a request to enable is as old at most."""
WATCHDOG_BRAKE: Final = 0.5
"""Ours: how hard the watchdog brakes."""
ENABLE, DISABLE = 1, 2
PAUSED, REMOTE, CONTROL_ALLOWED = 1, 2, 3
"""States of the remote's switch; 0 is its emergency stop."""


class Authority:
    """Decides over the axes of a kit's state; `settle` after whatever has changed.

    Without `has_watchdog` nothing brakes by itself.
    """

    def __init__(self, state: KitState, generation: Generation, *, has_watchdog: bool) -> None:
        self._state, self._generation, self.has_watchdog = state, generation, has_watchdog
        self.inhibit_reason = ReleaseReason.NONE
        """Why generation 2 is not ready, if nothing in the state says so."""
        self._system_count: int | None = None
        self._requested_ns: int | None = None
        """When the newest request to enable came, while they keep coming."""
        self._is_requested, self._is_spent = False, False
        """Whether the system is to become active; whether it was, so that requests have to begin anew."""

    def request(self, order: SystemOrder, now_ns: int) -> None:
        """Take generation 2's request to the system."""
        if not order.is_valid or order.count == self._system_count:
            return
        self._system_count = order.count
        if order.request == ENABLE:
            self._requested_ns, self._is_requested = now_ns, not self._is_spent
            return
        self._requested_ns, self._is_requested, self._is_spent = None, False, False
        if order.request == DISABLE and self._state.system == SystemState.ACTIVE:
            self.lose("steering", ReleaseReason.REQUESTED)

    def live(self, now_ns: int) -> None:
        """Forget a request to enable that is too old."""
        if self._requested_ns is not None and self._requested_ns + COMMAND_TIMEOUT_NS <= now_ns:
            self._requested_ns, self._is_requested, self._is_spent = None, False, False

    def settle(self) -> None:
        """Let go of what may be enabled no longer, enable what may be, and see what comes out."""
        state = self._state
        for axis in AXES:
            if not state.actuators[axis].may_be_enabled:
                self.lose(axis, ReleaseReason.FAULT if state.actuators[axis].faults else ReleaseReason.DISABLED)
        state.not_ready = self._why_not_ready()
        if state.not_ready != ReleaseReason.NONE and self._generation.is_one_system:
            self.lose("steering", state.not_ready)
        ready = [
            axis for axis in AXES if state.actuators[axis].may_be_enabled and state.not_ready == ReleaseReason.NONE
        ]
        if not self._generation.is_one_system or (len(ready) == len(AXES) and self._is_requested):
            self._enable(ready)
        state.system = self._system_state()
        state.throttle, state.brake = self._pedals()

    def _why_not_ready(self) -> ReleaseReason:
        """Tell what hinders the kit as a whole."""
        state = self._state
        if state.watchdog != ReleaseReason.NONE or not self._generation.is_one_system:
            return state.watchdog
        if state.gear_faults or any(actuator.faults for actuator in state.actuators.values()):
            return ReleaseReason.FAULT
        if state.is_overridden:
            return ReleaseReason.OVERRIDE
        return ReleaseReason.REMOTE if state.remote_state <= PAUSED else self.inhibit_reason

    def _system_state(self) -> SystemState:
        if self._state.actuators["steering"].is_enabled:
            return SystemState.ACTIVE
        if self._state.watchdog != ReleaseReason.NONE or self._state.not_ready == ReleaseReason.FAULT:
            return SystemState.FAULT
        return SystemState.READY if self._state.not_ready == ReleaseReason.NONE else SystemState.MANUAL

    def _enable(self, axes: list[Axis]) -> None:
        for axis in axes:
            if axis == "steering" and not self._state.actuators[axis].is_enabled:
                self._state.held_rad = self._state.wheel_rad
            self._state.actuators[axis].is_enabled = True

    def lose(self, axis: Axis, reason: ReleaseReason) -> None:
        """Let go of an enabled axis: with the watchdog's brakes, unless somebody wanted it or has taken over."""
        state = self._state
        if not state.actuators[axis].is_enabled:
            return
        is_wanted = reason in {ReleaseReason.REQUESTED, ReleaseReason.OVERRIDE} or (
            reason == ReleaseReason.DISABLED
            and (self._generation.is_one_system or (state.is_stationary and not state.is_in_gear))
        )
        is_trip = self.has_watchdog and not is_wanted and not state.is_overridden
        if is_trip:
            state.watchdog, state.watchdog_axis, state.watchdog_brakes = reason, axis, True
        state.disengaged = reason
        self._is_requested, self._is_spent = False, self._requested_ns is not None
        for each in AXES if is_trip or self._generation.is_one_system else (axis,):
            state.actuators[each].is_enabled = False
            if each == "steering":
                self._state.held_rad = state.wheel_rad

    def override(self, axis: Axis) -> None:
        """Latch that the driver has taken an axis over, and let go of it."""
        self.lose(axis, ReleaseReason.OVERRIDE)
        self._state.actuators[axis].is_overridden = True

    def clear(self, axis: Axis) -> None:
        """Forget overrides, once hands and feet are off, and the watchdog, once somebody has taken over."""
        state = self._state
        for each in AXES if self._generation.is_one_system else (axis,):
            state.actuators[each].is_overridden &= state.actuators[each].driver_acts
        if self._generation.is_one_system:  # its command for the gear has no such bit
            state.is_gear_overridden = False
        if not state.watchdog_brakes:
            state.watchdog, state.watchdog_axis = ReleaseReason.NONE, None

    def _pedals(self) -> tuple[float, float]:
        """Give throttle and brake: the kit's and the driver's, whichever is more; without a gear nothing drives."""
        state, requested = self._state, dict.fromkeys(AXES, 0.0)
        for axis, actuator in state.actuators.items():
            if actuator.is_enabled and actuator.order is not None:
                requested[axis] = actuator.order.target
        watchdog = WATCHDOG_BRAKE if state.watchdog_brakes else 0.0
        throttle = max(requested["throttle"], state.driver_throttle) if state.is_in_gear else 0.0
        return throttle, max(requested["brake"], state.driver_brake, watchdog)
