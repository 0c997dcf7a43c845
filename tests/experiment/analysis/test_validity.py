from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.analysis.clock_validity import step_reasons
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.analysis.results import IDENTITY, MEASURES, run_result, write_json
from lavt.experiment.analysis.validity import injection_reasons, invalid_reasons
from lavt.recording.record import read_record

MakeRun = Callable[..., Path]


def reasons(make_run: MakeRun, directory: Path, **settings: Any) -> list[str]:
    make_run(directory, **settings)
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    return invalid_reasons(server, client, measure(server, client))


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


# The clocks.

SERVER, CLIENT = "10.9.0.1", "10.9.0.2"
GOOD_PATH = {"peer_delay_s": 0.0006, "peer_dispersion_s": 0.00003, "skew_ppm": 4.0, "age_s": 0.5, "poll_s": 1.0}


def following(**changes: Any) -> dict[str, Any]:
    """Give the settings of a run whose client follows its server, as chrony tells it to root."""

    def client(second: int) -> dict[str, Any]:
        path = {**GOOD_PATH, "follows": SERVER, "addresses": [CLIENT], "good_samples": 20 + second}
        return path | {name: told(second) if callable(told) else told for name, told in changes.items()}

    return {"client_clock": client, "server_clock": lambda _second: {"addresses": [SERVER]}}


def test_a_client_that_follows_its_server_is_known_as_well_as_the_path(make_run: MakeRun, tmp_path: Path) -> None:
    """Where one follows the other the bound is half the path's delay, its dispersion, and skew times age."""
    make_run(tmp_path, bound_s=0.5, **following())
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    measured = measure(server, client)
    assert measured.clocks.bound_ms == pytest.approx(0.3 + 0.03 + 0.002, abs=1e-3)
    assert invalid_reasons(server, client, measured) == []


@pytest.mark.parametrize("lacking", ["peer_delay_s", "peer_dispersion_s", "skew_ppm", "age_s"])
def test_without_the_paths_figures_the_bound_is_the_followers_root_distance(
    make_run: MakeRun, tmp_path: Path, lacking: str
) -> None:
    """A chrony that tells one of the path's figures to root only leaves the root distance of the host that follows."""
    make_run(tmp_path, bound_s=0.0004, **following(**{lacking: None}))
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    assert measure(server, client).clocks.bound_ms == pytest.approx(0.4, abs=1e-3)


def test_a_slow_last_sample_does_not_widen_the_bound(make_run: MakeRun, tmp_path: Path) -> None:
    """Where the last sample took long the root distance counts, which goes by the better samples before it."""
    slow = following(peer_delay_s=lambda second: 0.0006 if second % 3 == 0 else 0.02)
    assert reasons(make_run, tmp_path, bound_s=0.0005, **slow) == []


