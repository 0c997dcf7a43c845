"""Tests of the compliance of one drive, from small records in memory whose numbers are computed by hand.

All times of these records are in ms since the start of the drive.
"""

from __future__ import annotations

import itertools
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader

from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import WorkError
from lavt.experiment.analysis.latency import frame_age
from lavt.experiment.analysis.metrics import driving_interval
from lavt.experiment.compliance.criteria import ComplianceLimits
from lavt.experiment.compliance.drive_compliance import DriveCompliance, evaluate_drive
from lavt.experiment.compliance.figures import drive_figure
from lavt.recording.record import Record, read_record
from lavt.recording.table import Table, table_of

MakeRun = Callable[..., Path]
BEGAN_NS = 1_000 * NS_PER_S
IDENTITY = {
    "run": "a",
    "time": "virtual",
    "fidelity": "video",
    "route": "a",
    "condition": "L0",
    "driver": "lane_keeper",
}
LIMITS = ComplianceLimits(latency_ms=100.0, nominal_mps=10.0)


def ns(time_ms: float) -> int:
    return BEGAN_NS + round(time_ms * NS_PER_MS)


def table(rows: Sequence[Mapping[str, Any]]) -> Table:
    return table_of(rows, [0] * len(rows), [0] * len(rows))


def frame(stamped_ms: float, capture_ms: float | None = None) -> dict[str, Any]:
    return {
        "stamp_ns": ns(stamped_ms),
        "stamped_mono_ns": ns(stamped_ms),
        "capture_ns": None if capture_ms is None else ns(capture_ms),
    }


def command(applied_ms: float, stamped_ms: float, driver_ms: float = 0.0) -> dict[str, Any]:
    """Return an accepted command that the driver made within `driver_ms`; its control latency is 5 ms."""
    sent_ns = ns(applied_ms - 5)
    return {
        "stamp_ns": ns(stamped_ms),
        "received_mono_ns": ns(applied_ms),
        "applied_mono_ns": ns(applied_ms),
        "sent_wall_ns": sent_ns,
        "stamp_received_wall_ns": sent_ns - round(driver_ms * NS_PER_MS),
        "verdict": "accepted",
    }


def speeds(*reports: tuple[float, float]) -> list[dict[str, Any]]:
    return [{"mono_ns": ns(time_ms), "speed_mps": speed_mps} for time_ms, speed_mps in reports]


def safety(time_ms: float, detail: str) -> tuple[str, float, str]:
    return "safety", time_ms, detail


def record(
    ended_ms: float = 1000.0, events: Sequence[tuple[str, float, str]] = (), **channels: Sequence[Mapping[str, Any]]
) -> Record:
    """Return a server's record in memory of a drive that ends at `ended_ms`."""
    everything = [("drive_began", 0.0, ""), *events, ("ending", ended_ms, "completed")]
    rows = [{"kind": kind, "mono_ns": ns(time_ms), "detail": detail} for kind, time_ms, detail in everything]
    tables = {name: table(entries) for name, entries in {"event": rows, **channels}.items()}
    return Record(Path("in memory"), True, tables, {}, ns(ended_ms + 1000))


def evaluated(server: Record, limits: ComplianceLimits = LIMITS, page: Table | None = None) -> DriveCompliance:
    return evaluate_drive(Path("in memory"), IDENTITY, server, page, limits)


STEADY = speeds(*((time_ms, 8.0) for time_ms in range(-100, 1200, 20)))
"""A car that drives 8 m/s."""


def test_time_above_the_limit() -> None:
    """The frame age counts from the capture; share, longest stretch and its start are those computed by hand."""
    frames = [frame(-40, -50), frame(300, 290), frame(900, 890)]
    commands = [command(-10, -40), command(400, 300), command(950, 900)]
    entry = evaluated(record(frame=frames, admission=commands, truth=STEADY)).entry
    # Ages: 50 to 450 ms from 0 s on, 110 to 660 ms from 0.4 s on, 60 to 110 ms from 0.95 s on.
    above_ms = (400 - 50) + 550 + 10
    assert entry["age_from"] == "capture"
    assert entry["above_share"] == pytest.approx((above_ms / 1000,) * 2)
    assert entry["above_s"] == pytest.approx((above_ms / 1000,) * 2)
    assert entry["longest_above_s"] == pytest.approx((0.9, 0.9))
    assert entry["longest_above_began_s"] == pytest.approx(0.05)
    assert entry["picture_age_ms"]["max"] == pytest.approx((660.0, 660.0))
    assert entry["verdicts"]["above_share"] == entry["verdict"] == "above"


