"""The latency of each stage of the pipeline from frame to command, network links included, from both records."""

from __future__ import annotations

from itertools import chain
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS
from lavt.experiment.analysis.clock_offset import ClockOffset
from lavt.experiment.analysis.latency import FramesWithCommands, look_up, received_frames_of, video_latency_ns
from lavt.recording.record import Record
from lavt.recording.table import MISSING, IntArray, Table

Stage = tuple[str, str]
"""The node, or "network", and the name of the stage."""

TO_WHEEL: Stage = ("vehicle", "command to wheel")
AFTER_LOOP: frozenset[Stage] = frozenset({("actuator", "report"), TO_WHEEL})
"""The stages after the loop, which ends when the command is applied."""

StageDurations = list[tuple[Stage, IntArray]]
"""For each stage, in order, the durations of the frames that passed the stage."""


def stage_percentiles(
    server: Record, client: Record, frames: Table, tau_c_ns: IntArray, offset: ClockOffset | None
) -> list[dict[str, Any]]:
    """Return the latency (p50 and p95 in ms) and the count `n` of each stage that `frames` passed.

    The stages are in the order in which a frame passes them. The latency of the control link is tau_c of every accepted
    command. Without an `offset` the two network links are left out.
    """
    received_frames = received_frames_of(client.table("picture"), frames)
    video_ns = np.zeros(0, np.int64)
    if offset:
        video_ns = video_link_ns(server.table("timeline"), received_frames, frames, offset)
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
    node, name = stage
    return {"node": node, "stage": name, "p50": float(p50), "p95": float(p95), "n": len(durations_ns)}


def camera_stages(server: Record, frames: Table) -> StageDurations:
    """Return the durations of the camera's stages from the stamp on, because the loop begins with the stamp."""
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
    """Return the times from the application of a command to the vehicle's report that it steers by this command.

    The result is empty for a vehicle without such reports.
    """
    wheel = server.table("wheel")
    is_from_frames = np.isin(wheel.ints("stamp_ns"), frames.ints("stamp_ns"))
    return np.asarray((wheel.ints("wheel_mono_ns") - wheel.ints("applied_mono_ns"))[is_from_frames], np.int64)


def video_link_ns(timelines: Table, received_frames: Table, frames: Table, offset: ClockOffset) -> IntArray:
    """Return the time of each frame on the video link, in ns.

    This time begins when the camera sends the frame's last packet, and ends when the packet arrives that completes the
    frame. It is computed as tau_v, minus the camera's time after the stamp, minus the client's time from that packet to
    the reading of the stamp. `timelines` are the server's.
    """
    stamps = received_frames.ints("stamp_ns")
    sent_ns = _last_end_ns(timelines, "camera", stamps)
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), stamps)
    client_times = (received_frames.ints(name) for name in ("read_wall_ns", "read_mono_ns", "packet_mono_ns"))
    has_times = np.all([times != MISSING for times in (sent_ns, stamped_ns, *client_times)], axis=0)
    is_known = received_frames.flags("readable") & has_times
    readable = received_frames.where(is_known)
    on_camera_ns = (sent_ns - stamped_ns)[is_known]
    on_client_ns = readable.ints("read_mono_ns") - readable.ints("packet_mono_ns")
    return np.asarray(video_latency_ns(readable, offset) - on_camera_ns - on_client_ns, np.int64)


def _last_end_ns(timelines: Table, node: str, stamps: IntArray) -> IntArray:
    """Return when a node had finished with each frame, on its host's monotonic clock; `MISSING` if it is unknown."""
    of_node = timelines.where(np.array([name == node for name in timelines.texts("node")], np.bool_))
    ends_ns = np.array([stages[-1][1] if stages else MISSING for stages in of_node.objects("stages")], np.int64)
    latest_first = np.argsort(-ends_ns, kind="stable")
    return look_up(of_node.ints("stamp_ns")[latest_first], ends_ns[latest_first], stamps)


def processing_ns(server: Record, client: Record, received_frames: Table, paired: FramesWithCommands) -> IntArray:
    """Return the part of each frame's loop latency that is not on the network, in ns.

    It is the camera's time after the stamp, the client's time from the packet that completes the frame to the frame's
    first command, and the actuator's time. Each is measured on one clock. A command that was lost and repeated does not
    count.
    """
    readable = received_frames.where(received_frames.flags("readable"))
    packet_ns = look_up(readable.ints("stamp_ns"), readable.ints("packet_mono_ns"), paired.stamp_ns)
    sent_ns = _last_end_ns(server.table("timeline"), "camera", paired.stamp_ns)
    decided_ns = _last_end_ns(client.table("timeline"), "driver", paired.stamp_ns)
    received_ns = paired.commands.ints("received_mono_ns")
    is_known = np.all([times != MISSING for times in (packet_ns, sent_ns, decided_ns, received_ns)], axis=0)
    processing = sent_ns - paired.stamped_mono_ns + decided_ns - packet_ns + paired.actuator_ns
    return np.asarray(processing[is_known], np.int64)


def _receiver_ns(timelines: Table, received_frames: Table, frames: Table) -> IntArray:
    """Return the receiver's time for each frame, in ns.

    This time begins when the packet arrives that completes the access unit, and ends when the access unit arrives at
    the driver. Both times come from the driver's entries, because the receiver's own timelines have no stamps.
    """
    inputs = zip(timelines.texts("node"), timelines.texts("channel"), strict=True)
    units = timelines.where(np.array([node_input == ("driver", "access_unit") for node_input in inputs], np.bool_))
    stamps = frames.ints("stamp_ns")
    packet_ns = look_up(received_frames.ints("stamp_ns"), received_frames.ints("packet_mono_ns"), stamps)
    unit_ns = look_up(units.ints("stamp_ns"), units.ints("arrived_mono_ns"), stamps)
    known = (packet_ns != MISSING) & (unit_ns != MISSING)
    return np.asarray(unit_ns[known] - packet_ns[known], np.int64)


def _node_stages(timelines: Table, node: str, frames: Table, *, from_stamp: bool = False) -> StageDurations:
    """Return the durations of each stage of `node`.

    For each frame and each input channel, only the first timeline is used. With `from_stamp`, the stage in which the
    frame was stamped begins at the stamp, and stages that ended before the stamp are left out.
    """
    timelines = timelines.where(np.array([name == node for name in timelines.texts("node")], np.bool_))
    stamps = timelines.ints("stamp_ns")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), stamps)
    durations_ns: dict[str, list[int]] = {}
    used: set[tuple[str, int]] = set()
    for channel, stamp_ns, stamped_at_ns, arrived_ns, stages in zip(
        timelines.texts("channel"),
        stamps.tolist(),
        stamped_ns.tolist(),
        timelines.ints("arrived_mono_ns").tolist(),
        timelines.objects("stages"),
        strict=True,
    ):
        if stamped_at_ns == MISSING or (channel, stamp_ns) in used:
            continue
        used.add((channel, stamp_ns))
        begin_ns = max(arrived_ns, stamped_at_ns) if from_stamp else arrived_ns
        for name, end_ns in stages or []:
            if end_ns > begin_ns or not from_stamp:
                stage = f"wait for {channel}" if name == "wait" else name
                durations_ns.setdefault(stage, []).append(end_ns - begin_ns)
                begin_ns = end_ns
    return [((node, name), np.array(durations, np.int64)) for name, durations in durations_ns.items()]
