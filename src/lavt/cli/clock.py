"""`lavt clock`: report the error of this machine's clock and, with --server, the offset to another machine's clock."""

from __future__ import annotations

import queue
from collections.abc import Callable
from contextlib import closing
from typing import Annotated, Any, Literal

import msgspec
import typer

from lavt.assembly.clock_source import build_query_process, clock_source
from lavt.cli import console
from lavt.clock import MachineClock, pause
from lavt.config import ClockConfig
from lavt.config_file import parse_config
from lavt.doctor.clock_checks import check_host, compare_with_server
from lavt.domain import NS_PER_MS, NS_PER_S, Now
from lavt.errors import BadMessage, WorkError
from lavt.node import Send
from lavt.transport.clock_sync.clock_report import ClockReport
from lavt.transport.clock_sync.probe import DEFAULT_PORT, ClockProbe, ProbeReply, decode_reply, encode_request
from lavt.transport.udp_link import UdpLink, resolve_host

PROBE_PERIOD_NS = 50 * NS_PER_MS
LAST_REPLY_TIMEOUT_NS = 500 * NS_PER_MS
"""How long to wait for replies after the last request."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("clock")(clock)


def clock(
    server: Annotated[str | None, typer.Option(help="Host of a running `lavt server` whose clock to probe.")] = None,
    port: Annotated[int, typer.Option(min=1, max=65535, help="The server's clock.probe_port.")] = DEFAULT_PORT,
    seconds: Annotated[float, typer.Option(min=0.1, max=3600, help="Duration of the probing.")] = 3.0,
    source: Annotated[
        Literal["chrony", "ptp", "external"], typer.Option(help="The time source of this machine's clock.")
    ] = "chrony",
    correction_ms: Annotated[
        float | None, typer.Option(help="For external: reference time minus this machine's wall clock.")
    ] = None,
    bound_ms: Annotated[float | None, typer.Option(help="For external: the largest error of the correction.")] = None,
    as_json: console.JsonOption = False,
) -> None:
    """Report the error of this machine's clock.

    With --server, the command also measures the offset to the vehicle's clock. It exits with 1 if the clock is not
    accurate enough to measure one-way latencies.

    Example: lavt clock --server 192.0.2.7
    """
    requested = {"source": source, "correction_ms": correction_ms, "bound_ms": bound_ms}
    config = parse_config(ClockConfig, requested, "lavt clock")
    address = None if server is None else resolve_host("--server", server)
    machine = MachineClock()
    with closing(build_query_process(config)) as process:
        read_source = clock_source(config, machine, process.run)
        report = _read_report(read_source, source)
        if address is None:
            finding = check_host(report)
        else:
            probes, last_reply = probe(machine, address, port, round(seconds * NS_PER_S))
            if last_reply is None:
                raise WorkError(
                    f"no answer from {server}:{port} (UDP): is `lavt server` running there, is its "
                    f"clock.probe_port {port}, and does the firewall admit this port?"
                )
            report_before, report = report, _read_report(read_source, source)
            finding = compare_with_server(report_before, report, probes, last_reply, address)
    if as_json:
        console.print_json({**msgspec.to_builtins(finding), "clock": msgspec.to_builtins(report)})
    else:
        for sentence in finding.says:
            console.print_result(f"{sentence}.")
    if not finding.good:
        raise typer.Exit(1)


def _read_report(read_source: Callable[[], ClockReport | None], source: str) -> ClockReport:
    report = read_source()
    if report is None:
        raise WorkError(f"{source} did not answer in time: is this machine overloaded?")
    return report


def probe(
    machine: MachineClock, address: str, port: int, duration_ns: int
) -> tuple[list[ClockProbe], ProbeReply | None]:
    """Probe a server; return all complete exchanges and the last reply. Other datagrams are ignored."""
    replies: queue.SimpleQueue[tuple[bytes, Now]] = queue.SimpleQueue()

    def deliver(_channel: str, payload: Any, arrived: Now, _peer: Any) -> None:
        replies.put((payload, arrived))

    sent_wall_ns: dict[int, int] = {}
    link = UdpLink(machine, "probe_reply", bind=("", 0), remote=(address, port), name="probe")
    with closing(link):
        link.start(deliver)
        end_ns = machine.now().mono_ns + duration_ns
        while machine.now().mono_ns < end_ns:
            sequence = len(sent_wall_ns)
            sent_wall_ns[sequence] = machine.now().wall_ns
            link.send(Send("probe_request", encode_request(sequence, sent_wall_ns[sequence])))
            pause(PROBE_PERIOD_NS)
        pause(LAST_REPLY_TIMEOUT_NS)
    probes: list[ClockProbe] = []
    last_reply = None
    while not replies.empty():
        payload, arrived = replies.get()
        try:
            reply = decode_reply(payload)
        except BadMessage:
            continue
        if sent_wall_ns.pop(reply.sequence, None) == reply.sent_wall_ns:
            times = (reply.sent_wall_ns, reply.received_wall_ns, reply.answered_wall_ns, arrived.wall_ns)
            probes.append(ClockProbe(reply.sequence, *times))
            last_reply = reply
    return probes, last_reply
