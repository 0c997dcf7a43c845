"""Measure the cost of rendering: CPU time of each frame of whole drives, in the lane or swerving, and memory.

A swerving car moves up to 6 m to both sides of its lane's centre and turns by up to 0.6 rad. All cases run in one
process. So the memory of a case is the largest that this process has used until then.

    python benchmarks/render_times.py [--route b] [--drives 3]
"""

from __future__ import annotations

import argparse
import resource
import time  # noqa: TID251 (CPU time is what is measured)
from statistics import median

import numpy as np

from lavt.domain import CameraModel, FloatArray, Pose
from lavt.vehicle.sim.rendering import renderer
from lavt.vehicle.sim.rendering.light import LightName
from lavt.vehicle.sim.rendering.renderer import Renderer, SceneryKind
from lavt.vehicle.sim.road.road import Road, load_road

METRES_PER_FRAME = 8.33 / 30
SWERVE_M, SWERVE_RAD, SWERVE_PERIOD_M = 6.0, 0.6, 56.0
VGA, HD = CameraModel(), CameraModel(1280, 720)
CASES: tuple[tuple[CameraModel, SceneryKind, LightName, bool], ...] = (
    (VGA, "full", "noon", False),
    (VGA, "full", "low_sun", False),
    (VGA, "full", "overcast", False),
    (VGA, "light", "noon", False),
    (VGA, "none", "noon", False),
    (VGA, "full", "low_sun", True),
    (HD, "full", "noon", False),
    (HD, "full", "low_sun", True),
)
"""Camera, scenery, light, and whether the car swerves."""


def measure_drive(road: Road, scene_renderer: Renderer, *, swerving: bool) -> FloatArray:
    """Return the CPU time of every frame of a drive at 30 km/h and 30 Hz, in milliseconds."""
    times_ms = []
    for number, s_m in enumerate(np.arange(0.0, road.route_length_m, METRES_PER_FRAME)):
        phase = 2 * np.pi * s_m / SWERVE_PERIOD_M if swerving else 0.0
        x_m, y_m = road.point_at(s_m, SWERVE_M * np.sin(phase)).tolist()
        turned_rad = SWERVE_RAD * float(np.cos(phase)) if swerving else 0.0
        pose = Pose(0, x_m, y_m, float(road.centre_at(s_m).heading_rad) + turned_rad)
        begin_s = time.process_time()
        scene_renderer.render(pose, number)
        times_ms.append((time.process_time() - begin_s) * 1000)
    return np.array(times_ms)


def main() -> None:
    """Print a table. Each value is a median over the drives, so that a disturbance of one drive has no effect."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--route", default="b")
    parser.add_argument("--drives", type=int, default=3)
    options = parser.parse_args()
    road = load_road(options.route)
    print("picture    scenery  light     drive     prepare s  median ms  p99 ms  longest ms  peak memory so far MB")
    for model, scenery, light, swerving in CASES:
        measurements = []
        for _ in range(options.drives):
            renderer.world.cache_clear()
            begin_s = time.process_time()
            scene_renderer = Renderer(road, model, seed=1, scenery=scenery, light=light)
            scene_renderer.prepare()
            prepare_s = time.process_time() - begin_s
            times_ms = measure_drive(road, scene_renderer, swerving=swerving)
            measurements.append(
                (prepare_s, float(np.median(times_ms)), float(np.percentile(times_ms, 99)), float(times_ms.max()))
            )
        prepare_s, median_ms, p99_ms, longest_ms = (median(column) for column in zip(*measurements, strict=True))
        peak_memory_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1000
        size, driving = f"{model.width_px}x{model.height_px}", "swerving" if swerving else "in lane"
        print(
            f"{size:9}  {scenery:7}  {light:8}  {driving:8}  {prepare_s:9.2f}  {median_ms:9.2f}  {p99_ms:6.1f}"
            f"  {longest_ms:10.1f}  {peak_memory_mb:21.0f}"
        )


if __name__ == "__main__":
    main()
