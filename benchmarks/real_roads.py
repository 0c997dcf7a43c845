"""Print how the lane detector does on real road pictures, and how reliable its confidence is there.

    python -m benchmarks.real_roads [--directory out/real_roads] [--offline] [--part seen] [--draw out/drawn]
                                    [--detector onnx --detector-file lanes.yaml]

`real_roads.yaml` names the repository, commit, path and SHA-256 of each picture, and has labels: points of the lane's
lines, set by eye. A picture that is not in the directory is fetched from the public repository, unless
`--offline` is given. A picture that cannot be had, or is another one, is skipped with a reason. The detector searches
each picture as its first one. The part `unseen` was not used while the detector was changed.
"""

from __future__ import annotations

import argparse
import hashlib
import time  # noqa: TID251 (costs are CPU time, which clock.py does not give)
import urllib.error
import urllib.request
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal
from urllib.parse import quote

import cv2
import numpy as np
import yaml

from lavt.assembly.cameras import calibrated_camera
from lavt.assembly.detection.detectors import build_detector
from lavt.config import CalibrationConfig
from lavt.config.perception import BUILT_IN
from lavt.config_file import parse_config
from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import FloatArray, Lane, Picture
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera, axes, picture_points
from lavt.perception.detection import DetectorSettings
from lavt.perception.lane_detector import GRID
from lavt.perception.panel import draw_lane

DATA = Path(__file__).with_suffix(".yaml")
RAW_URL = "https://raw.githubusercontent.com/{repository}/{commit}/{path}"
FETCH_TIMEOUT_S = 60
AHEAD_M = np.array([8.0, 10.0, 12.0, 15.0])
"""Distances ahead of the rear axle at which both lines are compared, where they are labelled."""
LABEL_MARGIN_M = 1.0
"""A labelled line is continued straight on by this much."""
ERROR_LIMIT_M = 0.5
"""A line that is off by more than this is wrong there."""
CONFIDENCE_BINS = (0.0, 0.05, 0.2, 0.3, 0.4, 0.6, 0.8, 1.001)
REPETITIONS = 5

Judgement = Literal["right", "partly", "wrong", "missed"]
JUDGEMENTS: tuple[Judgement, ...] = ("right", "partly", "wrong", "missed")
KINDS = {2: "both lines painted", 1: "one line painted", 0: "no lane to be seen"}
"""The kind of picture by the number of labelled lines."""


@dataclass(frozen=True, slots=True)
class RoadPicture:
    """A labelled picture."""

    name: str
    group: str
    """The camera, or the group of cameras of one data set."""
    camera: CalibratedCamera
    part: str
    picture: Picture
    lines_m: dict[int, FloatArray] = field(default_factory=dict)
    """The labelled lines on the ground, (n, 2), by side: 1 left, -1 right."""


@dataclass(frozen=True, slots=True)
class Verdict:
    """What the detector made of a picture."""

    road: RoadPicture
    lane: Lane
    judgement: Judgement
    """The judgement of the lane, whatever its confidence; never `missed`."""

    def believed(self, threshold: float) -> bool:
        """Return whether the lane would be followed."""
        return self.lane.confidence >= threshold

    def outcome(self, threshold: float) -> Judgement:
        """Return the judgement, which is `missed` if the confidence is below the threshold."""
        return self.judgement if self.believed(threshold) else "missed"


def ground_points(camera: CalibratedCamera, pixels: Sequence[Sequence[float]]) -> FloatArray:
    """Return the ground points (n, 2) of pixels (n, 2) below the horizon, sorted by x."""
    points = np.array(pixels, dtype=np.float64).reshape(-1, 1, 2)
    rays = cv2.undistortPoints(points, camera.camera_matrix, np.array(camera.distortion)).reshape(-1, 2)
    directions = np.column_stack([rays, np.ones(len(rays))]) @ axes(camera)
    ahead = directions[:, 2] < 0
    scale = camera.z_m / -directions[ahead, 2]
    ground = np.array([camera.x_m, camera.y_m]) + scale[:, None] * directions[ahead, :2]
    return np.asarray(ground[np.argsort(ground[:, 0])], dtype=np.float64)


def load_roads(
    directory: Path, *, offline: bool, parts: Iterable[str], data: Path = DATA
) -> tuple[list[RoadPicture], list[str]]:
    """Return the labelled pictures of `parts`, and for each picture that is missing the reason."""
    listed: dict[str, Any] = yaml.safe_load(data.read_text(encoding="utf-8"))
    cameras = {
        name: calibrated_camera(parse_config(CalibrationConfig, keys, name)) for name, keys in listed["cameras"].items()
    }
    roads, skipped = [], []
    for entry in listed["pictures"]:
        if entry["part"] not in parts:
            continue
        source = listed["sources"][entry["source"]]
        name = f"{source['repository']}/{entry['path']}" + (f" frame {entry['frame']}" if "frame" in entry else "")
        try:
            picture = _read_picture(directory, source, entry, offline=offline)
        except UserError as error:
            skipped.append(f"{name}: {error}")
            continue
        camera = cameras[entry["camera"]]
        sides = {1: entry.get("left"), -1: entry.get("right")}
        lines_m = {side: ground_points(camera, pixels) for side, pixels in sides.items() if pixels}
        group = entry["camera"].split("_")[0] if entry["camera"].startswith("bdd") else entry["camera"]
        roads.append(RoadPicture(name, group, camera, entry["part"], picture, lines_m))
    return roads, skipped


