"""`lavt camera`: calibrate a camera's lens and its mounting on the car."""

from __future__ import annotations

import math
import re
from collections import Counter
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, NamedTuple

import numpy as np
import typer

from lavt.assembly.cameras import calibrated_camera, camera_of_file
from lavt.cli import console
from lavt.cli.pictures import (
    PICTURE_SUFFIXES,
    SourceKind,
    check_output,
    find_sources,
    read_pictures,
    write_picture,
)
from lavt.config import CalibrationConfig
from lavt.config_file import parse_config
from lavt.domain import FloatArray, Picture
from lavt.errors import UserError
from lavt.perception.calibration import CalibratedCamera
from lavt.perception.lens_calibration import Corners, LensCalibration, calibrate_lens, covered_shares, find_corners
from lavt.perception.mounting import Mounting, draw_mounting, find_mounting

GOOD_RMS_PX = 1.0
"""A larger RMS is a bad calibration: blurred or bent boards, or a wrong kind of lens."""
GOOD_COVERAGE = 0.7
"""Share of the picture's width and height that the boards should cover."""
GOOD_DEVIATION_M = 0.1
"""A larger deviation of the points from straight lines is a curve, a wrong lens, or inaccurate points."""
DEFAULT_OUT = Path("camera.yaml")
BOARDS = SourceKind(PICTURE_SUFFIXES, "picture of a chessboard", "pictures of a chessboard")

BoardsArgument = Annotated[
    list[Path] | None, typer.Argument(help="Pictures of a chessboard, or directories of them; not with --lens.")
]
LensOption = Annotated[
    Path | None, typer.Option(help="A calibration whose lens is used, instead of pictures of a chessboard.")
]
RoadOption = Annotated[
    Path | None, typer.Option(help="A picture of two parallel lines on straight, level road; the car is along them.")
]
RollOption = Annotated[
    float | None, typer.Option(help="The camera's roll, which the lines cannot show; right side down is positive.")
]
CheckOption = Annotated[
    Path | None, typer.Option(help="The picture that shows whether the mounting is right; default: NAME-check.png.")
]


class _RoadLines(NamedTuple):
    """Two parallel lines in a picture of a road."""

    source: Path
    picture: Picture
    left_px: FloatArray
    right_px: FloatArray
    """Points of the lines, (n, 2)."""
    distance_m: float


def register(app: typer.Typer) -> None:
    """Add the command."""
    camera = typer.Typer(help="Calibrate a camera (docs/camera.md).", no_args_is_help=True, rich_markup_mode=None)
    camera.callback()(_callback)  # with a callback, Typer keeps a single command as a subcommand
    camera.command("calibrate")(calibrate)
    app.add_typer(camera, name="camera")


def _callback() -> None:
    """Calibrate a camera (docs/camera.md)."""


