"""Authority over the axes: which axes are enabled, why the kit releases them, and when the watchdog brakes."""

from __future__ import annotations

from typing import Final

from lavt.domain import NS_PER_MS
from lavt.vehicle.software_car.generations import Generation
from lavt.vehicle.software_car.state import AXES, Axis, KitState, ReleaseReason, SystemOrder, SystemState

COMMAND_TIMEOUT_NS: Final = 100 * NS_PER_MS
"""The time after its last valid order when an axis is released. A request to enable expires after the same time."""
WATCHDOG_BRAKE: Final = 0.5
"""Our choice: how hard the watchdog brakes, as a fraction of the full brake."""
ENABLE, DISABLE = 1, 2
"""Requests of a `SystemOrder`; 0 requests nothing."""
PAUSED, REMOTE, CONTROL_ALLOWED = 1, 2, 3
"""States of the remote's switch; 0 is the emergency stop."""


class Authority:
    """The logic that enables and releases the axes. Call `update` after every change of the kit's state.

    Without `has_watchdog` the kit never brakes on its own.
    """

    def __init__(self, state: KitState, generation: Generation, *, has_watchdog: bool) -> None:
        self._state, self._generation, self.has_watchdog = state, generation, has_watchdog
        self.inhibit_reason = ReleaseReason.NONE
        """Why a kit of generation 2 is not ready, if its state contains no other reason."""
        self._system_count: int | None = None
        self._requested_ns: int | None = None
        """Time of the newest request to enable; None after it has expired."""
        self._is_enable_pending = False
        """Whether the system is to become active as soon as it is ready."""
        self._is_enable_used = False
        """Whether the system was released during the current series of requests to enable. The series then has no more
        effect; it must stop before a new request can enable the system."""

    def receive_system_order(self, order: SystemOrder, now_ns: int) -> None:
        """Process generation 2's order to the system."""
        if not order.is_valid or order.count == self._system_count:
            return
        self._system_count = order.count
        if order.request == ENABLE:
            self._requested_ns, self._is_enable_pending = now_ns, not self._is_enable_used
            return
        self._requested_ns, self._is_enable_pending, self._is_enable_used = None, False, False
        if order.request == DISABLE and self._state.system == SystemState.ACTIVE:
            self.release("steering", ReleaseReason.REQUESTED)

    def expire_request(self, now_ns: int) -> None:
        """Discard a request to enable that is too old."""
        if self._requested_ns is not None and self._requested_ns + COMMAND_TIMEOUT_NS <= now_ns:
            self._requested_ns, self._is_enable_pending, self._is_enable_used = None, False, False

    def update(self) -> None:
        """Release axes that are no longer allowed to be enabled, enable axes that are ready, and set the pedals."""
        state = self._state
        for axis in AXES:
            if not state.actuators[axis].may_be_enabled:
                self.release(axis, ReleaseReason.FAULT if state.actuators[axis].faults else ReleaseReason.DISABLED)
        state.not_ready_reason = self._not_ready_reason()
        if state.not_ready_reason != ReleaseReason.NONE and self._generation.is_one_system:
            self.release("steering", state.not_ready_reason)
        is_ready = state.not_ready_reason == ReleaseReason.NONE
        ready_axes = [axis for axis in AXES if is_ready and state.actuators[axis].may_be_enabled]
        if not self._generation.is_one_system or (len(ready_axes) == len(AXES) and self._is_enable_pending):
            self._enable(ready_axes)
        state.system = self._system_state()
        state.throttle, state.brake = self._pedals()

    def _not_ready_reason(self) -> ReleaseReason:
        """Return why the kit as a whole is not ready."""
        state = self._state
        if state.watchdog_reason != ReleaseReason.NONE or not self._generation.is_one_system:
            return state.watchdog_reason
        if state.gear_faults or any(actuator.faults for actuator in state.actuators.values()):
            return ReleaseReason.FAULT
        if state.is_overridden:
            return ReleaseReason.OVERRIDE
        return ReleaseReason.REMOTE if state.remote_state <= PAUSED else self.inhibit_reason

    def _system_state(self) -> SystemState:
        if self._state.actuators["steering"].is_enabled:
            return SystemState.ACTIVE
        if self._state.watchdog_reason != ReleaseReason.NONE or self._state.not_ready_reason == ReleaseReason.FAULT:
            return SystemState.FAULT
        return SystemState.READY if self._state.not_ready_reason == ReleaseReason.NONE else SystemState.MANUAL

    def _enable(self, axes: list[Axis]) -> None:
        for axis in axes:
            if axis == "steering" and not self._state.actuators[axis].is_enabled:
                self._state.setpoint_rad = self._state.wheel_rad
            self._state.actuators[axis].is_enabled = True

    def release(self, axis: Axis, reason: ReleaseReason) -> None:
        """Release an axis if it is enabled.

        The watchdog then brakes, unless the release was commanded or the driver overrides.
        """
        state = self._state
        if not state.actuators[axis].is_enabled:
            return
        is_commanded = reason in {ReleaseReason.REQUESTED, ReleaseReason.OVERRIDE} or (
            reason == ReleaseReason.DISABLED
            and (self._generation.is_one_system or (state.is_stationary and not state.is_in_gear))
        )
        is_trip = self.has_watchdog and not is_commanded and not state.is_overridden
        if is_trip:
            state.watchdog_reason, state.watchdog_axis, state.watchdog_brakes = reason, axis, True
        state.disengage_reason = reason
        self._is_enable_pending, self._is_enable_used = False, self._requested_ns is not None
        for released_axis in AXES if is_trip or self._generation.is_one_system else (axis,):
            state.actuators[released_axis].is_enabled = False
            if released_axis == "steering":
                self._state.setpoint_rad = state.wheel_rad

    def override(self, axis: Axis) -> None:
        """Release an axis because the driver acts on it, and latch the override."""
        self.release(axis, ReleaseReason.OVERRIDE)
        self._state.actuators[axis].is_overridden = True

    def clear(self, axis: Axis) -> None:
        """Clear the override of an axis if the driver no longer acts on it, and the watchdog if it no longer brakes.

        Generation 2 clears the overrides of all axes.
        """
        state = self._state
        for cleared_axis in AXES if self._generation.is_one_system else (axis,):
            state.actuators[cleared_axis].is_overridden &= state.actuators[cleared_axis].driver_acts
        if self._generation.is_one_system:  # the gear command of generation 2 has no CLEAR
            state.is_gear_overridden = False
        if not state.watchdog_brakes:
            state.watchdog_reason, state.watchdog_axis = ReleaseReason.NONE, None

    def _pedals(self) -> tuple[float, float]:
        """Return throttle and brake, the larger of the kit's and the driver's each. Out of gear the throttle is 0."""
        state, requested = self._state, dict.fromkeys(AXES, 0.0)
        for axis, actuator in state.actuators.items():
            if actuator.is_enabled and actuator.order is not None:
                requested[axis] = actuator.order.target
        watchdog_brake = WATCHDOG_BRAKE if state.watchdog_brakes else 0.0
        throttle = max(requested["throttle"], state.driver_throttle) if state.is_in_gear else 0.0
        return throttle, max(requested["brake"], state.driver_brake, watchdog_brake)
