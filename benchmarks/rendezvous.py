"""Measure the latency that `lavt rendezvous` adds to video packets on the loopback.

    python benchmarks/rendezvous.py [--seconds 20]

A socket that has registered as the vehicle sends frames to a client's socket, 30 a second, each of 14 packets of 1216
bytes (4 Mbit/s). Every second frame goes through the rendezvous, the other frames go directly. The latency of a packet
is the time between its sending and the kernel's timestamp of its arrival. The difference between the two ways is the
time that the rendezvous itself takes, without any network. Prints a row for each way and finally a line of JSON.
"""

from __future__ import annotations

import argparse
import json
import socket
import struct
import sys
import tempfile
from pathlib import Path

import numpy as np

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S, NS_PER_US
from lavt.experiment.runs.processes import Processes
from lavt.runtime import process_priority
from lavt.transport.arrival import ANCILLARY_BYTES, arrival, enable_arrival_times
from lavt.transport.rendezvous.forwarder import REGISTER_EVERY_NS, Address, encode_registration, wrap
from lavt.transport.video.path_validation import PathClient

LOOPBACK = "127.0.0.1"
PACKETS_PER_FRAME, PACKET_BYTES, RATE_HZ = 14, 1216, 30
WAIT_S = 1.0
CHANGES = (f"bind={LOOPBACK}", "video_port=0", "probe_port=0")
PERCENTILES = (50, 95, 99)


class LatencyMeter:
    """The sockets of a vehicle and a client, which measure latencies directly and through a rendezvous."""

    def __init__(self, vehicle: socket.socket, client: socket.socket, rendezvous: Address) -> None:
        self._clock = MachineClock()
        self._vehicle, self._client, self._rendezvous = vehicle, client, rendezvous
        enable_arrival_times(client)
        for endpoint in (vehicle, client):
            endpoint.bind((LOOPBACK, 0))
            endpoint.settimeout(WAIT_S)
        self._registered_ns = 0

    def refresh(self) -> None:
        """Register the vehicle and send a hello of the client, once a second."""
        now = self._clock.now()
        if now.mono_ns - self._registered_ns < REGISTER_EVERY_NS:
            return
        self._registered_ns = now.mono_ns
        self._vehicle.sendto(encode_registration("vehicle-1", "video", now.wall_ns, None), self._rendezvous)
        self._client.sendto(PathClient(bytes(16)).hello(0), self._rendezvous)
        self._vehicle.recv(2000)

    def send_frame(self, *, through: bool) -> list[int]:
        """Send a frame, `through` the rendezvous or directly; return the latencies of its packets in nanoseconds."""
        client = self._client.getsockname()
        for number in range(PACKETS_PER_FRAME):
            packet = struct.pack(">Bq", number, self._clock.now().wall_ns).ljust(PACKET_BYTES, b"\0")
            self._vehicle.sendto(wrap(client, packet) if through else packet, self._rendezvous if through else client)
        return [self._receive_ns() for _ in range(PACKETS_PER_FRAME)]

    def _receive_ns(self) -> int:
        """Receive a packet and return its latency."""
        packet, ancillary, _flags, _sender = self._client.recvmsg(2000, ANCILLARY_BYTES)
        return arrival(ancillary, self._clock.now()).wall_ns - int(struct.unpack_from(">xq", packet)[0])


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=20.0)
    frames = max(2, round(parser.parse_args().seconds * RATE_HZ))
    process_priority.raise_priority()
    latencies_ns: dict[str, list[int]] = {"straight": [], "through": []}
    config = Path(__file__).parents[1] / "configs" / "rendezvous.yaml"
    options = [word for change in CHANGES for word in ("--set", change)]
    with (
        tempfile.TemporaryDirectory() as folder,
        Processes(Path(folder)) as processes,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as vehicle,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as client,
    ):
        port = processes.start("rendezvous", "rendezvous", str(config), *options).wait_ready()["ready"]["video_port"]
        meter = LatencyMeter(vehicle, client, (LOOPBACK, port))
        for number in range(frames):
            meter.refresh()
            way = "straight" if number % 2 == 0 else "through"
            latencies_ns[way] += meter.send_frame(through=way == "through")
            pause(NS_PER_S // RATE_HZ - NS_PER_MS)
    latencies_us = {
        way: {f"p{rank}": round(float(np.percentile(times_ns, rank)) / NS_PER_US, 1) for rank in PERCENTILES}
        for way, times_ns in latencies_ns.items()
    }
    for way, percentiles in latencies_us.items():
        print(f"{way:>8}  " + "  ".join(f"{name} {us:7.1f} us" for name, us in percentiles.items()))
    print(json.dumps({"us": latencies_us, "pictures": frames, "python": sys.version.split()[0]}))


if __name__ == "__main__":
    main()
