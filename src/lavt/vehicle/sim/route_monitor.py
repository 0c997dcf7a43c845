"""The route monitor, which tracks a car on its road and reports the events of a drive.

The events are lane invasions, collisions, leaving the road, completion of the route, and exceeding the time limit.
"""

from __future__ import annotations

import itertools
import math
from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence

from msgspec import Struct

from lavt.domain import NS_PER_S, EventKind, VehicleEvent
from lavt.vehicle.sim.dynamics import CarMotion, CarParameters, Contact
from lavt.vehicle.sim.road.cross_section import Rail
from lavt.vehicle.sim.road.road import PROJECTION_WINDOW_M, Road

REFERENCE_SPEED_MPS = 30.0 / 3.6
TIMEOUT_SLOWNESS = 3.0
TIMEOUT_ALLOWANCE_S = 30.0
"""The default time limit is the time that the route takes at a third of 30 km/h, plus this allowance."""

MOVING_MPS = 0.1
"""A drive's time counts from the moment the car first exceeds this speed."""

CONTACT_GAP_NS = NS_PER_S // 2
"""A contact more than this time after the last contact is another collision."""

MAX_UNCHECKED_M = PROJECTION_WINDOW_M / 3
"""The longest movement of the body without a check. After a longer one, a projection could fail, because it searches
only around the last known station."""

RoadPosition = tuple[float, float, float]
"""Station (m) and lateral offset (m) of a point of the body, and the road's heading (rad) there."""


class TrackingError(Struct, frozen=True):
    """A car's pose relative to its lane's centre; `GroundTruth` defines where each value is measured."""

    cross_track_m: float
    heading_error_rad: float
    progress_m: float


def time_limit_s(route_length_m: float) -> float:
    """Return the default time limit for a route of this length."""
    return route_length_m / (REFERENCE_SPEED_MPS / TIMEOUT_SLOWNESS) + TIMEOUT_ALLOWANCE_S


