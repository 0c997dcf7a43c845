"""A drive in virtual time that is monitored in memory and not recorded, for searches with many hundred drives."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_S, FloatArray, Now
from lavt.experiment.runs.plan import PlannedRun
from lavt.experiment.runs.virtual_run import build_loop, drive, free_finished_loops
from lavt.nodes.payloads import Admission, FrameWritten

CHANNELS = frozenset({"truth", "event", "frame", "admission"})
"""The channels that are kept in memory."""

NEVER_NS = 2**62
"""The start time of a drive that did not begin; it is later than all times of a run."""


class InMemoryRecorder:
    """A recorder that keeps the payloads of `CHANNELS` in memory."""

    channels = CHANNELS

    def __init__(self) -> None:
        self.payloads: defaultdict[str, list[Any]] = defaultdict(list)

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (part of the protocol)
        """Keep the payload if its channel is in `CHANNELS`."""
        if topic in CHANNELS:
            self.payloads[topic].append(payload)


@dataclass(frozen=True, slots=True)
class MonitoredRun:
    """The monitored quantities of one drive from its start to its ending.

    The arrays are empty if the vehicle was never armed.
    """

    ending: str | None
    lane_invasions: int
    total_delay_ms: float
    """The median of the total delays of all frames with an accepted command; NaN without such a frame."""
    time_s: FloatArray
    """Times since the start of the drive; `cross_track_m` and `speed_mps` have a value for each of these times."""
    cross_track_m: FloatArray
    speed_mps: FloatArray
    limited_s: FloatArray
    """The times since the start of the drive at which a safety limit of the vehicle changed a command."""


def drive_monitored(planned: PlannedRun, *, limit_s: float = 3600.0) -> MonitoredRun:
    """Drive a run in virtual time without records, and return its monitored quantities.

    The drive is identical to a drive of `run_once`.
    """
    cv2.setNumThreads(1)
    recorder = InMemoryRecorder()
    loop = build_loop(planned, None, watcher=recorder)
    drive(loop, limit_ns=round(limit_s * NS_PER_S))
    del loop
    free_finished_loops(planned.config)
    return summarize_drive(recorder.payloads)


def summarize_drive(payloads: dict[str, list[Any]]) -> MonitoredRun:
    """Return the monitored quantities of a drive, from the payloads of each channel of the server."""
    began_ns = next((event.mono_ns for event in payloads["event"] if event.kind == "drive_began"), NEVER_NS)
    ending_event = next(((event.mono_ns, event.detail) for event in payloads["event"] if event.kind == "ending"), None)
    ended_ns, ending = ending_event or (payloads["truth"][-1].mono_ns, None)
    truths = [truth for truth in payloads["truth"] if began_ns <= truth.mono_ns <= ended_ns]
    verdicts = payloads["admission"]
    accepted = [command for command in verdicts if command.verdict == "accepted" and command.mode == "drive"]
    accepted = [command for command in accepted if began_ns <= command.applied_mono_ns <= ended_ns]

    def since_began_s(times_ns: list[int]) -> FloatArray:
        return np.asarray((np.array(times_ns, np.int64) - began_ns) / NS_PER_S, np.float64)

    events = [event for event in payloads["event"] if began_ns <= event.mono_ns <= ended_ns]
    return MonitoredRun(
        ending=ending,
        lane_invasions=sum(event.kind == "lane_invasion" for event in events),
        total_delay_ms=_total_delay_ms(payloads["frame"], accepted),
        time_s=since_began_s([truth.mono_ns for truth in truths]),
        cross_track_m=np.array([truth.cross_track_m for truth in truths], np.float64),
        speed_mps=np.array([truth.speed_mps for truth in truths], np.float64),
        limited_s=since_began_s([command.applied_mono_ns for command in accepted if command.limited]),
    )


def _total_delay_ms(frames: list[FrameWritten], accepted: list[Admission]) -> float:
    """Return the median time from the middle of a frame's exposure to the first accepted command made from it."""
    captured_ns = {frame.stamp_ns: frame.capture_ns for frame in frames if frame.capture_ns is not None}
    applied_ns: dict[int, int] = {}  # when the first command of each frame was applied, by the frame's stamp
    for command in accepted:
        if command.applied_mono_ns is not None:
            applied_ns.setdefault(command.stamp_ns, command.applied_mono_ns)
    delays_ns = [applied_ns[stamp_ns] - captured_ns[stamp_ns] for stamp_ns in applied_ns if stamp_ns in captured_ns]
    return float(np.median(delays_ns)) / NS_PER_MS if delays_ns else float("nan")
