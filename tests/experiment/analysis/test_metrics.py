"""Tests of a run's metrics, mostly from the synthetic drive of `conftest.py`.

By default the drive has a tau_v of 62 ms, a client time of 3 ms, a tau_c of 9 ms and an actuator time of 2 ms: together
a loop latency of 76 ms.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from lavt.experiment.analysis.clock_offset import NO_OFFSET
from lavt.experiment.analysis.latency import control_latency_ns, frame_age, rtp_timestamp
from lavt.experiment.analysis.metrics import RunMeasurement, driving_interval, last_count, measure
from lavt.experiment.analysis.steering import steering_reversals
from lavt.experiment.analysis.tracking import (
    cross_track_metrics,
    heading_metrics,
    p95_by_10m,
    per_km,
    route_length_m,
    sampled_by_distance,
)
from lavt.recording.record import Record, read_record
from lavt.recording.table import Table, table_of

MakeRun = Callable[..., Path]
ONE_MICROSECOND_MS = 1e-3


def measured(make_run: MakeRun, directory: Path, **settings: Any) -> RunMeasurement:
    make_run(directory, **settings)
    return measure(read_record(directory / "server.mcap"), read_record(directory / "client.mcap"))


def table(rows: list[dict[str, Any]]) -> Table:
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def record_of(*events: tuple[str, int, str], last_ns: int = 0, **channels: list[dict[str, Any]]) -> Record:
    """Return a record in memory of events and further channels."""
    named = [{"kind": kind, "mono_ns": mono_ns, "detail": detail} for kind, mono_ns, detail in events]
    tables = {name: table(rows) for name, rows in {"event": named, **channels}.items()}
    return Record(Path("in memory"), True, tables, {}, last_ns)


BEGAN, ENDED = ("drive_began", 100, ""), ("ending", 200, "completed")


@pytest.mark.parametrize(
    ("events", "interval"),
    [
        ([BEGAN, ENDED], (100, 200, "completed")),
        ([BEGAN, ENDED, ("late", 300, "60 ms")], (100, 200, "completed")),
        ([BEGAN, ("collision", 150, "a tree"), ENDED], (100, 200, "completed")),
        ([BEGAN, ("drive_began", 120, ""), ENDED], (100, 200, "completed")),
        ([BEGAN, ENDED, ("ending", 210, "aborted")], (100, 200, "completed")),
        ([("ending", 90, "aborted"), BEGAN, ENDED], (100, 200, "completed")),
        ([BEGAN], (100, 500, None)),
        ([("ending", 90, "aborted"), BEGAN], (100, 500, None)),
        ([ENDED], (501, 500, None)),
        ([("late", 300, "60 ms")], (501, 500, None)),
        ([], (501, 500, None)),
    ],
)
def test_the_driving_interval(events: list[tuple[str, int, str]], interval: tuple[int, int, str | None]) -> None:
    """A drive lasts from the first `drive_began` to the next `ending`.

    Without `drive_began` it is empty; without `ending` it lasts to the end of the record.
    """
    assert driving_interval(record_of(*events, last_ns=500)) == interval


def test_the_driving_interval_includes_its_edges() -> None:
    """Events and truth at the start and the end of the drive are included, those outside are not."""
    collisions = [("collision", at_ns, "a tree") for at_ns in (99, 100, 150, 200, 201)]
    invasions = [("lane_invasion", at_ns, "left") for at_ns in (99, 100, 200, 201, 202)]
    truth = [
        {"mono_ns": at_ns, "progress_m": progress_m, "cross_track_m": 1.0 if 100 <= at_ns <= 200 else 9.0}
        for at_ns, progress_m in ((99, 0.0), (100, 10.0), (150, 20.0), (200, 30.0), (201, 90.0))
    ]
    server = record_of(BEGAN, *collisions, *invasions, ENDED, truth=truth)
    entry = measure(server, record_of()).entry
    assert (entry["collisions"], entry["lane_invasions"]) == (3, 2)
    assert (entry["distance_m"], entry["max_m"]) == (20.0, 1.0)
    assert entry["collisions_per_km"] == pytest.approx(3 / 0.02)
    assert entry["lane_invasions_per_km"] == pytest.approx(2 / 0.02)
    assert entry["ending"] == "completed"


def test_duration_of_an_empty_drive() -> None:
    """A drive that ended at its start has a duration of 0 s; without a drive the duration is null."""
    assert measure(record_of(BEGAN, ("ending", 100, "aborted")), record_of()).entry["duration_s"] == 0.0
    assert measure(record_of(last_ns=100), record_of()).entry["duration_s"] is None


def test_the_last_recorded_count_is_returned() -> None:
    """The last recorded value of a counter is returned, or None if there is no value."""
    record = record_of(counts=[{"late": 1}, {"late": 5}, {"other": 9}])
    assert [last_count(record, name) for name in ("late", "other", "neither")] == [5, 9, None]
    assert last_count(record_of(), "late") is None


def test_latencies_are_right_to_the_microsecond(make_run: MakeRun, tmp_path: Path) -> None:
    """With clocks 250 ms apart that drift by 20 ppm, tau_v, tau_c and the loop latency are exact to 1 us."""
    entry = measured(make_run, tmp_path).entry
    for name, p50_ms, spread_ms in (("tau_v_ms", 62.0, 2.0), ("loop_ms", 76.0, 2.0), ("tau_c_ms", 9.0, 0.0)):
        assert entry[name]["p50"] == pytest.approx(p50_ms, abs=ONE_MICROSECOND_MS)
        assert entry[name]["p5"] == pytest.approx(p50_ms - spread_ms, abs=ONE_MICROSECOND_MS)
        assert entry[name]["p95"] == pytest.approx(p50_ms + spread_ms, abs=ONE_MICROSECOND_MS)
    assert entry["delta"]["ms"] == pytest.approx(250.0, abs=0.2)


def test_the_clock_offset_affects_one_way_latencies_only(make_run: MakeRun, tmp_path: Path) -> None:
    """Without the correction, tau_v is wrong by the 250 ms between the clocks, and the loop latency is correct."""
    entry = measured(make_run, tmp_path, corrected=False).entry
    assert entry["tau_v_ms"]["p50"] == pytest.approx(62.0 - 250.0, abs=0.2)
    assert entry["tau_c_ms"]["p50"] == pytest.approx(9.0 + 250.0, abs=0.2)
    assert entry["loop_ms"]["p50"] == pytest.approx(76.0, abs=ONE_MICROSECOND_MS)


def test_one_way_latencies_have_the_bound_of_both_hosts(make_run: MakeRun, tmp_path: Path) -> None:
    """The bound of tau_v and tau_c is the sum of the bounds of both hosts."""
    entry = measured(make_run, tmp_path, bound_s=0.0003).entry
    assert entry["tau_v_ms"]["bound"] == pytest.approx(0.6)
    assert entry["tau_c_ms"]["bound"] == pytest.approx(0.6)


def test_hosts_that_share_a_kernel_share_a_clock(make_run: MakeRun, tmp_path: Path) -> None:
    """If both sides report the same host, Delta is 0 with bound 0, regardless of the time sources."""
    settings = {"server_host": "one", "client_host": "one", "offset_s": 0.0, "drift": 0.0}
    same_host = measured(make_run, tmp_path / "a", **settings)
    assert same_host.entry["tau_v_ms"]["p50"] == pytest.approx(62.0, abs=1e-9)
    assert same_host.clocks.bound_ms == 0.0


def test_hosts_without_a_name_are_not_taken_for_one_host(make_run: MakeRun, tmp_path: Path) -> None:
    """Two sides that do not report their host do not get a bound of 0."""
    run = measured(make_run, tmp_path, server_host="", client_host="", bound_s=None, probes=False)
    assert run.clocks.bound_ms is None
    assert run.entry["tau_v_ms"]["p50"] == pytest.approx(62.0, abs=ONE_MICROSECOND_MS)
    assert run.entry["tau_v_ms"]["bound"] is None


def test_the_parts_of_the_loop_add_up(make_run: MakeRun, tmp_path: Path) -> None:
    """tau_v, client time, tau_c and actuator time add up to the loop latency to 1 us, although the clocks drift."""
    closure_ms = measured(make_run, tmp_path).closure_p95_ms
    assert closure_ms is not None
    assert closure_ms < ONE_MICROSECOND_MS


def test_the_closure_is_absolute(make_run: MakeRun, tmp_path: Path) -> None:
    """With a client clock that loses 1 %, the closure is 1 % of the client time of 3 ms, and not negative."""
    closure_ms = measured(make_run, tmp_path, drift=0.01, spread_ms=0.0).closure_p95_ms
    assert closure_ms == pytest.approx(0.03, abs=0.002)


def test_the_closure_is_the_95th_percentile(make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """For latency-sum errors of 0, 1, .. 100 ms of either sign, the closure is 95 ms."""
    errors_ns = np.arange(101) * 1_000_000 * np.resize([1, -1], 101)
    monkeypatch.setattr("lavt.experiment.analysis.metrics.latency_sum_error_ns", lambda *_: errors_ns)
    assert measured(make_run, tmp_path, seconds=0.1).closure_p95_ms == pytest.approx(95.0)


def test_without_pictures_tau_v_is_unknown(make_run: MakeRun, tmp_path: Path) -> None:
    """Without pictures, tau_v, its bound and the closure are unknown; tau_c and its bound are known."""
    make_run(tmp_path, server_host="one", client_host="one")
    server = read_record(tmp_path / "server.mcap")
    run = measure(server, read_record(tmp_path / "client.mcap", channels=("clock",)))
    assert (run.entry["tau_v_ms"]["n"], run.entry["tau_v_ms"]["bound"]) == (0, None)
    assert run.entry["tau_c_ms"]["n"] > 0
    assert run.entry["tau_c_ms"]["bound"] == 0.0
    assert run.closure_p95_ms is None


def test_a_clock_step_does_not_change_the_loop_latency(make_run: MakeRun, tmp_path: Path) -> None:
    """If the client's wall clock steps by 100 ms, loop latency and frame age do not change."""
    without_step, stepped = measured(make_run, tmp_path / "a"), measured(make_run, tmp_path / "b", step_s=0.1)
    assert stepped.entry["loop_ms"] == without_step.entry["loop_ms"]
    assert stepped.entry["picture_age_ms"] == without_step.entry["picture_age_ms"]
    assert stepped.entry["tau_v_ms"]["p95"] > without_step.entry["tau_v_ms"]["p95"] + 50


