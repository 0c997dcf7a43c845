"""One process of `fleet.py`: `light`, `watcher`, `vehicles` or `clients`.

The arguments are the role and a JSON object. A process prints a line of JSON when it is ready, begins to measure when
it reads a line, ends when its standard input is closed, and prints its results.
"""

from __future__ import annotations

import contextlib
import json
import os
import sys
import threading
import time  # noqa: TID251 (a benchmark reads the clock)
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

import zenoh
from benchmarks.fleet_parts.sessions import LightVehicle, matching_count, open_session, settings, state

from lavt.clock import MachineClock
from lavt.domain import NS_PER_S, PATH_POINTS, Command, Now, State
from lavt.node import Send
from lavt.runtime.realtime import SWITCH_INTERVAL_S
from lavt.transport.messages import decode, encode
from lavt.transport.zenoh_link import RECEIVE_RING_LENGTH, ZenohLink

RATE_HZ = 50
OPENERS = 4
"""Sessions that are opened at the same time."""
PAUSE_S = 0.001
PARENT_WAIT_S = 0.2
ROUND_TRIP_TIMEOUT_NS = NS_PER_S


def say(line: dict[str, Any]) -> None:
    """Print a line of JSON."""
    print(json.dumps(line), flush=True)


class Orders:
    """The orders of the parent process on standard input: to measure, and to end."""

    def __init__(self) -> None:
        self.measuring = threading.Event()
        self.ended = threading.Event()
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        for _ in sys.stdin:
            self.measuring.set()
        self.ended.set()


def light(orders: Orders, *, topology: Any, port: int, numbers: list[int], rate_hz: float) -> None:
    """Open the sessions of light vehicles, and publish their states, evenly distributed over time."""
    openers = ThreadPoolExecutor(OPENERS)
    openings = [openers.submit(LightVehicle, topology, port, number) for number in numbers]
    vehicles: list[LightVehicle] = []
    while matching_count(vehicles) < len(numbers) and not orders.ended.is_set():
        vehicles = [opening.result() for opening in openings if opening.done()]
        say({"connected": matching_count(vehicles)})
        orders.ended.wait(PARENT_WAIT_S)
    say({"connected": matching_count(vehicles), "ready": True})
    payload = state(time.time_ns())
    sent = measured = 0
    begin_ns, measuring_ns = time.monotonic_ns(), 0
    while not orders.ended.is_set():
        now_ns = time.monotonic_ns()
        if orders.measuring.is_set() and not measuring_ns:
            measuring_ns, measured = now_ns, sent
        due = round((now_ns - begin_ns) / NS_PER_S * rate_hz * len(vehicles))
        for number in range(sent, min(due, sent + len(vehicles))):  # at most one state of each vehicle
            vehicle = vehicles[number % len(vehicles)]
            with contextlib.suppress(zenoh.ZError):
                vehicle.publisher.put(state(time.time_ns()) if vehicle.is_sampled else payload)
        sent = min(due, sent + len(vehicles))
        time.sleep(PAUSE_S)
    elapsed_s = (time.monotonic_ns() - measuring_ns) / NS_PER_S if measuring_ns else 0.0
    say({"sent_per_s": (sent - measured) / elapsed_s if elapsed_s else 0.0})


def watcher(orders: Orders, *, topology: Any, port: int) -> None:
    """Subscribe to the states of all vehicles, and read those of the sampled ones to measure their latency."""
    session = open_session(topology, port)
    everything: Any = zenoh.handlers.RingChannel(1)
    all_states = session.declare_subscriber("lavt/*/state", everything)
    ring: Any = zenoh.handlers.RingChannel(RECEIVE_RING_LENGTH)
    sampled = session.declare_subscriber("lavt/sampled-$*/state", ring)
    latencies_ns: list[int] = []

    def listen() -> None:
        handler: Any = sampled.handler
        with contextlib.suppress(zenoh.ZError):
            while True:
                sample = handler.recv()
                now_ns = time.time_ns()
                if orders.measuring.is_set():
                    sent_ns = decode(State, sample.payload.to_bytes()).sent_wall_ns
                    latencies_ns.append(now_ns - sent_ns)

    threading.Thread(target=listen, daemon=True).start()
    say({"ready": True})
    orders.ended.wait()
    say({"latencies_ns": list(latencies_ns), "keep": all_states is None})


