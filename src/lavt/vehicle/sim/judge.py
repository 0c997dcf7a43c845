"""Where a car is on its road, and what happens to it there: lanes left, rails hit, road left, route done, time over."""

from __future__ import annotations

import math
from bisect import bisect_left
from dataclasses import dataclass

from lavt.domain import NS_PER_S, EventKind, VehicleEvent
from lavt.vehicle.sim.dynamics import CarMotion, CarParameters
from lavt.vehicle.sim.road import Road

REFERENCE_SPEED_MPS = 30.0 / 3.6
TIMEOUT_SLOWNESS = 3.0
TIMEOUT_ALLOWANCE_S = 30.0
"""A drive may take as long as the route takes at a third of 30 km/h, and this much more."""

MOVING_MPS = 0.1
"""The time of a drive counts from when the car is first faster than this."""


Points = tuple[tuple[float, float], ...]


@dataclass(frozen=True, slots=True)
class Track:
    """A car against the centre of its lane; see `GroundTruth` for what is measured where."""

    cross_track_m: float
    heading_error_rad: float
    progress_m: float


class Judge:
    """Judges one drive; each ending happens once, lanes are left as often as they are."""

    def __init__(self, road: Road, parameters: CarParameters, near_s_m: float) -> None:
        self._road = road
        half_m = parameters.body_width_m / 2
        front_m, rear_m = parameters.rear_axle_to_front_m, -parameters.rear_axle_to_rear_m
        self._left_corners = ((front_m, half_m), (rear_m, half_m))
        self._right_corners = ((front_m, -half_m), (rear_m, -half_m))
        self._middle = (((front_m + rear_m) / 2, 0.0),)
        self._paved_left_m, self._paved_right_m = _carriageway(road)
        limit_s = road.length_m / (REFERENCE_SPEED_MPS / TIMEOUT_SLOWNESS) + TIMEOUT_ALLOWANCE_S
        self._limit_ns = round(limit_s * NS_PER_S)
        self._began_ns: int | None = None
        self._lanes: tuple[int, int] | None = None
        self._happened: set[EventKind] = set()
        self._near_s_m = near_s_m

    def track(self, motion: CarMotion) -> Track:
        """Measure the rear axle against the centre of the lane."""
        s_m, lateral_m, heading_rad = self._road.project(motion.x_m, motion.y_m, self._near_s_m)
        return Track(lateral_m, math.remainder(motion.heading_rad - heading_rad, 2 * math.pi), s_m)

    def judge(self, motion: CarMotion, at_ns: int) -> list[VehicleEvent]:
        """Tell what has happened since the last call; call it at every step."""
        progress_m, _, _ = self._road.project(motion.x_m, motion.y_m, self._near_s_m)
        self._near_s_m = progress_m
        left = self._places(motion, self._left_corners)
        right = self._places(motion, self._right_corners)
        events = self._lane_events(max(lateral for _, lateral in left), min(lateral for _, lateral in right), at_ns)
        hit = self._rail_hit(left + right)
        if hit is not None:
            events += self._once("collision", f"the {hit} was reached at {progress_m:.1f} m", at_ns)
        if hit is None and not self._on_asphalt(*self._places(motion, self._middle)[0]):
            events += self._once("off_road", f"the asphalt was left at {progress_m:.1f} m", at_ns)
        if progress_m >= self._road.length_m:
            events += self._once("completed", f"{self._road.length_m:.1f} m were driven", at_ns)
        if self._began_ns is None and motion.speed_mps > MOVING_MPS:
            self._began_ns = at_ns
        if self._began_ns is not None and at_ns - self._began_ns > self._limit_ns:
            events += self._once("timeout", f"{self._limit_ns / NS_PER_S:.0f} s were not enough", at_ns)
        return events

    def _once(self, kind: EventKind, detail: str, at_ns: int) -> list[VehicleEvent]:
        if kind in self._happened:
            return []
        self._happened.add(kind)
        return [VehicleEvent(at_ns, kind, detail)]

    def _places(self, motion: CarMotion, points: Points) -> Points:
        """Stations and lateral offsets of points of the body, given ahead and to the left of the rear axle."""
        cosine, sine = math.cos(motion.heading_rad), math.sin(motion.heading_rad)
        project, near_s_m = self._road.project, self._near_s_m
        return tuple(
            project(motion.x_m + ahead * cosine - left * sine, motion.y_m + ahead * sine + left * cosine, near_s_m)[:2]
            for ahead, left in points
        )

    def _lane_events(self, left_m: float, right_m: float, at_ns: int) -> list[VehicleEvent]:
        """Make an event for each edge of the body that is in another lane than before; lanes count from the right."""
        edges_m = self._road.lanes.edges_m
        lanes = (bisect_left(edges_m, left_m), bisect_left(edges_m, right_m))
        before, self._lanes = self._lanes, lanes
        if before is None:
            return []
        return [
            VehicleEvent(at_ns, "lane_invasion", f"{edge} edge from lane {old} to {new} from the right")
            for edge, old, new in zip(("left", "right"), before, lanes, strict=True)
            if old != new
        ]

    def _rail_hit(self, corners: Points) -> str | None:
        for rail in self._road.rails:
            side = math.copysign(1.0, rail.offset_m)
            for s_m, lateral_m in corners:
                if rail.from_m <= s_m <= rail.to_m and side * (lateral_m - rail.offset_m) >= 0:
                    return rail.kind
        return None

    def _on_asphalt(self, s_m: float, lateral_m: float) -> bool:
        """Whether the place is on the driven carriageway, or a rail stands between it and the rest."""
        if self._paved_right_m <= lateral_m <= self._paved_left_m:
            return True
        return any(rail.offset_m * lateral_m > 0 and rail.from_m <= s_m <= rail.to_m for rail in self._road.rails)


def _carriageway(road: Road) -> tuple[float, float]:
    """Find the left and right limit of the strip of asphalt in which the driven lane lies."""
    for strip in road.paved:
        if strip.right_m < 0.0 < strip.left_m:
            return strip.left_m, strip.right_m
    raise ValueError(f"the driven lane of {road.title!r} lies on no asphalt")
