from __future__ import annotations

import csv
import json
import re
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from markupsafe import Markup, escape

from lavt.domain import NS_PER_S, Now
from lavt.errors import WorkError
from lavt.experiment.analysis.drive_data import DriveData, capture_to_stamp_ms, read_drive
from lavt.experiment.analysis.results import read_json, run_result, write_json
from lavt.experiment.report import html_page, table_format
from lavt.experiment.report.figures.figure_style import condition_colours
from lavt.experiment.report.replay_section import largest_error_s, least_and_most_delayed
from lavt.experiment.report.report import write_report
from lavt.experiment.report.run_sections import received_pictures, setting_text
from lavt.experiment.report.sections import ReportContext
from lavt.experiment.report.tables import machine_table, stage_table
from lavt.nodes.payloads import VideoUnit
from lavt.recording.record import RecordWriter, read_record

MakeRun = Callable[..., Path]

ROUTE = "A <script>alert('1')</script> & \"key\" $^$"
"""A route name with special characters of HTML and of mathematical text in figures."""

FAILED_RUNS = [{"run": "<b>5</b>", "reason": '<img src=x onerror="alert(1)"> & more'}]
"""A failed run whose name and reason have special characters of HTML."""


CHAPTERS = ("results", "trajectories", "latency", "statistics", "validity", "every_run")