def test_only_frames_of_the_drive_are_counted(make_run: MakeRun, tmp_path: Path) -> None:
    """Frames before the drive are excluded; unreadable pictures, one in 50, are counted and have no latency."""
    entry = measured(make_run, tmp_path).entry
    assert entry["frames_sent"] == 361
    assert entry["frames_decoded"] == 361
    assert entry["frames_unreadable"] == 7
    assert entry["tau_v_ms"]["n"] == 354
    assert entry["duration_s"] == 12.0


def test_an_undecoded_access_unit_is_not_a_picture(make_run: MakeRun, tmp_path: Path) -> None:
    """An access unit that was not decoded is counted neither as decoded nor as unreadable, and has no latency."""
    entry = measured(make_run, tmp_path, undecoded=5).entry
    assert (entry["frames_sent"], entry["frames_decoded"], entry["frames_unreadable"]) == (361, 356, 7)
    assert entry["tau_v_ms"]["n"] == 349


def test_pictures_without_the_field_decoded_are_decoded(make_run: MakeRun, tmp_path: Path) -> None:
    """Pictures without the field `decoded` are counted as decoded."""
    entry = measured(make_run, tmp_path, undecoded=None).entry
    assert (entry["frames_decoded"], entry["frames_unreadable"]) == (361, 7)


