"""`lavt watch`: what a plain RTP stream brings, also from a sender that nobody here wrote."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from itertools import count
from typing import Annotated, Any

import typer

from lavt.cli import console
from lavt.cli.watch_nodes import Sender, WatchNodes
from lavt.clock import MachineClock
from lavt.domain import NS_PER_S
from lavt.errors import WorkError
from lavt.runtime import process_priority
from lavt.runtime.realtime import RealRuntime
from lavt.transport.udp_link import UdpLink, resolve_host

PATIENCE_S = 5
"""After so long without a packet it is said what to look for."""
CHECKS: Mapping[Sender, str] = {
    "lavt": "each accepted stamp says the same time as its RTP timestamp: it is wrong by less than 12 us",
    "foreign": "the check is weaker: the base of the sender's RTP clock was learned from its stamps, so that an "
    "accepted one may be wrong by up to 10 ms",
}


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("watch")(watch)


def watch(
    port: Annotated[int, typer.Option(min=0, max=65535, help="UDP port that the stream is sent to; 0: any.")] = 5600,
    bind: Annotated[str, typer.Option(help="The address of this machine to listen at.")] = "0.0.0.0",  # noqa: S104
    sent_from: Annotated[str | None, typer.Option("--from", help="Hear this host only, whatever its port.")] = None,
    sender: Annotated[
        Sender, typer.Option(help="foreign: its RTP clock has a base of its own, which is learned: a weaker check.")
    ] = "lavt",
    reorder_hold_ms: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=500,
            help="How long a packet after a gap waits for those before it.",
            show_default="as the network needs it",
        ),
    ] = None,
    seconds: Annotated[int | None, typer.Option(min=1, help="End after so long, not by Ctrl-C only.")] = None,
    as_json: console.Json = False,
) -> None:
    """Receive a plain RTP/H.264 stream and say each second, and at the end, what arrived and how late. Sends nothing.

    Latency is this machine's wall clock less the stamp in the picture: right only as far as the clocks of the two
    machines agree (`lavt clock` tells). Ends with 1 if no picture came.

    Example: lavt watch --port 5004 --sender foreign
    """
    process_priority.raise_priority()
    only_from = None if sent_from is None else resolve_host("--from", sent_from)
    clock, watched = MachineClock(), WatchNodes(sender, reorder_hold_ms)
    runtime = RealRuntime(clock, watched.nodes, watched, lambda: None)
    link = UdpLink(clock, "rtp", runtime.deliver, bind=(bind, port), only_from=only_from)
    with closing(link), console.until_told() as told:
        _begin(link.port, as_json)
        runtime.start({})  # whatever a node might want sent has no way out
        link.start()
        so_far = watched.totals()
        for second in _seconds(clock, told, seconds):
            if runtime.stopped.is_set():
                break
            before, so_far = so_far, watched.totals()
            _show("second", watched.between(before, so_far), as_json)
            if second == PATIENCE_S and not so_far["packets"]:
                console.say(_nothing(link, so_far))
        runtime.stop()
    if runtime.failed is not None:
        raise WorkError(f"stopped because a part failed: {runtime.failed}")
    in_all = watched.between(Counter(), watched.totals())
    strangers = link.counts["datagrams_from_strangers"]
    _show("summary", {**in_all, "datagrams_from_strangers": strangers, "check": CHECKS[sender]}, as_json)
    if not in_all["pictures"]:
        raise WorkError("no picture came")
    if not in_all["stamps_accepted"]:
        console.say("no stamp was accepted: is there one in the pictures, and is --sender what it should be?")


def _seconds(clock: MachineClock, told: console.StopEvent, limit_s: int | None) -> Iterator[int]:
    """Count the seconds as they end, up to the limit or until told."""
    begin_ns = clock.now().mono_ns
    for number in count(1) if limit_s is None else range(1, limit_s + 1):
        if told.wait(max(0, begin_ns + number * NS_PER_S - clock.now().mono_ns) / NS_PER_S):
            return
        yield number


def _begin(port: int, as_json: bool) -> None:
    if as_json:
        console.show_json({"watching": {"port": port}})
    else:
        console.show(
            f"watching UDP port {port}; Ctrl-C ends it; latency is this machine's wall clock less the stamp: right "
            "only as far as the clocks of the two machines agree (`lavt clock` tells)"
        )


def _nothing(link: UdpLink, so_far: Mapping[str, int]) -> str:
    return (
        f"no RTP packet came in {PATIENCE_S} s ({so_far['datagrams_unreadable']} other datagrams, "
        f"{link.counts['datagrams_from_strangers']} from other hosts): is it sent to UDP port {link.port} of this "
        "machine, and does the firewall let it through?"
    )


def _show(kind: str, line: Mapping[str, Any], as_json: bool) -> None:
    if as_json:
        console.show_json({kind: line})
        return
    reason = f" (the last: {line['last_unreadable_reason']})" if line["stamps_unreadable"] else ""
    latency = (
        f"latency median {line['latency_median_ms']:.1f} ms, p95 {line['latency_p95_ms']:.1f} ms"
        if line["stamps_accepted"]
        else "latency unknown"
    )
    console.show(
        f"{'' if kind == 'second' else 'in all: '}{line['pictures']} pictures; {line['stamps_accepted']} stamps "
        f"accepted, {line['stamps_unreadable']} not{reason}; {latency}; {line['packets']} packets, "
        f"{line['lost']} lost, {line['reordered']} reordered, jitter {line['jitter_ms']:.1f} ms"
    )
    if "check" in line:
        console.show(line["check"])