class RouteMonitor:
    """A monitor of one drive, which begins near the station `near_station_m`.

    Each of the events `timeout`, `off_road` and `completed` is reported once, each lane invasion and collision anew.
    """

    def __init__(
        self, road: Road, parameters: CarParameters, near_station_m: float, *, limit_s: float | None = None
    ) -> None:
        self._road = road
        half_width_m = parameters.body_width_m / 2
        front_m, rear_m = parameters.rear_axle_to_front_m, -parameters.rear_axle_to_rear_m
        self._corners = tuple(itertools.product((front_m, rear_m), (half_width_m, -half_width_m)))
        self._middle = ((front_m + rear_m) / 2, 0.0)
        self._limit_ns = round((time_limit_s(road.route_length_m) if limit_s is None else limit_s) * NS_PER_S)
        self._began_ns: int | None = None
        self._lanes: tuple[int, int] | None = None
        """The lanes of the body's left and right edge at the last check."""
        self._reported: set[EventKind] = set()
        self._near_station_m = near_station_m
        self._last_contact_ns: int | None = None
        self._signed_rails = tuple((rail, math.copysign(1.0, rail.offset_m)) for rail in road.rails)
        """Each rail with its side of the driven lane: 1 is left, -1 is right."""
        self._event_margin = _EventMargin(road, body_reach_m=max(math.hypot(*corner) for corner in self._corners))
        self.contacts: tuple[Contact, ...] = ()
        """The body's contacts with rails at the last update."""

    def track(self, motion: CarMotion) -> TrackingError:
        """Return the rear axle's position and heading relative to the lane's centre."""
        s_m, lateral_m, heading_rad = self._road.project(motion.x_m, motion.y_m, self._near_station_m)
        return TrackingError(lateral_m, math.remainder(motion.heading_rad - heading_rad, 2 * math.pi), s_m)

    def update(self, motion: CarMotion, at_ns: int) -> list[VehicleEvent]:
        """Return the events since the last call; this method must be called at every step."""
        # As long as the body touches a rail, check every step: the contact can become deeper or end.
        can_skip = not self.contacts and self._event_margin.covers(motion)
        events = [] if can_skip else self._check_body(motion, at_ns)
        if self._began_ns is None:
            if motion.speed_mps > MOVING_MPS:
                self._began_ns = at_ns
        elif at_ns - self._began_ns > self._limit_ns:
            events += self._report_once("timeout", f"{self._limit_ns / NS_PER_S:.0f} s were not enough", at_ns)
        return events

    def _check_body(self, motion: CarMotion, at_ns: int) -> list[VehicleEvent]:
        """Project the whole body onto the road and return the events that follow."""
        progress_m, lateral_m, heading_rad = self._road.project(motion.x_m, motion.y_m, self._near_station_m)
        self._near_station_m = progress_m
        *corners, middle = self._project_points(motion, (*self._corners, self._middle))
        events = self._lane_events(corners, at_ns)
        self.contacts, touched_rail = self._find_contacts(corners)
        if touched_rail is not None:
            if self._last_contact_ns is None or at_ns - self._last_contact_ns > CONTACT_GAP_NS:
                events.append(
                    VehicleEvent(at_ns, "collision", f"the {touched_rail.kind} was reached at {progress_m:.1f} m")
                )
            self._last_contact_ns = at_ns
        elif not self._on_asphalt(middle):
            events += self._report_once("off_road", f"the asphalt was left at {progress_m:.1f} m", at_ns)
        if progress_m >= self._road.route_length_m:
            events += self._report_once("completed", f"{self._road.route_length_m:.1f} m were driven", at_ns)
        self._event_margin.restart(motion, ((progress_m, lateral_m, heading_rad), *corners, middle))
        return events

    def _report_once(self, kind: EventKind, detail: str, at_ns: int) -> list[VehicleEvent]:
        if kind in self._reported:
            return []
        self._reported.add(kind)
        return [VehicleEvent(at_ns, kind, detail)]

    def _project_points(self, motion: CarMotion, points: Iterable[tuple[float, float]]) -> list[RoadPosition]:
        """Return the road positions of points of the body, given as metres ahead and to the left of the rear axle."""
        cosine, sine = math.cos(motion.heading_rad), math.sin(motion.heading_rad)
        project, near_m = self._road.project, self._near_station_m
        return [
            project(motion.x_m + ahead * cosine - left * sine, motion.y_m + ahead * sine + left * cosine, near_m)
            for ahead, left in points
        ]

    def _lane_events(self, corners: Sequence[RoadPosition], at_ns: int) -> list[VehicleEvent]:
        """Return an event for each edge of the body that has changed lanes; the rightmost lane has number 1.

        An edge that is exactly on a line has not crossed the line.
        """
        edges_at = self._road.lanes.edges_at
        lanes = (
            max([bisect_left(edges_at(s_m), offset_m) for s_m, offset_m, _ in corners]),
            min([bisect_right(edges_at(s_m), offset_m) for s_m, offset_m, _ in corners]),
        )
        previous_lanes, self._lanes = self._lanes, lanes
        if previous_lanes is None:
            return []
        return [
            VehicleEvent(at_ns, "lane_invasion", f"{edge} edge from lane {old} to {new} from the right")
            for edge, old, new in zip(("left", "right"), previous_lanes, lanes, strict=True)
            if old != new
        ]

    def _find_contacts(self, corners: Sequence[RoadPosition]) -> tuple[tuple[Contact, ...], Rail | None]:
        """Return the contacts of corners with rails, and the first touched rail (None without a contact)."""
        contacts, touched_rail = [], None
        offsets_m = [lateral_m for _, lateral_m, _ in corners]
        leftmost_m, rightmost_m = max(offsets_m), min(offsets_m)
        for rail, sign in self._signed_rails:
            if (leftmost_m < rail.offset_m) if sign > 0.0 else (rightmost_m > rail.offset_m):
                continue  # the common case: no corner has reached the rail
            depths_m = [sign * (offset_m - rail.offset_m) for offset_m in offsets_m]
            if min(depths_m) >= 0.0:
                continue  # the body is entirely behind the rail and does not touch it
            for (ahead_m, left_m), (s_m, _, heading_rad), depth_m in zip(self._corners, corners, depths_m, strict=True):
                if depth_m >= 0.0 and rail.from_m <= s_m <= rail.to_m:
                    # The car is moved out by the shortest way: across the road, or along it from an end of the rail.
                    depths_and_directions = (
                        (depth_m, heading_rad - sign * math.pi / 2),
                        (s_m - rail.from_m, heading_rad + math.pi),
                        (rail.to_m - s_m, heading_rad),
                    )
                    contacts.append(Contact(ahead_m, left_m, *min(depths_and_directions)))
                    touched_rail = touched_rail or rail
        return tuple(contacts), touched_rail

    def _on_asphalt(self, position: RoadPosition) -> bool:
        s_m, lateral_m, _ = position
        return any(strip.contains(s_m, lateral_m) for strip in self._road.paved)


