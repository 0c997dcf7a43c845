from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from lavt.experiment.analysis.clock_validity import step_reasons
from lavt.experiment.analysis.invalid_reason import InvalidCode, InvalidReason, not_measured
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.analysis.results import IDENTITY_KEYS, OPTIONAL_IDENTITY_KEYS, run_result, write_json
from lavt.experiment.analysis.validity import injection_reasons, invalid_reasons, measured_checks
from lavt.recording.record import read_record

MakeRun = Callable[..., Path]


def reasons(make_run: MakeRun, directory: Path, **settings: Any) -> list[InvalidReason]:
    make_run(directory, **settings)
    server, client = read_record(directory / "server.mcap"), read_record(directory / "client.mcap")
    return invalid_reasons(server, client, measure(server, client))


def require_one(found: list[InvalidReason], code: InvalidCode, *facts: str) -> None:
    """Require exactly one reason, with this code and these facts in its text."""
    assert [reason.code for reason in found] == [code], found
    assert all(fact in found[0].text for fact in facts), found


def test_a_run_without_faults_is_valid(make_run: MakeRun, tmp_path: Path) -> None:
    """A run without faults of the infrastructure is valid, whatever its ending."""
    assert reasons(make_run, tmp_path / "a") == []
    assert reasons(make_run, tmp_path / "b", ending="collision", wave_amplitude_m=3.0) == []


@pytest.mark.parametrize(
    ("settings", "code", "fact"),
    [
        (
            {"server_counts": (("record_overflow", 3),)},
            InvalidCode.RECORD_OVERFLOW,
            "3 messages",
        ),
        (
            {"server_counts": (("carla_states", 990), ("carla_states_late", 10))},
            InvalidCode.STATES_LATE,
            "10 of 990 states",
        ),
        ({"step_s": 0.02}, InvalidCode.CLOCK_STEP, "+20.0 ms"),
        ({"bound_s": None, "probes": False}, InvalidCode.CLOCK_BOUND, ""),
        ({"bound_s": 0.0011}, InvalidCode.CLOCK_BOUND, "2.20 ms"),
        ({"late": 3}, InvalidCode.PHYSICS_LATE, "180 ms"),
        ({"skipped": 10}, InvalidCode.FRAMES_MISSED, "10 of 361"),
        ({"ending": None}, InvalidCode.NO_ENDING, ""),
        ({"slow_frame_ms": 11.0}, InvalidCode.LOOP_JITTER, "11.0 ms"),
        ({"server_unsampled_s": (4, 6)}, InvalidCode.CLOCK_NOT_SAMPLED, "3.0 s"),
        ({"server_unsampled_s": (-1, 3)}, InvalidCode.CLOCK_NOT_SAMPLED, "3.0 s"),
        ({"server_unsampled_s": (10, 15)}, InvalidCode.CLOCK_NOT_SAMPLED, "3.0 s"),
        ({"server_unsampled_s": (-1, 15)}, InvalidCode.CLOCK_NOT_SAMPLED, "12.0 s"),
        ({"client_unsampled_s": (4, 6)}, InvalidCode.CLOCK_NOT_SAMPLED, "3.0 s"),
        ({"client_unsampled_s": (6, 15)}, InvalidCode.CLOCK_NOT_SAMPLED, "6.0 s of a drive of 12.0 s"),
        ({"client_unsampled_s": (-1, 15)}, InvalidCode.CLOCK_NOT_SAMPLED, "0.0 s of a drive of 12.0 s"),
    ],
)
def test_each_infrastructure_fault_makes_the_run_invalid(
    make_run: MakeRun, tmp_path: Path, settings: dict[str, Any], code: InvalidCode, fact: str
) -> None:
    """Each fault of the infrastructure makes the run invalid, with a reason that names it."""
    found = reasons(make_run, tmp_path, **settings)
    assert [reason for reason in found if reason.code is code and fact in reason.text]


@pytest.mark.parametrize(
    "settings",
    [
        {"late": 1},
        {"skipped": 3, "server_counts": (("record_overflow", 0),)},
        {"server_counts": (("carla_states", 1000), ("carla_states_late", 10))},
        {"step_s": 0.0005},
        {"slow_frame_ms": 9.0},
        {"spread_ms": 60.0},  # of tau_v: jitter of the network
        {"server_unsampled_s": (4, 5), "client_unsampled_s": (7, 8)},
        {"server_unsampled_s": (-1, 2)},
        {"server_unsampled_s": (11, 15)},
    ],
)
def test_small_faults_are_tolerated(make_run: MakeRun, tmp_path: Path, settings: dict[str, Any]) -> None:
    """A run is valid with small faults: late physics, missed frames, clock steps, late states, loop jitter."""
    assert reasons(make_run, tmp_path, **settings) == []


