"""Maps are read into plain data; bad files end in one sentence."""

from __future__ import annotations

import contextlib
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from lavt.errors import UserError
from lavt.opendrive import reader, xml_tree
from lavt.opendrive.reader import parse_map, read_map
from lavt.opendrive.road_map import JunctionConnection, LaneMark, RoadLink

HAMLET = Path(__file__).parent / "data" / "hamlet.xodr"

SMALL = """<?xml version="1.0"?>
<OpenDRIVE><road id="1" length="20" junction="-1">
<planView><geometry s="0" x="0" y="0" hdg="0" length="20"><line/></geometry></planView>
<lanes><laneSection s="0"><center><lane id="0"/></center>
<right><lane id="-1" type="driving"><width sOffset="0" a="3" b="0" c="0" d="0"/></lane></right></laneSection></lanes>
</road></OpenDRIVE>"""


def test_the_structure_of_a_map_is_read() -> None:
    """Roads, sections, lanes, marks, links and junctions of a map are read."""
    hamlet = read_map(str(HAMLET))
    assert list(hamlet.roads) == ["1", "11", "12", "2", "3"]
    road = hamlet.road("1")
    assert [(section.s_m, section.end_m) for section in road.sections] == [(0.0, 40.0), (40.0, 70.0)]
    assert sorted(road.sections[1].lanes) == [-2, -1, 0, 1]
    assert road.sections[1].lanes[-1].marks == (LaneMark(0.0, "broken", "white", 0.125),)
    assert road.successor == RoadLink("junction", "100", None)
    assert hamlet.road("12").successor == RoadLink("road", "3", "end")
    assert hamlet.road("12").junction == "100"
    assert hamlet.junctions["100"][1] == JunctionConnection("1", "12", "start", ((-1, -1),))
    assert hamlet.ignored == ()


def test_ignored_content_is_named() -> None:
    """A map with hills, objects and signals says that they are ignored; a profile of zeros is not mentioned."""
    extra = (
        '<elevationProfile><elevation s="0" a="0.0" b="0.02" c="0" d="0"/></elevationProfile>'
        '<lateralProfile><superelevation s="0" a="0.0e+00" b="-0" c="0" d="0"/></lateralProfile>'
        '<objects><object id="1"/><object id="2"/></objects><signals><signal id="3"/></signals></road>'
    )
    assert parse_map(SMALL.replace("</road>", extra).encode(), "m.xodr").ignored == (
        "elevation is ignored (1 of 1 roads have it): all roads are read as flat",
        "objects are ignored: 2",
        "signals are ignored: 1",
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("<line/>", "", "one shape"),
        ("<line/>", '<spiral curvStart="0" curvEnd="1e9"/>', "turns by more than"),
        ("<line/>", '<paramPoly3 aU="0" bU="0" cU="0" dU="0" aV="0" bV="0" cV="0" dV="0"/>', "single point"),
        ('hdg="0"', 'hdg="nan"', "write a finite number"),
        ('hdg="0"', "", "no attribute hdg"),
        ('length="20" junction', 'length="-5" junction', "length -5"),
        ('a="3"', 'a="1e300"', "write a finite number"),
        ('id="1"', 'id="1&#10;2"', "printable characters"),
        ('id="1"', f'id="{"1" * 65}"', "at most 64"),
        ('a="3"', 'a="1_0"', "write a finite number"),
        ('id="-1"', 'id="-1.5"', "write a whole number"),
        ('id="-1"', 'id="-+1"', "write a whole number"),
        ("</lane></right>", "</lane>" + "".join(f'<lane id="-{n}"/>' for n in range(2, 300)) + "</right>", "64 lanes"),
        ('id="-1"', 'id="-2"', "no lane -1"),
        ('id="-1"', 'id="1"', "wrong side"),
        ("<planView>", "<link><successor elementType='river' elementId='2'/></link><planView>", "elementType='river'"),
        ("<planView>", "<link><successor elementType='road' elementId='2'/></link><planView>", "no attribute contact"),
        ('laneSection s="0"', 'laneSection s="20.0000004"', None),
        ("<OpenDRIVE>", '<!DOCTYPE x [<!ENTITY a "b">]><OpenDRIVE>', "document type"),
        ("<OpenDRIVE>", "<OpenDRIVE>&a;", "not well-formed"),
        ('version="1.0"', 'version="1.0" encoding="klingon"', "unknown encoding"),
        ("OpenDRIVE>", "svg>", "not an OpenDRIVE map"),
        ("<lanes>", "<lanes><laneOffset s='0' a='1' b='0' c='0' d='0'/>", None),
        ("</road>", "</road>" + "<a>" * 40, "nested deeper"),
        ("</road>", "</road><road id='1' length='1'/>", "no geometry"),
        ("</road>", "</road><junction id='5'/><junction id='5'/>", "two junctions have the id 5"),
        ('laneSection s="0"', 'laneSection s="21"', "begins at s=21"),
        ("road", "rood", "no roads"),
    ],
)
def test_a_bad_map_ends_in_a_sentence(old: str, new: str, message: str | None) -> None:
    """Each fault of a file raises UserError with the file's name and the fault; a valid change raises nothing."""
    assert old in SMALL
    content = SMALL.replace(old, new).encode()
    if message is None:
        parse_map(content, "m.xodr")
        return
    with pytest.raises(UserError, match=message) as caught:
        parse_map(content, "m.xodr")
    assert str(caught.value).startswith("m.xodr")