def _read_picture(directory: Path, source: dict[str, str], entry: dict[str, Any], *, offline: bool) -> Picture:
    file = directory / source["repository"] / entry["path"]
    if not file.is_file():
        if offline:
            raise UserError(f"{file} does not exist, and nothing is fetched with --offline")
        _fetch(RAW_URL.format(**source | {"path": quote(entry["path"])}), file)
    if hashlib.sha256(file.read_bytes()).hexdigest() != entry["sha256"]:
        raise UserError(f"{file} is not the labelled picture: its SHA-256 differs")
    if "frame" in entry:
        video = cv2.VideoCapture(str(file))
        picture = None
        for _ in range(entry["frame"] + 1):  # seeking is not exact with every build of OpenCV
            picture = video.read()[1]
    else:
        picture = cv2.imread(str(file), cv2.IMREAD_COLOR)
    if picture is None:
        raise UserError(f"{file} cannot be decoded")
    return np.asarray(picture, dtype=np.uint8)


def _fetch(url: str, file: Path) -> None:
    try:
        with urllib.request.urlopen(url, timeout=FETCH_TIMEOUT_S) as answer:
            content = answer.read()
    except (urllib.error.URLError, TimeoutError, OSError) as error:
        raise UserError(f"{url} cannot be fetched ({error}); --directory names a directory that has it") from error
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_bytes(content)


def judge(lines_m: dict[int, FloatArray], lane: Lane) -> Judgement:
    """Compare a lane with the labelled lines.

    It is right if each labelled line is within `ERROR_LIMIT_M` wherever it is compared, partly right if it is there in
    at least half of these places, and else wrong. Without a labelled line every lane is wrong.
    """
    c0, c1, c2 = lane.centre
    good = []
    for side, line in lines_m.items():
        seen = (line[0, 0] - LABEL_MARGIN_M <= AHEAD_M) & (line[-1, 0] + LABEL_MARGIN_M >= AHEAD_M)
        x = AHEAD_M[seen]
        slope = c1 + 2 * c2 * x
        y = c0 + (c1 + c2 * x) * x + side * lane.width_m / 2 * np.hypot(1.0, slope)
        good += (np.abs(y - _continued(x, line)) <= ERROR_LIMIT_M).tolist()
    if not good or 2 * sum(good) < len(good):
        return "wrong"
    return "right" if all(good) else "partly"


def _continued(x: FloatArray, line: FloatArray) -> FloatArray:
    """Return y of a line at x, continued straight on at both ends."""
    margin = np.array([-LABEL_MARGIN_M, LABEL_MARGIN_M])
    slopes = [np.diff(line[ends, 1]) / np.diff(line[ends, 0]) for ends in ([0, 1], [-2, -1])]
    ends_y = [line[end, 1] + step * slope[0] for end, step, slope in zip((0, -1), margin, slopes, strict=True)]
    xs = np.concatenate([[line[0, 0] + margin[0]], line[:, 0], [line[-1, 0] + margin[1]]])
    return np.asarray(np.interp(x, xs, np.concatenate([[ends_y[0]], line[:, 1], [ends_y[1]]])), dtype=np.float64)


def check_road(road: RoadPicture, detector: str = BUILT_IN, file: str = "") -> Verdict:
    """Search a picture for a lane with the detector of that name, and judge it."""
    lane = build_detector(detector, road.camera, DetectorSettings(stamped=False, file=file)).detect(road.picture)
    return Verdict(road, lane, judge(road.lines_m, lane))


def outcome_table(verdicts: Sequence[Verdict], threshold: float) -> str:
    """Return the table of outcomes by kind of picture and camera."""
    lines = ["| pictures | camera | number | right | partly | wrong | missed |", "|---|---|---|---|---|---|---|"]
    for count, kind in KINDS.items():
        of_kind = [verdict for verdict in verdicts if len(verdict.road.lines_m) == count]
        groups = list(dict.fromkeys(verdict.road.group for verdict in of_kind)) if count == max(KINDS) else []
        for group in [*groups, None]:
            chosen = [verdict for verdict in of_kind if group in (None, verdict.road.group)]
            outcomes = Counter(verdict.outcome(threshold) for verdict in chosen)
            cells = [kind, group or "all", str(len(chosen)), *(str(outcomes[each]) for each in JUDGEMENTS)]
            lines.append("| " + " | ".join(cells) + " |")
    return "\n".join(lines)