def test_frame_age_is_the_loop_latency_plus_half_a_frame(make_run: MakeRun, tmp_path: Path) -> None:
    """With a constant loop latency of 76 ms and a frame every 33.3 ms, the mean frame age is 92.7 ms."""
    age = measured(make_run, tmp_path, spread_ms=0.0).entry["picture_age_ms"]
    assert age["mean"] == pytest.approx(76 + 33.333 / 2, abs=0.05)
    assert age["p95"] == pytest.approx(76 + 33.333 * 0.95, abs=0.1)


def test_frame_age_of_three_commands() -> None:
    """If the age grows from 10 to 20, from 10 to 30 and from 5 to 15 ms, its mean is 16.25 ms and its P95 is 28 ms."""
    millisecond = 1_000_000
    frames = table(
        [{"stamp_ns": n, "stamped_mono_ns": stamped * millisecond} for n, stamped in ((1, 0), (2, 10), (3, 35))]
    )
    command_verdicts = table(
        [
            {"stamp_ns": n, "verdict": "accepted", "applied_mono_ns": applied * millisecond}
            for n, applied in ((1, 10), (2, 20), (3, 40))
        ]
    )
    age = frame_age(frames, command_verdicts, 10 * millisecond, 50 * millisecond)
    # For each command: the time (ms) for which it is in force, times its mean age.
    assert age.mean_ms == pytest.approx((10 * 15 + 20 * 20 + 10 * 10) / 40)
    assert age.p95_ms == pytest.approx(28.0)


