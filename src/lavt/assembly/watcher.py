"""The nodes of `lavt watch`, and the statistics of the stream."""

from __future__ import annotations

from array import array
from collections import Counter
from typing import Any, Literal

import numpy as np

from lavt.domain import NS_PER_MS, Now
from lavt.nodes.payloads import PictureRead
from lavt.nodes.picture_reader import PictureReader
from lavt.nodes.receiver import ReceiverNode
from lavt.nodes.watcher import WatcherNode
from lavt.transport.rtp.jitter_buffer import JitterBuffer
from lavt.transport.rtp.reception_stats import ReceptionSample
from lavt.transport.rtp.rtp import Depacketizer
from lavt.transport.video.frame_codec import VideoReceiver
from lavt.transport.video.h264 import Decoder
from lavt.transport.video.stamp import read_clear_stamp
from lavt.transport.video.stamp_check import LearnedBase

Sender = Literal["lavt", "foreign"]


class WatchNodes:
    """The nodes of `lavt watch`, and their recorder, which keeps the statistics of the stream."""

    def __init__(self, sender: Sender, reorder_hold_ms: int | None) -> None:
        self._reader = _picture_reader(sender)
        hold_ns = None if reorder_hold_ms is None else reorder_hold_ms * NS_PER_MS
        self._receiver = ReceiverNode(JitterBuffer(hold_ns), Depacketizer())
        self.nodes = (self._receiver, WatcherNode(self._reader))
        self._latencies_ms = array("d")
        self._jitter_us = 0
        self._unreadable_reason = ""

    def write(self, topic: str, payload: Any, now: Now) -> None:  # noqa: ARG002 (the protocol's)
        """Store the latency of a picture, or the reason why it has none, and the jitter of the last second."""
        if topic == "picture":
            self._record_latency(payload)
        elif topic == "reception":
            sample: ReceptionSample = payload
            self._jitter_us = sample.jitter_us

    def _record_latency(self, picture: PictureRead) -> None:
        if picture.stamp_ns is None:
            self._unreadable_reason = picture.reason
        else:
            self._latencies_ms.append((picture.read_wall_ns - picture.stamp_ns) / NS_PER_MS)

    def totals(self) -> Counter[str]:
        """Return the counts since the start."""
        received, decoded = Counter(self._receiver.counts), self._reader.counts
        return Counter(
            pictures=decoded["frames_decoded"],
            stamps_accepted=len(self._latencies_ms),
            stamps_unreadable=decoded["frames_unreadable"],
            packets=received["packets"],
            lost=received["packets_lost"],
            reordered=received["packets_reordered"],
            datagrams_unreadable=received["packets_unreadable"] + received["challenges_unreadable"],
        )

    def statistics_between(self, before: Counter[str], after: Counter[str]) -> dict[str, Any]:
        """Return the statistics of the time between two `totals`; without an accepted stamp, latencies are None."""
        latencies_ms = self._latencies_ms[before["stamps_accepted"] : after["stamps_accepted"]]
        median_ms, p95_ms = np.percentile(latencies_ms, (50, 95)).tolist() if latencies_ms else (None, None)
        return {
            **{name: count - before[name] for name, count in after.items()},
            "last_unreadable_reason": self._unreadable_reason,
            "latency_median_ms": median_ms,
            "latency_p95_ms": p95_ms,
            "jitter_ms": self._jitter_us / 1000,
        }


def _picture_reader(sender: Sender) -> PictureReader:
    """Return the reader for a sender's stamps.

    The check of foreign stamps is weak, so the stamps of frames in doubt are not read.
    """
    if sender == "lavt":
        return PictureReader(VideoReceiver(Decoder(), shape=None))
    receiver = VideoReceiver(Decoder(), shape=None, read=read_clear_stamp)
    return PictureReader(receiver, LearnedBase().agrees, reads_doubtful=False)
