"""`lavt perception`: detect the lane in pictures and videos, and draw the steps."""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from statistics import median
from typing import Annotated, Any

import typer

from lavt.assembly.cameras import camera_of_file
from lavt.assembly.detection.detectors import build_detector
from lavt.cli import console
from lavt.cli.pictures import check_output, find_sources, read_pictures, write_picture
from lavt.clock import MachineClock
from lavt.config.perception import BUILT_IN
from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.domain import NS_PER_MS, Lane, Picture
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.detection import LANE_WIDTH_M, TRACK_CONFIDENCE, DetectorSettings, PictureDetector
from lavt.perception.lane_detector import LaneDetector
from lavt.perception.panel import TILE_PX, draw_panel
from lavt.recording.output_directory import disk_errors_named
from lavt.transport.video.stamp import has_stamp
from lavt.transport.video.video_file import write_video

DIRECTORY = Path("perception-steps")
"""Where the drawings of several files are, without `--out`."""
COLUMNS = (
    "source",
    "picture",
    "confidence",
    "followed",
    "centre_m",
    "heading_rad",
    "curvature_per_m",
    "width_m",
    "near_m",
    "far_m",
    "left_visible",
    "right_visible",
    "searched",
    "detection_ms",
)
"""The columns of a row; docs/perception.md explains them."""

SourcesArgument = Annotated[
    list[Path], typer.Argument(help="PNG, JPEG, MP4, MKV, a run's client.mcap, or directories of such files.")
]
StepsOption = Annotated[
    Path | None,
    typer.Option(
        help="For one source the output file: .png or .jpg for a picture, .mp4, .mkv or .webp for a video; "
        "default: NAME-steps. For several sources or a directory, the output directory; default: perception-steps."
    ),
]
TileWidthOption = Annotated[
    int, typer.Option(min=200, max=1920, help="The width of each drawn step; its height is three quarters of it.")
]
LaneWidthOption = Annotated[
    float, typer.Option(min=2.0, max=5.0, help="The assumed lane width if only one marking is visible.")
]
LaneConfidenceOption = Annotated[
    float, typer.Option(min=0.05, max=0.95, help="The lowest confidence of a lane that counts as followed.")
]
Row = dict[str, Any]


@dataclass
class _Inspection:
    """What is needed to detect lanes in all files, and the rows so far."""

    camera: CalibratedCamera
    detector_name: str
    settings: DetectorSettings
    lane_confidence: float
    tile_px: tuple[int, int]
    rows: list[Row] = field(default_factory=list)

    def panels(self, source: Path, pictures: Iterator[Picture]) -> Iterator[Picture]:
        """Detect the lane in each picture of a file, add its row, and yield the drawing of its steps."""
        for detector, picture, lane in self.detect(source, pictures):
            yield draw_panel(self.camera, detector, picture, lane, self.tile_px, lane_confidence=self.lane_confidence)

    def detect(self, source: Path, pictures: Iterator[Picture]) -> Iterator[tuple[PictureDetector, Picture, Lane]]:
        """Detect the lane in each picture of a file, add its row, and yield the detector, the picture and the lane."""
        first = next(pictures, None)
        if first is None:
            raise UserError(f"{source} has no picture: name another file")
        settings = DetectorSettings(
            stamped=has_stamp(first),
            lane_width_m=self.settings.lane_width_m,
            track_confidence=self.settings.track_confidence,
            file=self.settings.file,
        )
        detector, clock = build_detector(self.detector_name, self.camera, settings), MachineClock()
        for number, picture in enumerate(chain([first], pictures)):
            height_px, width_px, _ = picture.shape
            if (width_px, height_px) != (self.camera.width_px, self.camera.height_px):
                raise UserError(
                    f"{source} is {width_px} x {height_px}, but the calibration is for {self.camera.width_px} x "
                    f"{self.camera.height_px}: use pictures of that size, or a calibration for this size"
                )
            begin_ns = clock.now().mono_ns
            lane = detector.detect(picture)
            detection_ms = (clock.now().mono_ns - begin_ns) / NS_PER_MS
            row = {"source": str(source), "picture": number, **lane_row(lane, detector, self.lane_confidence)}
            self.rows.append({**row, "detection_ms": round(detection_ms, 3)})
            yield detector, picture, lane


def lane_row(lane: Lane, detector: PictureDetector, lane_confidence: float) -> Row:
    """Return the row of a picture, without its source and time; values of a lane that is not followed are None."""
    is_followed = lane.confidence >= lane_confidence
    trace = detector.trace if isinstance(detector, LaneDetector) else None
    fit = None if trace is None else trace.fit
    c0, c1, c2 = lane.centre
    values = {
        "centre_m": c0,
        "heading_rad": math.atan(c1),
        "curvature_per_m": 2 * c2,
        "width_m": lane.width_m,
        "near_m": lane.near_m,
        "far_m": lane.far_m,
    }
    return {
        "confidence": round(lane.confidence, 4),
        "followed": is_followed,
        **{name: round(value, 5) if is_followed else None for name, value in values.items()},
        "left_visible": None if fit is None else round(fit.left_visible, 4),
        "right_visible": None if fit is None else round(fit.right_visible, 4),
        "searched": None if trace is None else trace.is_search,
    }


def register(app: typer.Typer) -> None:
    """Add the command."""
    perception = typer.Typer(help="Inspect lane detection.", no_args_is_help=True, rich_markup_mode=None)
    perception.callback()(_callback)  # with a callback, Typer keeps a single command as a subcommand
    perception.command("show")(show)
    app.add_typer(perception, name="perception")


def _callback() -> None:
    """Inspect lane detection."""


