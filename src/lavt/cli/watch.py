"""`lavt watch`: measure loss and latency of a plain RTP stream, of LAVT or of another sender."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import closing
from itertools import count
from typing import Annotated, Any

import typer

from lavt.assembly.watcher import Sender, WatchNodes
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.domain import NS_PER_S
from lavt.errors import WorkError, describe_error
from lavt.runtime import process_priority
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.transport.udp_link import UdpLink, resolve_host

HINT_AFTER_S = 5
"""After this time without a packet the command prints what to check."""
CHECKS: Mapping[Sender, str] = {
    "lavt": "each accepted stamp agrees with its RTP timestamp, so the stamp's error is less than 12 us",
    "foreign": "the check is weaker: the base of the sender's RTP clock is learned from its stamps, so an accepted "
    "stamp may have an error of up to 10 ms",
}
"""How stamps are checked, by the kind of sender; printed with the summary."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("watch")(watch)


def watch(
    port: Annotated[int, typer.Option(min=0, max=65535, help="UDP port of the stream; 0: any free port.")] = 5600,
    bind: Annotated[str, typer.Option(help="The local address to listen on.")] = "0.0.0.0",  # noqa: S104
    sent_from: Annotated[
        str | None, typer.Option("--from", help="Accept packets of this host only, from any port.")
    ] = None,
    sender: Annotated[
        Sender, typer.Option(help="foreign: a sender whose RTP clock has another base, so that the check is weaker.")
    ] = "lavt",
    reorder_hold_ms: Annotated[
        int | None,
        typer.Option(
            min=0,
            max=500,
            help="How long the jitter buffer holds a packet after a gap.",
            show_default="adapted to the network",
        ),
    ] = None,
    seconds: Annotated[int | None, typer.Option(min=1, help="Stop after this time; default: on Ctrl-C.")] = None,
    as_json: console.JsonOption = False,
) -> None:
    """Receive an RTP/H.264 stream and measure its latency.

    The command prints loss and latency each second, and a summary at the end. It sends nothing. Latency is this
    machine's wall clock minus the stamp in the picture: it is only as accurate as the synchronisation of the two clocks
    (`lavt clock`). The command exits with 1 if no picture arrived.

    Example: lavt watch --port 5004 --sender foreign
    """
    process_priority.raise_priority()
    only_from = None if sent_from is None else resolve_host("--from", sent_from)
    clock, nodes = MachineClock(), WatchNodes(sender, reorder_hold_ms)
    runtime = RealRuntime(clock, nodes.nodes, nodes, lambda: None)
    link = UdpLink(clock, "rtp", bind=(bind, port), only_from=only_from)
    with closing(link), console.stop_on_signals() as stop, fail_on_thread_errors(runtime.fail):
        _print_header(link.port, as_json)
        runtime.start({})  # no link: the command sends nothing
        link.start(runtime.deliver)
        totals = nodes.totals()
        for second in _seconds(clock, stop, seconds):
            if runtime.stopped.is_set():
                break
            previous_totals, totals = totals, nodes.totals()
            _print_statistics("second", nodes.statistics_between(previous_totals, totals), as_json)
            if second == HINT_AFTER_S and not totals["packets"]:
                console.print_message(_no_packet_hint(link, totals))
        runtime.stop()
    if runtime.failed is not None:
        raise WorkError(f"stopped because a part failed: {describe_error(runtime.failed)}")
    summary = nodes.statistics_between(Counter(), nodes.totals())
    from_strangers = link.counts["datagrams_from_strangers"]
    values = {**summary, "datagrams_from_strangers": from_strangers, "check": CHECKS[sender]}
    _print_statistics("summary", values, as_json)
    if not summary["pictures"]:
        raise WorkError(f"no picture arrived: does a sender send to UDP port {link.port} of this machine?")
    if not summary["stamps_accepted"]:
        console.print_message("no stamp was accepted: do the pictures have stamps, and is --sender correct?")


def _seconds(clock: MachineClock, stop: console.StopEvent, limit_s: int | None) -> Iterator[int]:
    """Yield 1, 2, ... each time a further second has passed, up to `limit_s` or the stop event."""
    start_ns = clock.now().mono_ns
    for number in count(1) if limit_s is None else range(1, limit_s + 1):
        if stop.wait(max(0, start_ns + number * NS_PER_S - clock.now().mono_ns) / NS_PER_S):
            return
        yield number


def _print_header(port: int, as_json: bool) -> None:
    if as_json:
        console.print_json({"watching": {"port": port}})
    else:
        console.print_result(
            f"watching UDP port {port}; Ctrl-C ends it; latency is this machine's wall clock minus the stamp, as "
            "accurate as the synchronisation of the two clocks (`lavt clock`)"
        )


def _no_packet_hint(link: UdpLink, totals: Mapping[str, int]) -> str:
    return (
        f"no RTP packet arrived in {HINT_AFTER_S} s ({totals['datagrams_unreadable']} other datagrams, "
        f"{link.counts['datagrams_from_strangers']} from other hosts): is the stream sent to UDP port {link.port} of "
        "this machine, and does the firewall admit this port?"
    )


def _print_statistics(kind: str, values: Mapping[str, Any], as_json: bool) -> None:
    if as_json:
        console.print_json({kind: values})
        return
    reason = f" (last reason: {values['last_unreadable_reason']})" if values["stamps_unreadable"] else ""
    latency = (
        f"latency median {values['latency_median_ms']:.1f} ms, p95 {values['latency_p95_ms']:.1f} ms"
        if values["stamps_accepted"]
        else "latency unknown"
    )
    console.print_result(
        f"{'' if kind == 'second' else 'summary: '}{values['pictures']} pictures; {values['stamps_accepted']} stamps "
        f"accepted, {values['stamps_unreadable']} not{reason}; {latency}; {values['packets']} packets, "
        f"{values['lost']} lost, {values['reordered']} reordered, jitter {values['jitter_ms']:.1f} ms"
    )
    if "check" in values:
        console.print_result(values["check"])
