"""A by-wire kit, sans-IO: frames and times in, frames and what reaches the wheels out.

It behaves as the facts say kits behave. Where they say nothing it does what shows an adapter's mistakes best; that is
marked "ours".
"""

from __future__ import annotations

from typing import Final, Literal

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, VehicleState
from lavt.errors import UserError
from lavt.vehicle.can_frame import CanFrame
from lavt.vehicle.software_car.authority import COMMAND_TIMEOUT_NS, CONTROL_ALLOWED, REMOTE, Authority
from lavt.vehicle.software_car.gearbox import GEARS, shift
from lavt.vehicle.software_car.generations import GENERATIONS
from lavt.vehicle.software_car.mechanics import Mechanics, within
from lavt.vehicle.software_car.state import (
    AXES,
    OVERRIDE_PEDAL,
    Axis,
    Gear,
    GearOrder,
    KitState,
    Order,
    ReleaseReason,
    SystemOrder,
)

OVERRIDE_TORQUE_NM: Final = 2.0
"""Ours: from where on hands are an override."""
INHIBIT_REASONS: Final = {
    "seat belt": ReleaseReason.SEAT_BELT,
    "door": ReleaseReason.DOOR,
    "speed": ReleaseReason.LOCKOUT_SPEED,
    "acceleration": ReleaseReason.LOCKOUT_ACCELERATION,
    "reverse": ReleaseReason.LOCKOUT_REVERSE,
}
REPORTED: Final = {"angle", "speed", "wheel_speed"}


def known(name: str, names: set[str], what: str) -> str:
    """Give a name back; raises `UserError` with the known ones."""
    if name not in names:
        raise UserError(f"there is no {what} {name!r}: the known ones are {', '.join(sorted(names))}")
    return name