@pytest.mark.parametrize(
    ("settings", "code", "expected"),
    [
        ({"step_s": 0.002}, InvalidCode.CLOCK_STEP, (2.0, 5.0)),
        ({"server_unsampled_s": (4, 5)}, InvalidCode.CLOCK_NOT_SAMPLED, (2.0, 2.5)),
        ({"client_unsampled_s": (10, 15)}, InvalidCode.CLOCK_NOT_SAMPLED, (3.0, 2.5)),
        ({"bound_s": 0.0011}, InvalidCode.CLOCK_BOUND, (2.2, 2.0)),
        ({"late": 1}, InvalidCode.PHYSICS_LATE, (0.005, 0.01)),
        ({"skipped": 3}, InvalidCode.FRAMES_MISSED, (3 / 361, 0.01)),
        ({"slow_frame_ms": 9.0}, InvalidCode.LOOP_JITTER, (9.0, 10.0)),
        ({}, InvalidCode.CLOSURE, (0.0, 1.0)),
    ],
)
def test_each_check_has_its_value_and_limit(
    make_run: MakeRun, tmp_path: Path, settings: dict[str, Any], code: InvalidCode, expected: tuple[float, float]
) -> None:
    """A check has its measured value and its limit in each run, and exceeds the limit only in an invalid run."""
    make_run(tmp_path, **settings)
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    measured = measure(server, client)
    checks = measured_checks(server, client, measured)
    (check,) = [check for check in checks if check.code is code]
    assert (check.value, check.limit) == pytest.approx(expected, rel=0.05, abs=1e-3)
    exceeded = {check.code for check in checks if check.value > check.limit}
    assert exceeded == {reason.code for reason in invalid_reasons(server, client, measured)}


# The clocks.

SERVER, CLIENT = "10.9.0.1", "10.9.0.2"
GOOD_PATH = {"peer_delay_s": 0.0006, "peer_dispersion_s": 0.00003, "skew_ppm": 4.0, "age_s": 0.5, "poll_s": 1.0}


def following(**changes: Any) -> dict[str, Any]:
    """Return the settings of a run whose client follows its server, with the data that chrony gives to root only."""

    def client(second: int) -> dict[str, Any]:
        path = {**GOOD_PATH, "follows": SERVER, "addresses": [CLIENT], "good_samples": 20 + second}
        return path | {name: change(second) if callable(change) else change for name, change in changes.items()}

    return {"client_clock": client, "server_clock": lambda _second: {"addresses": [SERVER]}}


def test_a_following_client_has_the_bound_of_its_path(make_run: MakeRun, tmp_path: Path) -> None:
    """If the client follows the server, the bound is half the peer delay + dispersion + skew x age."""
    make_run(tmp_path, bound_s=0.5, **following())
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    measured = measure(server, client)
    assert measured.clocks.bound_ms == pytest.approx(0.3 + 0.03 + 0.002, abs=1e-3)
    assert invalid_reasons(server, client, measured) == []


@pytest.mark.parametrize("lacking", ["peer_delay_s", "peer_dispersion_s", "skew_ppm", "age_s"])
def test_without_path_data_the_bound_is_the_root_distance(make_run: MakeRun, tmp_path: Path, lacking: str) -> None:
    """If one quantity of the path is missing, the bound is the follower's root distance."""
    make_run(tmp_path, bound_s=0.0004, **following(**{lacking: None}))
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    assert measure(server, client).clocks.bound_ms == pytest.approx(0.4, abs=1e-3)


def test_a_slow_last_sample_does_not_widen_the_bound(make_run: MakeRun, tmp_path: Path) -> None:
    """If the last sample took long, the bound is the root distance, because earlier, better samples determine it."""
    slow = following(peer_delay_s=lambda second: 0.0006 if second % 3 == 0 else 0.02)
    assert reasons(make_run, tmp_path, bound_s=0.0005, **slow) == []