def test_an_unknown_exposure_is_not_within_the_limit() -> None:
    """Without capture times the age counts from the stamp, and is above the limit for sure, or else not decided."""
    channels: dict[str, Any] = {
        "frame": [frame(number * 50) for number in range(-1, 20)],
        "admission": [command(number * 50 + 30, number * 50) for number in range(-1, 20)],
        "truth": STEADY,
    }
    unknown = evaluated(record(**channels)).entry
    assert unknown["age_from"] == "stamp"
    assert unknown["above_share"] == (0.0, 1.0)  # from the stamp, the age is at most 80 ms
    assert unknown["verdicts"]["above_share"] == unknown["verdicts"]["longest_above_s"] == "not decided"
    assert unknown["longest_above_s"] == (0.0, 1.0)
    fast_camera = evaluated(record(**channels), ComplianceLimits(latency_ms=100, nominal_mps=10, camera_ms=20)).entry
    assert fast_camera["verdicts"]["above_share"] == "within"
    slow_camera = evaluated(record(**channels), ComplianceLimits(latency_ms=100, nominal_mps=10, camera_ms=30)).entry
    # The oldest possible frames are up to 110 ms old, for 10 ms of each 50 ms from 20 ms on.
    assert slow_camera["above_share"] == pytest.approx((0.0, 0.2))
    assert slow_camera["verdicts"]["above_share"] == "not decided"
    below = evaluated(record(**channels), ComplianceLimits(latency_ms=60, nominal_mps=10)).entry
    assert below["verdicts"]["above_share"] == "above"


def test_time_without_a_known_frame() -> None:
    """Before the first command, and while the stamp in force is unknown, the age may be below or above the limit."""
    frames = [frame(150, 140), frame(500, 490)]
    commands = [command(200, 150), {**command(300, 150), "stamp_ns": 7}, command(550, 500)]
    entry = evaluated(record(ended_ms=600, frame=frames, admission=commands, truth=STEADY)).entry
    # Known: 60 to 160 ms from 0.2 to 0.3 s, 60 to 110 ms from 0.55 s on. Unknown: the other 450 ms.
    assert entry["above_share"] == pytest.approx(((60 + 10) / 600, (60 + 10 + 450) / 600))
    assert entry["above_share"][1] <= 1
    assert entry["picture_age_ms"]["max"][1] == np.inf


@pytest.mark.parametrize("stamped_ms", [0, 5000])
def test_a_frame_is_not_younger_than_its_stamp(stamped_ms: float) -> None:
    """A capture after the stamp counts as the stamp, and a frame that is newer than its command as unknown."""
    frames = [frame(stamped_ms, 9000)]
    commands = [{**command(0, stamped_ms), "stamp_ns": ns(stamped_ms)}]
    entry = evaluated(record(frame=frames, admission=commands, truth=STEADY)).entry
    assert entry["above_share"] == (pytest.approx((0.9, 0.9)) if stamped_ms == 0 else (0.0, 1.0))
    assert entry["picture_age_ms"]["max"] == (pytest.approx((1000.0, 1000.0)) if stamped_ms == 0 else (0.0, np.inf))


def test_a_driver_cannot_take_longer_than_the_loop() -> None:
    """If a client states more time than passed since the exposure, the two-way latency is not known to be within."""
    frames = [frame(number * 200, number * 200 - 10) for number in range(-1, 5)]
    commands = [command(number * 200 + 180, number * 200, driver_ms=10_000) for number in range(-1, 5)]
    entry = evaluated(record(frame=frames, admission=commands, truth=STEADY)).entry
    assert entry["two_way_ms"]["max"] == pytest.approx((0.0, 190.0))
    assert entry["verdicts"]["two_way_above_share"] == "not decided"


def test_the_figure_of_a_drive_shows_lower_bounds() -> None:
    """If a client states an impossible time, the curve of the two-way latency is at its lower bound, 0."""
    frames = [frame(number * 200, number * 200 - 10) for number in range(-1, 5)]
    commands = [command(number * 200 + 180, number * 200, driver_ms=10_000) for number in range(-1, 5)]
    drive = evaluated(record(frame=frames, admission=commands, truth=STEADY))
    age, two_way, *_ = drive_figure(drive, 100.0).axes[0].get_lines()
    assert np.nanmax(age.get_ydata()) == pytest.approx(390.0)
    assert np.nanmax(two_way.get_ydata()) == 0.0


