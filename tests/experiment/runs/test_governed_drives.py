"""Whole drives of a vehicle with a speed governor, in virtual time without pixels."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import pytest

from lavt.assembly.nodes import build_governor
from lavt.config import RunConfig, SweepConfig
from lavt.config_file import build_config, load_config, shipped
from lavt.domain import NS_PER_S, Now
from lavt.experiment.analysis.metrics import measure
from lavt.experiment.runs.monitored_run import drive_monitored
from lavt.experiment.runs.plan import plan_run, plan_sweep
from lavt.experiment.runs.virtual_run import build_loop, drive
from lavt.nodes.payloads import SpeedLimitSample
from lavt.recording.record import Record, read_record
from lavt.runtime.recorder import Recorders

pytestmark = pytest.mark.full

STEP_MS = 260.0
"""By how much the delay of the video rises and falls in the middle of the drive."""
STEP_BEGINS_NS, STEP_ENDS_NS, END_NS = 15 * NS_PER_S, 22 * NS_PER_S, 42 * NS_PER_S
"""Times since the start of the run; the car begins to drive after about 2 s."""
FIRST_LIMIT_S = 0.6
"""The time from the step until enough of its late pictures were in force to be a twentieth of the window."""
COMFORT_MPS2 = 2.0
KMPH = 1 / 3.6
CHANGES = (
    "fidelity=geometry",
    "vehicle.route=straight",
    "costs=constant",
    "safety.governor.enabled=true",
)


@dataclass(frozen=True)
class GovernedDrive:
    """The limits and the true speeds of a drive, by the time since the start of the run in s."""

    record: Record
    limits: list[tuple[float, SpeedLimitSample]]
    speeds_mps: list[tuple[float, float]]

    def limit_at(self, at_s: float) -> SpeedLimitSample:
        """Return the limit at a time."""
        return next(sample for sample_s, sample in self.limits if sample_s >= at_s)

    def speed_at(self, at_s: float) -> float:
        """Return the true speed at a time."""
        return next(speed_mps for speed_s, speed_mps in self.speeds_mps if speed_s >= at_s)


class KeptChannels:
    """A recorder that keeps the payloads of two channels in memory."""

    def __init__(self) -> None:
        self.payloads: defaultdict[str, list[Any]] = defaultdict(list)

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (part of the protocol)
        """Keep the payload."""
        if topic in {"truth", "speed_limit"}:
            self.payloads[topic].append(payload)


@cache
def drive_with_a_step() -> GovernedDrive:
    """Drive on a straight road; in the middle, the delay of the video rises by `STEP_MS` for seven seconds."""
    kept = KeptChannels()
    with TemporaryDirectory() as directory:
        loop = build_loop(plan_run(build_config(RunConfig, {}, CHANGES, "test")), Path(directory) / "run")
        server = loop.runtime.hosts["server"]
        server.recorder = Recorders(server.recorder, kept)
        line = loop.runtime.links["rtp"].line
        slow, fast = replace(line.delay, constant_ms=line.delay.constant_ms + STEP_MS), line.delay
        loop.runtime.call_at(STEP_BEGINS_NS, setattr, line, "delay", slow)
        loop.runtime.call_at(STEP_ENDS_NS, setattr, line, "delay", fast)
        start_ns = server.clock.now_at(0).mono_ns
        drive(loop, limit_ns=END_NS)
        record = read_record(Path(directory) / "run" / "server.mcap")
        record.table("frame"), record.table("admission"), record.table("speed_limit"), record.table("event")
    limits = [((sample.mono_ns - start_ns) / NS_PER_S, sample) for sample in kept.payloads["speed_limit"]]
    speeds = [((truth.mono_ns - start_ns) / NS_PER_S, truth.speed_mps) for truth in kept.payloads["truth"]]
    return GovernedDrive(record, limits, speeds)


def test_a_step_of_the_delay_lowers_the_limit_at_once() -> None:
    """Shortly after the step, the limit is that of the new age, and the reason is the latency."""
    drive = drive_with_a_step()
    begins_s = STEP_BEGINS_NS / NS_PER_S
    assert drive.limit_at(begins_s - 0.1).limit_mps > 30 * KMPH
    fallen = drive.limit_at(begins_s + FIRST_LIMIT_S)
    assert fallen.reason == "latency"
    assert fallen.age_ms is not None
    assert fallen.age_ms > 290
    assert fallen.limit_mps <= 40 * KMPH * 200 / 290
    stepped = [sample.limit_mps for at_s, sample in drive.limits if begins_s < at_s < STEP_ENDS_NS / NS_PER_S]
    assert max(later - earlier for earlier, later in pairwise(stepped)) < 0.1


def test_the_car_slows_down_to_the_limit_comfortably() -> None:
    """The car is at its limit within the time that the comfortable deceleration and the lag of the brake need."""
    drive = drive_with_a_step()
    begins_s = STEP_BEGINS_NS / NS_PER_S
    before_mps = drive.speed_at(begins_s)
    limit_mps = drive.limit_at(begins_s + FIRST_LIMIT_S).limit_mps
    slowed_s = begins_s + FIRST_LIMIT_S + (before_mps - limit_mps) / COMFORT_MPS2 + 1.0
    assert before_mps > limit_mps + 0.3
    until_s = STEP_ENDS_NS / NS_PER_S
    excess = [speed - drive.limit_at(at_s).limit_mps for at_s, speed in drive.speeds_mps if slowed_s < at_s < until_s]
    assert len(excess) > 50
    assert max(excess) < 0.15
    of_step = [(at_s, speed) for at_s, speed in drive.speeds_mps if begins_s < at_s < until_s]
    changes = [(later - before) / (t2 - t1) for (t1, before), (t2, later) in zip(of_step, of_step[10:], strict=False)]
    assert min(changes) > -COMFORT_MPS2 - 0.5


def test_after_the_step_the_limit_rises_slowly() -> None:
    """The limit begins to rise when the late pictures have left the window, at 0.5 m/s2, until it is the old one."""
    drive = drive_with_a_step()
    ends_s = STEP_ENDS_NS / NS_PER_S
    low_mps = drive.limit_at(ends_s).limit_mps
    assert drive.limit_at(ends_s + 4.0).limit_mps < low_mps + 0.2
    rising = [(at_s, sample) for at_s, sample in drive.limits if sample.reason == "recovery" and at_s > ends_s]
    assert rising
    (from_s, first), (until_s, last) = rising[0], rising[-1]
    assert 4.5 < from_s - ends_s < 6.5
    assert last.limit_mps - first.limit_mps == pytest.approx(0.5 * (until_s - from_s), rel=0.05)
    assert drive.limits[-1][1].reason == "stopping distance"
    assert drive.speeds_mps[-1][1] > 29 * KMPH


def test_the_limits_of_a_drive_can_be_computed_again_from_its_record() -> None:
    """A governor that gets the frames and commands of the record has the recorded ages and limits."""
    drive = drive_with_a_step()
    governor = build_governor(build_config(RunConfig, {}, CHANGES, "test").safety)
    assert governor is not None
    frames, commands = drive.record.table("frame"), drive.record.table("admission")
    captured_ns = dict(zip(frames.ints("stamp_ns").tolist(), frames.ints("capture_ns").tolist(), strict=True))
    applied = [
        (applied_ns, captured_ns[stamp_ns], mode)
        for applied_ns, stamp_ns, mode, verdict in zip(
            commands.ints("applied_mono_ns").tolist(),
            commands.ints("stamp_ns").tolist(),
            commands.texts("mode"),
            commands.texts("verdict"),
            strict=True,
        )
        if verdict == "accepted"
    ]
    last_arm_ns = max(applied_ns for applied_ns, _, mode in applied if mode == "arm")
    differences_mps, differences_ms = [], []
    for _, sample in drive.limits:
        while applied and applied[0][0] <= sample.mono_ns:
            applied_ns, frame_ns, _ = applied.pop(0)
            if applied_ns == last_arm_ns:
                governor.begin_drive(applied_ns)
            governor.note_age(applied_ns - frame_ns, applied_ns)
        age_s = governor.age_s(sample.mono_ns)
        assert age_s is not None
        assert sample.age_ms is not None
        differences_ms.append(abs(age_s * 1000 - sample.age_ms))
        if sample.reason not in {"stopping distance", "speed"}:
            differences_mps.append(abs(governor.limit(sample.mono_ns).mps - sample.limit_mps))
        else:
            governor.limit(sample.mono_ns)
    assert len(differences_mps) > 300
    assert sorted(differences_ms)[-20] < 1.0
    assert sorted(differences_mps)[-20] < 0.1


def test_the_result_has_the_time_of_each_reason() -> None:
    """`speed_limits` of the result has the time and the share of each reason; all shares together are 1."""
    drive = drive_with_a_step()
    limits = measure(drive.record, drive.record).entry["speed_limits"]
    assert limits["time_s"] == pytest.approx((END_NS - STEP_BEGINS_NS) / NS_PER_S + 12, abs=3)
    assert list(limits["reasons"]) == ["stopping distance", "latency", "recovery"]
    assert sum(reason["share"] for reason in limits["reasons"].values()) == pytest.approx(1.0)
    assert limits["reasons"]["latency"]["time_s"] == pytest.approx(12.0, abs=2.0)
    assert limits["lowest_mps"] == min(sample.limit_mps for _, sample in drive.limits)


def test_delay_margins_keep_the_lane_keeper_in_its_lane_at_l5() -> None:
    """At L5 the lane keeper touches lines; with the delay margins of its preset it drives slower, and touches none."""
    settings = ("routes=[a_key]", "conditions=[L5]")
    without, governed = plan_sweep(load_config(SweepConfig, shipped("configs/governor.yaml"), settings))
    free, slow = drive_monitored(without), drive_monitored(governed)
    assert (free.ending, slow.ending) == ("completed", "completed")
    assert free.lane_invasions > 0
    assert slow.lane_invasions == 0
    assert max(abs(slow.cross_track_m)) < max(abs(free.cross_track_m)) / 2
    assert np.median(slow.speed_mps) < 13 * KMPH
