"""Where the time of a loop goes: medians of every hop, from the timelines of both records."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS
from lavt.experiment.latency import frames_within, look_up
from lavt.experiment.metrics import driving_interval
from lavt.experiment.record import Record
from lavt.experiment.table import MISSING, IntArray, Table

BEFORE_VIDEO, AFTER_VIDEO, AFTER_CONTROL = ("camera",), ("driver",), ("actuator",)
"""The nodes on the way of a frame, and between which of them it is on the network."""

Share = tuple[str, str, float]
"""Node or "network", what it did, and how long that took (median, ms)."""


def breakdown(server: Record, client: Record, result: Mapping[str, Any]) -> list[Share]:
    """Split the median loop latency of a run into hops and links, in the order of a frame's life.

    A hop's time is the median over the frames of the drive. The control link is the median tau_c. What is left of the
    median loop is the video link and every wait for a next tick; medians do not add up exactly, so this is a picture of
    the loop, not a measurement. Empty where there is no loop latency.
    """
    loop_ms, tau_c_ms = result["loop_ms"]["p50"], result["tau_c_ms"]["p50"]
    if loop_ms is None:
        return []
    began_ns, ended_ns, _ = driving_interval(server)
    frames = frames_within(server.table("frame"), began_ns, ended_ns)
    camera = _hops(server.table("timeline"), BEFORE_VIDEO, frames, from_stamp=True)
    client_hops = [*_receiver(client, frames), *_hops(client.table("timeline"), AFTER_VIDEO, frames)]
    actuator = _hops(server.table("timeline"), AFTER_CONTROL, frames)
    control_link: list[Share] = [] if tau_c_ms is None else [("network", "control link", max(tau_c_ms, 0.0))]
    known_ms = sum(share[2] for share in [*camera, *client_hops, *control_link, *actuator])
    rest: list[Share] = [("network", "video link and waiting", max(loop_ms - known_ms, 0.0))]
    return [*camera, *rest, *client_hops, *control_link, *actuator]


def capture_to_stamp_ms(server: Record) -> float | None:
    """Median time from a frame's exposure to its stamp, which is before the loop; None where no camera told of it."""
    began_ns, ended_ns, _ = driving_interval(server)
    frames = frames_within(server.table("frame"), began_ns, ended_ns)
    capture_ns = frames.ints("capture_ns")
    known = capture_ns != MISSING
    return _median_ms((frames.ints("stamped_mono_ns") - capture_ns)[known])


def _receiver(client: Record, frames: Table) -> list[Share]:
    """Give the receiver's share: its timelines know no stamp, but the pictures and the driver's timelines do.

    It reaches from the arrival of the packet that made the access unit whole to the access unit's at the driver.
    """
    timelines, pictures = client.table("timeline"), client.table("picture")
    chains = zip(timelines.texts("node"), timelines.texts("channel"), strict=True)
    units = timelines.where(np.array([chain == ("driver", "access_unit") for chain in chains], np.bool_))
    stamps = frames.ints("stamp_ns")
    packet_ns = look_up(pictures.ints("stamp_ns"), pictures.ints("packet_mono_ns"), stamps)
    unit_ns = look_up(units.ints("stamp_ns"), units.ints("arrived_mono_ns"), stamps)
    share_ms = _median_ms((unit_ns - packet_ns)[(packet_ns != MISSING) & (unit_ns != MISSING)])
    return [] if share_ms is None else [("receiver", "reorder and depacketize", share_ms)]


def _median_ms(times_ns: IntArray) -> float | None:
    return float(np.median(times_ns)) / NS_PER_MS if len(times_ns) else None


def _hops(timelines: Table, nodes: Sequence[str], frames: Table, *, from_stamp: bool = False) -> list[Share]:
    """Median duration of each hop of `nodes`, over the first timeline that each chain of a node wrote for each frame.

    With `from_stamp` only what happened after the frame was stamped counts: the loop begins there.
    """
    stamps = timelines.ints("stamp_ns")
    stamped_ns = look_up(frames.ints("stamp_ns"), frames.ints("stamped_mono_ns"), stamps)
    names, channels = timelines.texts("node"), timelines.texts("channel")
    arrivals_ns = timelines.ints("arrived_mono_ns")
    every_hops = timelines.objects("hops")
    durations_ns: dict[tuple[str, str], list[int]] = {}
    seen: set[tuple[str, str, int]] = set()
    for node, channel, stamp_ns, start_ns, arrived_ns, hops in zip(
        names, channels, stamps.tolist(), stamped_ns.tolist(), arrivals_ns.tolist(), every_hops, strict=True
    ):
        if node not in nodes or start_ns == MISSING or (node, channel, stamp_ns) in seen:
            continue
        seen.add((node, channel, stamp_ns))
        before_ns = max(arrived_ns, start_ns) if from_stamp else arrived_ns
        for name, end_ns in hops or []:
            if end_ns > before_ns or not from_stamp:
                shown = f"wait for {channel}" if name == "wait" else name
                durations_ns.setdefault((node, shown), []).append(end_ns - before_ns)
                before_ns = end_ns
    ordered = sorted(durations_ns, key=lambda hop: nodes.index(hop[0]))
    return [(node, name, float(np.median(durations_ns[node, name])) / NS_PER_MS) for node, name in ordered]
