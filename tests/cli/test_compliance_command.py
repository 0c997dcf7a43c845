"""Tests of `lavt compliance`: what it rejects, and what a drive with an outage gives."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader
from tests.support.command_line import Run

from lavt.config_file import shipped
from lavt.experiment.analysis.results import IDENTITY_KEYS

BAD_OPTIONS = {
    "a limit of 0": (["--limit-ms", "0"], "--limit-ms is 0: give a positive number of ms"),
    "a negative limit": (["--limit-ms=-5"], "--limit-ms is -5"),
    "a limit that is no number": (["--limit-ms", "nan"], "--limit-ms is nan"),
    "an infinite limit": (["--limit-ms", "inf"], "--limit-ms is inf"),
    "a limit of years": (["--limit-ms", "1e300"], "--limit-ms is 1e+300: give a positive number of ms, at most 1e+06"),
    "an outage of 0": (["--outage-ms", "0"], "--outage-ms is 0"),
    "a nominal speed of 0": (["--nominal-kmh", "0"], "--nominal-kmh is 0: give a positive speed"),
    "a camera of the future": (["--camera-ms=-1"], "--camera-ms is -1"),
    "an unknown criterion": (["--threshold", "fun=1"], "above_share="),
    "a threshold without a number": (["--threshold", "outages=few"], "no valid number"),
    "a negative threshold": (["--threshold", "outages=-1"], "no valid number"),
    "a threshold that is no number": (["--threshold", "outages=nan"], "no valid number"),
}


@pytest.mark.parametrize("case", BAD_OPTIONS)
def test_bad_options(case: str, run: Run) -> None:
    """A limit or threshold that is not valid is rejected, and the sentence names it."""
    options, expected = BAD_OPTIONS[case]
    assert expected in run("compliance", "somewhere", *options).rejection()


def test_bad_directories(run: Run, tmp_path: Path) -> None:
    """A missing directory, one without runs, one that is named twice, or an output that is a file is rejected."""
    assert "nothing has no finished run" in run("compliance", "nothing").rejection()
    (tmp_path / "empty").mkdir()
    assert "empty has no finished run" in run("compliance", "empty").rejection()
    assert "is named 2 times" in run("compliance", "empty", "../" + tmp_path.name + "/empty").rejection()
    (tmp_path / "file").write_text("")
    assert "file/compliance is not a directory" in run("compliance", "empty", "--out", "file").rejection()


@pytest.mark.parametrize(
    ("valid", "record", "expected"),
    [
        (True, None, "there is no record at"),
        (True, b"", "server.mcap is cut or damaged"),
        (True, b"something else", "server.mcap is cut or damaged"),
        (False, None, "invalid: the clock was set"),
        ("yes", None, "result.json does not say that the run is valid"),
    ],
)
def test_damaged_runs(valid: Any, record: bytes | None, expected: str, run: Run, tmp_path: Path) -> None:
    """If the only run has no readable record, or is invalid, the command is rejected with the reason."""
    directory = tmp_path / "damaged"
    directory.mkdir()
    result = {**dict.fromkeys(IDENTITY_KEYS), "run": "damaged", "valid": valid}
    result["invalid_reasons"] = [] if valid else [{"code": "clock_step", "text": "the clock was set"}]
    (directory / "result.json").write_text(json.dumps(result))
    if record is not None:
        (directory / "server.mcap").write_bytes(record)
    assert expected in run("compliance", "damaged").rejection()
    assert not (directory / "compliance").exists()


GAP_S = 9.0
"""The time after which nothing arrives any more, in video and control."""


@pytest.mark.full
def test_a_drive_that_ends_in_an_outage(run: Run, tmp_path: Path) -> None:
    """After a gap in the network, outage, safe stop and distance agree with the raw messages of the record."""
    (tmp_path / "gap.csv").write_text(f"time_s,delay_ms\n0,20\n{GAP_S},20\n{GAP_S + 0.001},4000\n60,4000\n")
    changes = [
        "fidelity=geometry",
        f"network.video.trace={tmp_path}/gap.csv",
        f"network.control.trace={tmp_path}/gap.csv",
    ]
    options = [part for change in changes for part in ("--set", change)]
    assert run("run", str(shipped("configs/demo.yaml")), "--out", "drive", *options).code == 0
    printed = run("compliance", "drive", "--json")
    assert printed.code == 0
    content = json.loads(printed.out)
    assert content == json.loads((tmp_path / "drive/compliance/compliance.json").read_text())
    (drive,) = content["drives"]
    assert drive["fidelity"] == "geometry"

    messages: dict[str, list[dict[str, Any]]] = {}
    with (tmp_path / "drive/server.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages(topics=["/event", "/admission", "/truth", "/frame"]):
            messages.setdefault(channel.topic, []).append(json.loads(message.data))
    times = {event["kind"] + event["detail"].partition(":")[0]: event["mono_ns"] for event in messages["/event"]}
    began_ns, stop_ns = times["drive_began"], times["safetydegraded -> safe_stop"]
    numbers = {frame["stamp_ns"]: frame["number"] for frame in messages["/frame"]}
    newest, last_fresh_ns, last = -1, 0, {}
    for entry in messages["/admission"]:
        if entry["verdict"] == "accepted":
            last = entry
            if numbers[entry["stamp_ns"]] > newest:
                newest, last_fresh_ns = numbers[entry["stamp_ns"]], entry["received_mono_ns"]
    assert drive["outages"] == 1
    (outage,) = drive["outage_list"]
    assert outage["began_s"] == pytest.approx((last_fresh_ns - began_ns) / 1e9)
    assert outage["length_s"] == pytest.approx(0.5)
    (stop,) = drive["manoeuvre_list"]
    assert stop["began_s"] == pytest.approx((stop_ns - began_ns) / 1e9)
    assert stop["ended"] == "standstill"
    truth = messages["/truth"]
    still_ns = next(row["mono_ns"] for row in truth if row["mono_ns"] >= stop_ns and row["speed_mps"] < 0.05)
    assert stop["until_standstill_s"][0] < stop["until_standstill_s"][1] == pytest.approx((still_ns - stop_ns) / 1e9)
    driven_m = [row["progress_m"] for row in truth if stop_ns <= row["mono_ns"] <= still_ns]
    low_m, high_m = stop["distance_m"]
    assert low_m - 0.2 < driven_m[-1] - driven_m[0] < high_m  # up to 20 ms are before the first of these rows
    captured_ns = next(frame["capture_ns"] for frame in messages["/frame"] if frame["stamp_ns"] == last["stamp_ns"])
    assert drive["picture_age_ms"]["max"] == pytest.approx([(stop_ns - captured_ns) / 1e6] * 2)
    assert drive["longest_above_s"] == pytest.approx([(stop_ns - captured_ns) / 1e9 - 0.2] * 2)
    verdicts = drive["verdicts"]
    assert [verdicts[key] for key in ("above_share", "outages", "manoeuvres")] == ["above"] * 3
    assert verdicts["longest_manoeuvre_s"] == "within"
