from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lavt.domain import NS_PER_S, Now
from lavt.errors import WorkError
from lavt.experiment import tabular
from lavt.experiment.breakdown import breakdown, capture_to_stamp_ms
from lavt.experiment.figure_style import condition_colours
from lavt.experiment.record import RecordWriter, read_record
from lavt.experiment.report import write_report
from lavt.experiment.report_drives import received_pictures
from lavt.experiment.report_tables import hop_table
from lavt.experiment.results import run_result, write_json
from lavt.nodes.reports import VideoUnit

MakeRun = Callable[..., Path]


def add_run(make_run: MakeRun, sweep: Path, name: str, *, time: str = "virtual", **settings: Any) -> None:
    condition, video_ms = settings.pop("condition", "L0"), settings.pop("video_ms", 0.0)
    directory = make_run(sweep / "runs" / name, tau_v_ms=62.0 + video_ms, **settings)
    identity = {
        "run": name,
        "time": time,
        "injection": "model" if time == "virtual" else "relay",
        "inherent": "paper_wifi5",
        "route": "A <key>",
        "condition": condition,
        "controller": "lane",
        "preset": "designed",
        "seed": 1,
        "injected_ms": {"video": video_ms, "control": 0.0},
    }
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    write_json(directory / "result.json", run_result(identity, server, client))


