"""Tests of the whole loop in virtual time, with real pixels, codec and packets."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from msgspec.structs import replace

from lavt.config import RunConfig
from lavt.config_file import condition, load_config, shipped
from lavt.domain import NS_PER_S, Picture, Pose
from lavt.experiment.analysis.metrics import driving_interval, measure
from lavt.experiment.analysis.results import run_result
from lavt.experiment.runs.monitored_run import drive_monitored
from lavt.experiment.runs.network import VIDEO_LATENCY_STAGES, injected_network
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.experiment.runs.run import run_once
from lavt.experiment.runs.virtual_run import VirtualLoop, build_loop, drive, host_clocks, read_costs
from lavt.recording.record import Record, read_record
from lavt.runtime.virtual import modelled_clock_source
from lavt.streams import stream
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.vehicle.camera import CapturedFrame
from lavt.vehicle.sim.rendering.renderer import Renderer

NO_SCENERY = "vehicle.scenery=none"
GREY_FROM_FRAME = 240  # 8 s: the car drives at 30 km/h and is about to enter the curve

Change = Callable[[VirtualLoop], None]


def planned(*changes: str) -> PlannedRun:
    """Plan a run of the demo with constant costs, so that its latencies are known exactly."""
    return plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), ("costs=constant", *changes)))


def run(
    out: Path, planned_run: PlannedRun, *, change: Change = lambda _: None, seconds: float = 600.0, **keys: Any
) -> VirtualLoop:
    out.mkdir()
    loop = build_loop(planned_run, out, **keys)
    change(loop)
    drive(loop, limit_ns=round(seconds * NS_PER_S))
    return loop


def records(out: Path) -> tuple[Record, Record]:
    return read_record(out / "server.mcap"), read_record(out / "client.mcap")


def changing_pictures(change: Callable[[int, Picture], Picture]) -> Change:
    """Return a change of the loop that applies a function of (frame number, picture) to the camera's pictures."""

    def install(loop: VirtualLoop) -> None:
        node = loop.server.camera
        original_capture = node._capture_after_exposure

        def capture_after_exposure(number: int, begin_ns: int, poses: Sequence[Pose]) -> CapturedFrame | None:
            frame = original_capture(number, begin_ns, poses)
            return None if frame is None else replace(frame, picture=change(number, frame.picture))

        node._capture_after_exposure = capture_after_exposure

    return install