ONE_REASON = {
    "delay on NTP's path before it synchronised": (
        {**following(peer_delay_s=0.0756, correction_s=lambda second: 0.2875 + 20e-6 * second)},
        "the NTP of the client goes through injected delay: its round trip is 75.60 ms, the probe's 0.60 ms "
        "(limit 1.0 ms more)",
    ),
    "delay on NTP's path after it synchronised": (
        {**following(good_samples=lambda second: min(20 + second, 23))},
        "the NTP of the client accepted no sample for 10.0 s (limit 5 polls, 5.0 s): its path is lost or was put "
        "through injected delay, or the machine is too busy",
    ),
    "the server follows the client through delay": (
        {
            "server_clock": lambda _second: {**GOOD_PATH, "follows": CLIENT, "peer_delay_s": 0.1},
            "client_clock": lambda _second: {"addresses": [CLIENT]},
        },
        "the NTP of the server goes through injected delay: its round trip is 100.00 ms, the probe's 0.60 ms "
        "(limit 1.0 ms more)",
    ),
    "chrony forgets the offset": (
        {"corrected": False},
        "chrony and the probe disagree about the offset between the clocks: 0.00 and ",
    ),
    "both say that their own clock is the reference": (
        {"corrected": False, "bound_s": 0.0},
        "chrony and the probe disagree about the offset between the clocks: 0.00 and ",
    ),
    "an external statement that is wrong": (
        {
            "server_clock": lambda _second: {"source": "external", "correction_s": -0.003, "bound_s": 0.001},
            "client_clock": lambda _second: {"source": "external"},
        },
        "external and the probe disagree about the offset between the clocks: ",
    ),
    "no bound, and no probe": (
        {"bound_s": None, "probes": False},
        "the offset between the clocks has no bound",
    ),
    "chrony nowhere, and no probe": (
        {
            "server_clock": lambda _second: {"correction_s": None, "status": "chrony is not installed"},
            "client_clock": lambda _second: {"correction_s": None, "status": "chrony is not synchronised"},
            "probes": False,
        },
        "the offset between the clocks is not known (server: chrony is not installed, client: chrony is not "
        "synchronised), and the probe had no answer",
    ),
    "no probe": (
        {"probes": False},
        "the probe had no answer during the drive, so that nobody has checked the offset between the clocks: open the "
        "server's UDP port clock.probe_port",
    ),
    "two grandmasters": (
        {
            "server_clock": lambda _second: {"source": "ptp", "follows": "a"},
            "client_clock": lambda _second: {"source": "ptp", "follows": "b"},
        },
        "the hosts follow different PTP grandmasters: a and b",
    ),
    "a probe alone, over too long a way": (
        {
            "client_clock": lambda _second: {"source": "probe", "correction_s": None},
            "there_ms": 3.0,
            "back_ms": 3.0,
        },
        "the offset between the clocks is only known to 3.",
    ),
    "the client's clock is set forward": ({"step_s": 1.0}, "the wall clock of the client stepped by +1000.0 ms"),
    "the client's clock is set back": ({"step_s": -1.0}, "the wall clock of the client stepped by -1000.0 ms"),
    "the client's clock is set, and nobody has a source": (
        {"step_s": 1.0, "client_clock": lambda _second: {"source": "probe", "correction_s": None}},
        "the wall clock of the client stepped by +1000.0 ms",
    ),
}


@pytest.mark.parametrize("case", ONE_REASON)
def test_each_fault_of_the_clocks_is_told_once(make_run: MakeRun, tmp_path: Path, case: str) -> None:
    """Each fault of the clocks gives one reason, that of the cause, and none of what follows from it."""
    settings, said = ONE_REASON[case]
    found = reasons(make_run, tmp_path, **settings)
    assert len(found) == 1, found
    assert found[0].startswith(said)


def test_a_shared_clock_that_is_set_is_told_once(make_run: MakeRun, tmp_path: Path) -> None:
    """Two sides on one kernel have one clock: its step is one reason."""
    make_run(tmp_path / "a", step_s=1.0, server_host="one", client_host="one", offset_s=0.0, drift=0.0)
    client = read_record(tmp_path / "a" / "client.mcap")
    sampled_ns = client.table("clock").ints("mono_ns").tolist()
    assert step_reasons(client, client, measure(client, client).clocks, sampled_ns[0], sampled_ns[-1]) == [
        "the wall clock of the server stepped by +1000.0 ms"
    ]


@pytest.mark.parametrize("source", ["chrony", "probe"])
@pytest.mark.parametrize("step_s", [0.25, -1.0, -3600.0])
def test_a_clock_that_is_set_while_nobody_drives_yet(
    make_run: MakeRun, tmp_path: Path, step_s: float, source: str
) -> None:
    """A client's clock that is set 20 s before the drive is no reason, and Delta is what it is since then."""
    alone = {"client_clock": lambda _second: {"source": "probe", "correction_s": None}} if source == "probe" else {}
    make_run(tmp_path, step_s=step_s, stepped_s=-20.0, waited_s=40, drift=0.0, **alone)
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    measured = measure(server, client)
    assert invalid_reasons(server, client, measured) == []
    assert measured.entry["delta"]["source"] == source
    assert measured.entry["delta"]["ms"] == pytest.approx(250.0 - 1000 * step_s, abs=1e-3)


@pytest.mark.parametrize("stepped_s", [-3.0, 0.5, 11.5, 12.5])
def test_a_clock_that_is_set_near_the_drive(make_run: MakeRun, tmp_path: Path, stepped_s: float) -> None:
    """However long the sides waited, a step in the drive or within 5 s of it is told."""
    found = reasons(make_run, tmp_path, step_s=-1.0, stepped_s=stepped_s, waited_s=40)
    assert found == ["the wall clock of the client stepped by -1000.0 ms"]