def calibrate(
    boards: BoardsArgument = None,
    x_m: Annotated[
        float | None, typer.Option(help="How far the camera is ahead of the rear axle; default: that of --lens.")
    ] = None,
    corners: Annotated[
        str, typer.Option(help="The inner corners of the chessboard: COLUMNSxROWS; a board of 10 x 7 fields has 9x6.")
    ] = "9x6",
    fisheye: Annotated[bool, typer.Option("--fisheye", help="The lens is a fisheye.")] = False,
    lens: LensOption = None,
    road: RoadOption = None,
    left: Annotated[str, typer.Option(help="Points of the left line in it, in pixels: 'u,v u,v'.")] = "",
    right: Annotated[str, typer.Option(help="Points of the right line in it: 'u,v u,v'.")] = "",
    distance_m: Annotated[
        float | None, typer.Option(min=0.5, max=30, help="The distance between the middles of the two lines.")
    ] = None,
    y_m: Annotated[float | None, typer.Option(help="How far the camera is left of the middle of the car.")] = None,
    z_m: Annotated[
        float | None, typer.Option(help="The camera's height above the ground; with --road it is found.")
    ] = None,
    roll_deg: RollOption = None,
    out: Annotated[Path, typer.Option(help="The calibration file to write.")] = DEFAULT_OUT,
    check: CheckOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Calibrate a camera's lens and its mounting on the car.

    The lens comes from pictures of a chessboard, or from a calibration. Pitch, yaw and height come from two parallel
    lines on a road. The result is a file that `camera.calibration` names.

    Example: lavt camera calibrate boards/ --x-m 1.6 --z-m 1.4 --out camera.yaml
    """
    if (lens is None) == (not boards):
        raise UserError("the lens has one source: name either pictures of a chessboard, or a calibration with --lens")
    if lens is None and (x_m is None or (z_m is None and road is None)):
        raise UserError("measure the camera's place on the car: give --x-m, and either --z-m or --road")
    if not out.parent.is_dir():
        raise UserError(f"{out.parent} is not a directory: create it, or name another file with --out")
    check = check or out.with_name(f"{out.stem}-check.png")
    lines = None if road is None else _read_lines(road, left, right, distance_m, check)
    calibration: LensCalibration | None = None
    if lens is not None:
        camera = camera_of_file(lens)
    else:
        calibration, camera = _calibrate_boards(boards or [], _size_of(corners), fisheye=fisheye, is_quiet=as_json)
    camera = _placed(camera, x_m, y_m, z_m, roll_deg)
    mounting = None
    if lines is not None:
        mounting = _mount(camera, lines, check, is_quiet=as_json)
        camera = mounting.camera
    out.write_text(_text_of(camera, calibration, mounting), encoding="utf-8")
    calibrated_camera(parse_config(CalibrationConfig, _keys_of(camera), str(out)))
    if as_json:
        quality = {
            "rms_px": None if calibration is None else calibration.rms_px,
            "deviation_m": None if mounting is None else mounting.deviation_m,
        }
        console.print_json(quality | _keys_of(camera))
    else:
        console.print_result(f"the calibration is {out}")


def _placed(
    camera: CalibratedCamera, x_m: float | None, y_m: float | None, z_m: float | None, roll_deg: float | None
) -> CalibratedCamera:
    """Return the camera at the given coordinates and roll; a value of None stays as it is."""
    return replace(
        camera,
        x_m=camera.x_m if x_m is None else x_m,
        y_m=camera.y_m if y_m is None else y_m,
        z_m=camera.z_m if z_m is None else z_m,
        roll_rad=camera.roll_rad if roll_deg is None else math.radians(roll_deg),
    )


def _size_of(corners: str) -> tuple[int, int]:
    """Return the columns and rows of inner corners."""
    match = re.fullmatch(r"(\d{1,2})x(\d{1,2})", corners)
    size = (int(match[1]), int(match[2])) if match else (0, 0)
    if min(size) < 3:
        raise UserError(f"--corners is {corners!r}: write COLUMNSxROWS with at least 3 each, such as 9x6")
    return size


def _calibrate_boards(
    sources: list[Path], size: tuple[int, int], *, fisheye: bool, is_quiet: bool
) -> tuple[LensCalibration, CalibratedCamera]:
    """Return the lens, and a camera with it whose place is not known yet; print what was found."""
    pictures: dict[Path, Picture] = {}
    for file in find_sources(sources, BOARDS):
        opened = read_pictures(file)
        if not opened.is_video:
            pictures[file] = next(opened.pictures)
    if not pictures:
        raise UserError("there is no picture of a chessboard among these files: name PNG or JPEG files")
    (height_px, width_px), _ = Counter(picture.shape[:2] for picture in pictures.values()).most_common(1)[0]
    found = {
        file: find_corners(picture, size)
        for file, picture in pictures.items()
        if picture.shape[:2] == (height_px, width_px)
    }
    usable = {file: board for file, board in found.items() if board is not None}
    lens = calibrate_lens(list(usable.values()), size, (width_px, height_px), fisheye=fisheye)
    if not is_quiet:
        console.print_result(
            f"{len(usable)} of {len(pictures)} pictures show the whole board of {size[0]} x {size[1]} corners"
        )
        for file in pictures:
            if file not in found:
                console.print_message(f"{file} is left out: it is not {width_px} x {height_px}, as most of them are")
            elif file not in usable:
                console.print_message(f"{file} is left out: not all corners are seen")
        _print_lens(lens, usable, (width_px, height_px))
    camera = CalibratedCamera(
        width_px, height_px, lens.focal_px, lens.middle_px, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, lens.distortion, fisheye
    )
    return lens, camera


def _print_lens(lens: LensCalibration, boards: Mapping[Path, Corners], size_px: tuple[int, int]) -> None:
    """Print the quality of a lens from the corners of boards by file, and what is bad about it."""
    worst = max(zip(lens.board_rms_px, boards, strict=True))
    (fx, fy), (cx, cy) = lens.focal_px, lens.middle_px
    console.print_result(
        f"RMS {lens.rms_px:.2f} px, at worst {worst[0]:.2f} px in {worst[1].name}; "
        f"focal length {fx:.1f}, {fy:.1f} px, middle {cx:.1f}, {cy:.1f} px"
    )
    if lens.rms_px > GOOD_RMS_PX:
        console.print_message(
            f"an RMS above {GOOD_RMS_PX:.0f} px is bad: is the board flat and sharp, and does --fisheye fit the lens?"
        )
    across, down = covered_shares(list(boards.values()), size_px)
    if min(across, down) < GOOD_COVERAGE:
        console.print_message(
            f"the boards cover {100 * across:.0f} % of the width and {100 * down:.0f} % of the height: take more near "
            "the rim, because the lens is not known there"
        )


def _read_lines(road: Path, left: str, right: str, distance_m: float | None, check: Path) -> _RoadLines:
    """Return the picture and its lines; raise `UserError` if one is missing, or if `check` cannot be drawn."""
    if distance_m is None or not left or not right:
        raise UserError("--road needs the two lines in it: give --left, --right and --distance-m")
    left_px, right_px = _points_of(left, "--left"), _points_of(right, "--right")
    picture = next(read_pictures(road).pictures)
    check_output(check, source=road, is_video=False, option="--check")
    return _RoadLines(road, picture, left_px, right_px, distance_m)


def _mount(camera: CalibratedCamera, lines: _RoadLines, check: Path, *, is_quiet: bool) -> Mounting:
    """Return the mounting, draw it, and print it."""
    height_px, width_px, _ = lines.picture.shape
    if (width_px, height_px) != (camera.width_px, camera.height_px):
        raise UserError(
            f"{lines.source} is {width_px} x {height_px}, but the lens is calibrated for {camera.width_px} x "
            f"{camera.height_px}: use a picture of that size"
        )
    mounting = find_mounting(camera, lines.left_px, lines.right_px, lines.distance_m)
    write_picture(check, draw_mounting(lines.picture, mounting))
    if not is_quiet:
        found = mounting.camera
        console.print_result(
            f"pitch {math.degrees(found.pitch_rad):+.2f} deg (down +), yaw {math.degrees(found.yaw_rad):+.2f} deg "
            f"(left +), height {found.z_m:.3f} m; the points deviate from straight lines by up to "
            f"{mounting.deviation_m:.2f} m"
        )
        console.print_result(f"{check} shows whether it is right: the lines must lie on those of the road")
    if mounting.deviation_m > GOOD_DEVIATION_M:
        console.print_message("the points are not on two straight lines: choose a straight road, and check the points")
    return mounting


def _points_of(text: str, option: str) -> FloatArray:
    """Return the points, (n, 2), of an option."""
    number = r"-?\d+(?:\.\d+)?"
    parts = text.split()
    if not parts or any(re.fullmatch(f"{number},{number}", part) is None for part in parts):
        raise UserError(f"{option} is {text!r}: write pixels as 'u,v u,v', such as '300,700 580,460'")
    return np.array([[float(value) for value in part.split(",")] for part in parts])


def _keys_of(camera: CalibratedCamera) -> dict[str, object]:
    """Return the keys of a calibration, rounded."""
    (fx, fy), (cx, cy) = camera.focal_px, camera.middle_px
    keys: dict[str, object] = {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "fx_px": round(fx, 2),
        "fy_px": round(fy, 2),
        "cx_px": round(cx, 2),
        "cy_px": round(cy, 2),
    }
    if camera.distortion:
        keys |= {"lens": "fisheye" if camera.fisheye else "pinhole"}
        keys |= {"distortion": [round(value, 6) for value in camera.distortion]}
    keys |= {name: round(getattr(camera, name), 4) for name in ("x_m", "y_m", "z_m")}
    angles = {"yaw_deg": camera.yaw_rad, "pitch_deg": camera.pitch_rad, "roll_deg": camera.roll_rad}
    return keys | {name: round(math.degrees(angle), 3) for name, angle in angles.items()}


def _text_of(camera: CalibratedCamera, calibration: LensCalibration | None, mounting: Mounting | None) -> str:
    """Return the file: comments on the quality, then the keys, without exponents, which YAML would read as text."""
    comments = ["# written by lavt camera calibrate"]
    if calibration is not None:
        comments.append(f"# lens: {len(calibration.board_rms_px)} boards, RMS {calibration.rms_px:.3f} px")
    if mounting is not None:
        comments.append(f"# mounting: deviation from straight lines up to {mounting.deviation_m:.3f} m")
    lines = [f"{name}: {_plain(value)}" for name, value in _keys_of(camera).items()]
    return "\n".join([*comments, *lines, ""])


def _plain(value: object) -> str:
    if isinstance(value, list):
        return f"[{', '.join(_plain(each) for each in value)}]"
    return (
        f"{value:.6f}".rstrip("0") + ("0" if value == round(value) else "") if isinstance(value, float) else str(value)
    )
