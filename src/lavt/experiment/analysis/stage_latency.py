"""The latency of each stage of the pipeline from frame to command, network links included, from both records."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.clock_offset import ClockOffset
from lavt.experiment.analysis.latency import look_up, pictures_of, video_latency_ns
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

Stage = tuple[str, str]
"""The node, or "network", and the name of the stage."""

TO_WHEEL: Stage = ("vehicle", "command to wheel")
AFTER_LOOP: frozenset[Stage] = frozenset({("actuator", "report"), TO_WHEEL})
"""The stages after the command is applied, which ends the loop."""

StageDurations = list[tuple[Stage, IntArray]]
"""For each stage, in order, its duration for each frame that passed it."""


def stage_percentiles(
    server: Record, client: Record, frames: Table, tau_c_ns: IntArray, offset: ClockOffset | None
) -> list[dict[str, Any]]:
    """Return for each stage of the pipeline of `frames`, in order, its latency (p50 and p95 in ms) and the count `n`.

    The control link is tau_c of every accepted command. Without an `offset` the two network links are left out.
    """
    pictures = pictures_of(client.table("picture"), frames)
    video_ns = video_link_ns(server.table("timeline"), pictures, frames, offset) if offset else np.zeros(0, np.int64)
    pipeline = chain(
        camera_stages(server, frames),
        [(("network", "video link"), video_ns)],
        client_stages(client, frames),
        [(("network", "control link"), tau_c_ns)],
        actuator_stages(server, frames),
        [(TO_WHEEL, wheel_ns(server, frames))],
    )
    return [_entry(stage, durations_ns) for stage, durations_ns in pipeline if len(durations_ns)]


def _entry(stage: Stage, durations_ns: IntArray) -> dict[str, Any]:
    p50, p95 = np.percentile(durations_ns / NS_PER_MS, [50, 95])
    return {"node": stage[0], "stage": stage[1], "p50": float(p50), "p95": float(p95), "n": len(durations_ns)}


def camera_stages(server: Record, frames: Table) -> StageDurations:
    """Return the durations of the camera's stages, from the stamp on: the loop begins there."""
    return _node_stages(server.table("timeline"), "camera", frames, from_stamp=True)


def client_stages(client: Record, frames: Table) -> StageDurations:
    """Return the durations of the receiver, as one stage, and of the driver's stages."""
    timelines = client.table("timeline")
    receiver_ns = _receiver_ns(timelines, client.table("picture"), frames)
    return [(("receiver", "reorder and depacketize"), receiver_ns), *_node_stages(timelines, "driver", frames)]


def actuator_stages(server: Record, frames: Table) -> StageDurations:
    """Return the durations of the actuator's stages for the first command of each frame."""
    return _node_stages(server.table("timeline"), "actuator", frames)


def wheel_ns(server: Record, frames: Table) -> IntArray:
    """Return the times from applying a command to the vehicle's report that it steers by it; empty without reports."""
    wheel = server.table("wheel")
    known = np.isin(wheel.ints("stamp_ns"), frames.ints("stamp_ns"))
    return np.asarray((wheel.ints("wheel_mono_ns") - wheel.ints("applied_mono_ns"))[known], np.int64)


def video_link_ns(timelines: Table, pictures: Table, frames: Table, offset: ClockOffset) -> IntArray:
    """Return the times from a frame's last packet leaving the camera to the arrival of the packet that completed it.

    Each is tau_v minus the camera's time after the stamp, and minus the client's time until the stamp was read.
    `timelines` are the server's.
    """
    camera = timelines.where(np.array([node == "camera" for node in timelines.texts("node")], np.bool_))
    left_ns = np.array([stages[-1][1] if stages else MISSING for stages in camera.objects("stages")], np.int64)
    stamps = pictures.ints("stamp_ns")
    left_ns = look_up(camera.ints("stamp_ns"), left_ns, stamps)
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), stamps)
    needed = (pictures.ints(name) for name in ("read_wall_ns", "read_mono_ns", "packet_mono_ns"))
    known = pictures.flags("readable") & np.all([each != MISSING for each in (left_ns, stamped_ns, *needed)], axis=0)
    read = pictures.where(known)
    on_client_ns = read.ints("read_mono_ns") - read.ints("packet_mono_ns")
    return np.asarray(video_latency_ns(read, offset) - (left_ns - stamped_ns)[known] - on_client_ns, np.int64)


def _receiver_ns(timelines: Table, pictures: Table, frames: Table) -> IntArray:
    """Return the receiver's durations, from the packet that completed an access unit to the access unit at the driver.

    They come from the pictures and the driver's timelines, as the receiver's own timelines have no stamps.
    """
    inputs = zip(timelines.texts("node"), timelines.texts("channel"), strict=True)
    units = timelines.where(np.array([each == ("driver", "access_unit") for each in inputs], np.bool_))
    stamps = frames.ints("stamp_ns")
    packet_ns = look_up(pictures.ints("stamp_ns"), pictures.ints("packet_mono_ns"), stamps)
    unit_ns = look_up(units.ints("stamp_ns"), units.ints("arrived_mono_ns"), stamps)
    known = (packet_ns != MISSING) & (unit_ns != MISSING)
    return np.asarray(unit_ns[known] - packet_ns[known], np.int64)


def _node_stages(timelines: Table, node: str, frames: Table, *, from_stamp: bool = False) -> StageDurations:
    """Return the durations of each stage of `node`, from the first timeline of each input channel for each frame."""
    timelines = timelines.where(np.array([name == node for name in timelines.texts("node")], np.bool_))
    stamps = timelines.ints("stamp_ns")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), stamps)
    durations_ns: dict[str, list[int]] = {}
    seen: set[tuple[str, int]] = set()
    for channel, stamp_ns, start_ns, arrived_ns, stages in zip(
        timelines.texts("channel"),
        stamps.tolist(),
        stamped_ns.tolist(),
        timelines.ints("arrived_mono_ns").tolist(),
        timelines.objects("stages"),
        strict=True,
    ):
        if start_ns == MISSING or (channel, stamp_ns) in seen:
            continue
        seen.add((channel, stamp_ns))
        before_ns = max(arrived_ns, start_ns) if from_stamp else arrived_ns
        for name, end_ns in stages or []:
            if end_ns > before_ns or not from_stamp:
                stage = f"wait for {channel}" if name == "wait" else name
                durations_ns.setdefault(stage, []).append(end_ns - before_ns)
                before_ns = end_ns
    return [((node, name), np.array(each, np.int64)) for name, each in durations_ns.items()]
