"""Draw one sheet of the simulator's pictures: two places on each of the routes a, b and c, in every light.

python benchmarks/contact_sheet.py [--out docs/pictures/frames.jpg]
"""

from __future__ import annotations

import argparse
from pathlib import Path

import cv2
import numpy as np

from lavt.domain import CameraModel, Picture, Pose
from lavt.vehicle.sim.rendering.light import LIGHTS, LightName
from lavt.vehicle.sim.rendering.renderer import Renderer
from lavt.vehicle.sim.road.road import Road, load_road

MODEL = CameraModel()
PLACES = (("a", 30.0), ("a", 205.0), ("b", 175.0), ("b", 470.0), ("c", 60.0), ("c", 230.0))
"""Routes, and stations (m) on them."""

FRAME_PX = (480, 360)
"""Width and height of a picture on the sheet."""
LABEL_HEIGHT_PX = 22
JPEG_QUALITY = 80


def render_frame(road: Road, s_m: float, light: LightName) -> Picture:
    """Render the view of a car in the middle of its lane."""
    x_m, y_m, heading_rad, _ = (float(value) for value in road.centre_at(s_m))
    renderer = Renderer(road, MODEL, seed=1, scenery="full", light=light)
    return renderer.render(Pose(0, x_m, y_m, heading_rad), round(s_m))


def reduce_and_label(picture: Picture, text: str) -> Picture:
    """Return a picture in the size for the sheet, with a label in its upper left corner."""
    reduced = np.asarray(cv2.resize(picture, FRAME_PX, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    reduced[:LABEL_HEIGHT_PX] = reduced[:LABEL_HEIGHT_PX] // 3
    origin = (6, LABEL_HEIGHT_PX - 6)
    cv2.putText(reduced, text, origin, cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255, 255, 255), 1, cv2.LINE_AA)
    return reduced


def main() -> None:
    """Write the sheet and print the size of the file."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--out", type=Path, default=Path("docs/pictures/frames.jpg"))
    out: Path = parser.parse_args().out
    strips = []
    for route, s_m in PLACES:
        road = load_road(route)
        pictures = [
            reduce_and_label(render_frame(road, s_m, light), f"{road.title}, {s_m:.0f} m, {light}") for light in LIGHTS
        ]
        strips.append(np.hstack(pictures))
    out.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(out), np.vstack(strips), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    print(f"{out}: {out.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