def test_borders_with_a_lane_offset_are_rejected() -> None:
    """OpenDRIVE does not define lane borders together with a lane offset."""
    content = SMALL.replace("<width", "<border").replace(
        "<lanes>", "<lanes><laneOffset s='0' a='1' b='0' c='0' d='0'/>"
    )
    with pytest.raises(UserError, match="borders"):
        parse_map(content.encode(), "m.xodr")


@given(st.data())
@settings(max_examples=60)
def test_damaged_maps_raise_nothing_but_user_errors(data: st.DataObject) -> None:
    """A map with a part overwritten or cut out is read, or raises UserError."""
    content = HAMLET.read_bytes()
    at = data.draw(st.integers(0, len(content)))
    length = data.draw(st.integers(0, 60))
    damage = data.draw(st.one_of(st.binary(max_size=20), st.sampled_from([b"", b"-9", b"1e400", b'"/>', b"<road>"])))
    with contextlib.suppress(UserError):
        parse_map(content[:at] + damage + content[at + length :], "m.xodr")


@pytest.mark.parametrize(
    ("name", "message"), [("none.xodr", "cannot be read"), ("a\0b", "cannot be read"), (".", "cannot")]
)
def test_a_file_that_cannot_be_read_is_named(tmp_path: Path, name: str, message: str) -> None:
    """A missing file, an impossible path or a directory raises UserError."""
    with pytest.raises(UserError, match=message):
        read_map(str(tmp_path / name))


def test_breaks_of_a_road_are_where_its_shape_changes() -> None:
    """Between two stations, every beginning of an element of the plan view or of a lane offset is a break."""
    plan = '<geometry s="8" x="8" y="0" hdg="0" length="12"><line/></geometry></planView>'
    offsets = "".join(f'<laneOffset s="{s_m}" a="0" b="0" c="0" d="0"/>' for s_m in (0, 5, 10))
    text = SMALL.replace('hdg="0" length="20"', 'hdg="0" length="8"').replace("</planView>", plan)
    road = parse_map(text.replace("<lanes>", f"<lanes>{offsets}").encode(), "m.xodr").road("1")
    assert sorted(road.shape_breaks_m(0.0, 20.0)) == [5.0, 8.0, 10.0]
    assert road.shape_breaks_m(5.0, 10.0) == [8.0]


def test_a_pipe_is_rejected(tmp_path: Path) -> None:
    """A pipe is rejected without waiting for its writer."""
    os.mkfifo(tmp_path / "pipe.xodr")
    with pytest.raises(UserError, match="is a pipe"):
        read_map(str(tmp_path / "pipe.xodr"))


def test_large_files_are_rejected(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files and documents beyond the limits are rejected."""
    path = tmp_path / "m.xodr"
    path.write_text(SMALL)
    monkeypatch.setattr(xml_tree, "MAX_ELEMENTS", 5)
    with pytest.raises(UserError, match="more than 5 elements"):
        reader.read_map(str(path))
    monkeypatch.setattr(xml_tree, "MAX_BYTES", 100)
    with pytest.raises(UserError, match="larger than"):
        reader.read_map(str(path))