def test_rejected_commands_do_not_change_the_control_latency() -> None:
    """Only accepted commands have a control latency: a stranger's rejected command can have any send time."""
    millisecond = 1_000_000
    rows = [
        {
            "verdict": verdict,
            "sent_wall_ns": sent,
            "received_wall_ns": 10 * millisecond,
            "received_mono_ns": 10 * millisecond,
            "applied_mono_ns": 11 * millisecond if verdict == "accepted" else None,
        }
        for verdict, sent in (("accepted", millisecond), ("rejected", -(10**18)), ("rejected", 2 * millisecond))
    ]
    assert control_latency_ns(table(rows), NO_OFFSET, 0, 50 * millisecond).tolist() == [9 * millisecond]


def test_missing_data_are_null_not_zero(make_run: MakeRun, tmp_path: Path) -> None:
    """If the client recorded nothing, tau_v and its bound are null, and the loop latency is unchanged."""
    make_run(tmp_path / "a")
    make_run(tmp_path / "b", seconds=0.01)
    server = read_record(tmp_path / "a" / "server.mcap")
    empty_record = read_record(tmp_path / "b" / "client.mcap", channels=())
    entry = measure(server, empty_record).entry
    assert entry["tau_v_ms"] == {"p5": None, "p50": None, "p95": None, "bound": None, "n": 0}
    assert entry["loop_ms"]["p50"] == pytest.approx(76.0, abs=ONE_MICROSECOND_MS)
    assert measure(empty_record, empty_record).entry["mae_m"] is None
    assert measure(empty_record, empty_record).entry["duration_s"] is None


def test_tracking_of_a_sine(make_run: MakeRun, tmp_path: Path) -> None:
    """The errors of a sinusoidal path, divided by its amplitude: mean 2/pi, RMS 1/sqrt(2), maximum 1."""
    entry = measured(make_run, tmp_path, seconds=12 * np.pi).entry
    assert entry["mae_m"] == pytest.approx(0.5 * 2 / np.pi, abs=0.005)
    assert entry["rms_m"] == pytest.approx(0.5 / np.sqrt(2), abs=0.005)
    assert entry["max_m"] == pytest.approx(0.5, abs=0.001)
    assert entry["distance_m"] == pytest.approx(96 * np.pi, abs=0.2)
    speed_mps, wave_length_m = 8, 2 * np.pi * 5
    assert entry["steering_reversals_per_s"] == pytest.approx(2 * speed_mps / wave_length_m, abs=0.03)
    assert entry["lane_invasions"] == 1
    assert entry["collisions"] == 0


def test_samples_begin_at_the_first_row() -> None:
    """Errors are interpolated every 0.25 m from the first row on, wherever on the route this row is."""
    rows = [{"progress_m": 2.0, "cross_track_m": 4.0}, {"progress_m": 3.0, "cross_track_m": 8.0}]
    assert sampled_by_distance(table(rows), "cross_track_m").tolist() == [4.0, 5.0, 6.0, 7.0, 8.0]


def test_percentiles_of_linear_errors() -> None:
    """For errors that grow linearly from 0 to 1, the mean is 0.5, the 95th percentile 0.95 and the maximum 1."""
    rows = [
        {"progress_m": index * 0.25, "cross_track_m": index / 100, "heading_error_rad": -index / 100}
        for index in range(101)
    ]
    errors_m, errors_rad = cross_track_metrics(table(rows)), heading_metrics(table(rows))
    assert [errors_m[name] for name in ("mae_m", "p95_m", "max_m")] == pytest.approx([0.5, 0.95, 1.0])
    assert [errors_rad[name] for name in ("heading_mae_rad", "heading_p95_rad")] == pytest.approx([0.5, 0.95])
    assert p95_by_10m(table(rows)) == pytest.approx([0.38, 0.76])


