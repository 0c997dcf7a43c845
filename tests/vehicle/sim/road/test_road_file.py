import dataclasses
import itertools
import re
from pathlib import Path

import numpy as np
import pytest

from lavt.errors import UserError
from lavt.vehicle.sim.dynamics import LINCOLN_MKZ
from lavt.vehicle.sim.road.road import load_road, parse_road

SHORT = "title: x\nsegments: [{length_m: 100}]\n"
DOCS = Path(__file__).parents[4] / "docs" / "roads.md"


def test_the_documented_example_is_a_valid_road() -> None:
    """The example in docs/roads.md is a valid road with lanes, marks and asphalt, and has at most ten lines."""
    text = re.search(r"```yaml\n(title: My bend.*?)```", DOCS.read_text(), re.DOTALL)
    assert text is not None
    assert len(text[1].splitlines()) <= 10
    road = parse_road(text[1], source="my_bend.yaml")
    assert (road.route_length_m, road.first_m, road.last_m) == (250.0, -20.0, 350.0)
    assert road.lanes.edges_at(0.0) == (-1.75, 1.75, 5.25)
    assert [(mark.offset_m, mark.kind) for mark in road.marks] == [(-1.75, "solid"), (1.75, "broken"), (5.25, "solid")]
    assert [(strip.left_m, strip.right_m) for strip in road.paved] == [(5.75, -2.25)]
    assert float(np.abs(road.centre_at(np.arange(0.0, 250.0)).curvature_per_m).max()) == pytest.approx(0.02)


def test_the_parameters_of_the_car_are_documented() -> None:
    """docs/roads.md has each parameter of the car with its value, and the extent of its body."""
    page = DOCS.read_text()
    rows = re.findall(r"^\| `(\w+)` \| ([\d.]+) \|", page.partition("## The car")[2], re.MULTILINE)
    assert {name: float(value) for name, value in rows} == dataclasses.asdict(LINCOLN_MKZ)
    car = LINCOLN_MKZ
    extent = f"{-car.rear_axle_to_rear_m} m to {car.rear_axle_to_front_m} m along the car, and {car.body_width_m / 2} m"
    assert extent in page


def test_a_title_and_a_segment_make_a_road() -> None:
    """A road file needs only a title and a segment: by default there is one lane, from the origin along x."""
    road = parse_road(SHORT, source="x.yaml")
    assert road.start == (0.0, 0.0, 0.0)
    assert road.route_length_m == 100.0
    assert road.lanes.edges_at(0.0) == (-1.75, 1.75)
    assert road.rails == ()


def test_asphalt_and_marks_follow_lanes_that_change() -> None:
    """By default, asphalt and marks follow the lanes' edges; a lane without width has no mark."""
    road = parse_road(SHORT + CHANGE, source="x.yaml")
    assert road.lanes.edges_at(35.0) == pytest.approx((-2.125, -1.625, 1.625))
    assert [(mark.kind, *mark.offsets_m) for mark in road.marks if mark.from_m == 20.0] == [
        ("solid", -1.75, -2.5),
        ("broken", -1.75, -1.5),
        ("solid", 1.75, 1.5),
    ]
    assert [mark.kind for mark in road.marks if mark.to_m == 20.0] == ["solid", "solid"]
    assert [(strip.lefts_m, strip.rights_m) for strip in road.paved] == [
        ((2.25, 2.25), (-2.25, -2.25)),
        ((2.25, 2.0), (-2.25, -3.0)),
        ((2.0, 2.0), (-3.0, -3.0)),
    ]
    part = road.sub_route("x", 30.0, 20.0)
    assert part.lanes.edges_at(5.0) == pytest.approx(road.lanes.edges_at(35.0))
    np.testing.assert_allclose(part.lanes.edges_along(np.array([5.0]))[:, 0], part.lanes.edges_at(5.0))


def test_a_road_is_loaded_from_its_path(tmp_path: Path) -> None:
    """A path that ends in .yaml is loaded as a road, and `part_of` is relative to its directory."""
    (tmp_path / "whole.yaml").write_text(SHORT)
    (tmp_path / "part.yaml").write_text("title: y\npart_of: whole.yaml\nfrom_m: 40\nlength_m: 50\n")
    part = load_road(str(tmp_path / "part.yaml"))
    assert (part.title, part.start, part.first_m) == ("y", (40.0, 0.0, 0.0), -60.0)