CLOCK_FAULTS = {
    "delay on NTP's path before NTP synchronised": (
        {**following(peer_delay_s=0.0756, correction_s=lambda second: 0.2875 + 20e-6 * second)},
        InvalidCode.NTP_THROUGH_DELAY,
        ("client", "75.60 ms", "0.60 ms"),
    ),
    "delay on NTP's path after NTP synchronised": (
        {**following(good_samples=lambda second: min(20 + second, 23))},
        InvalidCode.NTP_NO_SAMPLE,
        ("client", "10.0 s", "5 polls", "5.0 s"),
    ),
    "the server follows the client through delay": (
        {
            "server_clock": lambda _second: {**GOOD_PATH, "follows": CLIENT, "peer_delay_s": 0.1},
            "client_clock": lambda _second: {"addresses": [CLIENT]},
        },
        InvalidCode.NTP_THROUGH_DELAY,
        ("server", "100.00 ms", "0.60 ms"),
    ),
    "chrony does not know the offset": (
        {"corrected": False},
        InvalidCode.CLOCK_DISAGREEMENT,
        ("chrony", "0.00 and "),
    ),
    "each side uses its own clock as the reference": (
        {"corrected": False, "bound_s": 0.0},
        InvalidCode.CLOCK_DISAGREEMENT,
        ("chrony", "0.00 and "),
    ),
    "a wrong external correction": (
        {
            "server_clock": lambda _second: {"source": "external", "correction_s": -0.003, "bound_s": 0.001},
            "client_clock": lambda _second: {"source": "external"},
        },
        InvalidCode.CLOCK_DISAGREEMENT,
        ("external",),
    ),
    "no bound, and no probe": (
        {"bound_s": None, "probes": False},
        InvalidCode.CLOCK_BOUND,
        (),
    ),
    "no chrony, and no probe": (
        {
            "server_clock": lambda _second: {"correction_s": None, "status": "chrony is not installed"},
            "client_clock": lambda _second: {"correction_s": None, "status": "chrony is not synchronised"},
            "probes": False,
        },
        InvalidCode.CLOCK_UNKNOWN,
        ("server: chrony is not installed", "client: chrony is not synchronised"),
    ),
    "no probe": (
        {"probes": False},
        InvalidCode.CLOCK_UNCHECKED,
        ("clock.probe_port",),
    ),
    "two grandmasters": (
        {
            "server_clock": lambda _second: {"source": "ptp", "follows": "a"},
            "client_clock": lambda _second: {"source": "ptp", "follows": "b"},
        },
        InvalidCode.PTP_GRANDMASTERS,
        ("a and b",),
    ),
    "a probe alone, with too long a round trip": (
        {
            "client_clock": lambda _second: {"source": "probe", "correction_s": None},
            "to_server_ms": 3.0,
            "to_client_ms": 3.0,
        },
        InvalidCode.CLOCK_BOUND,
        ("3.",),
    ),
    "the client's clock is set forward": ({"step_s": 1.0}, InvalidCode.CLOCK_STEP, ("client", "+1000.0 ms")),
    "the client's clock is set back": ({"step_s": -1.0}, InvalidCode.CLOCK_STEP, ("client", "-1000.0 ms")),
    "the client's clock is set, without time sources": (
        {"step_s": 1.0, "client_clock": lambda _second: {"source": "probe", "correction_s": None}},
        InvalidCode.CLOCK_STEP,
        ("client", "+1000.0 ms"),
    ),
}
"""By fault: the settings of the drive, the code of the only reason, and the facts in its text."""


@pytest.mark.parametrize("case", CLOCK_FAULTS)
def test_each_clock_fault_has_one_reason(make_run: MakeRun, tmp_path: Path, case: str) -> None:
    """Each fault of the clocks has one reason, for its cause and not for its consequences."""
    settings, code, facts = CLOCK_FAULTS[case]
    require_one(reasons(make_run, tmp_path, **settings), code, *facts)


def test_a_step_of_a_shared_clock_has_one_reason(make_run: MakeRun, tmp_path: Path) -> None:
    """Two sides on one kernel have one clock: its step is one reason."""
    make_run(tmp_path / "a", step_s=1.0, server_host="one", client_host="one", offset_s=0.0, drift=0.0)
    client = read_record(tmp_path / "a" / "client.mcap")
    sampled_ns = client.table("clock").ints("mono_ns").tolist()
    found = step_reasons(client, client, measure(client, client).clocks, sampled_ns[0], sampled_ns[-1])
    require_one(found, InvalidCode.CLOCK_STEP, "server", "+1000.0 ms")


