from __future__ import annotations

import json
import math
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from benchmarks import endurance, video_vs_gstreamer
from benchmarks.video.impaired import CASES, psnr_db, undamaged_share
from benchmarks.video.processes import WARM_UP_FRAMES, frames_of
from benchmarks.video.relay import LinkCase, PacketImpairment, TrafficCounter
from tests.interop.tools import missing_tools
from tests.require import need

from lavt.runtime import process_priority
from lavt.vehicle.sim.road.road import parse_road

BENCHMARKS = Path(__file__).parents[1] / "benchmarks"


def test_defaults_measure_every_part() -> None:
    """By default all parts are measured: several pairs of runs (LAVT, GStreamer), and a minute on impaired links."""
    requested = video_vs_gstreamer.parse_arguments([])
    assert requested.pairs > 1
    assert requested.frames >= 60 * 30
    assert requested.only is None
    assert set(video_vs_gstreamer.parts(requested, Path())) >= {"480p", "720p", "reorder", "loss1", "loss5"}


def test_only_the_pictures_of_the_requested_parts_are_rendered() -> None:
    """Pictures are rendered in the sizes of the requested parts."""
    for requested_parts, names in ((["720p"], ["720p"]), (["loss1"], ["480p"]), (["loss1", "720p"], ["480p", "720p"])):
        assert [size.name for size in video_vs_gstreamer.needed_sizes(requested_parts)] == names


@pytest.mark.parametrize("arguments", [["--pairs", "0"], ["--seconds", "0"], ["--frames", "0"]])
def test_empty_measurements_are_rejected(arguments: list[str]) -> None:
    """A benchmark without pairs, time or frames is rejected with exit status 2."""
    with pytest.raises(SystemExit) as ended:
        video_vs_gstreamer.parse_arguments(arguments)
    assert ended.value.code == 2


