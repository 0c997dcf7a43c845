"""The layout for Foxglove (docs/foxglove.json) shows topics and fields that records have."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, get_origin, get_type_hints

from lavt.domain import GroundTruth, State
from lavt.nodes.payloads import Admission, Event, LaneSeen

LAYOUT = json.loads((Path(__file__).parents[2] / "docs/foxglove.json").read_text())
TYPES: dict[str, Any] = {"truth": GroundTruth, "admission": Admission, "lane": LaneSeen, "state": State, "event": Event}
"""The types of the messages that the layout shows, by topic."""


def panels(tree: Any) -> list[str]:
    """Return the panels of a part of the layout."""
    return [tree] if isinstance(tree, str) else [*panels(tree["first"]), *panels(tree["second"])]


def message_paths(settings: Any) -> Iterator[str]:
    """Yield all message paths in the settings of panels."""
    if isinstance(settings, dict):
        for key, value in settings.items():
            if key in ("value", "topicPath"):
                yield value
            else:
                yield from message_paths(value)
    elif isinstance(settings, list):
        for value in settings:
            yield from message_paths(value)


def test_all_panels_have_settings() -> None:
    """The layout places exactly the panels that have settings, each once."""
    assert sorted(panels(LAYOUT["layout"])) == sorted(LAYOUT["configById"])


def test_all_paths_are_recorded() -> None:
    """Each message path is a topic of the records and a number or text in its messages."""
    paths = list(message_paths(LAYOUT["configById"]))
    assert len(paths) == 9
    for path in paths:
        topic, *fields = path.removeprefix("/").split(".")
        shown = TYPES[topic]
        for field in fields:
            shown = get_type_hints(shown)[field]
        assert not fields or shown in (float, int, str) or get_origin(shown) is Literal, path


def test_the_picture_is_the_video() -> None:
    """The picture shows the channel with compressed video."""
    assert LAYOUT["configById"]["Image!video"]["imageMode"]["imageTopic"] == "/video"
