"""Draw one sheet of the simulator's pictures in every weather, and print how confident perception is in each.

    python -m benchmarks.weather_sheet [--picture docs/pictures/weather.jpg] [--route a_key] [--seeds 1]
    python -m benchmarks.weather_sheet --sweep out/weather

The confidence is that of a detector that tracks the lane from picture to picture, while the car drives in the middle of
its lane at 30 km/h. There is no codec and no control. With `--sweep` the program prints the results of a sweep of
`configs/weather.yaml` instead. `docs/camera.md` has the output.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
from benchmarks.contact_sheet import JPEG_QUALITY, reduce_and_label

from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import NS_PER_S, CameraModel, FloatArray, Picture, Pose
from lavt.experiment.analysis.metrics import driving_interval
from lavt.perception.lane_detector import LaneDetector
from lavt.recording.record import read_record
from lavt.vehicle.sim.rendering.renderer import Renderer
from lavt.vehicle.sim.rendering.weather import WEATHERS, WeatherName
from lavt.vehicle.sim.road.road import Road, load_road

MODEL = CameraModel()
AHEAD_M = 10.0
"""The distance ahead of the rear axle at which the detected lane is compared with the road."""
SPEED_MPS, RATE_HZ = 30 / 3.6, 30.0
PLACES_M = (8.0, 60.0)
"""The stations of the sheet's pictures: before the bend of `a_key`, and in it."""
PICTURED_NS = 700_000_000
"""The time of the sheet's pictures, on which the drops on the windscreen depend."""


def pose_on(road: Road, s_m: float, mono_ns: int) -> Pose:
    """Return the pose of a car in the middle of its lane."""
    x_m, y_m, heading_rad, _ = (float(value) for value in road.centre_at(s_m))
    return Pose(mono_ns, x_m, y_m, heading_rad)


def drive(road: Road, weather: WeatherName, seed: int, last_m: float) -> Iterator[tuple[Pose, Picture]]:
    """Yield the poses and pictures of a car that drives in the middle of its lane up to a station."""
    renderer = Renderer(road, MODEL, seed=seed, scenery="full", light="overcast", weather=weather)
    for number, s_m in enumerate(np.arange(0.0, last_m, SPEED_MPS / RATE_HZ).tolist()):
        pose = pose_on(road, s_m, round(number * NS_PER_S / RATE_HZ))
        yield pose, renderer.render(pose, number)


def centre_error_m(road: Road, pose: Pose, s_m: float, centre: FloatArray) -> float:
    """Return the distance of a detected lane's centre from the road's, at `AHEAD_M`."""
    stations_m = s_m + np.linspace(0.0, 2 * AHEAD_M, 201)
    points_m = road.point_at(stations_m, 0.0) - np.array([pose.x_m, pose.y_m])
    cosine, sine = np.cos(pose.heading_rad), np.sin(pose.heading_rad)
    ahead_m, left_m = points_m @ np.array([cosine, sine]), points_m @ np.array([-sine, cosine])
    true_m = float(np.interp(AHEAD_M, ahead_m, left_m))
    return abs(float(np.polyval(centre[::-1], AHEAD_M)) - true_m)


def table_row(road: Road, weather: WeatherName, seeds: int, last_m: float) -> str:
    """Return the Markdown row of one weather."""
    confidences, errors_m = [], []
    for seed in range(1, seeds + 1):
        detector = LaneDetector(MODEL)
        for number, (pose, picture) in enumerate(drive(road, weather, seed, last_m)):
            lane = detector.detect(picture)
            confidences.append(lane.confidence)
            if lane.confidence >= LANE_CONFIDENCE:
                errors_m.append(centre_error_m(road, pose, number * SPEED_MPS / RATE_HZ, np.asarray(lane.centre)))
    accepted = 100 * len(errors_m) / len(confidences)
    error = f"{np.percentile(errors_m, 95):.2f} m" if errors_m else ""
    p5, middle = np.percentile(confidences, [5, 50])
    return f"| `{weather}` | {p5:.2f}, {middle:.2f} | {accepted:.1f} % | {error} |"


