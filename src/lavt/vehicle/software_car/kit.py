"""A by-wire kit without I/O: it takes frames and times, and returns frames and the actuation of the wheels.

The kit behaves as the published sources (docs/can.md) describe. If they say nothing, it behaves so that mistakes of an
adapter are easy to notice; such behaviour is marked as our choice.
"""

from __future__ import annotations

from typing import Final, Literal

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleState
from lavt.errors import UserError
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.authority import COMMAND_TIMEOUT_NS, CONTROL_ALLOWED, REMOTE, Authority
from lavt.vehicle.software_car.gearbox import GEARS, shift
from lavt.vehicle.software_car.generations import GENERATIONS
from lavt.vehicle.software_car.mechanics import Mechanics, clamp
from lavt.vehicle.software_car.state import (
    AXES,
    MIN_PRESSED_PEDAL,
    Axis,
    AxisOrder,
    Gear,
    GearOrder,
    KitState,
    ReleaseReason,
    SystemOrder,
)

OVERRIDE_TORQUE_NM: Final = 2.0
"""Our choice: the smallest torque of the driver on the steering wheel that is an override."""
INHIBIT_REASONS: Final = {
    "seat belt": ReleaseReason.SEAT_BELT,
    "door": ReleaseReason.DOOR,
    "speed": ReleaseReason.LOCKOUT_SPEED,
    "acceleration": ReleaseReason.LOCKOUT_ACCELERATION,
    "reverse": ReleaseReason.LOCKOUT_REVERSE,
}
REPORTED_VALUES: Final = {"angle", "speed", "wheel_speed"}


def check_known(name: str, names: set[str], kind: str) -> str:
    """Return `name` if it is one of `names`. Raises `UserError` with the known names."""
    if name not in names:
        raise UserError(f"there is no {kind} {name!r}: the known ones are {', '.join(sorted(names))}")
    return name


