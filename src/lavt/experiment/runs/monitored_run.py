"""A drive in virtual time that leaves no record: what was seen of it, for searches that drive many hundred times."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S, FloatArray, Now
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.virtual_run import EndingTap, build_loop, drive
from lavt.nodes.payloads import Admission, FrameWritten

KEPT = frozenset({"truth", "event", "frame", "admission"})


NEVER_NS = 2**62
"""When a drive began that did not."""


class InMemoryRecorder:
    """A recorder that keeps the payloads of a few channels in memory."""

    def __init__(self) -> None:
        self.payloads: defaultdict[str, list[Any]] = defaultdict(list)

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (a recorder is told when)
        """Keep one entry."""
        if topic in KEPT:
            self.payloads[topic].append(payload)


@dataclass(frozen=True, slots=True)
class MonitoredRun:
    """What was seen of one drive, from its beginning to its ending; no rows where the vehicle was never armed."""

    ending: str | None
    lane_invasions: int
    total_delay_ms: float
    """Median over frames from the middle of exposure to the first obeyed command made from them; NaN without one."""
    time_s: FloatArray
    """Since the beginning; of each row of the three below."""
    cross_track_m: FloatArray
    speed_mps: FloatArray
    limited_s: FloatArray
    """When commands were changed by a limit of the vehicle's safety."""


def drive_monitored(planned: PlannedRun, *, limit_s: float = 3600.0) -> MonitoredRun:
    """Drive, keeping in memory what is watched.

    It is the drive that `run_once` makes, but for its records: they are begun in a temporary directory that is removed.
    """
    cv2.setNumThreads(1)
    keeper = InMemoryRecorder()
    with TemporaryDirectory() as directory:
        loop = build_loop(planned, Path(directory) / "run")
        tap = EndingTap(keeper)
        loop.runtime.hosts["server"].recorder = tap
        loop.runtime.hosts["client"].recorder = InMemoryRecorder()
        drive(replace(loop, tap=tap), limit_ns=round(limit_s * NS_PER_S))
    return watched(keeper.payloads)


def watched(payloads: dict[str, list[Any]]) -> MonitoredRun:
    """Make of the payloads of each channel of the server what is known of the drive."""
    began_ns = next((event.mono_ns for event in payloads["event"] if event.kind == "drive_began"), NEVER_NS)
    ended = next(((each.mono_ns, each.detail) for each in payloads["event"] if each.kind == "ending"), None)
    ended_ns, ending = ended or (payloads["truth"][-1].mono_ns, None)
    within = [truth for truth in payloads["truth"] if began_ns <= truth.mono_ns <= ended_ns]
    accepted = [each for each in payloads["admission"] if each.verdict == "accepted" and each.mode == "drive"]
    accepted = [each for each in accepted if began_ns <= each.applied_mono_ns <= ended_ns]

    def since_began_s(times_ns: list[int]) -> FloatArray:
        return np.asarray((np.array(times_ns, np.int64) - began_ns) / NS_PER_S, np.float64)

    events = [event for event in payloads["event"] if began_ns <= event.mono_ns <= ended_ns]
    return MonitoredRun(
        ending=ending,
        lane_invasions=sum(event.kind == "lane_invasion" for event in events),
        total_delay_ms=_total_delay_ms(payloads["frame"], accepted),
        time_s=since_began_s([truth.mono_ns for truth in within]),
        cross_track_m=np.array([truth.cross_track_m for truth in within], np.float64),
        speed_mps=np.array([truth.speed_mps for truth in within], np.float64),
        limited_s=since_began_s([each.applied_mono_ns for each in accepted if each.limited]),
    )


def _total_delay_ms(frames: list[FrameWritten], accepted: list[Admission]) -> float:
    """Give the median time from the middle of exposure to the first obeyed command that was made from the frame."""
    captured_ns = {frame.stamp_ns: frame.capture_ns for frame in frames if frame.capture_ns is not None}
    first_ns: dict[int, int] = {}
    for command in accepted:
        if command.applied_mono_ns is not None:
            first_ns.setdefault(command.stamp_ns, command.applied_mono_ns)
    delays_ns = [applied_ns - captured_ns[stamp] for stamp, applied_ns in first_ns.items() if stamp in captured_ns]
    return float(np.median(delays_ns)) / NS_PER_MS if delays_ns else float("nan")