def test_the_driver_takes_its_time() -> None:
    """The two-way latency is the frame age at the application of the command, without the driver's own time."""
    frames = [frame(number * 100, number * 100 - 10) for number in range(-1, 10)]
    commands = [command(number * 100 + 80, number * 100, driver_ms=30) for number in range(-1, 10)]
    entry = evaluated(record(frame=frames, admission=commands, truth=STEADY)).entry
    assert entry["two_way_ms"] == {name: pytest.approx((60.0, 60.0)) for name in ("p50", "p95", "max")}
    assert entry["verdicts"]["two_way_above_share"] == "within"
    assert entry["verdicts"]["above_share"] == "above"


def test_a_person_sees_a_picture_when_the_page_shows_it() -> None:
    """If a person drives, the video ends at the page, with the bound of its clock; without its report it has bounds."""
    frames = [frame(-100, -110), frame(400, 390)]
    commands = [command(-10, -100, driver_ms=60), command(490, 400, driver_ms=60)]
    shown = {"stamp_ns": ns(-100), "shown_wall_ns": commands[0]["sent_wall_ns"] - 20 * NS_PER_MS}
    page = table([{**shown, "bound_ns": 3 * NS_PER_MS}])
    limits = ComplianceLimits(latency_ms=100, nominal_mps=10, outage_ms=900)
    low, high = evaluated(record(frame=frames, admission=commands, truth=STEADY), limits, page).two_way_ns
    # From exposure to application 100 ms; the person had 20 +- 3 ms, and with the second frame 0 to 60 ms.
    assert (low.first / NS_PER_MS).tolist() == pytest.approx([77, 40])
    assert (high.first / NS_PER_MS).tolist() == pytest.approx([83, 100])


def test_outages() -> None:
    """An outage is a time of more than the limit without a command from a newer frame; repeated commands end none."""
    frames = [frame(time_ms, time_ms) for time_ms in (-50, 100, 700, 900)]
    commands = [command(-20, -50), command(150, 100), command(300, 100), command(750, 700), command(950, 900)]
    entry = evaluated(record(ended_ms=2000, frame=frames, admission=commands, truth=STEADY)).entry
    assert entry["outages"] == 2
    assert [(gap["began_s"], gap["length_s"]) for gap in entry["outage_list"]] == [
        pytest.approx((0.15, 0.6)),
        pytest.approx((0.95, 1.05)),
    ]
    assert entry["outage_s"] == pytest.approx(1.65)
    assert entry["longest_outage_s"] == pytest.approx(1.05)
    assert entry["verdicts"]["outages"] == "above"
    # In an outage the two-way latency is the frame age, which is never shorter.
    assert entry["two_way_above_share"] <= entry["above_share"]
    assert entry["two_way_ms"]["max"] == entry["picture_age_ms"]["max"]
    tolerant = ComplianceLimits(latency_ms=100, nominal_mps=10, outage_ms=1200)
    assert (
        evaluated(record(ended_ms=2000, frame=frames, admission=commands, truth=STEADY), tolerant).entry["outages"] == 0
    )


TIMEOUT = "no command from a newer picture for too long"
BRAKING = speeds(
    *((time_ms, 8.0 if time_ms <= 500 else max(0.0, 8.0 - 0.02 * (time_ms - 500))) for time_ms in range(0, 1400, 20))
)
"""A car that brakes with 20 m/s2 from 0.5 s on, until 0.9 s."""


def test_a_minimal_risk_manoeuvre() -> None:
    """A safe stop has its reason, the time until standstill and the distance; its time is not commanded."""
    events = [safety(300, "driving -> degraded: no command"), safety(500, f"degraded -> safe_stop: {TIMEOUT}")]
    frames, commands = [frame(-50, -50)], [command(-20, -50)]
    entry = evaluated(record(1000, events, frame=frames, admission=commands, truth=BRAKING)).entry
    (stop,) = entry["manoeuvre_list"]
    assert (stop["kind"], stop["reason"], stop["ended"]) == ("safe_stop", TIMEOUT, "standstill")
    assert stop["began_s"] == 0.5
    assert stop["speed_kmh"] == pytest.approx(28.8)
    assert stop["until_standstill_s"] == pytest.approx((0.38, 0.4))
    low_m, high_m = stop["distance_m"]
    assert low_m <= 8.0 * 0.4 / 2 <= high_m
    assert high_m - low_m < 0.1
    assert entry["commanded_s"] == 0.5
    assert entry["degraded_s"] == pytest.approx(0.2)
    assert entry["outage_list"] == [{"began_s": 0.0, "length_s": 0.5}]
    assert entry["above_s"] == pytest.approx((0.45, 0.45))
    assert entry["verdicts"]["manoeuvres"] == "above"
    assert entry["verdicts"]["longest_manoeuvre_s"] == "within"


