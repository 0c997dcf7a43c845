"""Random roads: a population from which any number of roads can be drawn, each by its number."""

from __future__ import annotations

import math
import re

import numpy as np
import yaml

from lavt.streams import stream

_NAME = re.compile(r"random_([1-9][0-9]{0,5})")

BENDS = (1, 3)
"""The fewest and the most bends; each number is equally likely."""
STRAIGHT_M = (20.0, 80.0)
"""The length of the straight before the first bend and after each bend, uniform."""
RADIUS_M = (40.0, 200.0)
"""The radius of a bend; its logarithm is uniform. The routes `a`, `b` and `c` have 42 to 192 m."""
TURN_RAD = (math.radians(30), math.radians(90))
"""The angle by which a bend turns, uniform."""
TRANSITION_M = (0.0, 40.0)
"""The length of the clothoids before and after the arc of a bend, uniform."""
LARGEST_TRANSITION_SHARE = 0.8
"""The clothoids of a bend are shortened to turn by at most this share of its angle; the arc turns by the rest."""
LARGEST_HEADING_RAD = math.radians(90)
"""The road never heads farther from its first direction, so it always leads onwards and does not cross itself."""


def random_road_number(name: str) -> int | None:
    """Return the number of a random road; None if `name` is not the name of one."""
    match = _NAME.fullmatch(name)
    return int(match[1]) if match else None


def random_road_text(number: int) -> str:
    """Return a random road as the text of a road file; the same number always gives the same road.

    The cross-section is that of the routes `a`, `b` and `c`, without the other carriageway.
    """
    random = stream(number, "random road")
    segments = [_straight(random)]
    heading_rad = 0.0
    for _ in range(int(random.integers(BENDS[0], BENDS[1], endpoint=True))):
        radius_m = math.exp(random.uniform(math.log(RADIUS_M[0]), math.log(RADIUS_M[1])))
        turn_rad, transition_m = random.uniform(*TURN_RAD), random.uniform(*TRANSITION_M)
        sign = 1.0 if random.random() < 0.5 else -1.0
        if abs(heading_rad + sign * turn_rad) > LARGEST_HEADING_RAD:
            sign = -sign
        heading_rad += sign * turn_rad
        segments += _bend(sign / radius_m, turn_rad, transition_m)
        segments.append(_straight(random))
    road = {
        "title": f"Random {number}",
        "segments": segments,
        "lanes": {"widths_m": [3.5, 3.5, 3.5, 3.5], "driven": 2},
        "shoulders": {"left_m": 3.5, "right_m": 3.5},
        "rails": [{"offset_m": 12.25, "kind": "barrier"}, {"offset_m": -9.15}],
    }
    return yaml.safe_dump(road, sort_keys=False)


def _straight(random: np.random.Generator) -> dict[str, float]:
    return {"length_m": round(random.uniform(*STRAIGHT_M), 4)}


def _bend(curvature_per_m: float, turn_rad: float, transition_m: float) -> list[dict[str, float]]:
    """Return a clothoid, an arc and a clothoid that together turn by `turn_rad`."""
    curvature = round(curvature_per_m, 10)
    length_m = turn_rad / abs(curvature)  # of the arc alone, without clothoids: two clothoids turn as much as one arc
    clothoid_m = round(min(transition_m, LARGEST_TRANSITION_SHARE * length_m), 4)
    arc = {"length_m": round(length_m - clothoid_m, 4), "curvature_per_m": curvature}
    if clothoid_m == 0.0:
        return [arc]
    return [
        {"length_m": clothoid_m, "curvature_per_m": 0.0, "end_curvature_per_m": curvature},
        arc,
        {"length_m": clothoid_m, "curvature_per_m": curvature, "end_curvature_per_m": 0.0},
    ]
