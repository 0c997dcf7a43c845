"""Tests of the compliance of a fleet: limits, totals, excluded runs, and the contents of JSON, CSV and page."""

from __future__ import annotations

import csv
import io
import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lavt.errors import UserError
from lavt.experiment.analysis.results import read_json, run_result, write_json
from lavt.experiment.compliance.compliance import (
    FleetCompliance,
    evaluate_fleet,
    recorded_speed_limit,
    write_compliance,
)
from lavt.experiment.compliance.criteria import CRITERIA, ComplianceLimits, parse_thresholds, verdict_of, worst_of
from lavt.experiment.compliance.fleet import fleet_totals
from lavt.experiment.compliance.sentences import finding_sentences, setting_sentences
from lavt.experiment.compliance.tables import csv_table, format_bounds, format_share
from lavt.experiment.report.table_format import UNBROKEN, csv_of
from lavt.recording.record import read_record

MakeRun = Callable[..., Path]
LIMITS = ComplianceLimits(latency_ms=150.0, nominal_mps=10.0)


def add_run(
    make_run: MakeRun, directory: Path, *, time: str = "virtual", controller: str = "lane_keeper", **settings: Any
) -> Path:
    """Write the records and the result of a synthetic drive; the camera reports 8 ms from capture to stamp."""
    make_run(directory, **{"seconds": 1.0, "capture_ms": 8.0, **settings})
    identity = {"run": directory.name, "time": time, "injection": "model", "route": "a", "condition": "L0"}
    identity |= {"fidelity": "video", "driver": "lane_keeper", "inherent": "loopback", "controller": controller}
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    write_json(directory / "result.json", run_result(identity, server, client))
    return directory