CHANGE = "lanes: {widths_m: [3.5, 0], changes: [{from_m: 20, to_m: 50, widths_m: [3, 1]}]}"

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{new}: &{new} [{', '.join([f'*{old}'] * 9)}]\n" for old, new in itertools.pairwise("abcdefghij")
)
BOMB += "title: x\nsegments: *j\n"
"""YAML of a few lines whose aliases expand to a thousand million words."""

REJECTED = {
    "no segments": ("title: x", r"'segments' is missing"),
    "unknown key": (SHORT + "lane: {driven: 0}", r"unknown key 'lane': did you mean 'lanes'\?"),
    "unknown inner key": ("title: x\nsegments: [{lenght_m: 3}]", r"'segments\.0\.lenght_m': did you mean 'length_m'\?"),
    "unknown key of a lane": (SHORT + "lanes: {drivn: 0}", r"'lanes\.drivn': did you mean 'driven'\?"),
    "negative length": ("title: x\nsegments: [{length_m: -3}]", r"'segments\.0\.length_m'.*greater than 0, not -3"),
    "no length": ("title: x\nsegments: []", r"'segments'"),
    "not a number": ("title: x\nsegments: [{length_m: .nan}]", r"'segments\.0\.length_m'.*finite"),
    "a text for a number": ("title: x\nsegments: [{length_m: '3'}]", r"'segments\.0\.length_m'.*number, not '3'"),
    "huge": ("title: x\nsegments: [{length_m: 1.0e+300}]", r"'segments\.0\.length_m'.*20000"),
    "an integer beyond floats": (f"title: x\nsegments: [{{length_m: 1{'0' * 400}}}]", r"'segments\.0\.length_m'"),
    "too long in total": (
        "title: x\nsegments: [{length_m: 15000}, {length_m: 15000}]",
        r"30000 m long: a road has at most 20 km",
    ),
    "driven lane": (SHORT + "lanes: {widths_m: [3, 3], driven: 2}", r"lanes\.driven is 2, but lanes count from 0 to 1"),
    "negative lane": (SHORT + "lanes: {driven: -1}", r"'lanes\.driven'"),
    "no asphalt": (SHORT + "paved: [{left_m: 9, right_m: 3}]", r"no asphalt from 0\.0 m to 100\.0 m"),
    "asphalt ends": (SHORT + "paved: [{left_m: 2, right_m: -2, to_m: 60}]", r"no asphalt from 60\.0 m to 100\.0 m"),
    "asphalt has a hole": (
        SHORT + "paved: [{left_m: 2, right_m: 1}, {left_m: 0.9, right_m: -2}]",
        r"no asphalt from 0\.0 m",
    ),
    "asphalt the wrong way round": (SHORT + "paved: [{left_m: -2, right_m: 2}]", r"left is the greater offset"),
    "shoulders and paved": (SHORT + "shoulders: {}\npaved: [{left_m: 2, right_m: -2}]", r"leave out shoulders"),
    "tight": (
        "title: x\nsegments: [{length_m: 19, curvature_per_m: 0.1}]\nlanes: {widths_m: [4, 4, 4], driven: 2}",
        r"segments\.0 has a radius of 10\.0 m, but the road reaches 10\.5 m",
    ),
    "tight at the end of a clothoid": (
        "title: x\nsegments: [{length_m: 19, end_curvature_per_m: -0.1}]\nshoulders: {right_m: 9}",
        r"radius of 10\.0 m",
    ),
    "too tight for a car": ("title: x\nsegments: [{length_m: 9, curvature_per_m: 1}]", r"0\.2, not 1"),
    "route too long": (SHORT + "length_m: 101", r"only 100\.000 m long"),
    "rail in the lane": (SHORT + "rails: [{offset_m: 1.0}]", r"rails\.0 .* driven lane"),
    "rail nowhere": (SHORT + "rails: [{offset_m: 5, from_m: 900}]", r"rails\.0 is not on the road"),
    "rail backwards": (SHORT + "rails: [{offset_m: 5, from_m: 9, to_m: 3}]", r"from_m must be less than to_m"),
    "short": ("title: x\nsegments: [{length_m: 9.5}]", r"only 9\.5 m long: a route has at least 10 m"),
    "a short part": ("title: x\npart_of: a\nfrom_m: 0\nlength_m: 3", r"'length_m'.*10, not 3"),
    "an integer that cannot be shown": (
        f"title: x\nsegments: [{{length_m: 0x{'F' * 6000}}}]",
        r"'segments\.0\.length_m'.*not this int",
    ),
    "a list of itself": ("title: x\nsegments: &s [*s]", r"'segments\.0' .*keys and values, not this list"),
    "lists of lists of lists": (BOMB, r"'segments\.0' .*keys and values, not this list"),
    "not YAML": ("title: [", r"is not YAML"),
    "an impossible date": ("title: 2026-13-45", r"is not YAML"),
    "nested too deeply": ("[" * 1500, r"is not YAML"),
    "a list": ("- 3", r"keys and values.*not a list"),
    "nothing": ("", r"keys and values"),
    "part of an unknown road": ("title: x\npart_of: z\nfrom_m: 0\nlength_m: 30", r"no road"),
    "part of a part": ("title: x\npart_of: a_key\nfrom_m: 0\nlength_m: 30", r"a_key is itself a part.*name the whole"),
    "part too long": ("title: x\npart_of: a\nfrom_m: 400\nlength_m: 30", r"a has only 5\.\d m from 400\.0 m on"),
    "part beyond its road": ("title: x\npart_of: a\nfrom_m: 1000\nlength_m: 30", r"a ends at 405\.\d m: from_m must"),
    "dashes too short": ("title: x\nsegments: [{length_m: 9}]\nmarks: [{offset_m: 1, dash_m: 0.01}]", r"dash_m.*0\.1"),
    "widths for other lanes": (
        SHORT + CHANGE.replace("[3, 1]", "[3]"),
        r"lanes\.changes\.0 has 1 widths_m for 2 lanes",
    ),
    "a driven lane without width": (SHORT + CHANGE.replace("[3, 1]", "[0, 1]"), r"width of 0 for the driven lane"),
    "a change backwards": (SHORT + CHANGE.replace("50", "10"), r"from_m must be less than to_m"),
    "changes out of order": (
        SHORT + CHANGE.replace("]}]", "]}, {from_m: 40, to_m: 60, widths_m: [3, 1]}]"),
        r"sort them",
    ),
    "unknown key of a change": (SHORT + CHANGE.replace("to_m", "to"), r"changes\.0\.to': did you mean 'to_m'"),
    "a taper without ends": (SHORT + "marks: [{offset_m: 1, to_offset_m: 2, to_m: 9}]", r"marks\.0 .* give it from_m"),
    "asphalt that closes wrongly": (
        SHORT + "paved: [{left_m: 2, right_m: -2}, {left_m: 5, right_m: 2, from_m: 1, to_m: 9, to_left_m: 1}]",
        r"to_left_m 1\.0 and to_right_m 2\.0",
    ),
    "asphalt narrower than the lane": (
        SHORT + "paved: [{left_m: 2, right_m: -2, from_m: -20, to_m: 100, to_left_m: 1}]",
        r"no asphalt from 0\.0 m",
    ),
    "a rail in a lane that widens": (
        SHORT + "lanes: {changes: [{from_m: 1, to_m: 9, widths_m: [5]}]}\nrails: [{offset_m: 2.4}]",
        r"rails\.0 is in the driven lane",
    ),
    "part with segments": ("title: x\npart_of: a\nfrom_m: 0\nlength_m: 30\nsegments: []", r"unknown key 'segments'"),
}


@pytest.mark.parametrize("name", REJECTED)
def test_an_invalid_road_file_is_rejected(name: str) -> None:
    """An invalid road file is rejected with an error that names the file and the key."""
    text, message = REJECTED[name]
    with pytest.raises(UserError, match=rf"(?s)^x\.yaml.*{message}"):
        parse_road(text, source="x.yaml")


@pytest.mark.parametrize(("name", "content"), [("missing.yaml", None), ("bytes.yaml", b"\xff\xfe"), ("dir.yaml", "")])
def test_an_unreadable_file_is_rejected(name: str, content: bytes | str | None, tmp_path: Path) -> None:
    """A path that does not exist, is a directory or is not text is rejected with an error that names the path."""
    path = tmp_path / name
    if isinstance(content, bytes):
        path.write_bytes(content)
    elif content is not None:
        path.mkdir()
    with pytest.raises(UserError, match=rf"{name}.*(cannot be read|not a text file)"):
        load_road(str(path))
    with pytest.raises(UserError, match="no road"):
        load_road(str(tmp_path))
