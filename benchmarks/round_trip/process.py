"""One of the two processes of a round trip: the asking one, which sends commands, or the one that echoes them.

The arguments are `echo CARRIER PLACES`, or `ask CARRIER PLACES ADDRESS SECONDS MESSAGES`. Both processes print a line
of JSON with the stamps of their messages at the end: lists of times of the monotonic clock, which is the same in both
processes. The echoing process ends when its standard input is closed.
"""

from __future__ import annotations

import gc
import itertools
import json
import sys
import threading
import time  # noqa: TID251 (a benchmark reads the clock)
from collections.abc import Iterator
from typing import Any

import msgspec
from benchmarks.round_trip.carriers import CARRIERS
from benchmarks.round_trip.ends import CarrierEnd
from benchmarks.round_trip.zenoh_end import EPOCH, Places

from lavt.domain import NS_PER_S, PATH_POINTS, Command
from lavt.runtime.realtime import SWITCH_INTERVAL_S
from lavt.transport.messages import decode, encode

PERIOD_NS = NS_PER_S // 50
ECHO_TIMEOUT_S = 1.0
"""An echo that takes longer is lost."""
FIRST_ECHO_TIMEOUT_S = 20.0
"""The first echo takes longer, because routers and participants have to find each other."""
WARM_UP_MESSAGES = 50
Stamps = dict[str, int]


def command(sequence: int) -> bytes:
    """Encode a command like the driver's, with numbers that are as long on the wire as in a drive."""
    wall_ns = time.time_ns()
    path = tuple(0.01 + 0.001 * point for point in range(PATH_POINTS))
    return encode(Command(EPOCH, sequence, wall_ns, wall_ns - 1, wall_ns - 2, 0.123, 0.456, 0.01, path, "drive", 0))


def echo(end: CarrierEnd) -> dict[int, Stamps]:
    """Send back every message until the end is stopped; return the stamps by sequence number."""
    stamps: dict[int, Stamps] = {}
    while (receipt := end.receive(3600.0)) is not None:
        handed_ns = time.monotonic_ns()
        end.send(receipt.data)
        sent_ns = time.monotonic_ns()
        sequence = decode(Command, receipt.data).sequence
        decoded_ns = time.monotonic_ns()
        stamps[sequence] = {
            "arrived": receipt.arrived_ns,
            "verified": receipt.verified_ns,
            "handed": handed_ns,
            "signed": end.signed_ns or handed_ns,
            "sent": sent_ns,
            "decode": decoded_ns - sent_ns,
            "in_zenoh": receipt.in_zenoh_ns,
            "woken": receipt.woken_ns,
        }
    return stamps


def round_trip(end: CarrierEnd, sequence: int, timeout_s: float) -> Stamps | None:
    """Send a command and return the stamps of the round trip; None if the echo is lost."""
    begin_ns = time.monotonic_ns()
    data = command(sequence)
    encoded_ns = time.monotonic_ns()
    end.send(data)
    sent_ns = time.monotonic_ns()
    while (receipt := end.receive(timeout_s)) is not None:
        handed_ns = time.monotonic_ns()
        if receipt.data == data:
            return {
                "sequence": sequence,
                "begin": begin_ns,
                "encoded": encoded_ns,
                "signed": end.signed_ns or encoded_ns,
                "sent": sent_ns,
                "arrived": receipt.arrived_ns,
                "verified": receipt.verified_ns,
                "handed": handed_ns,
                "in_zenoh": receipt.in_zenoh_ns,
                "woken": receipt.woken_ns,
            }
    return None


def warm_up(end: CarrierEnd, sequences: Iterator[int]) -> None:
    """Send commands until the first echo arrives, and then 50 more; raise `SystemExit` if no echo arrives."""
    until_ns = time.monotonic_ns() + round(FIRST_ECHO_TIMEOUT_S * NS_PER_S)
    while round_trip(end, next(sequences), 0.1) is None:
        if time.monotonic_ns() > until_ns:
            raise SystemExit(f"no echo within {FIRST_ECHO_TIMEOUT_S:.0f} s")
    for _ in range(WARM_UP_MESSAGES):
        round_trip(end, next(sequences), ECHO_TIMEOUT_S)


def ask(end: CarrierEnd, seconds: float, messages: int) -> dict[str, Any]:
    """Return the stamps of round trips by pace: for `seconds` at 50 Hz, and for `messages` back to back.

    A lost echo is None.
    """
    sequences = itertools.count()
    warm_up(end, sequences)
    paced: list[Stamps | None] = []
    begin_ns = time.monotonic_ns()
    for number in range(max(1, round(seconds * 50))):
        time.sleep(max(0, begin_ns + number * PERIOD_NS - time.monotonic_ns()) / NS_PER_S)
        paced.append(round_trip(end, next(sequences), ECHO_TIMEOUT_S))
    back_to_back = [round_trip(end, next(sequences), ECHO_TIMEOUT_S) for _ in range(messages)]
    return {"at_50_hz": paced, "back_to_back": back_to_back, "wire_bytes": end.wire_bytes or len(command(0))}


def stop_at_end_of_input(end: CarrierEnd) -> None:
    """Stop the end when standard input is closed."""
    sys.stdin.read()
    end.stop()


def main() -> None:
    """Ask or echo."""
    role, name, places, *asking_arguments = sys.argv[1:]
    sys.setswitchinterval(SWITCH_INTERVAL_S)  # as in LAVT's runtime
    address = asking_arguments[0] if role == "ask" else ""
    end = CARRIERS[name].new_end(address, msgspec.json.decode(places, type=Places))
    gc.collect()
    gc.freeze()
    try:
        if role == "echo":
            threading.Thread(target=stop_at_end_of_input, args=(end,), daemon=True).start()
            print(json.dumps({"address": end.address}), flush=True)
            print(json.dumps(echo(end)), flush=True)
        else:
            _, seconds, messages = asking_arguments
            print(json.dumps(ask(end, float(seconds), int(messages))), flush=True)
    finally:
        end.close()


if __name__ == "__main__":
    main()