@pytest.fixture(scope="module")
def runs(make_run: MakeRun, tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Return runs: two with 62 ms of video latency, one with 130 ms, one invalid, one damaged, one without a drive."""
    directory = tmp_path_factory.mktemp("fleet")
    added = [
        add_run(make_run, directory / "fast"),
        add_run(make_run, directory / "real", time="real"),
        add_run(make_run, directory / "slow", tau_v_ms=130.0),
        add_run(make_run, directory / "invalid", ending=None),
        add_run(make_run, directory / "damaged"),
        add_run(make_run, directory / "broken"),
    ]
    record = directory / "damaged" / "server.mcap"
    record.write_bytes(record.read_bytes()[:-3000])
    (directory / "broken" / "result.json").write_text("{}")
    return added


@pytest.fixture(scope="module")
def fleet(runs: list[Path]) -> FleetCompliance:
    return evaluate_fleet(runs, LIMITS, failed=[{"run": "lost", "reason": "the process died"}])


def test_runs_that_do_not_count(fleet: FleetCompliance) -> None:
    """Failed, invalid and damaged runs are listed with the reason, and enter no total."""
    reasons = {run["run"]: run["reason"] for run in fleet.excluded}
    assert reasons.keys() == {"lost", "invalid", "damaged", "broken"}
    assert reasons["lost"] == "failed: the process died"
    assert "no ending" in reasons["invalid"]
    assert "server.mcap is cut or damaged" in reasons["damaged"]
    assert "not the result of a run" in reasons["broken"]
    assert [drive.entry["run"] for drive in fleet.drives] == ["fast", "real", "slow"]
    assert fleet.content()["fleet"][0]["drives"] == 3


def test_totals(fleet: FleetCompliance) -> None:
    """Totals are sums over drives, and a share is of the time of all; groups are shown if the drives differ in them."""
    content = fleet.content()
    everything, *groups = content["fleet"]
    drives = content["drives"]
    assert [group["group"] for group in groups] == ["real time", "virtual time"]
    assert everything["commanded_s"] == pytest.approx(sum(drive["commanded_s"] for drive in drives))
    above_s = [sum(drive["above_s"][side] for drive in drives) for side in (0, 1)]
    assert 0 < above_s[0] < above_s[1] < 3  # nothing is known before the first command
    assert everything["above_share"] == pytest.approx([time_s / everything["commanded_s"] for time_s in above_s])
    assert everything["verdict"]["above"] == 1
    assert everything["verdict"]["within"] == 2
    assert everything["verdict"]["above_interval"] == pytest.approx(
        [0.0084, 0.9057], abs=1e-3
    )  # Clopper, Pearson: 1 of 3
    assert everything["verdict"]["unit"] == "drive"
    assert everything["mean_above_share_per_drive"]["interval"] is None  # fewer than six drives
    assert everything["verdicts"]["above_share"]["largest"] == drives[2]["above_share"]
    assert content["verdict"] == "above"


def test_json_and_csv(fleet: FleetCompliance) -> None:
    """JSON has no NaN or infinity; CSV has a row for each drive with all digits, and the reasons of excluded runs."""
    content = fleet.content()
    assert json.loads(json.dumps(content, allow_nan=False)) == content
    assert content["schema"] == 1
    assert content["thresholds"].keys() == CRITERIA.keys()
    rows = list(csv.DictReader(io.StringIO(csv_of(csv_table(content)))))
    assert [row["run"] for row in rows] == ["fast", "real", "slow", "lost", "invalid", "damaged", "broken"]
    slow = rows[2]
    assert float(slow["frame age above 150 ms low (share)"]) == content["drives"][2]["above_share"][0]
    assert slow["verdict above_share"] == "above"
    assert slow["excluded because"] == ""
    assert rows[4]["verdict"] == ""
    assert "no ending" in rows[4]["excluded because"]


def test_sentences(fleet: FleetCompliance) -> None:
    """The sentences name verdicts, the longest stretch with its drive, excluded runs and both kinds of time."""
    findings = " ".join(finding_sentences(fleet.content()))
    assert "3 drives: 2 within all thresholds, 1 above at least one, 0 not decided" in findings
    assert "of the drive slow on" in findings
    assert "There was no outage." in findings
    assert "4 more drives do not count" in findings
    setting = " ".join(setting_sentences(fleet.content()))
    assert "1 in real time and 2 in virtual time" in setting
    assert "nominal speed is 36 km/h" in setting


def test_a_drive_in_real_time_has_its_date(fleet: FleetCompliance) -> None:
    """A drive in real time has the server's wall time of its start; one in virtual time has none."""
    fast, real, _ = (drive.entry for drive in fleet.drives)
    assert fast["began"] is None
    assert real["began"] == "2023-11-14T22:13:20+00:00"


def test_the_page_of_a_person_counts(make_run: MakeRun, tmp_path: Path) -> None:
    """If a person drives, the client's record is read: without reports of the page, the two-way latency has bounds."""
    directory = add_run(make_run, tmp_path / "person", controller="human", seconds=0.5)
    entry = evaluate_fleet([directory], LIMITS).drives[0].entry
    low_ms, high_ms = entry["two_way_ms"]["p50"]
    assert high_ms - low_ms >= 3.0  # the client's time in the synthetic drive
    (directory / "client.mcap").write_bytes(b"")
    with pytest.raises(UserError, match=r"client\.mcap is cut or damaged"):
        evaluate_fleet([directory], LIMITS)


def test_a_fleet_without_a_drive(runs: list[Path]) -> None:
    """If no drive is left, the command is rejected with the first reason."""
    with pytest.raises(UserError, match=r"no drive can be judged; the first, invalid: .*no ending"):
        evaluate_fleet(runs[3:5], LIMITS)


def test_six_drives_have_an_interval(fleet: FleetCompliance) -> None:
    """The mean share of six drives that differ has an interval, from that of the lower to that of the upper bounds."""
    drive = fleet.drives[0].entry
    shares = [{**drive, "above_share": (0.1 * number, 0.1 * number + 0.2)} for number in range(6)]
    mean = fleet_totals(shares)[0]["mean_above_share_per_drive"]
    assert mean["mean"] == pytest.approx((0.25, 0.45))
    low, high = mean["interval"]
    assert 0.0 < low < 0.25
    assert 0.45 < high < 0.7
    assert mean["unit"] == "drive"


@pytest.mark.parametrize(
    ("bounds", "threshold", "verdict"),
    [
        ((0.0, 0.0), 0.0, "within"),
        ((0.0, 0.1), 0.1, "within"),
        ((0.0, 0.1), 0.05, "not decided"),
        ((0.1, 0.2), 0.05, "above"),
        ((0.05, 0.2), 0.05, "not decided"),
        ((0.0, math.inf), 5.0, "not decided"),
        ((6.0, math.inf), 5.0, "above"),
    ],
)
def test_verdicts(bounds: tuple[float, float], threshold: float, verdict: str) -> None:
    """A value is within or above a threshold only if both its bounds are."""
    assert verdict_of(bounds, threshold) == verdict


def test_the_worst_verdict() -> None:
    """One criterion above makes the drive above; within needs all of them."""
    assert worst_of(["within", "above", "not decided"]) == "above"
    assert worst_of(["within", "not decided"]) == "not decided"
    assert worst_of(["within", "within"]) == "within"
    assert worst_of([]) == "not decided"


def test_thresholds() -> None:
    """A threshold replaces the default of its criterion only."""
    limits = ComplianceLimits(thresholds=parse_thresholds(["above_share=0.05", "outages=2"]))
    assert [limits.threshold(key) for key in ("above_share", "outages", "manoeuvres")] == [0.05, 2.0, 0.0]


def test_bounds_as_text() -> None:
    """Equal bounds are one number, an open one is "at least", and a small share never looks like none."""
    texts = [format_bounds((1.04, 1.01)), format_bounds((1.0, 2.0)), format_bounds((3.0, None)), format_bounds(None)]
    assert [text.replace(UNBROKEN, " ") for text in texts] == ["1.0", "1.0 to 2.0", "at least 3.0", "–"]
    shares = [
        format_share(bounds) for bounds in ((0.0, 0.0), (1.0, 1.0), (0.25, 0.25), (0.0004, 0.0004), (0.9999, 1.0))
    ]
    assert [text.replace(UNBROKEN, " ") for text in shares] == [
        "0.0 %",
        "100.0 %",
        "25.0 %",
        "0.04 %",
        "99.99 to 100.00 %",
    ]


def test_the_nominal_speed_is_that_of_the_config(tmp_path: Path) -> None:
    """The speed limit of the run's config is the nominal speed; a missing one is the default, a bad one an error."""
    config = tmp_path / "config.yaml"
    assert recorded_speed_limit(config) == pytest.approx(40 / 3.6)
    config.write_text("safety: {speed_limit_mps: 20.0}")
    assert recorded_speed_limit(config) == 20.0
    for text in ("safety: {speed_limit_mps: fast}", "safety: {speed_limit_mps: .nan}", "safety: 7", "{", "- 1"):
        config.write_text(text)
        with pytest.raises(UserError, match="--nominal-kmh"):
            recorded_speed_limit(config)
    with pytest.raises(UserError, match="--nominal-kmh"):
        recorded_speed_limit(tmp_path)


@pytest.mark.full
def test_the_page(fleet: FleetCompliance, tmp_path: Path) -> None:
    """The page is one file that loads nothing, says what it is not, and links to files that exist."""
    page = write_compliance(fleet, tmp_path)
    html = page.read_text(encoding="utf-8")
    assert "It is no certification" in html
    assert "the process died" in html
    assert 'src="http' not in html
    assert 'href="compliance.csv"' in html
    assert html.count('src="data:image/') == 2
    assert all((tmp_path / name).is_file() for name in ("compliance.csv", "compliance.json", "tables/criteria.csv"))
    assert read_json(tmp_path / "compliance.json") == fleet.content()
