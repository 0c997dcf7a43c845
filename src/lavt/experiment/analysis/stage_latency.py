"""How long each hop of a frame's life took, links among them, from the timelines of both records."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.clock_offset import ClockOffset
from lavt.experiment.analysis.latency import look_up, pictures_of, video_latency_ns
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

Hop = tuple[str, str]
"""Node or "network", and what it did."""

TO_WHEEL: Hop = ("vehicle", "command to wheel")
AFTER_LOOP: frozenset[Hop] = frozenset({("actuator", "report"), TO_WHEEL})
"""What happens once the command is applied, which ends the loop."""

Durations = list[tuple[Hop, IntArray]]
"""For each hop, in order, how long it took for each frame that it was done for."""


def stage_percentiles(
    server: Record, client: Record, frames: Table, tau_c_ns: IntArray, offset: ClockOffset | None
) -> list[dict[str, Any]]:
    """Tell of each hop of the life of `frames`, in order, how long it took: p50 and p95 in ms, and of how many.

    The control link is tau_c of every command; without an `offset` neither link of the network is there.
    """
    pictures = pictures_of(client.table("picture"), frames)
    sent = video_link_ns(server.table("timeline"), pictures, frames, offset) if offset else np.zeros(0, np.int64)
    life = chain(
        camera_stages(server, frames),
        [(("network", "video link"), sent)],
        client_stages(client, frames),
        [(("network", "control link"), tau_c_ns)],
        actuator_stages(server, frames),
        [(TO_WHEEL, wheel_ns(server, frames))],
    )
    return [_entry(stage, durations_ns) for stage, durations_ns in life if len(durations_ns)]


def _entry(stage: Hop, durations_ns: IntArray) -> dict[str, Any]:
    p50, p95 = np.percentile(durations_ns / NS_PER_MS, [50, 95])
    return {"node": stage[0], "stage": stage[1], "p50": float(p50), "p95": float(p95), "n": len(durations_ns)}


def camera_stages(server: Record, frames: Table) -> Durations:
    """Time the camera's hops. What happened before the frame was stamped is left out: the loop begins there."""
    return _timed(server.table("timeline"), "camera", frames, from_stamp=True)


def client_stages(client: Record, frames: Table) -> Durations:
    """Time the receiver, as one hop, and the driver's hops."""
    timelines = client.table("timeline")
    received_ns = _receiver_ns(timelines, client.table("picture"), frames)
    return [(("receiver", "reorder and depacketize"), received_ns), *_timed(timelines, "driver", frames)]


def actuator_stages(server: Record, frames: Table) -> Durations:
    """Time the actuator's hops for the first command made from each frame."""
    return _timed(server.table("timeline"), "actuator", frames)


def wheel_ns(server: Record, frames: Table) -> IntArray:
    """Time from a command being obeyed to the vehicle's report that it steers by it, as far as the vehicle tells it."""
    wheel = server.table("wheel")
    known = np.isin(wheel.ints("stamp_ns"), frames.ints("stamp_ns"))
    return np.asarray((wheel.ints("wheel_mono_ns") - wheel.ints("applied_mono_ns"))[known], np.int64)


def video_link_ns(timelines: Table, pictures: Table, frames: Table, offset: ClockOffset) -> IntArray:
    """Time from a frame's last packet leaving the camera to the arrival of the packet that made it whole.

    It is tau_v less what the camera did after the stamp, and less what the client did before the stamp was read.
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
    """Time the receiver: its timelines know no stamp, but the pictures and the driver's timelines do.

    It reaches from the arrival of the packet that made the access unit whole to the access unit's at the driver.
    """
    chains = zip(timelines.texts("node"), timelines.texts("channel"), strict=True)
    units = timelines.where(np.array([each == ("driver", "access_unit") for each in chains], np.bool_))
    stamps = frames.ints("stamp_ns")
    packet_ns = look_up(pictures.ints("stamp_ns"), pictures.ints("packet_mono_ns"), stamps)
    unit_ns = look_up(units.ints("stamp_ns"), units.ints("arrived_mono_ns"), stamps)
    known = (packet_ns != MISSING) & (unit_ns != MISSING)
    return np.asarray(unit_ns[known] - packet_ns[known], np.int64)


def _timed(timelines: Table, node: str, frames: Table, *, from_stamp: bool = False) -> Durations:
    """Time each hop of `node`, over the first timeline that each chain of it wrote for each frame."""
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
                shown = f"wait for {channel}" if name == "wait" else name
                durations_ns.setdefault(shown, []).append(end_ns - before_ns)
                before_ns = end_ns
    return [((node, stage), np.array(each, np.int64)) for stage, each in durations_ns.items()]
