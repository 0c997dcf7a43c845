"""Find content of an OpenDRIVE map that LAVT ignores, so that users are told."""

from __future__ import annotations

from xml.etree.ElementTree import Element

_HEIGHTS = (
    ("elevationProfile/elevation", "elevation is ignored ({} of {} roads have it): all roads are read as flat"),
    ("lateralProfile/superelevation", "superelevation is ignored ({} of {} roads have it): all roads are level"),
    ("lateralProfile/crossfall", "crossfall is ignored ({} of {} roads have it): all roads are level"),
    ("lateralProfile/shape", "the lateral shape is ignored ({} of {} roads have it): all roads are level"),
)
_FEATURES = (
    ("objects/object", "objects are ignored: {}"),
    ("objects/bridge", "bridges are ignored: {}"),
    ("objects/tunnel", "tunnels are ignored: {}"),
    ("signals/signal", "signals are ignored: {}"),
    ("railroad/*", "elements of railways are ignored: {}"),
)


def ignored_content(root: Element) -> tuple[str, ...]:
    """Return a sentence about each kind of ignored content that the map has."""
    roads = root.findall("road")
    sentences = []
    for path, sentence in _HEIGHTS:
        count = sum(any(map(_is_not_zero, road.iterfind(path))) for road in roads)
        if count:
            sentences.append(sentence.format(count, len(roads)))
    for path, sentence in _FEATURES:
        count = sum(len(road.findall(path)) for road in roads)
        if count:
            sentences.append(sentence.format(count))
    virtual = sum(junction.get("type") == "virtual" for junction in root.iterfind("junction"))
    if virtual:
        sentences.append(f"virtual junctions are ignored: {virtual}")
    return tuple(sentences)


def _is_not_zero(element: Element) -> bool:
    return any(element.get(key, "0").strip("+-0.eE ") for key in "abcd")