@pytest.fixture(scope="module")
def l0(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Drive at L0 with scenery, on hosts whose clocks are 250 ms and 20 ppm apart, and return the run directory."""
    out = tmp_path_factory.mktemp("virtual") / "l0"
    run(out, planned())
    return out


def test_the_car_keeps_its_lane_without_delay(l0: Path) -> None:
    """At L0 the lane keeper completes the route with a cross-track P95 under 0.3 m, in a valid run."""
    result = run_result(planned().identity, *records(l0))
    assert result["ending"] == "completed"
    assert result["p95_m"] < 0.3
    assert result["lane_invasions"] == 0
    assert result["valid"], result["invalid_reasons"]


def count_renderers() -> int:
    return sum(type(thing) is Renderer for thing in gc.get_objects())


@pytest.mark.full
def test_a_finished_run_leaves_no_painted_world(tmp_path: Path) -> None:
    """After a run with pictures, its renderer with the painted ground is freed without waiting for Python's search."""
    short = planned("fidelity=pixels", "vehicle.scenery=none", "vehicle.time_limit_s=1")
    gc.collect()
    gc.disable()
    try:
        before = count_renderers()
        run_once(short, tmp_path / "run")
        assert count_renderers() == before
        drive_monitored(short)
        assert count_renderers() == before
    finally:
        gc.enable()


def true_latencies_ms(run: PlannedRun) -> tuple[float, float]:
    """Return the modelled latencies of video and control with constant costs: stages plus link delays."""
    costs = read_costs()
    requested = injected_network(
        run.config.network.inherent, condition(run.config.network.condition), costs, run.seed, state_delay="none"
    )
    stages_us = sum(costs.stages_us.get(node, {}).get(stage, 0.0) for node, stage in VIDEO_LATENCY_STAGES)
    video_us = stages_us + costs.links_us["video"]
    control_us = costs.links_us["control"] + costs.stages_us["driver"]["command"]
    return requested.video.constant_ms + video_us / 1000, requested.control.constant_ms + control_us / 1000


def test_latencies_are_correct_within_their_bound(l0: Path) -> None:
    """With clocks 250 ms and 20 ppm apart, the median tau_v and tau_c are correct within their bound."""
    entry = measure(*records(l0)).entry
    video_ms, control_ms = true_latencies_ms(planned())
    for name, truth_ms in (("tau_v_ms", video_ms), ("tau_c_ms", control_ms)):
        assert 0 < entry[name]["bound"] <= 2.0
        assert abs(entry[name]["p50"] - truth_ms) <= entry[name]["bound"], name


def test_ignoring_the_clock_offset_makes_latencies_wrong(tmp_path: Path) -> None:
    """If time sources ignore the clock offset, tau_v and tau_c are wrong by the offset: the test above can fail."""

    def ignore_offset(loop: VirtualLoop) -> None:
        for side, host in loop.runtime.hosts.items():
            host.clock_source = partial(
                lambda name, clock, true_ns: ClockReport(
                    clock.now_at(true_ns).mono_ns, clock.now_at(true_ns).wall_ns, name, "wrong", 0.0, 0.0001
                ),
                side,
                host.clock,
            )

    out = tmp_path / "run"
    run(out, planned(NO_SCENERY), change=ignore_offset, seconds=5)
    entry = measure(*records(out)).entry
    video_ms, control_ms = true_latencies_ms(planned(NO_SCENERY))
    assert entry["tau_v_ms"]["p50"] == pytest.approx(video_ms - 250, abs=1)
    assert entry["tau_c_ms"]["p50"] == pytest.approx(control_ms + 250, abs=1)
    assert entry["loop_ms"]["p50"] == pytest.approx(video_ms + control_ms, abs=20)  # independent of the clock offset


def test_the_injected_delay_is_measured(l0: Path, tmp_path: Path) -> None:
    """The medians of tau_v, tau_c and the loop latency at L5 are those at L0 plus the injected delay."""
    out = tmp_path / "l5"
    run(out, planned(NO_SCENERY, "network.condition=L5"), seconds=8)
    before, after = measure(*records(l0)).entry, measure(*records(out)).entry
    for name, injected_ms in (("tau_v_ms", 225.0), ("tau_c_ms", 100.0), ("loop_ms", 325.0)):
        assert after[name]["p50"] - before[name]["p50"] == pytest.approx(injected_ms, abs=0.5), name


@pytest.mark.full
def test_the_inherent_profile_has_the_papers_median_and_p95(tmp_path: Path) -> None:
    """With `paper_wifi5`, tau_v has the paper's median of 62 and P95 of 86 ms, and tau_c is 9 ms."""
    out = tmp_path / "run"
    run(out, planned(NO_SCENERY, "network.inherent=paper_wifi5"), seconds=30)
    entry = measure(*records(out)).entry
    assert entry["tau_v_ms"]["p50"] == pytest.approx(62, abs=2)
    assert entry["tau_v_ms"]["p95"] == pytest.approx(86, abs=8)
    assert entry["tau_c_ms"]["p50"] == pytest.approx(9, abs=0.5)


# Reproducibility: digests.

DIGEST_PROGRAM = """
import sys
from pathlib import Path
import cv2
from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import build_loop, drive
cv2.setNumThreads(1)
loop = build_loop(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"))), Path(sys.argv[1]))
drive(loop, limit_ns=4_000_000_000)
print(loop.digest.hexdigest())
"""


def digest(out: Path, *changes: str, change: Change = lambda _: None) -> str:
    hexadecimal: str = run(out, planned(NO_SCENERY, *changes), change=change, seconds=2.2).digest.hexdigest()
    return hexadecimal


def flip_a_pixel(number: int, picture: Picture) -> Picture:
    if number == 60:
        picture[300, 320, 1] ^= 128
    return picture


def flip_a_bit_of_a_command(loop: VirtualLoop) -> None:
    line = loop.runtime.links["control"].line
    push, numbers = line.push, iter(range(10**9))

    def flip(item: tuple[bytes, Any], now_ns: int, index: int, size_bytes: int = 0) -> int | None:
        payload, peer = item
        if next(numbers) == 50:
            payload = payload[:-12] + bytes([payload[-12] ^ 1]) + payload[-11:]
        return push((payload, peer), now_ns, index, size_bytes)

    line.push = flip  # type: ignore[method-assign]


def test_the_digest_is_reproducible_and_sensitive(tmp_path: Path) -> None:
    """Equal runs have equal digests; another seed, one changed pixel or one changed bit of a command changes it."""
    digests = [
        digest(tmp_path / "first"),
        digest(tmp_path / "seed", "seed=2"),
        digest(tmp_path / "pixel", change=changing_pictures(flip_a_pixel)),
        digest(tmp_path / "bit", change=flip_a_bit_of_a_command),
    ]
    assert len(set(digests)) == 4
    assert digest(tmp_path / "again") == digests[0]


@pytest.mark.full
def test_the_digest_does_not_depend_on_the_hash_seed(tmp_path: Path) -> None:
    """Processes with different PYTHONHASHSEEDs compute the same digest."""
    digests = set()
    for hash_seed in ("1", "2"):
        (tmp_path / hash_seed).mkdir()
        completed = subprocess.run(
            [sys.executable, "-c", DIGEST_PROGRAM, str(tmp_path / hash_seed)],
            env={**os.environ, "PYTHONHASHSEED": hash_seed},
            capture_output=True,
            text=True,
            check=True,
        )
        digests.add(completed.stdout.strip())
    assert len(digests) == 1


# Dependence on the pictures.


def noisy_grey(number: int, picture: Picture) -> Picture:
    if number < GREY_FROM_FRAME:
        return picture
    return stream(1, "grey", number).integers(120, 136, picture.shape, np.uint8)


def grey(number: int, picture: Picture) -> Picture:
    return picture if number < GREY_FROM_FRAME else np.full_like(picture, 128)


def mirror(_number: int, picture: Picture) -> Picture:
    return np.ascontiguousarray(picture[:, ::-1])


@pytest.mark.full
@pytest.mark.parametrize("change", [noisy_grey, grey])
def test_grey_pictures_stop_the_car(tmp_path: Path, change: Callable[[int, Picture], Picture]) -> None:
    """Grey pictures, noisy or constant, lead to a safe stop within 3 s."""
    out = tmp_path / "run"
    run(out, planned(NO_SCENERY), change=changing_pictures(change), seconds=60)
    server, _ = records(out)
    frames = server.table("frame")
    grey_ns = int(frames.ints("stamped_mono_ns")[frames.ints("number") == GREY_FROM_FRAME][0])
    events = server.table("event")
    stops = [
        mono_ns
        for mono_ns, detail in zip(events.ints("mono_ns").tolist(), events.texts("detail"), strict=True)
        if "-> safe_stop" in detail
    ]
    assert stops
    assert 0 < stops[0] - grey_ns <= 3 * NS_PER_S
    _, _, ending = driving_interval(server)
    assert ending == "safe_stop"


@pytest.mark.full
def test_mirrored_pictures_make_the_car_leave_its_lane(tmp_path: Path) -> None:
    """Mirrored pictures make the car leave its lane: the controller depends on the pictures."""
    out = tmp_path / "run"
    run(out, planned(NO_SCENERY), change=changing_pictures(mirror), seconds=60)
    entry = measure(*records(out)).entry
    assert entry["ending"] != "completed"
    assert entry["lane_invasions"] > 0


def test_a_lost_vehicle_state_stops_the_car(tmp_path: Path) -> None:
    """If the vehicle's state no longer arrives at the client, the drive soon ends with a safe stop."""

    def lose_the_state(loop: VirtualLoop) -> None:
        loop.runtime.call_at(8 * NS_PER_S, lambda: setattr(loop.runtime.links["state"], "open", False))

    out = tmp_path / "run"
    run(out, planned("fidelity=geometry"), change=lose_the_state, seconds=60)
    entry = measure(*records(out)).entry
    assert entry["ending"] == "safe_stop"
    assert entry["duration_s"] < 11


# Clock steps.


@pytest.mark.parametrize("step_s", [1, -1])
@pytest.mark.parametrize("side", [0, 1])
def test_a_step_of_the_wall_clock_changes_no_safety_state(tmp_path: Path, side: int, step_s: int) -> None:
    """If either host's wall clock steps by 1 s in either direction, no safety state changes; the run is invalid."""
    config = planned("fidelity=geometry")
    clocks = host_clocks(config.config)
    clocks[side].steps = [(8 * NS_PER_S, step_s * NS_PER_S)]
    out = tmp_path / "run"

    def add_time_sources(loop: VirtualLoop) -> None:
        for host in loop.runtime.hosts.values():
            host.clock_source = modelled_clock_source(host.clock, host.side, 0.0, 0.0001)

    run(out, config, change=add_time_sources, clocks=clocks)
    server, client = records(out)
    safety_changes = [
        detail
        for kind, detail in zip(server.table("event").texts("kind"), server.table("event").texts("detail"), strict=True)
        if kind == "safety"
    ]
    assert [detail.split(":")[0] for detail in safety_changes] == [
        "disarmed -> arming",
        "arming -> driving",
        "driving -> safe_stop",  # the route is completed
    ]
    result = run_result(config.identity, server, client)
    assert result["ending"] == "completed"
    assert "clock_step" in {reason["code"] for reason in result["invalid_reasons"]}
