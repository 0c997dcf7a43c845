"""Where the time of a loop goes: medians of every hop, from the timelines of both records."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from lavt.domain import NS_PER_MS
from lavt.experiment.hops import Durations, actuator_hops, camera_hops, client_hops
from lavt.experiment.latency import frames_within
from lavt.experiment.metrics import driving_interval
from lavt.experiment.record import Record
from lavt.experiment.table import MISSING, IntArray

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
    camera, actuator = _medians(camera_hops(server, frames)), _medians(actuator_hops(server, frames))
    of_client = _medians(client_hops(client, frames))
    control_link: list[Share] = [] if tau_c_ms is None else [("network", "control link", max(tau_c_ms, 0.0))]
    known_ms = sum(share[2] for share in [*camera, *of_client, *control_link, *actuator])
    rest: list[Share] = [("network", "video link and waiting", max(loop_ms - known_ms, 0.0))]
    return [*camera, *rest, *of_client, *control_link, *actuator]


def capture_to_stamp_ms(server: Record) -> float | None:
    """Median time from a frame's exposure to its stamp, which is before the loop; None where no camera told of it."""
    began_ns, ended_ns, _ = driving_interval(server)
    frames = frames_within(server.table("frame"), began_ns, ended_ns)
    capture_ns = frames.ints("capture_ns")
    known = capture_ns != MISSING
    return _median_ms((frames.ints("stamped_mono_ns") - capture_ns)[known])


def _medians(hops: Durations) -> list[Share]:
    every = ((hop, _median_ms(durations_ns)) for hop, durations_ns in hops)
    return [(*hop, duration_ms) for hop, duration_ms in every if duration_ms is not None]


def _median_ms(times_ns: IntArray) -> float | None:
    return float(np.median(times_ns)) / NS_PER_MS if len(times_ns) else None
