"""The brake of a safe stop, controlled by the measured speed.

The deceleration of a brake is neither proportional to its pedal nor always the same.
"""

from __future__ import annotations

from lavt.domain import MAX_REPORTED_MPS, NS_PER_S, VehicleState
from lavt.safety.limits import Limits


class StopBrake:
    """A controller of the brake pedal in safe stops.

    The more the vehicle exceeds the planned speed of the stop, the harder it brakes. The planned speed falls at
    `stop_deceleration_mps2`, beginning `stop_settling_ns` after the beginning of the stop. During a stop the pedal is
    never eased. `max_braking_mps2` is the vehicle's deceleration at full pedal.
    """

    def __init__(self, limits: Limits, max_braking_mps2: float) -> None:
        self._limits = limits
        self._least_pedal = min(1.0, limits.stop_deceleration_mps2 / max_braking_mps2)
        self._began: tuple[int, float] | None = None
        """Time and speed at the beginning of the present stop."""
        self._pedal = 0.0

    def reset(self) -> None:
        """Note that the vehicle is not in a safe stop."""
        self._began = None

    def pedal(self, vehicle: VehicleState, now_ns: int) -> float:
        """Return the brake pedal for now; the first call after `reset` begins a stop."""
        limits = self._limits
        if self._began is None:
            self._began, self._pedal = (now_ns, abs(vehicle.speed_mps)), self._least_pedal
        began_ns, began_mps = self._began
        braked_ns = now_ns - began_ns - limits.stop_settling_ns
        planned_mps = max(0.0, began_mps - limits.stop_deceleration_mps2 * braked_ns / NS_PER_S)
        excess_mps = abs(vehicle.speed_mps) - planned_mps
        if not (vehicle.is_speed_plausible and abs(vehicle.speed_mps) <= MAX_REPORTED_MPS):
            self._pedal = 1.0
        elif braked_ns > 0 and excess_mps > 0:
            excess_share = min(1.0, excess_mps / limits.stop_excess_mps)
            self._pedal = max(self._pedal, self._least_pedal + excess_share * (1.0 - self._least_pedal))
        return self._pedal