class _EventMargin:
    """The distance by which the body can move before it can reach a boundary, and so before an event is possible.

    Boundaries are the edges of lanes and asphalt, the rails, the stations where asphalt and rails begin and end, and
    the end of the route. As long as the body is between the rails, it cannot reach the ends of rails.

    When a point of the body moves by d, its station changes by at most d / `_station_scale`, because on the inside of a
    curve a metre covers more than a metre of stations. The point's lateral offset changes by at most the sum of two
    distances: the point's movement across the direction that the road had at the last check, and the distance by which
    the road bends away from that direction along the movement. If a boundary's offset changes along the road, the
    distance to it changes, in addition, by at most its largest slope times the change of the station.
    """

    def __init__(self, road: Road, body_reach_m: float) -> None:
        self._body_reach_m = body_reach_m
        lanes, tapered = road.lanes, tuple(strip for strip in road.paved if strip.is_tapered)
        self._changing_lanes = lanes if lanes.changes else None
        self._tapered = tapered
        offsets_m = {edge_m for strip in road.paved if not strip.is_tapered for edge_m in (strip.left_m, strip.right_m)}
        if self._changing_lanes is None:
            offsets_m.update(lanes.edges_at(0.0))
        self._offsets_m = sorted({*offsets_m, *(rail.offset_m for rail in road.rails)})
        """The boundaries whose offset does not change."""
        asphalt_ends_m = [end_m for strip in road.paved for end_m in (strip.from_m, strip.to_m)]
        rail_ends_m = [end_m for rail in road.rails for end_m in (rail.from_m, rail.to_m)]
        self._stations_m = sorted({road.route_length_m, *filter(math.isfinite, asphalt_ends_m)})
        self._stations_and_rail_ends_m = sorted({*self._stations_m, *filter(math.isfinite, rail_ends_m)})
        self._between_rails_m = (
            max((rail.offset_m for rail in road.rails if rail.offset_m < 0.0), default=-math.inf),
            min((rail.offset_m for rail in road.rails if rail.offset_m >= 0.0), default=math.inf),
        )
        tapered_ends_m = [offset_m for strip in tapered for offset_m in (*strip.lefts_m, *strip.rights_m)]
        lane_ends_m = [edge_m for s_m in lanes.knots_m for edge_m in lanes.edges_at(s_m)]
        reached_m = [*self._offsets_m, *tapered_ends_m, *lane_ends_m]
        max_offset_m = max(map(abs, reached_m)) + body_reach_m
        max_curvature_per_m = max(
            max(abs(segment.curvature_per_m), abs(segment.end_curvature_per_m)) for segment in road.segments
        )
        self._station_scale = 1.0 - max_curvature_per_m * max_offset_m
        self._bend_per_m = max_curvature_per_m / self._station_scale if self._station_scale > 0.0 else math.inf
        slope = max([lanes.max_slope, *(strip.max_slope for strip in tapered)])
        self._shift_per_m = slope / self._station_scale if self._station_scale > 0.0 else math.inf
        """By how much the offset of a boundary changes at most while the body moves by a metre."""
        self._reference_pose = (math.inf, math.inf, 0.0)
        self._across_direction = (0.0, 1.0)
        self._heading_spread_rad = 0.0
        self._across_margin_m = self._along_margin_m = 0.0

    def restart(self, motion: CarMotion, positions: Sequence[RoadPosition]) -> None:
        """Store a checked pose and its distance from the boundaries; the first position is the rear axle's."""
        if self._station_scale <= 0.0:
            return  # no margin can be given on this road: check every step
        self._reference_pose = (motion.x_m, motion.y_m, motion.heading_rad)
        (_, _, road_rad), *_ = positions
        self._across_direction = (-math.sin(road_rad), math.cos(road_rad))
        self._heading_spread_rad = max([abs(heading_rad - road_rad) for _, _, heading_rad in positions])
        offsets_m = self._offsets_m
        self._across_margin_m = min([_distance_m(offsets_m, lateral_m) for _, lateral_m, _ in positions])
        if self._shift_per_m:
            self._across_margin_m = min([self._across_margin_m, *map(self._changing_distance_m, positions)])
        right_m, left_m = self._between_rails_m
        is_between_rails = all(right_m < lateral_m < left_m for _, lateral_m, _ in positions)
        stations_m = self._stations_m if is_between_rails else self._stations_and_rail_ends_m
        along_m = min([_distance_m(stations_m, s_m) for s_m, _, _ in positions])
        self._along_margin_m = min(along_m * self._station_scale, MAX_UNCHECKED_M)

    def covers(self, motion: CarMotion) -> bool:
        """Return True if no point of the body can have reached a boundary since the last check."""
        x_m, y_m, heading_rad = self._reference_pose
        dx_m, dy_m = motion.x_m - x_m, motion.y_m - y_m
        moved_m = math.hypot(dx_m, dy_m)
        turned_m = self._body_reach_m * abs(motion.heading_rad - heading_rad)
        max_moved_m = moved_m + turned_m
        if not max_moved_m < self._along_margin_m:
            return False
        across_m = (
            abs(dx_m * self._across_direction[0] + dy_m * self._across_direction[1])
            + moved_m * self._heading_spread_rad
            + turned_m
        )
        across_m += self._shift_per_m * max_moved_m
        return across_m + self._bend_per_m * max_moved_m * max_moved_m / 2 < self._across_margin_m

    def _changing_distance_m(self, position: RoadPosition) -> float:
        """Return the distance of a point from the nearest boundary whose offset changes along the road."""
        s_m, lateral_m, _ = position
        # The body does not reach an end of a strip between two checks, so only the strips that it is beside count.
        strips = [strip for strip in self._tapered if strip.from_m <= s_m <= strip.to_m]
        offsets_m = [float(edge_m) for strip in strips for edge_m in (strip.left_at(s_m), strip.right_at(s_m))]
        if self._changing_lanes is not None:
            offsets_m += self._changing_lanes.edges_at(s_m)
        return min([abs(lateral_m - offset_m) for offset_m in offsets_m], default=math.inf)


def _distance_m(boundaries_m: Sequence[float], at_m: float) -> float:
    """Return the distance between a coordinate and the nearest of the sorted boundaries."""
    index = bisect_left(boundaries_m, at_m)
    above_m = boundaries_m[index] - at_m if index < len(boundaries_m) else math.inf
    below_m = at_m - boundaries_m[index - 1] if index else math.inf
    return min(below_m, above_m)