def open_links(
    topology: Any, port: int, count: int, side: Any, deliver: Callable[[int, Any, Now], None]
) -> list[ZenohLink]:
    """Open LAVT's links of driven vehicles (`side` is server) or of their clients; `deliver` takes their number."""

    def receive(number: int, _channel: str, payload: Any, arrived: Now, _peer: Any) -> None:
        deliver(number, payload, arrived)

    links = []
    for number in range(count):
        link = ZenohLink(
            MachineClock(),
            side=side,
            settings=settings(topology, port),
            vehicle=f"driven-{number}",
            who=f"{side}-{number}",
        )
        link.start(partial(receive, number))
        links.append(link)
    return links


def vehicles(orders: Orders, *, topology: Any, port: int, count: int) -> None:
    """Answer each command with a state that names its sequence number."""
    links: list[ZenohLink] = []

    def deliver(number: int, payload: bytes, arrived: Now) -> None:
        if number < len(links):
            sequence = decode(Command, payload).sequence
            links[number].send(Send("state", state(arrived.wall_ns, sequence)))

    links += open_links(topology, port, count, "server", deliver)
    say({"ready": True})
    orders.ended.wait()
    say({})


class DrivingClient:
    """The commands of one client that have no answer yet, and the round trips."""

    def __init__(self) -> None:
        self.sent_ns: dict[int, int] = {}
        self.round_trips_ns: list[int] = []
        self.sent = 0


def clients(orders: Orders, *, topology: Any, port: int, count: int) -> None:
    """Send 50 commands a second to each driven vehicle, and measure the time until the state that answers each."""
    states = [DrivingClient() for _ in range(count)]

    def deliver(number: int, payload: bytes, arrived: Now) -> None:
        client = states[number]
        sent_ns = client.sent_ns.pop(decode(State, payload).applied_sequence, None)
        if sent_ns is not None and arrived.mono_ns - sent_ns < ROUND_TRIP_TIMEOUT_NS:
            client.round_trips_ns.append(arrived.mono_ns - sent_ns)

    links = open_links(topology, port, count, "client", deliver)
    begin_ns, sequence, is_ready = time.monotonic_ns(), 0, False
    path = tuple(0.01 + 0.001 * point for point in range(PATH_POINTS))
    while not orders.ended.is_set():
        number = sequence % count
        due_ns = begin_ns + sequence * NS_PER_S // (RATE_HZ * count)
        time.sleep(max(0, due_ns - time.monotonic_ns()) / NS_PER_S)
        wall_ns = time.time_ns()
        data = encode(Command(2**63 + 5, sequence, wall_ns, wall_ns, wall_ns, 0.123, 0.456, 0.01, path, "drive", 0))
        client = states[number]
        client.sent_ns[sequence] = time.monotonic_ns()
        links[number].send(Send("control", data))
        if orders.measuring.is_set():
            client.sent += 1
        elif not is_ready and all(client.round_trips_ns for client in states):
            is_ready = True
            say({"ready": True})
        if not orders.measuring.is_set() and is_ready:
            client.round_trips_ns = client.round_trips_ns[-1:]
        sequence += 1
    time.sleep(PARENT_WAIT_S)  # the last answers
    round_trips_ns = [time_ns for client in states for time_ns in client.round_trips_ns]
    say({"round_trips_ns": round_trips_ns, "sent": sum(client.sent for client in states)})


ROLES: dict[str, Callable[..., None]] = {
    "light": light,
    "watcher": watcher,
    "vehicles": vehicles,
    "clients": clients,
}


def main() -> None:
    """Run a role; end without closing many sessions one by one."""
    sys.setswitchinterval(SWITCH_INTERVAL_S)
    ROLES[sys.argv[1]](Orders(), **json.loads(sys.argv[2]))
    os._exit(0)


if __name__ == "__main__":
    main()
