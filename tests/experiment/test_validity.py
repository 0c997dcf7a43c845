from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.metrics import measure
from lavt.experiment.record import read_record
from lavt.experiment.results import IDENTITY, MEASURES, run_result, write_json
from lavt.experiment.validity import injection_reasons, invalid_because

MakeRun = Callable[..., Path]


def reasons(make_run: MakeRun, directory: Path, **settings: Any) -> list[str]:
    make_run(directory, **settings)
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    return invalid_because(server, client, measure(server, client))


def test_a_good_run_is_valid(make_run: MakeRun, tmp_path: Path) -> None:
    """A run in which the infrastructure did its work is valid, however it ended."""
    assert reasons(make_run, tmp_path / "a") == []
    assert reasons(make_run, tmp_path / "b", ending="collision", wobble_m=3.0) == []


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"server_counts": (("record_overflow", 3),)}, "the record of the server lost 3 messages"),
        ({"step_s": 0.02}, "the wall clock of the client stepped by +20.0 ms"),
        ({"bound_s": None, "probes": False}, "the offset between the clocks has no bound"),
        ({"bound_s": 0.0011}, "only known to 2.20 ms"),
        ({"late": 3}, "the physics was 180 ms late in all"),
        ({"skipped": 10}, "the camera missed 10 of 361 ticks"),
        ({"ending": None}, "the record has no ending"),
        ({"server_unpolled_s": (4, 6)}, "the clock of the server was not sampled for 3.0 s"),
        ({"server_unpolled_s": (-1, 3)}, "the clock of the server was not sampled for 3.0 s"),
        ({"server_unpolled_s": (10, 15)}, "the clock of the server was not sampled for 3.0 s"),
        ({"server_unpolled_s": (-1, 15)}, "the clock of the server was not sampled for 12.0 s"),
        ({"client_unpolled_s": (4, 6)}, "the clock of the client was not sampled for 3.0 s"),
        ({"client_unpolled_s": (6, 15)}, "the clock samples of the client reach over 6.0 s of a drive of 12.0 s"),
        ({"client_unpolled_s": (-1, 15)}, "the clock samples of the client reach over 0.0 s of a drive of 12.0 s"),
    ],
)
def test_each_fault_of_the_infrastructure_is_told(
    make_run: MakeRun, tmp_path: Path, settings: dict[str, Any], said: str
) -> None:
    """Each fault of the infrastructure makes the run invalid, with a sentence that says which."""
    assert [reason for reason in reasons(make_run, tmp_path, **settings) if said in reason]


@pytest.mark.parametrize(
    "settings",
    [
        {"late": 1},
        {"skipped": 3, "server_counts": (("record_overflow", 0),)},
        {"step_s": 0.0005},
        {"server_unpolled_s": (4, 5), "client_unpolled_s": (7, 8)},
        {"server_unpolled_s": (-1, 2)},
        {"server_unpolled_s": (11, 15)},
    ],
)
def test_small_faults_are_borne(make_run: MakeRun, tmp_path: Path, settings: dict[str, Any]) -> None:
    """Fewer than 1 % of the ticks missed, a clock moved by less than the bounds, or one missed poll leave it valid."""
    assert reasons(make_run, tmp_path, **settings) == []


def test_a_loop_that_does_not_close_is_told(make_run: MakeRun, tmp_path: Path) -> None:
    """Where the commands name other times than the pictures were read at, the sum misses the loop: invalid."""
    make_run(tmp_path / "a")
    make_run(tmp_path / "b", tau_v_ms=64.5)
    server, client = read_record(tmp_path / "a" / "server.mcap"), read_record(tmp_path / "b" / "client.mcap")
    said = invalid_because(server, client, measure(server, client))
    assert said == ["the parts of the loop miss the whole by 2.50 ms (p95, limit 1.0 ms)"]


def test_a_cut_record_is_told(make_run: MakeRun, tmp_path: Path) -> None:
    """A record that was never finished makes the run invalid."""
    path = make_run(tmp_path) / "client.mcap"
    path.write_bytes(path.read_bytes()[:-100])
    server, client = read_record(tmp_path / "server.mcap"), read_record(path)
    assert "the record of the client is not complete" in invalid_because(server, client, measure(server, client))


def test_injection_is_held_against_what_was_asked() -> None:
    """A measured delay more than 1 ms from the one asked for, or none at all, is a reason."""
    assert injection_reasons({"video": 75.0, "control": 0.0}, {"video": 75.6, "control": 0.2}) == []
    assert injection_reasons({"video": 75.0}, {"video": 60.0}) == ["video was delayed by 60.0 ms where 75 ms was asked"]
    assert injection_reasons({"control": 0.0}, {}) == ["nobody measured the injected delay of control"]


def test_a_result_has_every_key(make_run: MakeRun, tmp_path: Path) -> None:
    """`result.json` has every key, null where it does not apply, and is JSON without NaN."""
    make_run(tmp_path)
    identity = {"run": "0001", "time": "virtual", "route": "A key", "condition": "L0", "seed": 7}
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    result = run_result(identity, server, client, digest="ab", reasons=["the relay died"])
    write_json(tmp_path / "result.json", {**result, "mae_m": float("nan")})
    read = json.loads((tmp_path / "result.json").read_text())
    assert list(read) == [*IDENTITY, "digest", "ending", "valid", "invalid_because", *MEASURES]
    assert read["participant"] is None
    assert read["mae_m"] is None
    assert (read["valid"], read["invalid_because"]) == (False, ["the relay died"])