@pytest.mark.parametrize(
    ("events", "kind", "ended"),
    [
        ([safety(600, "safe_stop -> emergency_stop: emergency stop")], "emergency_stop", "standstill"),
        ([safety(950, "safe_stop -> emergency_stop: emergency stop")], "safe_stop", "standstill"),
        ([safety(700, "safe_stop -> disarmed: the driver in the car has taken over")], "safe_stop", "driver override"),
        ([safety(950, "safe_stop -> arming: all arming conditions are met")], "safe_stop", "standstill"),
    ],
)
def test_how_a_manoeuvre_ends(events: list[tuple[str, float, str]], kind: str, ended: str) -> None:
    """A stop that becomes an emergency stop before standstill is one manoeuvre; a driver who takes over ends it."""
    changes = [safety(500, f"driving -> safe_stop: {TIMEOUT}"), *events]
    entry = evaluated(
        record(1000, changes, frame=[frame(-50, -50)], admission=[command(-20, -50)], truth=BRAKING)
    ).entry
    (stop,) = entry["manoeuvre_list"]
    assert (stop["kind"], stop["ended"]) == (kind, ended)
    assert entry["driver_overrides"] == (ended == "driver override")
    if ended == "driver override":
        assert stop["until_standstill_s"] == (pytest.approx(0.2), np.inf)
        assert entry["verdicts"]["longest_manoeuvre_s"] == "not decided"


def test_the_end_of_a_drive_is_no_manoeuvre() -> None:
    """The safe stop because the drive is over is not counted, and neither is a stop of a vehicle at rest."""
    events = [safety(1000, "driving -> safe_stop: the drive is over"), safety(0, "arming -> driving: armed")]
    entry = evaluated(record(1000, events, frame=[frame(-50, -50)], admission=[command(-20, -50)], truth=STEADY)).entry
    assert entry["manoeuvre_list"] == []
    assert entry["commanded_s"] == 1.0


def test_a_standstill_that_was_not_recorded() -> None:
    """A manoeuvre without a standstill in the record has no upper bound; without speeds, no distance either."""
    events = [safety(500, f"driving -> safe_stop: {TIMEOUT}")]
    channels: dict[str, Any] = {"frame": [frame(-50, -50)], "admission": [command(-20, -50)]}
    (moving,) = evaluated(record(1000, events, **channels, truth=STEADY)).entry["manoeuvre_list"]
    assert (moving["ended"], moving["until_standstill_s"]) == ("not recorded", (pytest.approx(0.68), np.inf))
    (unknown,) = evaluated(record(1000, events, **channels)).entry["manoeuvre_list"]
    assert (unknown["speed_kmh"], unknown["distance_m"]) == (None, None)


def test_speed_and_what_latency_allowed() -> None:
    """The blind distance is speed x age; the car is too fast while it exceeds nominal speed x limit, by both bounds."""
    frames, commands = [frame(-50, -50)], [command(-20, -50)]
    limits = ComplianceLimits(latency_ms=100, nominal_mps=16)
    entry = evaluated(record(frame=frames, admission=commands, truth=STEADY), limits).entry
    # 8 m/s are allowed up to an age of 200 ms, which is reached at 0.15 s.
    low, high = entry["too_fast_share"]
    assert low <= 0.85 <= high
    assert high - low < 0.01
    assert entry["blind_distance_m"]["limit"] == pytest.approx(1.6)
    smallest, largest = entry["blind_distance_m"]["max"]
    assert smallest <= 8.0 * 1.05 <= largest
    assert largest < 8.11 * 1.05
    slower = evaluated(record(frame=frames, admission=commands, truth=STEADY), ComplianceLimits(nominal_mps=7.9)).entry
    assert slower["too_fast_share"][1] == 1.0  # with the bound of the speed, always above the nominal speed
    assert slower["verdicts"]["too_fast_share"] == "above"
    unknown = evaluated(record(frame=frames, admission=commands)).entry
    assert unknown["too_fast_share"] == (0.0, 1.0)
    assert unknown["verdicts"]["too_fast_share"] == "not decided"
    assert unknown["distance_m"] is None


def test_a_real_vehicle_reports_its_speed() -> None:
    """Without ground truth, the speeds of the published states count, also backwards."""
    states = [{"state_mono_ns": ns(time_ms), "speed_mps": -3.0} for time_ms in range(0, 1020, 20)]
    entry = evaluated(record(frame=[frame(-50, -50)], admission=[command(-20, -50)], state=states)).entry
    assert entry["speed_source"] == "the vehicle's own report"
    low_m, high_m = entry["distance_m"]
    assert low_m <= 3.0 <= high_m


