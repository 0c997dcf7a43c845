"""`lavt road`: draw roads, import them from maps, and export them as maps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.cli import console
from lavt.domain import CameraModel
from lavt.errors import UserError
from lavt.opendrive.xml_tree import INTEGER
from lavt.recording.output_directory import replace_text
from lavt.vehicle.sim.road.road import load_road


def register(app: typer.Typer) -> None:
    """Add the command."""
    road = typer.Typer(no_args_is_help=True, help="Draw roads; import and export OpenDRIVE maps.")
    road.command("draw")(draw)
    road.command("import")(import_road)
    road.command("export")(export)
    app.add_typer(road, name="road")


def draw(
    name: Annotated[
        str, typer.Argument(metavar="FILE_OR_NAME", help="A road's YAML file, or the name of a shipped road.")
    ],
    out: Annotated[Path | None, typer.Option(help="Output file, a PNG; default: out/road_NAME.png.")] = None,
) -> None:
    """Draw a road from above and from the driver's seat.

    Example: lavt road draw a_key --out a_key.png
    """
    road = load_road(name)
    out = out or Path("out") / f"road_{Path(name).stem}.png"
    if out.suffix != ".png":
        raise UserError(f"--out {out}: the picture is a PNG, so its name must end with .png")
    from lavt.vehicle.sim.rendering.drawing import draw_road  # noqa: PLC0415 (slow: matplotlib)

    out.parent.mkdir(parents=True, exist_ok=True)
    draw_road(road, model=CameraModel()).savefig(out)
    console.print_result(f"the picture is {out}")


def import_road(
    file: Annotated[str, typer.Argument(metavar="FILE.xodr", help="An OpenDRIVE map.")],
    start: Annotated[
        str, typer.Option("--from", metavar="ROAD,LANE", help="The road's id and the lane where the route begins.")
    ],
    goal: Annotated[
        str, typer.Option("--to", metavar="ROAD,LANE", help="The road's id and the lane where the route ends.")
    ],
    out: Annotated[Path | None, typer.Option(help="Output file, a YAML file; default: out/road_NAME.yaml.")] = None,
) -> None:
    """Make a road of the lanes that lead from one lane of an OpenDRIVE map to another (docs/opendrive.md).

    Example: lavt road import Town04.xodr --from 37,-3 --to 38,-3 --out town04.yaml
    """
    start_lane, goal_lane = _parse_lane("--from", start), _parse_lane("--to", goal)
    out = out or Path("out") / f"road_{Path(file).stem}.yaml"
    if out.suffix not in {".yaml", ".yml"}:
        raise UserError(f"--out {out}: a road is a YAML file, so its name must end with .yaml")
    from lavt.opendrive.reader import read_map  # noqa: PLC0415 (only this command needs maps)
    from lavt.vehicle.sim.road.lane_import import import_lanes  # noqa: PLC0415 (the same)

    imported = import_lanes(read_map(file), start_lane, goal_lane)
    _write(out, imported.text)
    for note in imported.notes:
        console.print_message(note)
    console.print_result(
        f"the road is {out}: {imported.road.route_length_m:.1f} m, {len(imported.road.segments) - 2} segments; "
        f"its centre line is within {1000 * imported.deviation_m:.1f} mm of the map's"
    )


def _parse_lane(option: str, text: str) -> tuple[str, int]:
    """Return a road's id and a lane's number; an id may itself contain commas."""
    road, comma, lane = text.rpartition(",")
    if not (comma and road and INTEGER.fullmatch(lane.strip())):
        raise UserError(f"{option} {text}: write the id of a road, a comma and the number of a lane, such as 37,-3")
    return road.strip(), int(lane)


def export(
    name: Annotated[
        str, typer.Argument(metavar="FILE_OR_NAME", help="A road's YAML file, or the name of a shipped road.")
    ],
    out: Annotated[Path | None, typer.Option(help="Output file, an OpenDRIVE map; default: out/NAME.xodr.")] = None,
) -> None:
    """Write a road as an OpenDRIVE map (docs/opendrive.md).

    Example: lavt road export a --out a.xodr
    """
    road = load_road(name)
    out = out or Path("out") / f"{Path(name).stem}.xodr"
    if out.suffix != ".xodr":
        raise UserError(f"--out {out}: the name of an OpenDRIVE map must end with .xodr")
    from lavt.vehicle.sim.road.opendrive_export import export_road  # noqa: PLC0415 (only this command needs it)

    exported = export_road(road)
    _write(out, exported.text)
    for note in exported.notes:
        console.print_message(note)
    console.print_result(
        f"the map is {out}: the route is on road 1, lane {exported.lane}, from s={exported.start_m:g} m"
    )


def _write(path: Path, text: str) -> None:
    """Write a file, or replace it; it stays as it was if this fails."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        replace_text(path, text)
    except OSError as error:
        raise UserError(f"{path} cannot be written ({error.strerror}): name another file with --out") from error