def test_polls_that_are_missing_while_nobody_drives_yet(make_run: MakeRun, tmp_path: Path) -> None:
    """A client that did not sample its clocks for 10 s before the drive is no reason; samples do not stand in for those
    of the drive's end.
    """
    assert reasons(make_run, tmp_path / "before", client_unpolled_s=(-30, -20), waited_s=40) == []
    assert reasons(make_run, tmp_path / "end", client_unpolled_s=(8, 15), waited_s=40) == [
        "the clock samples of the client reach over 9.0 s of a drive of 12.0 s"
    ]


def test_a_clock_that_is_steered_fast_did_not_step(make_run: MakeRun, tmp_path: Path) -> None:
    """Steering by 83 ms a second, the most that chrony does, moves both clocks of a host, and is no step."""
    found = reasons(make_run, tmp_path, drift=-83_333e-6)
    assert [reason for reason in found if "stepped" in reason] == []


def test_some_long_round_trips_of_ntp_are_borne(make_run: MakeRun, tmp_path: Path) -> None:
    """Two thirds of NTP's round trips lengthened by a busy machine are no injected delay: the bound says all of it."""
    busy = following(peer_delay_s=lambda second: 0.0006 if second % 3 == 0 else 0.0031)
    assert reasons(make_run, tmp_path, **busy) == []


@pytest.mark.parametrize("silent", ["server_clock", "client_clock"])
def test_without_chrony_the_probe_alone_counts(make_run: MakeRun, tmp_path: Path, silent: str) -> None:
    """Where one side's chrony cannot tell, Delta is the probe's, with half the round trip and more as its bound."""
    unknown = {"correction_s": None, "bound_s": None, "status": "chrony is not installed"}
    make_run(tmp_path, **{silent: lambda _second: unknown})
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    measured = measure(server, client)
    assert invalid_reasons(server, client, measured) == []
    delta = measured.entry["delta"]
    assert delta["source"] == "probe"
    assert delta["ms"] == delta["probe_ms"] == pytest.approx(250.0 + 20e-6 * 6000, abs=0.001)
    assert 0.3 < delta["bound_ms"] == delta["probe_bound_ms"] < 0.5
    assert measured.entry["tau_v_ms"]["p50"] == pytest.approx(62.0, abs=0.02)
    assert measured.entry["tau_v_ms"]["bound"] == delta["bound_ms"]


def test_a_chrony_that_synchronises_too_late_is_not_used(make_run: MakeRun, tmp_path: Path) -> None:
    """What chrony says counts from before the drive's beginning on, all through it, or not at all."""

    def client(from_second: int) -> dict[str, Any]:
        return {"client_clock": lambda second: {"correction_s": None} if second < from_second else {}}

    found = {}
    for from_second in (0, 3):
        make_run(tmp_path / str(from_second), **client(from_second))
        records = [read_record(tmp_path / str(from_second) / f"{side}.mcap") for side in ("server", "client")]
        found[from_second] = measure(*records).entry["delta"]["source"]
    assert found == {0: "chrony", 3: "probe"}


def test_a_loop_that_does_not_close_is_told(make_run: MakeRun, tmp_path: Path) -> None:
    """Where the commands name other times than the pictures were read at, the sum misses the loop: invalid."""
    make_run(tmp_path / "a")
    make_run(tmp_path / "b", tau_v_ms=64.5)
    server, client = read_record(tmp_path / "a" / "server.mcap"), read_record(tmp_path / "b" / "client.mcap")
    said = invalid_reasons(server, client, measure(server, client))
    assert said == ["the parts of the loop miss the whole by 2.50 ms (p95, limit 1.0 ms)"]


def test_a_cut_record_is_told(make_run: MakeRun, tmp_path: Path) -> None:
    """A record that was never finished makes the run invalid."""
    path = make_run(tmp_path) / "client.mcap"
    path.write_bytes(path.read_bytes()[:-100])
    server, client = read_record(tmp_path / "server.mcap"), read_record(path)
    assert "the record of the client is not complete" in invalid_reasons(server, client, measure(server, client))


def test_injection_is_held_against_what_was_requested() -> None:
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
    assert list(read) == [*IDENTITY, "digest", "ending", "valid", "invalid_reasons", *MEASURES]
    assert read["participant"] is None
    assert read["mae_m"] is None
    assert (read["valid"], read["invalid_reasons"]) == (False, ["the relay died"])