def add_run(make_run: MakeRun, sweep: Path, name: str, *, time: str = "virtual", **settings: Any) -> None:
    condition, video_ms = settings.pop("condition", "L0"), settings.pop("video_ms", 0.0)
    directory = make_run(sweep / "runs" / name, tau_v_ms=62.0 + video_ms, **settings)
    identity = {
        "run": name,
        "time": time,
        "injection": "model" if time == "virtual" else "relay",
        "inherent": "paper_wifi5",
        "route": ROUTE,
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
    """Return a sweep with its report: three virtual runs (one ends early), three in real time, and one unfinished."""
    directory = tmp_path_factory.mktemp("sweep")
    add_run(make_run, directory, "0", seconds=3.0)
    add_run(make_run, directory, "1", seconds=3.0, condition="L1", video_ms=75.0)
    add_run(
        make_run, directory, "2", seconds=2.0, condition="L1", video_ms=75.0, ending="collision", wave_amplitude_m=2.0
    )
    add_run(make_run, directory, "3", seconds=3.0, time="real", bound_s=0.003)
    add_run(make_run, directory, "5", seconds=3.0, time="real", client_clock=lambda _second: {"correction_s": None})
    add_run(
        make_run, directory, "6", seconds=3.0, time="real", server_host="a", client_host="a", offset_s=0.0, drift=0.0
    )
    (directory / "runs" / "4").mkdir()
    write_report(directory, speed={"simulated_s": 30.0, "wall_s": 10.0, "jobs": 2}, failed=FAILED_RUNS)
    return directory


def page_of(sweep: Path) -> str:
    return (sweep / "report" / "index.html").read_text()


def test_the_report_is_complete(sweep: Path) -> None:
    """The report has the page, all files it links to, and the summary; the page loads nothing from a network."""
    html = page_of(sweep)
    figures = set(re.findall(r'<img data-name="([^"]+)" src="data:image/', html))
    assert figures == {
        "headline",
        "degradation",
        "degradation_age",
        "injected",
        "stages_virtual",
        "stages_real",
        "time_virtual",
        "time_real",
        "survival_virtual",
        "survival_real",
        "incidence_virtual",
        "incidence_real",
        "trajectories_whole_virtual",
        "trajectories_whole_real",
        "cross_track_whole_virtual",
        "cross_track_whole_real",
    }
    for figure in figures:
        assert (sweep / "report" / f"{figure}.png").read_bytes().startswith(b"\x89PNG")
        assert "<text" in (sweep / "report" / f"{figure}.svg").read_text()
    linked = set(re.findall(r'href="([^"#]+)"', html))
    assert {f"{figure}.{ending}" for figure in figures for ending in ("svg", "png")} < linked
    assert {"tables/runs.csv", "tables/runs.tex", "tables/conditions_real_driving.csv"} < linked
    assert all((sweep / "report" / name).is_file() for name in linked)
    assert not re.search(r'(?:src|srcset)="(?!data:)', html)
    assert "http" not in re.sub('base64,[^"]+', "", html)
    assert "3.0 times as fast" in html
    summary = json.loads((sweep / "summary.json").read_text())
    assert summary["conditions"]["L1"]["completion_rate"] == 0.5
    assert summary["conditions"]["L1"]["injected_ms"]["video"] == 75.0
    assert summary["speed"]["jobs"] == 2


def test_the_page_links_to_its_chapters_in_order(sweep: Path) -> None:
    """The page links to each of its chapters, which fold; those of results and trajectories are open."""
    html = page_of(sweep)
    names = re.findall(r'<div class="inside" id="([^"]+)"', html)
    links = re.findall(r'<a href="#([^"]+)"', html.partition("<nav>")[2])
    assert links == names == [f"chapter_{name}" for name in CHAPTERS]
    assert re.findall(r"<details( open)?><summary>", html) == [" open", " open", "", "", "", ""]
    assert re.findall(r'<h3 id="([^"]+)"', html) == [
        "conditions",
        "driving_performance_over_latency",
        "distance_driven_and_endings",
        "results_by_route",
        "trajectories",
        "single_runs",
        "latencies_of_the_conditions",
        "injected_and_measured_latency",
        "latency_of_each_stage",
        "planned_contrasts",
        "errors_of_lane_keeping",
        "valid_and_invalid_runs",
        "clock_offset_between_two_machines",
        "versions_and_machines",
        "all_runs",
    ]


def test_the_first_screen_says_what_was_run(sweep: Path) -> None:
    """Before the chapters come what was run, the headline figure, the findings, the replay and the legend."""
    first = page_of(sweep).partition("<nav>")[0]
    places = [first.index(part) for part in ("runs in virtual time", 'data-name="headline"', "<ul", "<video", "<dl")]
    assert places == sorted(places)
    assert '<a href="#chapter_validity">See why.</a>' in first
    assert "Loop latency" in first


def test_the_first_screen_has_speed_lane_width_and_date(sweep: Path) -> None:
    """Speed, lane width and date are from the records; the speed is left out if not all runs are drawn."""
    first = page_of(sweep).partition("<nav>")[0]
    assert "The median speed of a run is 29 km/h. The runs in real time were driven on 2023-11-14 (UTC)." in first
    drives = [read_drive(sweep / "runs" / name, read_json(sweep / "runs" / name / "result.json")) for name in "03"]
    faster = replace(
        drives[1].truth, columns={**drives[1].truth.columns, "speed_mps": np.full(len(drives[1].truth), 10)}
    )
    sets = {("virtual", ""): drives[:1], ("real", ""): [replace(drives[1], truth=faster)]}
    runs = [{**drive.result, "lane_kept": {"lane_width_m": 3.494}} for drive in drives]
    report = ReportContext({"runs": runs}, sweep, {})
    text = "The median speed of a run is 29 to 36 km/h. The lanes are 3.5 m wide. The runs in real time"
    assert setting_text(report, sets).startswith(text)
    assert setting_text(report, {("virtual", ""): drives[:1]}) == "The lanes are 3.5 m wide."


def test_texts_of_figures_are_legible_on_a_phone(sweep: Path) -> None:
    """On a screen of 390 px, where a figure is 368 px wide, each text of a figure has at least 11 px."""
    for path in (sweep / "report").glob("*.svg"):
        svg = path.read_text()
        width = re.search(r'viewBox="0 0 ([0-9.]+) ', svg)
        sizes = [float(size) for size in re.findall(r"font-size: ([0-9.]+)px", svg)]
        assert width is not None
        assert sizes, path
        assert min(sizes) * 368 / float(width[1]) >= 11, path


def test_a_wide_table_has_its_titles_in_each_row(sweep: Path) -> None:
    """On a narrow screen each row of a wide table is a list of titles and cells; a small table remains a table."""
    html = page_of(sweep)
    wide, *_ = re.findall(r'<table class="wide">.*?</table>', html, re.DOTALL)
    row = wide.partition("<tbody>")[2].partition("</tr>")[0]
    assert row.count("<td") == row.count("data-title=") == wide.count("<th") - 1  # without <thead>
    assert '<td class="text" data-title="condition">L0</td>' in row
    routes = html.partition('id="results_by_route"')[2].partition("</table>")[0]
    assert "data-title" not in routes


def test_a_table_hides_columns_behind_a_switch(sweep: Path) -> None:
    """The page shows the main columns of a table; a switch shows the rest, which the CSV always has."""
    html = page_of(sweep)
    driving = html.partition("lane invasions / run</th>")[0].rpartition("<table")[2]
    assert '<th class="extra">95 %, these routes</th>' in driving
    assert "<th>runs</th>" in driving
    assert 'type="checkbox"> all ' in html


def test_a_note_on_hidden_columns_is_behind_their_switch(sweep: Path) -> None:
    """A note that explains only hidden columns is inside the table's switch, once for each table, and nowhere else."""
    html = page_of(sweep)
    section = html.partition('id="conditions"')[2].partition("<h3")[0]
    notes = re.findall(r'<p class="note extra">([^<]*)</p></div>', section)
    assert len(notes) == section.count("The intervals “these routes”") == section.count("<table") == 2
    assert ".table:has(> .switch > input:checked) p.extra { display: block; }" in html


def test_the_figures_of_a_route_are_side_by_side(sweep: Path) -> None:
    """The trajectories of up to three routes and their errors are a row; the figures of a section leave no gap."""
    section = page_of(sweep).partition('id="trajectories"')[2].partition("<h3")[0]
    rows = [re.findall('data-name="([^"]+)"', row) for row in section.split('<div class="figures two">')[1:]]
    assert rows == [
        [f"{name}_whole_{kind}" for name in ("trajectories", "cross_track")] for kind in ("virtual", "real")
    ]
    assert [str(html_page.figures([Markup()] * count)).split('"')[1] for count in (1, 2, 3, 4, 6)] == [
        "figures",
        "figures two",
        "figures three",
        "figures two",
        "figures three",
    ]


def test_figures_follow_the_scheme_of_the_page(sweep: Path) -> None:
    """Each SVG exchanges its background and its ink if the page is dark."""
    svg = (sweep / "report" / "headline.svg").read_text()
    assert svg.count("prefers-color-scheme:dark") == 1


def test_the_replay_is_a_video(sweep: Path) -> None:
    """The page plays the replay of the runs with the least and the most delay, and names them."""
    html = page_of(sweep)
    assert len(re.findall(r'<video src="data:video/mp4;base64,', html)) == 1
    assert '<a href="replay.mp4">MP4</a>' in html
    for colour, meaning in (("#50c850", "the lane that the driver detected"), ("#ffc850", "where the rear axle was")):
        assert f'<i style="background: {colour}"></i> {meaning}' in html
    assert "The runs 0 and 1" in html
    assert re.search(r"a still picture shows the moment [0-9.]+ s after the start, when L1 is farthest", html)
    video = cv2.VideoCapture(str(sweep / "report" / "replay.mp4"))
    assert int(video.get(cv2.CAP_PROP_FRAME_COUNT)) > 20


def test_the_poster_shows_the_largest_error(sweep: Path) -> None:
    """Before it plays and on paper, the replay shows the moment of the largest error of the run with the most delay."""
    directory = sweep / "runs" / "2"
    drive = read_drive(directory, read_json(directory / "result.json"))
    time_s = largest_error_s(drive)
    index = int(np.searchsorted(drive.truth.ints("mono_ns"), drive.began_ns + round(time_s * NS_PER_S)))
    error_m = np.abs(drive.truth.floats("cross_track_m"))
    assert error_m[index] == error_m.max() > 1.5
    html = page_of(sweep)
    poster = re.search(r' poster="(data:image/jpeg;base64,[^"]+)"', html)
    assert poster is not None
    assert f'<img class="printed" src="{poster[1]}"' in html
    picture = cv2.imread(str(sweep / "report" / "replay.jpg"))
    assert picture is not None
    assert picture.shape[1] == 960


def test_the_runs_with_the_least_and_most_delay_are_shown(sweep: Path, tmp_path: Path) -> None:
    """Runs of different routes or repetitions are not compared, and runs without delay give no replay."""
    drive = read_drive(sweep / "runs" / "0", read_json(sweep / "runs" / "0" / "result.json"))

    def change(directory: Path = drive.directory, video_ms: float = 0.0, **keys: Any) -> DriveData:
        return replace(drive, directory=directory, result={**drive.result, "injected_ms": {"video": video_ms}, **keys})

    none, little, most = change(), change(video_ms=75.0), change(video_ms=225.0)
    assert least_and_most_delayed([little, most, none]) == [none, most]
    assert least_and_most_delayed([none, change(video_ms=75.0, repetition=1)]) == []
    assert least_and_most_delayed([none, change(video_ms=75.0, route="b")]) == []
    assert least_and_most_delayed([none, change(video_ms=75.0, fidelity="geometry")]) == []
    assert least_and_most_delayed([none, change(tmp_path, 75.0)]) == []
    assert least_and_most_delayed([none, none]) == []


@pytest.mark.full
def test_a_report_is_byte_for_byte_reproducible(sweep: Path) -> None:
    """A second report of the same runs, from drives that are already read, has the same bytes in each file.

    The second summary has the same bytes, too, including the speed of the sweep.
    """
    before, summary = files_of(sweep), (sweep / "summary.json").read_bytes()
    assert len(before) > 40
    directories = [sweep / "runs" / name for name in "012356"]
    drives = {directory: read_drive(directory, read_json(directory / "result.json")) for directory in directories}
    write_report(sweep, drives=drives, failed=FAILED_RUNS)
    assert files_of(sweep) == before
    assert (sweep / "summary.json").read_bytes() == summary


def files_of(sweep: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted((sweep / "report").rglob("*.*"))}


def test_csv_files_have_exact_numbers(sweep: Path) -> None:
    """The CSV of a table has all digits of each number, two columns for an interval, and no text for unknown values."""
    summary = json.loads((sweep / "summary.json").read_text())
    with (sweep / "report" / "tables" / "conditions_virtual_driving.csv").open(newline="") as file:
        rows = {row["condition"]: row for row in csv.DictReader(file)}
    entry = summary["conditions"]["L1"]
    interval = [float(rows["L1"][f"95 %, these routes {end} (share)"]) for end in ("low", "high")]
    assert interval == entry["completion_interval"]
    assert float(rows["L1"]["lane invasions / km"]) == entry["lane_invasions_per_km"]
    with (sweep / "report" / "tables" / "conditions_virtual_latency.csv").open(newline="") as file:
        latencies = {row["condition"]: row for row in csv.DictReader(file)}
    assert float(latencies["L0"]["τ video ms p50"]) == summary["conditions"]["L0"]["tau_v_ms"]["p50"]
    with (sweep / "report" / "tables" / "conditions_virtual_error.csv").open(newline="") as file:
        errors = {row["condition"]: row for row in csv.DictReader(file)}
    assert float(errors["L1"]["maximum m, mean of runs"]) == summary["conditions"]["L1"]["max_m"]
    assert errors["L1"]["p95 m, all runs ranked p75"] == ""


def test_real_and_virtual_runs_have_separate_tables(sweep: Path) -> None:
    """The tables say whether time is virtual or real, and what injects the delay; an invalid run has its reason."""
    html = page_of(sweep)
    assert "Virtual time, fidelity video: modelled network and clocks" in html
    assert "Real time, injected by relay" in html
    assert "invalid: the offset between the clocks is only known to 6.00 ms" in html


def test_the_worst_value_of_each_check_is_shown(sweep: Path) -> None:
    """Beside the limit of each check is the worst value of all runs, with its run, for each kind of time."""
    with (sweep / "report" / "tables" / "checks.csv").open(newline="") as file:
        rows = {row["check"]: row for row in csv.DictReader(file)}
    bound = rows["error bound of the clock offset, ms"]
    assert bound["run in real time"] == "3"
    assert float(bound["worst in real time (limit) value"]) == pytest.approx(6.0)
    assert float(bound["worst in real time (limit) limit"]) == 2.0
    assert float(bound["worst in virtual time (limit) value"]) == pytest.approx(0.4, abs=0.05)
    validity = page_of(sweep).partition('id="valid_and_invalid_runs"')[2].partition("<h3")[0]
    assert "6.00\N{NO-BREAK SPACE}(2.00)" in validity


def test_the_table_of_machines_says_where_the_costs_were_measured() -> None:
    """Of the costs the table has only where they were measured, and it has no empty entries."""
    model = {"costs": '{"measured_on": "2 cores", "stages_us": {}}', "traces": "{}", "condition": "{}"}
    assert machine_table({"model": model}).rows == [["model", "costs measured on", "2 cores"]]
    for damaged in ("", "[]", "{}x", '{"stages_us": {}}'):
        assert machine_table({"model": {"costs": damaged}}).rows == [["model", "costs measured on", "unknown"]]


def test_the_page_has_the_clock_offset_of_two_machines(sweep: Path) -> None:
    """Runs on two machines have the clock offset with source, bound and drift, and the probe's offset."""
    clock_section = (
        page_of(sweep).partition('id="clock_offset_between_two_machines"')[2].partition('id="versions_and_machines"')[0]
    )
    rows = re.findall(r"<tr><td.*?</tr>", clock_section.replace("\n", ""))
    cells = [[re.sub("<[^>]*>|\xa0", "", cell) for cell in re.findall(r"<td[^>]*>(.*?)</td>", row)] for row in rows]
    run_with_chrony, run_with_probe = cells  # columns: run, source, offset, drift, the probe's offset
    assert run_with_chrony[:4] == ["3", "chrony", "250.030±6.000", "20.00"]
    assert run_with_probe[:2] == ["5", "probe"]
    offsets = (run_with_chrony[4], run_with_probe[2], run_with_probe[4])
    assert [offset.partition("±")[0] for offset in offsets] == ["250.030"] * 3
    assert "half the round trip" in clock_section
    header, *_ = (sweep / "report" / "tables" / "clocks.csv").read_text().splitlines()
    assert header.split(",")[2:4] == ["clock offset ms", "clock offset ms bound"]


def test_texts_of_users_are_escaped(sweep: Path) -> None:
    """The page shows names and reasons with special characters of HTML as text, never as markup."""
    html = page_of(sweep)
    assert not re.search("<script|<b>|<img src=x", html)
    assert str(escape(ROUTE)) in html
    assert "<li>&lt;b&gt;5&lt;/b&gt;: &lt;img src=x" in html
    page = PageTexts()
    page.feed(html)
    assert any(ROUTE in text for text in page.texts)
    assert f"{FAILED_RUNS[0]['run']}: {FAILED_RUNS[0]['reason']}" in page.texts
    assert any(ROUTE in text for text in page.alternatives)


class PageTexts(HTMLParser):
    """The texts and the alternative texts of a page, as a browser reads them."""

    def __init__(self) -> None:
        super().__init__()
        self.texts: list[str] = []
        self.alternatives: list[str] = []

    def handle_data(self, data: str) -> None:
        """Collect a text."""
        self.texts.append(data)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        """Collect the alternative text of an image."""
        self.alternatives += [value or "" for name, value in attrs if tag == "img" and name == "alt"]


def test_unfinished_runs_are_left_out_and_named(sweep: Path) -> None:
    """A run without a result is listed as left out; a directory without a finished run is an error."""
    assert "2 runs failed and are left out" in page_of(sweep)
    assert "4: no result" in page_of(sweep)
    with pytest.raises(WorkError, match=r"no finished run"):
        write_report(sweep / "report")


def test_the_table_of_stages_begins_with_capture_to_stamp(make_run: MakeRun, tmp_path: Path, sweep: Path) -> None:
    """The first row of the table of stages has the time from capture to stamp, or a dash if this time is unknown."""
    make_run(tmp_path, seconds=3.0, capture_ms=7.5)
    assert capture_to_stamp_ms(tmp_path / "server.mcap") == 7.5
    assert capture_to_stamp_ms(sweep / "runs" / "0" / "server.mcap") is None
    row = "camera: capture to stamp, before the loop"
    assert list(stage_table({"L0": []}, {"L0": 7.5}).rows) == [[row, 7.5]]
    assert re.search(f"{row}</td><td>–</td>", page_of(sweep))


def test_received_pictures_are_decoded(tmp_path: Path) -> None:
    """Four evenly spaced pictures are decoded from the recorded video; a record without video gives no picture."""
    h264 = pytest.importorskip("lavt.transport.video.h264")
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
    assert [text for text, _ in pictures] == ["0.0 s", "2.0 s", "4.0 s", "6.0 s"]
    indexes = [round((float(picture.mean()) - 40) / 20) for _, picture in pictures]
    assert indexes == [1, 3, 5, 7]


def test_each_condition_has_a_distinct_colour() -> None:
    """No two conditions share a colour, and the colours do not depend on the order of the conditions."""
    names = [f"L{index}" for index in range(20)]
    colours = condition_colours(names)
    assert len({str(colour) for colour in colours.values()}) == 20
    assert condition_colours(["L5", "L0"]) == condition_colours(["L0", "L5"])


def test_an_unknown_value_is_a_dash() -> None:
    """An unknown number, share, interval or latency is shown as a dash, and an unknown bound as "unknown"."""
    nothing = {"p5": None, "p50": None, "p95": None, "bound": None, "n": 0}
    dashes = [
        table_format.format_number(None),
        table_format.format_percent(None),
        table_format.format_interval(None),
        table_format.format_latency(nothing),
    ]
    assert dashes == [table_format.NOTHING] * 4
    unbounded = table_format.format_latency({"p5": 1.0, "p50": 2.0, "p95": 3.0, "bound": None, "n": 1})
    assert unbounded.replace(table_format.UNBROKEN, " ") == "2.0 ± unknown (1.0 to 3.0)"


def test_a_run_with_empty_records_is_reported(tmp_path: Path) -> None:
    """A run whose records have no messages is in the report, as invalid with the reasons."""
    directory = tmp_path / "runs" / "0"
    directory.mkdir(parents=True)
    RecordWriter(directory / "server.mcap", "server").close()
    RecordWriter(directory / "client.mcap", "client").close()
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    identity = {"run": "0", "time": "real", "injection": "none", "route": "A", "condition": "L0"}
    write_json(directory / "result.json", run_result(identity, server, client))
    html = write_report(tmp_path).read_text()
    assert "Real time, nothing injected" in html
    assert "the record has no ending" in html
