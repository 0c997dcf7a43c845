"""A car in a CARLA server as a `lavt.vehicle.vehicle.Vehicle`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S, Actuation, EventKind, GroundTruth, VehicleEvent, VehicleState
from lavt.vehicle.carla.follower import Follower
from lavt.vehicle.carla.session import BRAKED, CarlaSession
from lavt.vehicle.carla.ticker import Ticker
from lavt.vehicle.sim.dynamics import CarMotion, CarParameters
from lavt.vehicle.sim.road.road import Road
from lavt.vehicle.sim.route_monitor import CONTACT_GAP_NS, RouteMonitor
from lavt.vehicle.vehicle import Capabilities, ReachedCommand

STATIONARY_MPS: Final = 0.01
"""Below this speed the car is stationary: Unreal's bodies never rest completely."""
MONITORED: Final[frozenset[EventKind]] = frozenset({"off_road", "completed", "timeout"})
"""The events that come from the route; collisions and lane invasions come from CARLA's sensors."""
POLL_NS: Final = 5 * NS_PER_MS
"""How often the actuator looks for a new tick in real time."""
FROZEN_NS: Final = NS_PER_S // 2
"""Without a tick for this long, the car accepts no commands."""


class CarlaVehicle:
    """A `Vehicle` in a world that the ticker advances or the follower follows.

    The route monitor gives the ground truth on the road.
    """

    def __init__(
        self,
        session: CarlaSession,
        ticker: Ticker | Follower,
        road: Road,
        parameters: CarParameters,
        *,
        start_ns: int,
        limit_s: float | None = None,
    ) -> None:
        self._session, self._ticker, self._parameters = session, ticker, parameters
        self._snapshot = session.snapshot
        self._at_ns = self._now_ns = start_ns
        self._is_engaged = False
        pose = self._snapshot.pose
        self._motion = CarMotion(*pose)
        stations_m = np.arange(road.first_m, road.last_m, 1.0)
        xs_m, ys_m, _, _ = road.centre_at(stations_m)
        near_m = float(stations_m[np.argmin(np.hypot(xs_m - pose.x_m, ys_m - pose.y_m))])
        self._monitor = RouteMonitor(road, parameters, near_station_m=near_m, limit_s=limit_s)
        self._monitor.update(self._motion, start_ns)
        self._contact_ns: int | None = None

    @property
    def capabilities(self) -> Capabilities:
        """The properties of this vehicle."""
        return Capabilities(
            simulated=True,
            virtual_time=not self._session.settings.is_asynchronous,
            ground_truth=True,
            reset=False,
            wheelbase_m=self._session.wheelbase_m,
            max_steering_rad=self._session.max_steering_rad,
            max_steering_rate_radps=self._parameters.max_steering_rate_radps,
            max_acceleration_mps2=self._parameters.max_acceleration_mps2,
            max_braking_mps2=self._parameters.max_braking_mps2,
        )

    @property
    def counts(self) -> Mapping[str, int]:
        """The counters of the ticks."""
        return {f"carla_{name}": number for name, number in self._ticker.counts.items()}

    def advance(self, to_ns: int) -> list[VehicleEvent]:
        """Make the ticks up to `to_ns`, or take those that the thread has made; return their events.

        Raises `VehicleError` if the server does not answer.
        """
        self._now_ns = max(self._now_ns, to_ns)
        self._ticker.tick_until(to_ns)
        events: list[VehicleEvent] = []
        for ticked in self._ticker.take_ticks(self._at_ns):
            self._at_ns, self._snapshot = ticked.due_ns, ticked.snapshot
            self._move(ticked.snapshot.steering_rad)
            events += [event for event in self._monitor.update(self._motion, self._at_ns) if event.kind in MONITORED]
        for at_ns, event in self._ticker.take_events():
            if event.kind != "collision":
                events.append(VehicleEvent(at_ns, event.kind, event.detail))
                continue
            if self._contact_ns is None or at_ns - self._contact_ns > CONTACT_GAP_NS:
                events.append(VehicleEvent(at_ns, "collision", event.detail))
            self._contact_ns = at_ns
        return sorted(events, key=lambda event: event.mono_ns)

    def apply(self, actuation: Actuation, now_ns: int) -> None:
        """Apply `actuation` from `now_ns` on; of a car that is not engaged, only the brake is used."""
        is_free = self._is_engaged
        commanded = actuation if is_free else Actuation(0.0, 0.0, max(actuation.brake, BRAKED.brake))
        is_held = not is_free and self.state().speed_mps == 0.0
        self._ticker.command(commanded, now_ns, hand_brake=is_held)

    def engage(self, wanted: bool, now_ns: int) -> None:  # noqa: ARG002 (part of the protocol)
        """Engage the car if `wanted`, otherwise disengage it."""
        self._is_engaged = wanted

    def take_reached(self) -> list[ReachedCommand]:
        """Return an empty list: CARLA does not report when the wheels reach a command."""
        return []

    def state(self) -> VehicleState:
        """Return the state after the newest tick."""
        snapshot = self._snapshot
        reason = ""
        if self._now_ns - self._at_ns > FROZEN_NS and self._ticker.is_threaded:
            reason = f"CARLA has not completed a tick for {(self._now_ns - self._at_ns) // NS_PER_MS} ms"
        speed_mps = snapshot.speed_mps if abs(snapshot.speed_mps) >= STATIONARY_MPS else 0.0
        return VehicleState(
            self._at_ns,
            speed_mps,
            snapshot.steering_rad,
            "reverse" if snapshot.gear < 0 else "drive",
            inhibit_reason=reason,
            is_engaged=self._is_engaged,
        )

    def ground_truth(self) -> GroundTruth:
        """Return the ground truth after the newest tick."""
        track, state, pose = self._monitor.track(self._motion), self.state(), self._snapshot.pose
        return GroundTruth(
            self._at_ns,
            pose.x_m,
            pose.y_m,
            pose.heading_rad,
            state.speed_mps,
            state.steering_rad,
            track.cross_track_m,
            track.heading_error_rad,
            track.progress_m,
        )

    def next_wake_ns(self) -> int:
        """Return when the next tick is due or, if a thread ticks, when to look for its result."""
        return self._now_ns + POLL_NS if self._ticker.is_threaded else self._ticker.next_due_ns

    def _move(self, steering_rad: float) -> None:
        pose = self._snapshot.pose
        motion = self._motion
        motion.x_m, motion.y_m, motion.heading_rad = pose
        motion.speed_mps, motion.steering_rad = self._snapshot.speed_mps, steering_rad
