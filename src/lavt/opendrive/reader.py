"""Read OpenDRIVE files (versions 1.1 to 1.8) into an `OpenDriveMap`."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal
from xml.etree.ElementTree import Element

from lavt.errors import UserError
from lavt.opendrive.geometry import Clothoid, Cubic, CubicCurve, PlanElement
from lavt.opendrive.ignored import ignored_content
from lavt.opendrive.road_map import (
    STATION_TOLERANCE_M,
    CubicPieces,
    JunctionConnection,
    LaneMark,
    LaneSection,
    MapLane,
    MapRoad,
    OpenDriveMap,
    RoadLink,
)
from lavt.opendrive.xml_tree import parse_xml, read_file, read_id, read_integer, read_number, read_text

MAX_LENGTH_M = 1_000_000.0
MAX_LANES = 64
"""The largest number of lanes of a lane section: more would take too long to compute."""

MAX_TURN_RAD = 100.0
"""The largest angle by which one element of a plan view may turn: more would take too long to compute."""

MIN_CURVE_M = 1e-9
"""Shorter elements of a plan view are points, and are left out."""

SHAPES = ("line", "arc", "spiral", "poly3", "paramPoly3")


def read_map(path: str) -> OpenDriveMap:
    """Read a map file; raise UserError if it is not an OpenDRIVE map that LAVT can read."""
    return parse_map(read_file(path), path)


def parse_map(content: bytes, source: str) -> OpenDriveMap:
    """Parse the content of a map file; `source` is its name in messages."""
    root = parse_xml(content, source)
    if root.tag != "OpenDRIVE":
        raise UserError(f"{source} is not an OpenDRIVE map (its root is {root.tag[:40]!a}): name a file .xodr")
    roads: dict[str, MapRoad] = {}
    for element in root.iterfind("road"):
        road = _read_road(element, source)
        if road.number in roads:
            raise UserError(f"{source}: two roads have the id {road.number}: rename one of them")
        roads[road.number] = road
    if not roads:
        raise UserError(f"{source} has no roads: name a map with roads")
    junctions: dict[str, tuple[JunctionConnection, ...]] = {}
    for element in root.iterfind("junction"):
        number = read_id(element, "id", source)
        where = f"{source}: junction {number}"
        if number in junctions:
            raise UserError(f"{source}: two junctions have the id {number}: rename one of them")
        connections = [_read_connection(child, where) for child in element.iterfind("connection")]
        junctions[number] = tuple(connection for connection in connections if connection is not None)
    return OpenDriveMap(source, roads, junctions, ignored_content(root))


def _read_road(element: Element, source: str) -> MapRoad:
    number = read_id(element, "id", source)
    where = f"{source}: road {number}"
    length_m = _read_length(element, where)
    plan = [
        _read_plan_element(child, where)
        for child in element.iterfind("planView/geometry")
        if _read_length(child, where) > MIN_CURVE_M
    ]
    if not plan:
        raise UserError(f"{where}: the plan view has no geometry: add it")
    plan.sort(key=lambda item: item.s_m)
    lane_offsets = _read_cubics(element.iterfind("lanes/laneOffset"), "s", where)
    sections = _read_sections(element, length_m, where)
    if not lane_offsets.is_zero and any(lane.borders.cubics for part in sections for lane in part.lanes.values()):
        raise UserError(f"{where}: lanes with borders have a lane offset: OpenDRIVE does not define this; use widths")
    junction = element.get("junction", "-1")
    return MapRoad(
        number=number,
        length_m=length_m,
        junction=None if junction in {"-1", ""} else junction,
        left_hand_traffic=element.get("rule") == "LHT",
        plan=tuple(plan),
        lane_offsets=lane_offsets,
        sections=sections,
        predecessor=_read_road_link(element.find("link/predecessor"), where),
        successor=_read_road_link(element.find("link/successor"), where),
    )


def _read_length(element: Element, where: str) -> float:
    length_m = read_number(element, "length", where)
    if not 0.0 <= length_m <= MAX_LENGTH_M:
        raise UserError(f"{where}: <{element.tag}> has the length {length_m:g} m: use 0 to {MAX_LENGTH_M:.0f} m")
    return length_m


def _read_plan_element(element: Element, where: str) -> PlanElement:
    s_m = read_number(element, "s", where)
    where = f"{where}: geometry at s={s_m:g} m"
    shapes = [child for child in element if child.tag in SHAPES]
    if len(shapes) != 1:
        raise UserError(f"{where}: there must be one shape, a {', '.join(SHAPES[:-1])} or {SHAPES[-1]}")
    curve = _READ_SHAPE[shapes[0].tag](shapes[0], _read_length(element, where), where)
    if isinstance(curve, Clothoid) and curve.max_turn_rad > MAX_TURN_RAD:
        raise UserError(f"{where}: the curve turns by more than {MAX_TURN_RAD:g} rad: reduce its curvature")
    return PlanElement(
        s_m,
        read_number(element, "x", where),
        read_number(element, "y", where),
        read_number(element, "hdg", where),
        curve,
    )


def _read_line(_element: Element, length_m: float, _where: str) -> Clothoid:
    return Clothoid(length_m)


def _read_arc(element: Element, length_m: float, where: str) -> Clothoid:
    curvature_per_m = read_number(element, "curvature", where)
    return Clothoid(length_m, curvature_per_m, curvature_per_m)


def _read_spiral(element: Element, length_m: float, where: str) -> Clothoid:
    return Clothoid(length_m, read_number(element, "curvStart", where), read_number(element, "curvEnd", where))


def _read_poly3(element: Element, length_m: float, where: str) -> CubicCurve:
    return CubicCurve(length_m, Cubic(0.0, 1.0), _read_cubic(element, where), None)


def _read_param_poly3(element: Element, length_m: float, where: str) -> CubicCurve:
    # Without pRange, the parameter is normalized: it was so in OpenDRIVE 1.4, where the attribute was optional.
    p_range = element.get("pRange", "normalized")
    if p_range not in {"normalized", "arcLength"}:
        raise UserError(f"{where}: pRange is {p_range[:40]!a}: use normalized or arcLength")
    ahead, left = (Cubic(*(read_number(element, f"{letter}{axis}", where) for letter in "abcd")) for axis in ("U", "V"))
    if not any((ahead.b, ahead.c, ahead.d, left.b, left.c, left.d)):
        raise UserError(f"{where}: the paramPoly3 is a single point: give it coefficients")
    return CubicCurve(length_m, ahead, left, 1.0 if p_range == "normalized" else length_m)


_READ_SHAPE: dict[str, Callable[[Element, float, str], Clothoid | CubicCurve]] = {
    "line": _read_line,
    "arc": _read_arc,
    "spiral": _read_spiral,
    "poly3": _read_poly3,
    "paramPoly3": _read_param_poly3,
}


def _read_cubic(element: Element, where: str) -> Cubic:
    a, b, c, d = (read_number(element, letter, where) for letter in "abcd")
    return Cubic(a, b, c, d)


def _read_cubics(elements: Iterable[Element], begin_key: str, where: str) -> CubicPieces:
    pieces = [(read_number(element, begin_key, where), _read_cubic(element, where)) for element in elements]
    pieces.sort(key=lambda piece: piece[0])  # stable: of several with the same beginning, the last one counts
    return CubicPieces(tuple(begin for begin, _ in pieces), tuple(cubic for _, cubic in pieces))


def _read_sections(road: Element, length_m: float, where: str) -> tuple[LaneSection, ...]:
    elements = [(read_number(child, "s", where), child) for child in road.iterfind("lanes/laneSection")]
    if not elements:
        raise UserError(f"{where}: there is no lane section: add one")
    elements.sort(key=lambda item: item[0])
    sections = []
    for index, (s_m, element) in enumerate(elements):
        end_m = min(elements[index + 1][0], length_m) if index + 1 < len(elements) else length_m
        if not -STATION_TOLERANCE_M <= s_m <= length_m + STATION_TOLERANCE_M:
            raise UserError(f"{where}: a lane section begins at s={s_m:g} m: the road has 0 to {length_m:g} m")
        lanes = _read_lanes(element, f"{where}: lane section at s={s_m:g} m")
        sections.append(LaneSection(min(max(s_m, 0.0), length_m), end_m, lanes))
    return tuple(sections)


def _read_lanes(section: Element, where: str) -> dict[int, MapLane]:
    lanes: dict[int, MapLane] = {}
    for side, sign in (("left", 1), ("center", 0), ("right", -1)):
        for element in section.iterfind(f"{side}/lane"):
            number = read_integer(element, "id", where)
            if (number > 0) - (number < 0) != sign or number in lanes:
                raise UserError(f"{where}: lane {number} is twice there or on the wrong side (<{side}>): renumber it")
            if len(lanes) == MAX_LANES:
                raise UserError(f"{where}: there are more than {MAX_LANES} lanes: remove some")
            lanes[number] = _read_lane(element, number, f"{where}: lane {number}")
    for number in lanes:
        inner = number - (number > 0) + (number < 0)
        if inner not in lanes and inner != 0:
            raise UserError(f"{where}: there is a lane {number}, but no lane {inner}: number lanes without gaps")
    return lanes


def _read_lane(element: Element, number: int, where: str) -> MapLane:
    widths = _read_cubics(element.iterfind("width"), "sOffset", where)
    borders = CubicPieces() if widths.cubics else _read_cubics(element.iterfind("border"), "sOffset", where)
    marks = [
        LaneMark(
            read_number(mark, "sOffset", where, 0.0),
            mark.get("type", "none"),
            mark.get("color", "standard"),
            read_number(mark, "width", where) if mark.get("width") else None,
        )
        for mark in element.iterfind("roadMark")
    ]
    marks.sort(key=lambda mark: mark.offset_m)
    predecessor, successor = element.find("link/predecessor"), element.find("link/successor")
    return MapLane(
        number=number,
        kind=element.get("type", "none"),
        widths=widths,
        borders=borders,
        marks=tuple(marks),
        predecessor=None if predecessor is None else read_integer(predecessor, "id", where),
        successor=None if successor is None else read_integer(successor, "id", where),
    )


def _read_road_link(element: Element | None, where: str) -> RoadLink | None:
    if element is None:
        return None
    kind, target = read_text(element, "elementType", where), read_text(element, "elementId", where)
    if kind == "junction":
        return RoadLink("junction", target, None)
    if kind == "road":
        if "elementS" in element.attrib:
            return None  # into the middle of a road, at a virtual junction
        return RoadLink("road", target, _read_contact(element, where))
    raise UserError(f"{where}: a link has elementType={kind[:40]!a}: use road or junction")


def _read_connection(element: Element, where: str) -> JunctionConnection | None:
    connecting = element.get("connectingRoad", element.get("linkedRoad"))  # a direct junction links roads themselves
    if connecting is None or element.get("incomingRoad") is None:
        return None  # a virtual connection, which has no roads of its own
    lane_links = tuple(
        (read_integer(link, "from", where), read_integer(link, "to", where)) for link in element.iterfind("laneLink")
    )
    return JunctionConnection(
        read_text(element, "incomingRoad", where), connecting, _read_contact(element, where), lane_links
    )


def _read_contact(element: Element, where: str) -> Literal["start", "end"]:
    contact = read_text(element, "contactPoint", where)
    if contact == "start":
        return "start"
    if contact == "end":
        return "end"
    raise UserError(f"{where}: contactPoint is {contact[:40]!a}: use start or end")