def reliability_table(verdicts: Sequence[Verdict]) -> str:
    """Return the table of stated confidence against observed judgements."""
    lines = ["| confidence | pictures | right | partly | wrong | share wrong |", "|---|---|---|---|---|---|"]
    for low, high in pairwise(CONFIDENCE_BINS):
        in_bin = [verdict.judgement for verdict in verdicts if low <= verdict.lane.confidence < high]
        if in_bin:
            outcomes = Counter(in_bin)
            cells = [f"{low:.2f} to {min(high, 1):.2f}", str(len(in_bin))]
            cells += [str(outcomes[each]) for each in JUDGEMENTS[:3]]
            lines.append("| " + " | ".join([*cells, f"{100 * outcomes['wrong'] / len(in_bin):.1f} %"]) + " |")
    return "\n".join(lines)


def cost_ms(roads: Iterable[RoadPicture], detector_name: str = BUILT_IN, file: str = "") -> tuple[float, float]:
    """Return the median CPU times of a picture in milliseconds: while searching, and while following a lane."""
    searching_s: list[float] = []
    following_s: list[float] = []
    for road in roads:
        detector = build_detector(detector_name, road.camera, DetectorSettings(stamped=False, file=file))
        for _ in range(REPETITIONS):
            detector.forget()
            for times_s in (searching_s, following_s):
                begin_s = time.process_time()
                confidence = detector.detect(road.picture).confidence
                times_s.append(time.process_time() - begin_s)
                if confidence < LANE_CONFIDENCE:
                    break  # the next picture would be searched, too
    medians = [1e3 * float(np.median(times_s)) if times_s else float("nan") for times_s in (searching_s, following_s)]
    return medians[0], medians[1]


def draw_verdict(verdict: Verdict, threshold: float) -> Picture:
    """Return the picture with the lane, if it is believed, the labelled lines in yellow, and the outcome."""
    road = verdict.road
    lane = verdict.lane if verdict.believed(threshold) else Lane((0.0, 0.0, 0.0), 3.5, GRID.near_m, GRID.far_m, 0.0)
    drawn = draw_lane(road.camera, road.picture, lane)
    for line in road.lines_m.values():
        pixels = picture_points(road.camera, line)
        cv2.polylines(drawn, [np.round(pixels).astype(np.int32)], False, (0, 255, 255), 1, cv2.LINE_AA)
    label = f"{verdict.outcome(threshold)} {verdict.lane.confidence:.2f} {road.part} {road.name}"
    cv2.putText(drawn, label, (8, 24), cv2.FONT_HERSHEY_SIMPLEX, 0.6, (0, 0, 255), 2, cv2.LINE_AA)
    return drawn


def main() -> None:
    """Read or fetch the pictures, detect the lanes, and print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--directory", type=Path, default=Path("out/real_roads"), help="pictures: OWNER/NAME/PATH")
    parser.add_argument("--offline", action="store_true", help="fetch nothing")
    parser.add_argument("--part", choices=["seen", "unseen", "all"], default="all")
    parser.add_argument("--detector", default=BUILT_IN, help="the name of the detector, as perception.detector")
    parser.add_argument("--detector-file", default="", help="the detector's file, as perception.file")
    parser.add_argument("--threshold", type=float, default=LANE_CONFIDENCE)
    parser.add_argument("--draw", type=Path, default=None, help="directory for the pictures with lanes and labels")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    parts = ("seen", "unseen") if arguments.part == "all" else (arguments.part,)
    roads, skipped = load_roads(arguments.directory, offline=arguments.offline, parts=parts)
    for reason in skipped:
        print(f"skipped: {reason}")
    if not roads:
        print("no picture is left: see the reasons above")
        return
    verdicts = [check_road(road, arguments.detector, arguments.detector_file) for road in roads]
    for number, verdict in enumerate(verdicts):
        if verdict.judgement != "right" or not verdict.believed(arguments.threshold):
            print(f"{verdict.outcome(arguments.threshold)} {verdict.lane.confidence:.2f} {verdict.road.name}")
        if arguments.draw is not None:
            arguments.draw.mkdir(parents=True, exist_ok=True)
            cv2.imwrite(str(arguments.draw / f"{number:02}.jpg"), draw_verdict(verdict, arguments.threshold))
    for part in parts:
        of_part = [verdict for verdict in verdicts if verdict.road.part == part]
        print(f"\npart {part}, threshold {arguments.threshold}:\n\n{outcome_table(of_part, arguments.threshold)}")
    print(f"\n{reliability_table(verdicts)}")
    searching_ms, following_ms = cost_ms(roads, arguments.detector, arguments.detector_file)
    print(f"\ncost of a picture: searching {searching_ms:.2f} ms, following {following_ms:.2f} ms (median CPU times)")


if __name__ == "__main__":
    main()