def test_a_drive_without_length() -> None:
    """A drive that ended when it began, or never began, is not evaluated."""
    with pytest.raises(WorkError, match="no length"):
        evaluated(record(ended_ms=0.0))
    with pytest.raises(WorkError, match="never armed"):
        evaluated(Record(Path("empty"), True, {}, {}, 0))


def test_bounds_of_random_drives() -> None:
    """Bounds are in order, no stretch is longer than the time above, and no share rises with the limit."""
    for seed in range(4):
        random = np.random.default_rng(seed)
        stamped_ms = np.cumsum(random.choice([30, 60, 400], 12, p=[0.6, 0.3, 0.1])) - 60.0
        delays_ms = random.uniform(40, 300, 12)
        frames = [frame(time_ms, None if random.random() < 0.2 else time_ms - 10) for time_ms in stamped_ms]
        commands = [
            command(time_ms + delay_ms, time_ms, driver_ms=random.uniform(0, 30))
            for time_ms, delay_ms in zip(stamped_ms, delays_ms, strict=True)
        ]
        server = record(1200, frame=frames, admission=commands, truth=STEADY)
        before: Mapping[str, Any] | None = None
        for limit_ms in (60, 120, 300):
            limits = ComplianceLimits(latency_ms=limit_ms, nominal_mps=12, camera_ms=20)
            entry = evaluated(server, limits).entry
            shares = {key: entry[key] for key in ("above_share", "two_way_above_share", "too_fast_share")}
            assert all(0 <= low <= high <= 1 for low, high in shares.values())
            for side in (0, 1):
                assert entry["two_way_above_share"][side] <= entry["above_share"][side] + 1e-9
                assert entry["longest_above_s"][side] <= entry["above_s"][side] + 1e-9 <= entry["commanded_s"] + 2e-9
                assert before is None or all(shares[key][side] <= before[key][side] + 1e-9 for key in shares)
            before = shares


def test_the_frame_age_is_that_of_the_metrics(make_run: MakeRun, tmp_path: Path) -> None:
    """From the stamp, the 95th percentile of the frame age is `picture_age_ms.p95` of the run's result."""
    server = read_record(make_run(tmp_path, seconds=2.0) / "server.mcap")
    began_ns, ended_ns, _ = driving_interval(server)
    expected = frame_age(server.table("frame"), server.table("admission"), began_ns, ended_ns)
    assert evaluated(server).entry["picture_age_ms"]["p95"][0] == pytest.approx(expected.p95_ms)


def test_a_record_that_is_read_by_other_means(make_run: MakeRun, tmp_path: Path) -> None:
    """Share, outages and longest stretch agree with a loop over the raw messages of the record's file."""
    directory = make_run(tmp_path, seconds=3.0, capture_ms=8.0, slow_frame_ms=40.0)
    messages: dict[str, list[dict[str, Any]]] = {}
    with (directory / "server.mcap").open("rb") as file:
        for _, channel, message in make_reader(file).iter_messages():
            messages.setdefault(channel.topic, []).append(json.loads(message.data))
    begin_ns, end_ns = (
        next(event["mono_ns"] for event in messages["/event"] if event["kind"] == kind)
        for kind in ("drive_began", "ending")
    )
    captured = {frame["stamp_ns"]: frame["capture_ns"] for frame in messages["/frame"]}
    applied = sorted(
        (entry["applied_mono_ns"], captured[entry["stamp_ns"]])
        for entry in messages["/admission"]
        if entry["verdict"] == "accepted"
    )
    above_ns, stretch_ns, longest_ns = 0, 0, 0
    for (since_ns, capture_ns), (until_ns, _) in itertools.pairwise([*applied, (end_ns, 0)]):
        since_ns, until_ns = max(since_ns, begin_ns), min(until_ns, end_ns)  # noqa: PLW2901
        if until_ns <= since_ns:
            continue
        part_ns = min(max(until_ns - capture_ns - 100 * NS_PER_MS, 0), until_ns - since_ns)
        stretch_ns = stretch_ns + part_ns if since_ns - capture_ns >= 100 * NS_PER_MS else part_ns
        above_ns, longest_ns = above_ns + part_ns, max(longest_ns, stretch_ns)
    entry = evaluated(read_record(directory / "server.mcap")).entry
    assert above_ns > 0
    assert entry["above_s"] == pytest.approx((above_ns / NS_PER_S,) * 2)
    assert entry["longest_above_s"] == pytest.approx((longest_ns / NS_PER_S,) * 2)