@pytest.mark.parametrize("source", ["chrony", "probe"])
@pytest.mark.parametrize("step_s", [0.25, -1.0, -3600.0])
def test_a_clock_step_long_before_the_drive_is_accepted(
    make_run: MakeRun, tmp_path: Path, step_s: float, source: str
) -> None:
    """If the client's clock stepped 20 s before the drive, the run is valid, and Delta has its value after the step."""
    probe_only = (
        {"client_clock": lambda _second: {"source": "probe", "correction_s": None}} if source == "probe" else {}
    )
    make_run(tmp_path, step_s=step_s, stepped_s=-20.0, sampled_before_s=40, drift=0.0, **probe_only)
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    measured = measure(server, client)
    assert invalid_reasons(server, client, measured) == []
    assert measured.entry["delta"]["source"] == source
    assert measured.entry["delta"]["ms"] == pytest.approx(250.0 - 1000 * step_s, abs=1e-3)


@pytest.mark.parametrize("stepped_s", [-3.0, 0.5, 11.5, 12.5])
def test_a_clock_step_near_the_drive_makes_the_run_invalid(make_run: MakeRun, tmp_path: Path, stepped_s: float) -> None:
    """A clock step in the drive, or at most 5 s before or after the drive, makes a run invalid."""
    run_reasons = reasons(make_run, tmp_path, step_s=-1.0, stepped_s=stepped_s, sampled_before_s=40)
    require_one(run_reasons, InvalidCode.CLOCK_STEP, "client", "-1000.0 ms")


def test_clock_samples_are_required_during_the_drive_only(make_run: MakeRun, tmp_path: Path) -> None:
    """A run is valid if clock samples are missing long before the drive, but not if they are missing at its end."""
    assert reasons(make_run, tmp_path / "before", client_unsampled_s=(-30, -20), sampled_before_s=40) == []
    found = reasons(make_run, tmp_path / "end", client_unsampled_s=(8, 15), sampled_before_s=40)
    require_one(found, InvalidCode.CLOCK_NOT_SAMPLED, "client", "9.0 s", "12.0 s")


def test_fast_steering_is_not_a_step(make_run: MakeRun, tmp_path: Path) -> None:
    """Steering by 83 ms per second, chrony's maximum, moves both clocks of a host and is not a step."""
    run_reasons = reasons(make_run, tmp_path, drift=-83_333e-6)
    assert InvalidCode.CLOCK_STEP not in {reason.code for reason in run_reasons}


def test_some_long_ntp_round_trips_are_tolerated(make_run: MakeRun, tmp_path: Path) -> None:
    """If a busy machine lengthens two thirds of NTP's round trips, this is not taken for injected delay."""
    busy = following(peer_delay_s=lambda second: 0.0006 if second % 3 == 0 else 0.0031)
    assert reasons(make_run, tmp_path, **busy) == []


@pytest.mark.parametrize("side_without_chrony", ["server_clock", "client_clock"])
def test_without_chrony_the_probe_is_used(make_run: MakeRun, tmp_path: Path, side_without_chrony: str) -> None:
    """If one side's chrony has no correction, Delta comes from the probe, bounded by just over half the round trip."""
    unknown = {"correction_s": None, "bound_s": None, "status": "chrony is not installed"}
    make_run(tmp_path, **{side_without_chrony: lambda _second: unknown})
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    measured = measure(server, client)
    assert invalid_reasons(server, client, measured) == []
    delta = measured.entry["delta"]
    assert delta["source"] == "probe"
    at_middle_of_drive_ms = 250.0 + 20e-6 * 6000
    assert delta["ms"] == delta["probe_ms"] == pytest.approx(at_middle_of_drive_ms, abs=0.001)
    assert 0.3 < delta["bound_ms"] == delta["probe_bound_ms"] < 0.5
    assert measured.entry["tau_v_ms"]["p50"] == pytest.approx(62.0, abs=0.02)
    assert measured.entry["tau_v_ms"]["bound"] == delta["bound_ms"]