def show(
    sources: SourcesArgument,
    camera: Annotated[Path, typer.Option(help="A calibration in YAML, or a config with a camera section.")],
    out: StepsOption = None,
    csv_file: Annotated[
        Path | None, typer.Option("--csv", help="File for a table with one row for each picture.")
    ] = None,
    draw: Annotated[bool, typer.Option("--draw/--no-draw", help="Draw the steps.")] = True,
    tile_width_px: TileWidthOption = TILE_PX[0],
    lane_width_m: LaneWidthOption = LANE_WIDTH_M,
    lane_confidence: LaneConfidenceOption = LANE_CONFIDENCE,
    detector: Annotated[str, typer.Option(help="built_in, onnx, or the name of your own detector.")] = BUILT_IN,
    detector_file: Annotated[Path | None, typer.Option(help="The file with the detector's own settings.")] = None,
    as_json: console.JsonOption = False,
) -> None:
    """Draw the steps from a picture to its lane, and print its numbers.

    The steps are drawn side by side. For a video, the output is a video with the steps of each picture. In a video the
    lane is tracked; each picture file is searched as a first one.

    Example: lavt perception show out/run/client.mcap --camera configs/demo.yaml --out steps.mp4
    """
    inspection = _Inspection(
        camera_of_file(camera),
        detector,
        DetectorSettings(
            lane_width_m=lane_width_m,
            track_confidence=min(TRACK_CONFIDENCE, lane_confidence),
            file="" if detector_file is None else str(detector_file),
        ),
        lane_confidence,
        (tile_width_px, tile_width_px * 3 // 4),
    )
    if csv_file is not None and not csv_file.parent.is_dir():
        raise UserError(f"{csv_file.parent} is not a directory: create it, or name another file with --csv")
    files = find_sources(sources)
    is_single = len(sources) == 1 and not sources[0].is_dir()
    drawn = _draw_all(inspection, files, out, is_single=is_single) if draw else _detect_all(inspection, files)
    with console.interruptible():
        try:
            for file, target in zip(files, drawn, strict=False):
                if not as_json:
                    console.print_result(_sentence(file, inspection.rows, target))
        finally:  # also if a file cannot be read, or after Ctrl-C
            _give_rows(inspection.rows, csv_file, as_json=as_json)


def _give_rows(rows: Sequence[Row], csv_file: Path | None, *, as_json: bool) -> None:
    """Write the rows into `csv_file` if it is given, and print them if `as_json`; do nothing without rows."""
    if rows and csv_file is not None:
        write_rows(csv_file, rows)
    if rows and as_json:
        console.print_json(rows)


def _detect_all(inspection: _Inspection, files: Sequence[Path]) -> Iterator[None]:
    """Detect the lanes of each file without drawing; yield None for each, in the place of an output."""
    for file in files:
        deque(inspection.detect(file, read_pictures(file).pictures), maxlen=0)
        yield None


def _draw_all(inspection: _Inspection, files: Sequence[Path], out: Path | None, *, is_single: bool) -> Iterator[Path]:
    """Draw the steps of each file, a single one into a file and several into a directory; yield the outputs."""
    if is_single:
        yield _draw(inspection, files[0], out)
        return
    directory = out or DIRECTORY
    if directory.is_file():
        raise UserError(f"{directory} is a file, but several files are drawn: name a directory with --out")
    directory.mkdir(parents=True, exist_ok=True)
    outputs: list[Path] = []
    for file in files:
        outputs.append(_draw(inspection, file, directory, outputs))
        yield outputs[-1]


def _draw(inspection: _Inspection, file: Path, out: Path | None, used: Sequence[Path] | None = None) -> Path:
    """Draw the steps of a file, and return the output: `out`, or with `used` one in `out` that is not in `used`."""
    opened = read_pictures(file)
    suffix = ".mp4" if opened.is_video else ".png"
    names = (f"{file.stem}-steps{suffix}", *(f"{file.stem}-{number}-steps{suffix}" for number in range(2, 10_000)))
    if out is None:
        target = Path(names[0])
    else:
        target = out if used is None else next(path for name in names if (path := out / name) not in used)
    check_output(target, source=file, is_video=opened.is_video)
    panels = inspection.panels(file, opened.pictures)
    if opened.is_video:
        write_video(target, panels, opened.rate_hz)
    else:
        write_picture(target, next(panels))
    return target


def _sentence(file: Path, rows: Sequence[Row], drawn: Path | None) -> str:
    """Return a sentence on the lanes of a file."""
    of_file = [row for row in rows if row["source"] == str(file)]
    confidences = [row["confidence"] for row in of_file]
    followed = sum(row["followed"] for row in of_file)
    detection_ms = median(row["detection_ms"] for row in of_file)
    if len(of_file) == 1:
        (row,) = of_file
        found = f"a lane, centre {row['centre_m']:+.2f} m, width {row['width_m']:.2f} m" if followed else "no lane"
        text = f"{file}: confidence {row['confidence']:.2f}, {found}, detected in {detection_ms:.1f} ms"
    else:
        text = (
            f"{file}: {len(of_file)} pictures, {followed} with a lane ({100 * followed / len(of_file):.0f} %), median "
            f"confidence {median(confidences):.2f}, detected in {detection_ms:.1f} ms (median)"
        )
    return text if drawn is None else f"{text}; the steps are in {drawn}"


def write_rows(file: Path, rows: Sequence[Row]) -> None:
    """Write the rows as CSV, with a line of names; a value that is not known is empty."""
    with disk_errors_named(file), file.open("w", newline="", encoding="utf-8") as stream:
        writer = csv.DictWriter(stream, COLUMNS)
        writer.writeheader()
        writer.writerows({name: _csv_value(value) for name, value in row.items()} for row in rows)


def _csv_value(value: Any) -> Any:
    return str(value).lower() if isinstance(value, bool) else value
