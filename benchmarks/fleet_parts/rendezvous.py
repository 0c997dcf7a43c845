"""What one vehicle's video costs `lavt rendezvous`."""

from __future__ import annotations

import socket
import tempfile
from pathlib import Path

from benchmarks.fleet_parts.usage import usage
from benchmarks.rendezvous import CHANGES, LOOPBACK, PACKETS_PER_FRAME, RATE_HZ, LatencyMeter

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_S
from lavt.experiment.runs.processes import Processes


def measure_rendezvous(seconds: float) -> dict[str, float]:
    """Send a video of 4 Mbit/s through a rendezvous, and return what its process uses."""
    clock = MachineClock()
    config = Path(__file__).parents[2] / "configs" / "rendezvous.yaml"
    options = [word for change in CHANGES for word in ("--set", change)]
    with (
        tempfile.TemporaryDirectory() as folder,
        Processes(Path(folder)) as processes,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        process = processes.start("rendezvous", "rendezvous", str(config), *options)
        meter = LatencyMeter(vehicle, client, (LOOPBACK, process.wait_ready()["ready"]["video_port"]))
        meter.refresh()
        before, begin_ns = usage(process.popen.pid), clock.now().mono_ns
        frames = 0
        while clock.now().mono_ns - begin_ns < seconds * NS_PER_S:
            meter.refresh()
            meter.send_frame(through=True)
            frames += 1
            pause(begin_ns + frames * NS_PER_S // RATE_HZ - clock.now().mono_ns)
        after, elapsed_ns = usage(process.popen.pid), clock.now().mono_ns - begin_ns
    packets = frames * PACKETS_PER_FRAME
    return {
        "packets_per_s": round(packets * NS_PER_S / elapsed_ns, 1),
        "processor_share": round((after.processor_s - before.processor_s) * NS_PER_S / elapsed_ns, 4),
        "processor_us_per_packet": round((after.processor_s - before.processor_s) * 1e6 / packets, 1),
        "resident_mb": round(after.resident_mb, 1),
        "descriptors": after.descriptors,
    }