def test_missing_gstreamer_is_reported_with_the_packages_to_install(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """If GStreamer cannot be imported, the benchmark exits with 2 and names the packages to install in one line."""
    monkeypatch.setattr(process_priority, "raise_priority", lambda: None)  # it would change the priority of all tests
    monkeypatch.setitem(sys.modules, "gi", None)
    monkeypatch.setattr(sys, "argv", ["video_vs_gstreamer.py"])
    assert video_vs_gstreamer.main() == 2
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert "apt-get install" in message


def test_a_frame_is_damaged_if_it_is_2_db_worse_or_not_shown() -> None:
    """A frame is damaged if it is not shown, or more than 2 dB worse than in the loss-free decode."""
    loss_free = [10.0] * (WARM_UP_FRAMES + 4)
    squared_errors = {0: 10.0, 1: 10.0 * 10**0.19, 2: 10.0 * 10**0.21}
    received = {WARM_UP_FRAMES + frame: error for frame, error in squared_errors.items()}
    assert undamaged_share(received, loss_free) == 0.5
    assert psnr_db(255.0**2) == 0.0
    assert psnr_db(0.0) == math.inf


def test_two_links_of_a_case_are_identical() -> None:
    """Delay and loss of a packet depend only on its number, so two links of one case agree on every packet."""
    for case in CASES:
        one_link, other_link = PacketImpairment(case), PacketImpairment(case)
        assert [one_link.next_delay_ns() for _ in range(2000)] == [other_link.next_delay_ns() for _ in range(2000)]


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_link_follows_the_case(case: LinkCase) -> None:
    """Over 100000 packets the loss, the burst length and the range of the jitter are those of the case."""
    impairment = PacketImpairment(case)
    delays_ns = [impairment.next_delay_ns() for _ in range(100_000)]
    lost = np.array([delay_ns is None for delay_ns in delays_ns])
    assert abs(lost.mean() - case.loss) <= 0.1 * case.loss
    if case.burst_packets:
        is_burst_start = lost[1:] & ~lost[:-1]
        assert abs(lost.sum() / is_burst_start.sum() - case.burst_packets) < 0.3
    delays_of_arrived_ns = [delay_ns for delay_ns in delays_ns if delay_ns is not None]
    assert 0 <= min(delays_of_arrived_ns) <= max(delays_of_arrived_ns) <= case.jitter_ms * 1e6
    assert max(delays_of_arrived_ns) >= 0.99 * case.jitter_ms * 1e6


def test_traffic_is_counted_by_payload_type_from_the_last_warm_up_packet_on() -> None:
    """Bytes and losses are counted from the last packet of the warm-up on, by payload type; RTCP is not counted."""
    traffic = TrafficCounter()
    media_type, repair_type, rtcp_type, marker = 96, 97, 200, 0x80
    media, last_of_frame, repair, report = (
        bytes([0x80, second_byte]) + bytes(98)
        for second_byte in (media_type, media_type | marker, repair_type, rtcp_type)
    )
    for _ in range(WARM_UP_FRAMES - 1):
        traffic.note(media, lost=True)
        traffic.note(last_of_frame, lost=False)
    assert traffic.counts == {}
    for datagram, lost in ((last_of_frame, False), (media, True), (repair, False), (repair, True), (report, True)):
        traffic.note(datagram, lost=lost)
    assert traffic.counts == {
        "media_bytes": 200,
        "media_packets": 2,
        "media_lost": 1,
        "repair_bytes": 200,
        "repair_packets": 2,
        "repair_lost": 1,
    }


def test_warm_up_frames_are_additional() -> None:
    """A run of 10 s has 300 frames after the warm-up."""
    assert frames_of(10) - WARM_UP_FRAMES == 300


def test_growth_is_the_slope_of_memory() -> None:
    """Memory that grows by 2 kB/s grows by 120 kB/min, independent of its size at the start."""
    samples = [endurance.ResourceSample(at_s, memory_kb=50_000 + 2 * at_s, threads=5) for at_s in range(60)]
    assert endurance.growth_kb_per_minute(samples) == pytest.approx(120)


def test_latency_is_summarized_for_every_10_s() -> None:
    """Each median is over 300 frames; a shorter interval at the end is ignored."""
    latency_ms = np.repeat([1.0, 2.0, 9.0], [300, 300, 100])
    assert endurance.medians_ms(latency_ms) == [1.0, 2.0]


def test_growth_is_reported() -> None:
    """Growing memory, threads and latency are each reported; steady memory, threads and latency are not."""
    steady = [endurance.ResourceSample(float(at_s), memory_kb=50_000, threads=5) for at_s in range(60)]
    growing = [
        endurance.ResourceSample(float(at_s), memory_kb=50_000 + 10 * at_s, threads=5 + at_s // 50)
        for at_s in range(60)
    ]
    steady_latency_ms, growing_latency_ms = np.full(1200, 4.0), np.linspace(4.0, 8.0, 1200)
    assert endurance.describe_growth({"sender": steady}, steady_latency_ms) == []
    messages = endurance.describe_growth({"sender": growing}, growing_latency_ms)
    assert len(messages) == 3
    assert all(word in message for word, message in zip(("memory", "threads", "latency"), messages, strict=True))


@pytest.mark.full
def test_the_video_benchmark_runs() -> None:
    """`benchmarks/video_vs_gstreamer.py` prints its tables and, in the last line, the requested ratios and shares."""
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "video_vs_gstreamer.py", "--quick", "--only", "480p", "--only", "loss1"],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    if completed.returncode == 2 and not missing_tools():
        pytest.skip(f"Debian's GStreamer modules do not support this Python: {completed.stderr}")
    if completed.returncode == 2:
        need("gstreamer", completed.stderr)
    assert completed.returncode == 0, completed.stderr
    result = json.loads(completed.stdout.splitlines()[-1])
    assert list(result) == ["480p", "loss1"]
    assert list(result["480p"]) == ["median_ratio", "cpu_ratio", "over_floor_ms"]  # the floor is the codec alone
    assert list(result["loss1"]) == ["undamaged", "overhead", "gstreamer_undamaged"]
    assert result["480p"]["median_ratio"] > 0
    assert 0 < result["loss1"]["undamaged"] <= 1
    assert "| LAVT 1 | " in completed.stdout
    assert "| GStreamer, usual settings | " in completed.stdout


@pytest.mark.parametrize(("kb_per_s", "status"), [(10, 0), (50, 1)])
def test_growth_on_a_long_road_is_an_error(
    kb_per_s: int, status: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The benchmark fails if memory grows along a long road by more than 1000 kB/min."""
    samples = [endurance.ResourceSample(at_s, memory_kb=400_000 + kb_per_s * at_s, threads=5) for at_s in range(240)]
    monkeypatch.setattr(endurance, "drive_long_road", lambda _length_km, _folder: samples)
    assert endurance.check_long_road(5.0) == status
    assert f"grew by {60 * kb_per_s} kB/min" in capsys.readouterr().out


@pytest.mark.parametrize(("requested_km", "length_m"), [(0.1, 500.0), (1.0, 1000.0), (4.55, 4600.0)])
def test_the_long_road_has_the_requested_length(requested_km: float, length_m: float) -> None:
    """The road of the benchmark ends with the first segment that makes it as long as requested."""
    road = parse_road(endurance.long_road(requested_km), "long.yaml")
    assert road.route_length_m == pytest.approx(length_m)


@pytest.mark.full
def test_a_long_road_is_driven() -> None:
    """`benchmarks/endurance.py --road-km` drives the whole road, and prints the memory and, last, its verdict."""
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "endurance.py", "--road-km", "0.1"],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert completed.stdout.splitlines()[-1] in {"Nothing grew.", "Memory grew too much."}, completed.stderr


@pytest.mark.full
def test_the_endurance_benchmark_runs() -> None:
    """`benchmarks/endurance.py` prints memory and threads of both processes, latency and, last, its verdict."""
    completed = subprocess.run(
        [sys.executable, BENCHMARKS / "endurance.py", "--minutes", "0.1"],
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert "| our_sender | " in completed.stdout
    assert "| our_receiver | " in completed.stdout
    assert "of 180." in completed.stdout
    assert completed.stdout.splitlines()[-1].startswith(("Nothing grew", "Something grew"))