class Kit:
    """The kit. `now_ns` is of any monotonic clock, and never goes back.

    `commands` chooses which of generation 2's sets is obeyed. Without `has_watchdog` nothing brakes by itself, and
    generation 1 does not look at counters.
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
        self._authority.settle()

    # What comes from the bus.

    def receive(self, frame: CanFrame, now_ns: int) -> None:
        """Take a frame from the bus; what is not for the kit is dropped."""
        self._live(now_ns)
        if self._is_bus_off:
            return
        order = self._generation.read(frame, self._mechanics, self._is_remote)
        if isinstance(order, Order):
            self._hear(order)
        elif isinstance(order, GearOrder):
            shift(self.state, order)
        elif isinstance(order, SystemOrder):
            self._authority.request(order, self._now_ns)
        self._authority.settle()

    def _hear(self, order: Order) -> None:
        """Take an axis's command, if its checksum and counter are right."""
        actuator = self.state.actuators[order.axis]
        if not order.is_valid:
            actuator.is_crc_bad = True
            self._authority.lose(order.axis, ReleaseReason.CRC)
            return
        actuator.is_crc_bad = False
        if order.count is not None:
            before, actuator.count = actuator.count, order.count
            actuator.is_count_bad = not self._follows(before, order.count)
            if actuator.is_count_bad:
                self._authority.lose(order.axis, ReleaseReason.COUNTER)
                return
        if order.is_clearing:
            self._authority.clear(order.axis)
        if order.count is None:
            return
        actuator.order, actuator.heard_ns, actuator.has_timed_out = order, self._now_ns, False
        if actuator.driver_acts and order.is_enabling and not order.ignores_driver:
            self._authority.override(order.axis)

    def _follows(self, before: int | None, count: int) -> bool:
        is_checked = self._authority.has_watchdog or self._generation.is_one_system
        return before is None or not is_checked or self._generation.follows(before, count)

    # Time.

    def _live(self, now_ns: int) -> None:
        """Live on to a time: commands time out, the steering wheel turns."""
        state = self.state
        for end_ns, axis in sorted(end for end in self._ends() if end[0] <= now_ns):
            actuator = state.actuators[axis]
            self._turn(end_ns)
            actuator.has_timed_out = actuator.order is not None and actuator.order.is_enabling
            self._authority.lose(axis, ReleaseReason.TIMEOUT)
            actuator.order = None
            self._authority.settle()
        self._authority.live(now_ns)
        self._turn(now_ns)

    def _ends(self) -> list[tuple[int, Axis]]:
        """List when each axis's command times out."""
        actuators = self.state.actuators
        return [(actuators[axis].heard_ns + COMMAND_TIMEOUT_NS, axis) for axis in AXES if actuators[axis].order]

    def _turn(self, to_ns: int) -> None:
        """Turn the steering wheel towards its command, as fast as that allows."""
        steering, passed_s = self.state.actuators["steering"], (to_ns - self._now_ns) / NS_PER_S
        self._now_ns = to_ns
        if steering.is_enabled and steering.order is not None:
            furthest_rad = steering.order.rate_radps * passed_s
            self.state.held_rad += within(steering.order.target - self.state.held_rad, -furthest_rad, furthest_rad)

    def next_wake_ns(self) -> int:
        """Tell when something happens by itself next: a report, or a command that times out."""
        return min([self._next_due_ns, *(end_ns for end_ns, _ in self._ends())])

    # What goes out.

    def frames_due(self, now_ns: int) -> list[CanFrame]:
        """Give the reports that are due, each once however late the call is."""
        self._live(now_ns)
        if now_ns < self._next_due_ns:
            return []
        frames = []
        for identifier, (period_ms, make) in self._generation.reports.items():
            late_ns = now_ns - self._due_ns[identifier]
            if late_ns >= 0:
                period_ns = period_ms * NS_PER_MS
                self._due_ns[identifier] += (late_ns // period_ns + 1) * period_ns
                frames.append(CanFrame(identifier, make(self.state, self._mechanics)))
                self.state.sent[identifier] = self.state.sent.get(identifier, 0) + 1
        self._next_due_ns = min(self._due_ns.values())
        return [] if self._is_bus_off else frames

    def actuation(self, now_ns: int) -> Actuation:
        """Tell what reaches the wheels. With nobody steering, the wheel stays where it is (ours)."""
        self._live(now_ns)
        brake = 1.0 if self.state.gear == Gear.PARK else self.state.brake
        return Actuation(self.state.held_rad / self._mechanics.steering_ratio, self.state.throttle, brake)

    # The car, the people in it, and what breaks.

    def sense(self, vehicle: VehicleState, now_ns: int) -> None:
        """Take speed and wheel angle of the car."""
        self._live(now_ns)
        self.state.speed_mps = vehicle.speed_mps
        self.state.wheel_rad = vehicle.steering_rad * self._mechanics.steering_ratio

    def driver_steers(self, torque_nm: float, now_ns: int) -> None:
        """Put hands on the steering wheel, until told otherwise."""
        self._live(now_ns)
        self.state.driver_torque_nm = torque_nm
        self._note_driver_input("steering", abs(torque_nm) >= OVERRIDE_TORQUE_NM)

    def driver_brakes(self, fraction: float, now_ns: int) -> None:
        """Put a foot on the brake, until told otherwise."""
        self._live(now_ns)
        self.state.driver_brake = within(fraction, 0.0, 1.0)
        self._note_driver_input("brake", fraction >= OVERRIDE_PEDAL)

    def driver_throttles(self, fraction: float, now_ns: int) -> None:
        """Put a foot on the throttle, until told otherwise."""
        self._live(now_ns)
        self.state.driver_throttle = within(fraction, 0.0, 1.0)
        self._note_driver_input("throttle", fraction >= OVERRIDE_PEDAL)

    def _note_driver_input(self, axis: Axis, acts: bool) -> None:
        actuator = self.state.actuators[axis]
        actuator.driver_acts = acts
        order = actuator.order
        if acts and order is not None and order.is_enabling and not order.ignores_driver:
            self._authority.override(axis)
        self.state.watchdog_brakes &= not acts
        self._authority.settle()

    def driver_shifts(self, gear: Gear, now_ns: int) -> None:
        """Move the shifter."""
        known(gear.name, {each.name for each in GEARS}, "gear of this car")
        self._live(now_ns)
        state = self.state
        state.gear = gear
        if any(actuator.is_enabled for actuator in state.actuators.values()):
            if self._generation.is_one_system:
                self._authority.lose("steering", ReleaseReason.OVERRIDE)
            state.is_gear_overridden = True
        state.watchdog_brakes = False
        self._authority.settle()

    def set_fault(self, name: str, now_ns: int, *, is_set: bool = True) -> None:
        """Break a part, or mend it: `part.bit`, as in `steering.FLTPWR`; raises `UserError` with the known ones."""
        faults = self._generation.faults.items()
        known(name, {f"{part}.{bit}" for part, bits in faults for bit in bits}, "fault")
        self._live(now_ns)
        part, bit = name.split(".")
        of_part: dict[str, set[str]] = {"gear": self.state.gear_faults}
        of_part |= {axis: actuator.faults for axis, actuator in self.state.actuators.items()}
        (of_part[part].add if is_set else of_part[part].discard)(bit)
        self._authority.settle()

    def set_unknown(self, name: str, *, is_unknown: bool = True) -> None:
        """Have `angle`, `speed` or `wheel_speed` reported as unknown."""
        known(name, REPORTED, "value that can be unknown")
        (self.state.invalid.add if is_unknown else self.state.invalid.discard)(name)

    def inhibit(self, name: str | None, now_ns: int) -> None:
        """Let generation 2 have a reason not to be ready, one of `INHIBIT_REASONS`; None takes it away."""
        self._live(now_ns)
        self._authority.inhibit_reason = (
            ReleaseReason.NONE if name is None else INHIBIT_REASONS[known(name, set(INHIBIT_REASONS), "inhibit reason")]
        )
        self._authority.settle()

    def switch_remote(self, remote_state: int, now_ns: int) -> None:
        """Turn the remote's switch: 0 emergency stop, 1 pause, 2 remote, 3 control allowed."""
        self._live(now_ns)
        self.state.remote_state = remote_state
        self._authority.settle()

    def bus_off(self, now_ns: int, *, is_off: bool = True) -> None:
        """Cut the kit from the bus, or bring it back."""
        self._live(now_ns)
        self._is_bus_off = is_off

    def switch_watchdog(self, now_ns: int, *, is_there: bool = True) -> None:
        """Have the watchdog that brakes, or do without it."""
        self._live(now_ns)
        self._authority.has_watchdog = is_there
