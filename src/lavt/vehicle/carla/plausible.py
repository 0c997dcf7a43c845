"""Whether what a CARLA server reports can be: values that a car can have, and controls that were sent."""

from __future__ import annotations

import math
import threading
from collections import deque
from collections.abc import Iterable
from typing import Final

from lavt.errors import VehicleError
from lavt.vehicle.carla.settings import Snapshot

MAX_TICK_ERROR_S: Final = 1e-4
MAX_SPEED_MPS: Final = 100.0
"""No car of CARLA is faster."""
MAX_WHEEL_RAD: Final = math.pi / 2
HEEDED_S: Final = 0.5
"""In an asynchronous world, the control in force is one that was sent in so much of the world's time, or the guard's. A
new car may have another one for so long.
"""
MAX_CONTROL_DIFFERENCE: Final = 1e-3
GUARD_CONTROL: Final = (0.0, 1.0)


def check_finite(values: Iterable[float], address: str) -> None:
    """Raise `VehicleError` for values that are not finite."""
    if not all(map(math.isfinite, values)):
        raise _impossible("a pose, speed, angle or time that is not finite", address)


def checked(snapshot: Snapshot, address: str) -> Snapshot:
    """Return a snapshot; raise `VehicleError` for values that no car can have."""
    speed_mps, steering_rad = snapshot.speed_mps, snapshot.steering_rad
    check_finite((*snapshot.pose, speed_mps, steering_rad, snapshot.elapsed_s, snapshot.platform_s), address)
    if abs(speed_mps) > MAX_SPEED_MPS or abs(steering_rad) >= MAX_WHEEL_RAD:
        raise _impossible(f"{speed_mps:.3g} m/s and a steering angle of {steering_rad:.3g} rad", address)
    return snapshot


def check_tick(delta_s: float, tick_s: float, address: str) -> None:
    """Raise `VehicleError` if a tick has advanced the world by another time than `tick_s`."""
    if not abs(delta_s - tick_s) <= MAX_TICK_ERROR_S:
        raise VehicleError(
            f"the CARLA server at {address} advances its world by {delta_s:.4g} s in a tick instead of {tick_s:.4g} s: "
            "end the other client that sets its settings, or restart it"
        )


class SentControls:
    """The controls that were sent to an asynchronous world lately. All methods may be called from any thread."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._sent: deque[tuple[float, float, float]] = deque()
        """The world's time at the sending, throttle and brake."""
        self._first_s = math.inf
        """The world's time when the first control was sent."""

    def note(self, elapsed_s: float, throttle: float, brake: float) -> None:
        """Note a control that is sent at a time of the world."""
        with self._lock:
            self._sent.append((elapsed_s, throttle, brake))
            self._first_s = min(self._first_s, elapsed_s)

    def check(self, elapsed_s: float, throttle: float, brake: float, address: str) -> None:
        """Raise `VehicleError` if the control in force is none of the last ones: the connection may have failed."""
        with self._lock:
            while self._sent and not 0.0 <= elapsed_s - self._sent[0][0] <= HEEDED_S:
                self._sent.popleft()
            known = [(sent_throttle, sent_brake) for _, sent_throttle, sent_brake in self._sent]
            is_new = elapsed_s - self._first_s <= HEEDED_S
        if (
            known
            and not is_new
            and all(max(abs(throttle - t), abs(brake - b)) > MAX_CONTROL_DIFFERENCE for t, b in (GUARD_CONTROL, *known))
        ):
            raise VehicleError(
                f"the CARLA server at {address} does not do what it is told (throttle {throttle:.2f}, brake "
                f"{brake:.2f}): check the connection, and restart it"
            )


def _impossible(what: str, address: str) -> VehicleError:
    return VehicleError(f"the CARLA server at {address} reports {what}, which no car can have: restart it")