@pytest.fixture(scope="module")
def sweep(make_run: MakeRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Give a sweep and its report: three virtual runs, of which one ends early, three in real time, one unfinished."""
    directory = tmp_path_factory.mktemp("sweep")
    add_run(make_run, directory, "0", seconds=3.0)
    add_run(make_run, directory, "1", seconds=3.0, condition="L1", video_ms=75.0)
    add_run(make_run, directory, "2", seconds=2.0, condition="L1", video_ms=75.0, ending="collision", wobble_m=2.0)
    add_run(make_run, directory, "3", seconds=3.0, time="real", bound_s=0.003)
    add_run(make_run, directory, "5", seconds=3.0, time="real", client_clock=lambda _second: {"correction_s": None})
    add_run(
        make_run, directory, "6", seconds=3.0, time="real", server_host="a", client_host="a", offset_s=0.0, drift=0.0
    )  # fmt: skip
    (directory / "runs" / "4").mkdir()
    write_report(directory, speed={"simulated_s": 30.0, "wall_s": 10.0, "jobs": 2})
    return directory


def page_of(sweep: Path) -> str:
    return (sweep / "report" / "index.html").read_text()


def test_the_report_is_whole(sweep: Path) -> None:
    """The page, every figure it names, and the summary are there; nothing on the page comes from a network."""
    html = page_of(sweep)
    images = re.findall(r'src="([^"]+)"', html)
    assert {"loop.png", "injected.png", "hops_virtual.png", "time_virtual.png", "route_A_key_virtual.png"} <= set(
        images
    )
    assert "route_A_key_real.png" in images
    for image in images:
        assert (sweep / "report" / image).read_bytes().startswith(b"\x89PNG")
    assert "http" not in html
    assert "3.0 times as fast" in html
    summary = json.loads((sweep / "summary.json").read_text())
    assert summary["conditions"]["L1"]["completion_rate"] == 0.5
    assert summary["conditions"]["L1"]["injected_ms"]["video"] == 75.0
    assert summary["speed"]["jobs"] == 2


def test_real_and_virtual_runs_have_tables_of_their_own(sweep: Path) -> None:
    """The page says of each table whether time was real and who injected; an invalid run is named with its reason."""
    html = page_of(sweep)
    assert "virtual time, fidelity video: network and clocks are modelled" in html
    assert "real time, injected by relay" in html
    assert "not valid: the offset between the clocks is only known to 6.00 ms" in html


def test_two_clocks_are_told_with_source_bound_and_drift(sweep: Path) -> None:
    """Of runs on two machines the page has Delta, its source, bound and drift, and the probe's Delta; of others not."""
    clocks = page_of(sweep).partition("Clocks of two machines")[2].partition("Versions and machine")[0]
    rows = re.findall(r"<tr><td.*?</tr>", clocks.replace("\n", ""))
    cells = [[re.sub("<[^>]*>|\xa0", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row)] for row in rows]
    assert [row[:2] for row in cells] == [["3", "chrony"], ["5", "probe"]]
    assert cells[0][2:4] == ["250.030±6.000", "20.00"]
    assert [cell.partition("±")[0] for cell in (cells[0][4], cells[1][2], cells[1][4])] == ["250.030"] * 3
    assert "half the round trip" in clocks


def test_names_cannot_become_html(sweep: Path) -> None:
    """Whatever a route or a run is called, the page shows it as text."""
    html = page_of(sweep)
    assert "A &lt;key&gt;" in html
    assert "<key>" not in html


def test_a_report_made_again_keeps_the_speed(sweep: Path) -> None:
    """A second report of the same runs gives the same summary, the speed of the sweep included."""
    first = (sweep / "summary.json").read_bytes()
    write_report(sweep)
    assert (sweep / "summary.json").read_bytes() == first


def test_unfinished_runs_are_left_out_and_named(sweep: Path) -> None:
    """A run without a result is named as left out; a directory without any finished run is an error."""
    assert "did not finish: 4." in page_of(sweep)
    with pytest.raises(WorkError, match=r"no finished run"):
        write_report(sweep / "report")


def test_the_shares_of_the_loop_are_those_recorded(make_run: MakeRun, tmp_path: Path) -> None:
    """Hops keep their recorded durations, what was before the stamp is left out, and the shares sum to the loop."""
    make_run(tmp_path, seconds=3.0)
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    shares = breakdown(server, client, run_result({}, server, client))
    milliseconds = {(node, hop): duration_ms for node, hop, duration_ms in shares}
    assert milliseconds["driver", "decode"] == pytest.approx(2.0)
    assert milliseconds["receiver", "reorder and depacketize"] == pytest.approx(6.0)
    nodes = [node for node, _, _ in shares]
    assert nodes.index("driver") == nodes.index("receiver") + 1
    assert milliseconds["camera", "encode"] == pytest.approx(4.0)
    assert ("camera", "capture") not in milliseconds
    assert milliseconds["network", "control link"] == pytest.approx(9.0, abs=1e-3)
    assert sum(milliseconds.values()) == pytest.approx(76.0, abs=1e-3)


def test_what_is_before_the_stamp_is_in_the_table_only(make_run: MakeRun, tmp_path: Path, sweep: Path) -> None:
    """From capture to stamp is a row of the table of hops and no share of the loop; unknown where no camera told."""
    make_run(tmp_path, seconds=3.0, capture_ms=7.5)
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    assert capture_to_stamp_ms(server) == 7.5
    shares = breakdown(server, client, run_result({}, server, client))
    assert sum(duration_ms for _, _, duration_ms in shares) == pytest.approx(76.0, abs=1e-3)
    row = "camera: capture to stamp, before the loop"
    assert row in hop_table({"L0": shares}, {"L0": 7.5})
    assert "7.50" in hop_table({"L0": []}, {"L0": 7.5})
    assert capture_to_stamp_ms(read_record(sweep / "runs" / "0" / "server.mcap")) is None
    assert re.search(f"{row}.*?unknown", page_of(sweep).replace("\n", " "))


def test_received_pictures_are_decoded(tmp_path: Path) -> None:
    """Four pictures, evenly spread, come out of the recorded video; a record without video has none."""
    h264 = pytest.importorskip("lavt.transport.h264")
    writer = RecordWriter(tmp_path / "client.mcap", "client")
    writer.close()
    assert received_pictures(tmp_path / "client.mcap") == []
    writer = RecordWriter(tmp_path / "client.mcap", "client")
    encoder = h264.Encoder(width_px=320, height_px=240, rate_hz=30.0, bit_rate_bps=1_000_000, gop_frames=30)
    for index in range(8):
        picture = np.full((240, 320, 3), 20 * index + 40, np.uint8)
        unit = encoder.encode(picture)
        writer.write("video", VideoUnit(index * NS_PER_S, unit), Now(index, index))
    writer.close()
    pictures = received_pictures(tmp_path / "client.mcap")
    assert [text for text, _ in pictures] == ["1.0 s", "3.0 s", "5.0 s", "7.0 s"]
    assert [round(float(picture.mean()) / 20) for _, picture in pictures] == [3, 5, 7, 9]


def test_every_condition_has_a_colour_of_its_own() -> None:
    """However many conditions there are, no two share a colour, and the order they come in does not matter."""
    names = [f"L{index}" for index in range(20)]
    colours = condition_colours(names)
    assert len({str(colour) for colour in colours.values()}) == 20
    assert condition_colours(["L5", "L0"]) == condition_colours(["L0", "L5"])


def test_what_is_undefined_is_a_dash() -> None:
    """A number, a share, an interval or a latency that is not known is shown as a dash, and a bound as unknown."""
    nothing = {"p5": None, "p50": None, "p95": None, "bound": None, "n": 0}
    dashes = [tabular.number(None), tabular.percent(None), tabular.interval(None), tabular.latency(nothing)]
    assert dashes == [tabular.NOTHING] * 4
    unbounded = tabular.latency({"p5": 1.0, "p50": 2.0, "p95": 3.0, "bound": None, "n": 1})
    assert unbounded.replace(tabular.UNBROKEN, " ") == "2.0 ± unknown (1.0 to 3.0)"


def test_a_run_of_which_nothing_is_known_is_reported(tmp_path: Path) -> None:
    """Records without any message give a report all the same: nothing measured, and the reasons why it is not valid."""
    directory = tmp_path / "runs" / "0"
    directory.mkdir(parents=True)
    RecordWriter(directory / "server.mcap", "server").close()
    RecordWriter(directory / "client.mcap", "client").close()
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    identity = {"run": "0", "time": "real", "injection": "none", "route": "A", "condition": "L0"}
    write_json(directory / "result.json", run_result(identity, server, client))
    html = write_report(tmp_path).read_text()
    assert "real time, nothing injected" in html
    assert "the record has no ending" in html