def test_a_stationary_car_has_no_weight() -> None:
    """Errors are sampled by distance: 1000 rows of a car that waits 1 m off the centre do not change the error."""
    driving = [{"progress_m": index * 0.1, "cross_track_m": 0.0} for index in range(101)]
    waiting = [{"progress_m": 10.0, "cross_track_m": 1.0}] * 1000
    assert cross_track_metrics(table(driving + waiting))["mae_m"] == 0.0


def test_the_first_passage_counts() -> None:
    """Where the progress decreases and increases again, the error of the first passage is used."""
    rows = [(0.0, 0.0), (1.0, 0.0), (0.5, 9.0), (0.9, 9.0), (2.0, 0.0)]
    samples = sampled_by_distance(table([{"progress_m": p, "cross_track_m": c} for p, c in rows]), "cross_track_m")
    assert samples.tolist() == [0.0] * 9


def test_p95_up_to_every_ten_metres() -> None:
    """If the error is 1 m for 10 m and then 3 m, P95 is 1 m up to 10 m and 3 m up to 20 m; a partial 10 m has none."""
    rows = [{"progress_m": 5.0 + index * 0.25, "cross_track_m": -1.0 if index <= 40 else 3.0} for index in range(101)]
    assert p95_by_10m(table(rows)) == [1.0, 3.0]
    assert p95_by_10m(table(rows[:41])) == [1.0]
    assert p95_by_10m(table(rows[:40])) == []
    assert p95_by_10m(table([])) == []


def test_the_last_p95_is_that_of_the_whole_drive() -> None:
    """If a drive ends at a multiple of 10 m, the last of `p95_by_10m` is `p95_m`."""
    rows = [{"progress_m": index * 0.25, "cross_track_m": np.sin(index)} for index in range(121)]
    assert p95_by_10m(table(rows))[-1] == cross_track_metrics(table(rows))["p95_m"]


def test_heading_error_of_two_halves() -> None:
    """For 0.1 rad left in one half and 0.3 rad right in the other, the mean is 0.2, RMS 0.2236 and P95 0.3 rad."""
    rows = [{"progress_m": index * 0.25, "heading_error_rad": 0.1 if index < 50 else -0.3} for index in range(100)]
    statistics = heading_metrics(table(rows))
    assert statistics["heading_mae_rad"] == pytest.approx(0.2)
    assert statistics["heading_rms_rad"] == pytest.approx(np.sqrt(0.05))
    assert statistics["heading_p95_rad"] == pytest.approx(0.3)
    assert set(heading_metrics(table([])).values()) == {None}


def test_rates_by_distance() -> None:
    """Two events in 500 m are 4 per kilometre; without a known distance there is no rate."""
    assert per_km(2, 500.0) == 4.0
    assert per_km(0, 500.0) == 0.0
    assert per_km(0, 0.0) is None
    assert per_km(1, None) is None


def test_the_route_length_is_recorded(make_run: MakeRun, tmp_path: Path) -> None:
    """The route length is the length of the recorded route, and null without a recorded route."""
    entry = measured(make_run, tmp_path, seconds=6.0).entry
    assert entry["route_length_m"] == 100.0
    assert entry["lane_invasions_per_km"] == pytest.approx(1 / 0.048)
    assert len(entry["p95_by_10m"]) == 4
    assert route_length_m(table([])) is None


@pytest.mark.parametrize(
    ("angles", "reversals"),
    [([], 0), ([0.0], 0), ([0.0, 0.2, 0.1], 1), ([0.0, 0.2, 0.195, 0.3], 0), ([0.0, -0.1, 0.1, -0.1, 0.1], 3)],
)
def test_reversals_within_the_deadband_are_ignored(angles: list[float], reversals: int) -> None:
    """A change of steering direction is counted as a reversal if it is at least 0.01 rad."""
    assert steering_reversals(np.array(angles)) == reversals


def test_rtp_timestamps_do_not_overflow() -> None:
    """The RTP timestamp of a current stamp equals the result of exact arithmetic."""
    stamps = [1_700_000_000_123_456_789, 1_999_999_999_999_999_999]
    expected = [stamp * 9 // 100_000 % 2**32 for stamp in stamps]
    assert rtp_timestamp(np.array(stamps)).tolist() == expected