def confidences_of(run: Path) -> FloatArray:
    """Return the confidences of the lanes that the driver detected while a run's car was driving."""
    server, client = read_record(run / "server.mcap"), read_record(run / "client.mcap")
    began_ns, ended_ns, _ = driving_interval(server)
    frames = server.table("frame")
    stamped_ns = frames.ints("stamped_mono_ns")
    driven = set(frames.ints("stamp_ns")[(stamped_ns >= began_ns) & (stamped_ns <= ended_ns)].tolist())
    lanes = client.table("lane")
    seen, first = np.unique(lanes.ints("stamp_ns"), return_index=True)
    detected = lanes.where(first).objects("lane")
    values = [
        0.0 if lane is None else float(lane["confidence"])
        for stamp_ns, lane in zip(seen.tolist(), detected, strict=True)
        if stamp_ns in driven
    ]
    return np.array(values, np.float64)


def sweep_table(sweep: Path) -> str:
    """Return the Markdown table of a sweep of `configs/weather.yaml`, one row for each condition and weather."""
    lines = [
        "| condition | weather | runs | completed | in own lane | P95 of cross-track, completed runs "
        "| confidence: p5, median |",
        "|---" * 7 + "|",
    ]
    runs = sorted((sweep / "runs").glob("*/result.json"))
    results = [(json.loads(path.read_text()), path.parent) for path in runs]
    for condition in sorted({result["condition"] for result, _ in results}):
        for weather in WEATHERS:
            chosen = [
                (result, run)
                for result, run in results
                if (result["condition"], result["axes"]["vehicle.weather"]) == (condition, weather)
            ]
            if not chosen:
                continue
            completed = [result for result, _ in chosen if result["ending"] == "completed"]
            endings = sorted({result["ending"] for result, _ in chosen} - {"completed"})
            p95_m = ", ".join(f"{result['p95_m']:.2f} m" for result in completed)
            confidences = np.concatenate([confidences_of(run) for _, run in chosen])
            p5, middle = np.percentile(confidences, [5, 50])
            own = sum(result["completed_in_own_lane"] is True for result in completed)
            cells = [
                condition,
                f"`{weather}`",
                str(len(chosen)),
                f"{len(completed)}" + (f" ({', '.join(endings)})" if endings else ""),
                str(own),
                p95_m,
                f"{p5:.2f}, {middle:.2f}",
            ]
            lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    """Print the table and write the sheet."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--picture", type=Path, default=Path("docs/pictures/weather.jpg"))
    parser.add_argument("--route", default="a_key")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--length-m", type=float, default=None, help="default: the whole route")
    parser.add_argument("--sweep", type=Path, default=None, help="directory of a sweep of configs/weather.yaml")
    options = parser.parse_args()
    if options.sweep is not None:
        print(sweep_table(options.sweep))
        return
    cv2.setNumThreads(1)
    road = load_road(options.route)
    strips = []
    for weather in WEATHERS:
        renderer = Renderer(road, MODEL, seed=1, scenery="full", light="overcast", weather=weather)
        pictures = [renderer.render(pose_on(road, s_m, PICTURED_NS), round(s_m)) for s_m in PLACES_M]
        strips.append(
            np.hstack(
                [
                    reduce_and_label(picture, f"{weather}, {s_m:.0f} m")
                    for picture, s_m in zip(pictures, PLACES_M, strict=True)
                ]
            )
        )
    rows = [np.hstack(strips[first : first + 2]) for first in range(0, len(strips), 2)]
    options.picture.parent.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(options.picture), np.vstack(rows), [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    print(f"{options.picture}: {options.picture.stat().st_size / 1000:.0f} kB\n")
    print("| weather | confidence: p5, median | accepted pictures | error at 10 m, p95 of accepted |")
    print("|---" * 4 + "|")
    for weather in WEATHERS:
        print(table_row(road, weather, options.seeds, options.length_m or road.route_length_m), flush=True)


if __name__ == "__main__":
    main()