class Kit:
    """A by-wire kit. `now_ns` is a time of any monotonic clock and must not decrease.

    `commands` selects the command set that generation 2 accepts. Without `has_watchdog` the kit never brakes on its
    own, and generation 1 does not check counters.
    """

    def __init__(
        self,
        generation: Literal[1, 2],
        *,
        start_ns: int,
        commands: Literal["remote", "user"] = "remote",
        has_watchdog: bool = True,
        mechanics: Mechanics | None = None,
    ) -> None:
        self._generation = GENERATIONS[generation]
        self._is_remote = commands == "remote"
        self._mechanics = mechanics or Mechanics()
        reports = self._generation.reports.items()
        self._due_ns = {identifier: start_ns + period_ms * NS_PER_MS for identifier, (period_ms, _) in reports}
        self._next_due_ns = min(self._due_ns.values())
        self._now_ns, self._is_bus_off = start_ns, False
        self.state = KitState(remote_state=REMOTE if self._is_remote else CONTROL_ALLOWED)
        self._authority = Authority(self.state, self._generation, has_watchdog=has_watchdog)
        self._authority.update()

    # Frames from the bus.

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Process a frame from the bus, or ignore it if it is not for the kit."""
        self._advance(now_ns)
        if self._is_bus_off:
            return
        order = self._generation.parse_order(frame, self._mechanics, self._is_remote)
        if isinstance(order, AxisOrder):
            self._receive_axis_order(order)
        elif isinstance(order, GearOrder):
            shift(self.state, order)
        elif isinstance(order, SystemOrder):
            self._authority.receive_system_order(order, self._now_ns)
        self._authority.update()

    def _receive_axis_order(self, order: AxisOrder) -> None:
        """Process an order to an axis; release the axis if the order's checksum or counter is wrong."""
        actuator = self.state.actuators[order.axis]
        if not order.is_valid:
            actuator.is_crc_bad = True
            self._authority.release(order.axis, ReleaseReason.CRC)
            return
        actuator.is_crc_bad = False
        if order.count is not None:
            previous_count, actuator.count = actuator.count, order.count
            actuator.is_count_bad = not self._follows(previous_count, order.count)
            if actuator.is_count_bad:
                self._authority.release(order.axis, ReleaseReason.COUNTER)
                return
        if order.is_clearing:
            self._authority.clear(order.axis)
        if order.count is None:
            return
        actuator.order, actuator.received_ns, actuator.has_timed_out = order, self._now_ns, False
        if actuator.driver_acts and order.is_enabling and not order.ignores_driver:
            self._authority.override(order.axis)

    def _follows(self, previous_count: int | None, count: int) -> bool:
        is_checked = self._authority.has_watchdog or self._generation.is_one_system
        return previous_count is None or not is_checked or self._generation.follows(previous_count, count)

    # Time.

    def _advance(self, now_ns: int) -> None:
        """Advance to `now_ns`: release axes whose orders time out, and turn the steering wheel."""
        state = self.state
        for deadline_ns, axis in sorted(deadline for deadline in self._deadlines() if deadline[0] <= now_ns):
            actuator = state.actuators[axis]
            self._turn(deadline_ns)
            actuator.has_timed_out = actuator.order is not None and actuator.order.is_enabling
            self._authority.release(axis, ReleaseReason.TIMEOUT)
            actuator.order = None
            self._authority.update()
        self._authority.expire_request(now_ns)
        self._turn(now_ns)

    def _deadlines(self) -> list[tuple[int, Axis]]:
        """Return for each axis with an order when this order times out, and the axis."""
        actuators = self.state.actuators
        return [(actuators[axis].received_ns + COMMAND_TIMEOUT_NS, axis) for axis in AXES if actuators[axis].order]

    def _turn(self, to_ns: int) -> None:
        """Turn the setpoint of the steering wheel towards the ordered angle, at most at the ordered rate."""
        steering, passed_s = self.state.actuators["steering"], (to_ns - self._now_ns) / NS_PER_S
        self._now_ns = to_ns
        if steering.is_enabled and steering.order is not None:
            limit_rad = steering.order.rate_radps * passed_s
            self.state.setpoint_rad += clamp(steering.order.target - self.state.setpoint_rad, -limit_rad, limit_rad)

    def next_wake_ns(self) -> int:
        """Return the time of the next report or timeout."""
        return min([self._next_due_ns, *(deadline_ns for deadline_ns, _ in self._deadlines())])

    # Outputs.

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Return the reports that are due. If the call is several periods late, each report is returned only once."""
        self._advance(now_ns)
        if now_ns < self._next_due_ns:
            return []
        frames = []
        dropped = {self._generation.speed_messages[source] for source in self.state.sensor_faults.dropped}
        for identifier, (period_ms, encode) in self._generation.reports.items():
            late_ns = now_ns - self._due_ns[identifier]
            if late_ns >= 0:
                period_ns = period_ms * NS_PER_MS
                self._due_ns[identifier] += (late_ns // period_ns + 1) * period_ns
                if identifier in dropped:
                    continue
                frames.append(CanFrame(identifier, encode(self.state, self._mechanics)))
                self.state.sent[identifier] = self.state.sent.get(identifier, 0) + 1
        self._next_due_ns = min(self._due_ns.values())
        return [] if self._is_bus_off else frames

    def actuation(self, now_ns: int) -> Actuation:
        """Return the actuation of the wheels. If steering is not enabled, they keep their angle (our choice)."""
        self._advance(now_ns)
        brake = 1.0 if self.state.gear == Gear.PARK else self.state.brake * self.state.brake_share
        return Actuation(self.state.setpoint_rad / self._mechanics.steering_ratio, self.state.throttle, brake)

    # The car, the driver, and faults.

    def sense(self, vehicle: VehicleState, now_ns: int) -> None:
        """Update the car's speed and wheel angle."""
        self._advance(now_ns)
        self.state.speed_mps = vehicle.speed_mps
        self.state.wheel_rad = vehicle.steering_rad * self._mechanics.steering_ratio

    def driver_steers(self, torque_nm: float, now_ns: int) -> None:
        """Set the driver's torque on the steering wheel."""
        self._advance(now_ns)
        self.state.driver_torque_nm = torque_nm
        self._set_driver_acts("steering", abs(torque_nm) >= OVERRIDE_TORQUE_NM)

    def driver_brakes(self, fraction: float, now_ns: int) -> None:
        """Set the driver's brake pedal."""
        self._advance(now_ns)
        self.state.driver_brake = clamp(fraction, 0.0, 1.0)
        self._set_driver_acts("brake", fraction >= MIN_PRESSED_PEDAL)

    def driver_throttles(self, fraction: float, now_ns: int) -> None:
        """Set the driver's throttle pedal."""
        self._advance(now_ns)
        self.state.driver_throttle = clamp(fraction, 0.0, 1.0)
        self._set_driver_acts("throttle", fraction >= MIN_PRESSED_PEDAL)

    def _set_driver_acts(self, axis: Axis, acts: bool) -> None:
        actuator = self.state.actuators[axis]
        actuator.driver_acts = acts
        order = actuator.order
        if acts and order is not None and order.is_enabling and not order.ignores_driver:
            self._authority.override(axis)
        self.state.watchdog_brakes &= not acts
        self._authority.update()

    def driver_shifts(self, gear: Gear, now_ns: int) -> None:
        """Move the shifter as the driver. Raises `UserError` for a gear that the car does not have."""
        check_known(gear.name, {known_gear.name for known_gear in GEARS}, "available gear")
        self._advance(now_ns)
        state = self.state
        state.gear = gear
        if any(actuator.is_enabled for actuator in state.actuators.values()):
            if self._generation.is_one_system:
                self._authority.release("steering", ReleaseReason.OVERRIDE)
            state.is_gear_overridden = True
        state.watchdog_brakes = False
        self._authority.update()

    def set_fault(self, name: str, now_ns: int, *, is_set: bool = True) -> None:
        """Set or clear a fault `part.bit`, such as `steering.FLTPWR`. Raises `UserError` with the known faults."""
        faults = self._generation.faults.items()
        check_known(name, {f"{part}.{bit}" for part, bits in faults for bit in bits}, "fault")
        self._advance(now_ns)
        part, bit = name.split(".")
        faults_by_part: dict[str, set[str]] = {"gear": self.state.gear_faults}
        faults_by_part |= {axis: actuator.faults for axis, actuator in self.state.actuators.items()}
        (faults_by_part[part].add if is_set else faults_by_part[part].discard)(bit)
        self._authority.update()

    def set_unknown(self, name: str, *, is_unknown: bool = True) -> None:
        """Report `angle`, `speed` or `wheel_speed` as unknown, or as known again."""
        check_known(name, REPORTED_VALUES, "reported value")
        (self.state.invalid.add if is_unknown else self.state.invalid.discard)(name)

    def stick_speed(self, source: str, speed_mps: float | None = None) -> None:
        """Let a source report the same speed all the time, by default the present one.

        Raises `UserError` with the known sources.
        """
        faults = self.state.sensor_faults
        self._check_source(source)
        faults.stuck_mps[source] = self.state.reported_mps(source) if speed_mps is None else speed_mps

    def scale_speed(self, source: str, factor: float) -> None:
        """Let a source report a multiple of the speed. Raises `UserError` with the known sources."""
        self._check_source(source)
        self.state.sensor_faults.factors[source] = factor

    def drop_speed(self, source: str) -> None:
        """Stop sending the message of a source. Raises `UserError` with the known sources."""
        self._check_source(source)
        self.state.sensor_faults.dropped.add(source)

    def restore_speed(self, source: str) -> None:
        """Remove the faults of a source. Raises `UserError` with the known sources."""
        self._check_source(source)
        self.state.sensor_faults.clear(source)

    def weaken_brake(self, share: float) -> None:
        """Let only a share of the brake's force reach the wheels; 1 removes the fault."""
        self.state.brake_share = clamp(share, 0.0, 1.0)

    def _check_source(self, source: str) -> None:
        check_known(source, set(self._generation.speed_messages), "source of speed of this kit")

    def inhibit(self, name: str | None, now_ns: int) -> None:
        """Make generation 2 not ready for a reason of `INHIBIT_REASONS`; None removes the reason."""
        self._advance(now_ns)
        reason = ReleaseReason.NONE
        if name is not None:
            reason = INHIBIT_REASONS[check_known(name, set(INHIBIT_REASONS), "inhibit reason")]
        self._authority.inhibit_reason = reason
        self._authority.update()

    def switch_remote(self, remote_state: int, now_ns: int) -> None:
        """Set the switch of the remote: 0 emergency stop, 1 pause, 2 remote, 3 control allowed."""
        self._advance(now_ns)
        self.state.remote_state = remote_state
        self._authority.update()

    def set_bus_off(self, now_ns: int, *, is_off: bool = True) -> None:
        """Disconnect the kit from the bus, or reconnect it."""
        self._advance(now_ns)
        self._is_bus_off = is_off

    def set_watchdog(self, now_ns: int, *, is_enabled: bool = True) -> None:
        """Enable or disable the watchdog's braking."""
        self._advance(now_ns)
        self._authority.has_watchdog = is_enabled
