"""Measure the cost of a stranger's datagram at the vehicle's video port, with and without the filter before the record.

    python benchmarks/stranger_datagrams.py [--datagrams 20000] [--rounds 7]

In each round the same datagrams are delivered to the same camera node twice: without the filter and then with it. The
node runs in the real-time runtime, with a record on disk. The cost is the CPU time per datagram of the whole process,
including the threads of node and record. With the filter it includes the 200 datagrams a second that the filter lets
pass. Prints for each kind of datagram the median costs in microseconds and their ratio.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
import time  # noqa: TID251 (CPU time is what is measured)
from collections import Counter
from pathlib import Path
from statistics import median

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_US
from lavt.nodes.camera import CameraNode
from lavt.recording.record import RecordWriter
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.recorder import QueuedRecorder
from lavt.transport.datagram_filter import VideoPortFilter, filtered
from lavt.transport.rtp.fec import RepairSender
from lavt.transport.rtp.rtp import Packetizer
from lavt.transport.udp_link import Deliver
from lavt.transport.video.path_validation import PathClient, PathServer
from lavt.transport.video.stream_sender import StreamSender

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.fuzzing.camera import FakeCamera

TOKEN = bytes(range(16))
STRANGER = ("198.51.100.7", 5004)
NEVER_AFTER_NS = 10**15
"""Longer than any measurement."""
BATCH = 1000
"""Number of datagrams between two pauses; the node's queue has more places than this."""


def kinds() -> dict[str, bytes]:
    """Return a datagram of each kind."""
    return {
        "random bytes": b"\x00" * 46,
        "report": bytes.fromhex("80c900010000000b"),
        "replayed hello": PathClient(TOKEN).hello(0),
        "forged hello": PathClient(bytes(16)).hello(0),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--datagrams", type=int, default=20_000, help="of each kind, in each round, for each delivery")
    parser.add_argument("--rounds", type=int, default=7)
    arguments = parser.parse_args()
    clock, camera = MachineClock(), FakeCamera()
    path = PathServer(lambda: bytes(32))
    path.set_token(TOKEN)
    stream = StreamSender(Packetizer(2, 0), RepairSender(3, 0))
    never_ns = clock.now().mono_ns + NEVER_AFTER_NS  # the camera must not capture frames during the measurement
    node = CameraNode(camera, camera, stream, path, start_ns=never_ns)
    with tempfile.TemporaryDirectory() as directory:
        recorder = QueuedRecorder(RecordWriter(Path(directory) / "server.mcap", "server"))
        runtime = RealRuntime(clock, [node], recorder, lambda: None)
        runtime.start({"video": DiscardingLink()})
        deliver_filtered = filtered(runtime.deliver, VideoPortFilter(path), Counter())
        for kind, datagram in kinds().items():
            runtime.deliver("feedback", datagram, clock.now(), STRANGER)  # the first datagram of a kind is not measured
            unfiltered_costs_us, filtered_costs_us = [], []
            for _ in range(arguments.rounds):
                unfiltered_costs_us.append(cost_us(clock, runtime.deliver, datagram, arguments.datagrams))
                filtered_costs_us.append(cost_us(clock, deliver_filtered, datagram, arguments.datagrams))
            unfiltered_us, filtered_us = median(unfiltered_costs_us), median(filtered_costs_us)
            ratio = unfiltered_us / filtered_us
            sys.stdout.write(f"{kind}: {unfiltered_us:.1f} us, filtered {filtered_us:.2f} us, ratio {ratio:.1f}\n")
        runtime.stop()
        recorder.close(clock.now())


class DiscardingLink:
    """A link that sends nothing."""

    def send(self, *sends: object) -> None:
        """Discard everything."""


def cost_us(clock: MachineClock, deliver: Deliver, datagram: bytes, number: int) -> float:
    """Deliver `number` datagrams and return the CPU time per datagram, until node and record have processed all."""
    begin_ns = time.process_time_ns()
    for index in range(number):
        deliver("feedback", datagram, clock.now(), STRANGER)
        if index % BATCH == 0:
            pause(20 * NS_PER_MS)
    pause(100 * NS_PER_MS)
    return (time.process_time_ns() - begin_ns) / NS_PER_US / number


if __name__ == "__main__":
    main()