def test_chrony_must_be_synchronised_before_the_drive(make_run: MakeRun, tmp_path: Path) -> None:
    """The time source chrony is used only if it had a correction before and during the whole drive."""

    def client(from_second: int) -> dict[str, Any]:
        return {"client_clock": lambda second: {"correction_s": None} if second < from_second else {}}

    sources = {}
    for from_second in (0, 3):
        make_run(tmp_path / str(from_second), **client(from_second))
        records = [read_record(tmp_path / str(from_second) / f"{side}.mcap") for side in ("server", "client")]
        sources[from_second] = measure(*records).entry["delta"]["source"]
    assert sources == {0: "chrony", 3: "probe"}


def test_a_closure_error_makes_the_run_invalid(make_run: MakeRun, tmp_path: Path) -> None:
    """If the parts of the loop do not add up to the loop latency, the run is invalid."""
    make_run(tmp_path / "a")
    make_run(tmp_path / "b", tau_v_ms=64.5)
    server, client = read_record(tmp_path / "a" / "server.mcap"), read_record(tmp_path / "b" / "client.mcap")
    require_one(invalid_reasons(server, client, measure(server, client)), InvalidCode.CLOSURE, "2.50 ms")


def test_an_incomplete_record_makes_the_run_invalid(make_run: MakeRun, tmp_path: Path) -> None:
    """A record that was never finished makes the run invalid."""
    path = make_run(tmp_path) / "client.mcap"
    path.write_bytes(path.read_bytes()[:-100])
    server, client = read_record(tmp_path / "server.mcap"), read_record(path)
    found = invalid_reasons(server, client, measure(server, client))
    require_one(
        [reason for reason in found if reason.code is InvalidCode.RECORD_INCOMPLETE],
        InvalidCode.RECORD_INCOMPLETE,
        "client",
    )


def test_the_injected_delay_is_compared_with_the_request() -> None:
    """A measured delay that is missing, or differs by more than 1 ms from the request, makes a run invalid."""
    assert injection_reasons({"video": 75.0, "control": 0.0}, {"video": 75.6, "control": 0.2}) == []
    found = injection_reasons({"video": 75.0}, {"video": 60.0})
    require_one(found, InvalidCode.INJECTION_DIFFERS, "video", "60.0 ms")
    require_one(injection_reasons({"control": 0.0}, {}), InvalidCode.INJECTION_NOT_MEASURED, "control")


def test_a_result_has_every_key(make_run: MakeRun, tmp_path: Path) -> None:
    """`result.json` has all keys of the run's identity, with null where they do not apply, every metric, and no NaN."""
    make_run(tmp_path)
    identity = {"run": "0001", "time": "virtual", "route": "A key", "condition": "L0", "seed": 7}
    server, client = read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")
    result = run_result(identity, server, client, digest="ab", reasons=[not_measured("video")])
    write_json(tmp_path / "result.json", {**result, "mae_m": float("nan")})
    read = json.loads((tmp_path / "result.json").read_text())
    metrics = measure(server, client).entry
    assert list(read)[: len(IDENTITY_KEYS)] == list(IDENTITY_KEYS)
    assert read.keys() == {*IDENTITY_KEYS, "digest", "valid", "invalid_reasons", "checks", *metrics}
    assert read["participant"] is None
    assert read["mae_m"] is None
    assert (read["valid"], read["invalid_reasons"]) == (
        False,
        [{"code": "injection_not_measured", "text": not_measured("video").text}],
    )


def test_every_metric_is_defined_in_the_documentation(make_run: MakeRun, tmp_path: Path) -> None:
    """`docs/metrics.md` has each metric of a run by its key."""
    make_run(tmp_path)
    page = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text()
    entry = measure(read_record(tmp_path / "server.mcap"), read_record(tmp_path / "client.mcap")).entry
    assert [key for key in (*entry, *entry["delta"]) if f"`{key}`" not in page] == []


def test_every_key_of_the_identity_is_defined_in_the_documentation() -> None:
    """The section of `docs/metrics.md` on the identity of a run has each key of the identity."""
    page = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text()
    section = page.partition("\n## Identity of a run")[2].partition("\n## ")[0]
    assert [key for key in (*IDENTITY_KEYS, *OPTIONAL_IDENTITY_KEYS, "digest") if f"`{key}`" not in section] == []


def test_the_page_explains_every_code() -> None:
    """`docs/metrics.md` has a row for each code of an invalid run, and no other row."""
    page = (Path(__file__).parents[3] / "docs" / "metrics.md").read_text()
    section = page.partition("\n## Validity")[2].partition("\n## ")[0]
    assert re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE) == list(InvalidCode)
