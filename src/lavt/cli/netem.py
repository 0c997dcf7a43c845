"""`lavt netem`: inject network latency with the kernel's queues (tc netem)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

import msgspec
import typer

from lavt.assembly.injection import Protocol, Role, StateDelay, netem_flows
from lavt.cli import console
from lavt.config_file import condition
from lavt.errors import UserError, WorkError
from lavt.transport.clock_sync import probe
from lavt.transport.emulation.impairment import ExemptPort, check_flows
from lavt.transport.netem.netem import NetemInterface, Verification
from lavt.transport.netem.queue_probe import ProbeResult
from lavt.transport.netem.state import DIRECTORY
from lavt.transport.netem.tc import Command, as_typed, first_commands

Interface = Annotated[str, typer.Option(help="The network interface towards the other side, such as eth0.")]
ProbePort = Annotated[int, typer.Option(help="UDP port of the clock probe, which is never delayed.", min=1, max=65535)]
MADE_BY_HAND = "queues that were set up by hand"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    netem = typer.Typer(no_args_is_help=True, help="Inject latency with tc netem (docs/netem.md).")
    for command in (show, apply, verify, clear):
        netem.command(command.__name__)(command)
    app.add_typer(netem, name="netem")


def show(interface: Interface, as_json: console.JsonOption = False) -> None:
    """Show the delay queues of an interface.

    Example: lavt netem show --interface eth0
    """
    status = NetemInterface(interface).status()
    applied = status["applied"] if status["ours"] else None
    impairments = msgspec.to_builtins(status["impairments"]) if status["ours"] else {}
    if as_json:
        owner = None if applied is None else {"condition": applied.condition, "owner_pid": applied.owner[0] or None}
        console.print_json({**status, "impairments": impairments, "applied": owner})
        return
    if not status["ours"]:
        console.print_result(f"{interface} has no delay queues of LAVT: {', '.join(status['queues']) or 'no queue'}")
        return
    console.print_result(f"{interface} has {MADE_BY_HAND if applied is None else applied.description}")
    for name, impairment in impairments.items():
        values = [f"{key} {value:g}" for key, value in impairment.items() if isinstance(value, int | float) and value]
        console.print_result(f"  {name}: {', '.join(values) or 'no impairment'}")


def apply(
    name: Annotated[str, typer.Argument(metavar="CONDITION", help="A condition of netem/conditions.yaml, such as L4.")],
    interface: Interface,
    role: Annotated[Role, typer.Option(help="This machine's role; both: server and client on one machine.")],
    video_port: Annotated[int, typer.Option(help="The server's UDP port for video.", min=1, max=65535)] = 5600,
    control_port: Annotated[int, typer.Option(help="The port of the server's router.", min=1, max=65535)] = 7448,
    protocol: Annotated[Protocol, typer.Option(help="The routers' protocol: udp (also for QUIC) or tcp.")] = "udp",
    probe_port: ProbePort = probe.DEFAULT_PORT,
    state_delay: Annotated[StateDelay, typer.Option(help="with_video: delay the state like the video.")] = "none",
    hold: Annotated[bool, typer.Option("--hold", help="Run until Ctrl-C, then restore the interface.")] = False,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only print the commands for an interface without delay queues.")
    ] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Apply a network condition to an interface and verify it.

    The condition delays packets that this machine sends, and stays in force after the end of the command. The command
    reads the queues back and measures the delay. It replaces an existing condition without packet loss. If the
    verification fails, the command restores the interface. If the change of an existing condition fails, some queues
    can remain, and the command says so.

    Example: lavt netem apply L4 --role server --interface eth0
    """
    flows = netem_flows(
        condition(name),
        role,
        video_port=video_port,
        control_port=control_port,
        protocol=protocol,
        state_delay=state_delay,
    )
    exempt = [ExemptPort("udp", probe_port, "the clock probe")]
    check_flows(flows, exempt)
    netem = NetemInterface(interface, persistent=not hold)
    if dry_run:
        _print_commands(first_commands(interface, flows, tables=str(DIRECTORY)), as_json, interface, name)
        return
    _print_messages(netem.check())
    with console.stop_on_signals() as stop:
        was_delayed = netem.status()["ours"]
        try:
            commands = netem.apply(flows, exempt=exempt, condition=name)
            if not as_json:
                _print_command_lines(commands)
            verification = netem.verify(flows, exempt=exempt)
            _print_verification(
                verification, as_json, {"interface": interface, "condition": name, "commands": commands}
            )
            if hold and not verification.reasons:
                stop.wait()
        except BaseException:
            _restore(netem, was_delayed)
            raise
        if hold or verification.reasons or stop.is_set():
            for command in netem.clear():
                console.print_message(as_typed(command))
    _raise_if_failed(verification)
    if stop.is_set() and not hold:
        raise WorkError(f"stopped; {interface} is restored")


def verify(
    interface: Interface, probe_port: ProbePort = probe.DEFAULT_PORT, as_json: console.JsonOption = False
) -> None:
    """Verify the condition that was applied to an interface.

    The command reads the queues back and measures the delay.

    Example: lavt netem verify --interface eth0
    """
    netem = NetemInterface(interface)
    applied = netem.applied()
    if applied is None:
        raise UserError(f"nothing was applied to {interface}: apply a condition first (`lavt netem apply`)")
    exempt = [ExemptPort("udp", probe_port, "the clock probe")]
    verification = netem.verify(applied.flows, exempt=exempt)
    _print_verification(verification, as_json, {"interface": interface, "condition": applied.condition})
    _raise_if_failed(verification)


def clear(
    interface: Interface,
    at_once: Annotated[
        bool, typer.Option("--at-once", help="Drop the queued packets; do not wait until they have left.")
    ] = False,
    as_json: console.JsonOption = False,
) -> None:
    """Remove the delay from an interface, whoever applied it.

    The command waits until queued packets have left, and prints whose delay it has removed.

    Example: lavt netem clear --interface eth0
    """
    netem = NetemInterface(interface)
    _print_messages(netem.restore())
    applied = netem.applied()
    commands = netem.clear(at_once=at_once, any_owner=True)
    if commands:
        console.print_message(f"lavt: removed: {MADE_BY_HAND if applied is None else applied.description}")
    _print_commands(commands, as_json, interface, "")
    if not as_json:
        console.print_result(f"{interface} is restored" if commands else f"{interface} has no delay queues of LAVT")


def _restore(netem: NetemInterface, was_delayed: bool) -> None:
    """Clear an interface after a failed change; if it `was_delayed` before, print how to find the remaining queues."""
    if not was_delayed:
        netem.clear()
        return
    console.print_message(
        f"lavt: {netem.interface} was already delayed, and its queues remain as they are now: `lavt netem show "
        f"--interface {netem.interface}` shows them, `lavt netem clear --interface {netem.interface}` removes them"
    )


def _print_commands(commands: Sequence[Command], as_json: bool, interface: str, condition_name: str) -> None:
    if as_json:
        console.print_json({"interface": interface, "condition": condition_name, "commands": commands})
    else:
        _print_command_lines(commands)


def _print_command_lines(commands: Sequence[Command]) -> None:
    for command in commands:
        console.print_result(as_typed(command))


def _print_messages(sentences: Sequence[str]) -> None:
    for sentence in sentences:
        console.print_message(f"lavt: {sentence}")


def _print_verification(verification: Verification, as_json: bool, context: Mapping[str, Any]) -> None:
    """Print the measured delays; as JSON, print the reasons for failure too."""
    if as_json:
        measured = msgspec.to_builtins(verification.measured)
        console.print_json({**context, "measured": measured, "reasons": verification.reasons})
        return
    for flow, result in verification.measured.items():
        console.print_result(f"measured: {flow}: {_format_probe(result)}")
    if not verification.reasons:
        console.print_result("verified: the queues and the measured delays match the condition")


def _format_probe(measured: ProbeResult) -> str:
    parts = ["no delay measured"]
    if measured.median_ms is not None:
        parts = [f"{measured.median_ms:.2f} ms (p5 {measured.p5_ms:.2f}, p95 {measured.p95_ms:.2f})"]
    counts = {"lost": measured.lost, "reordered": measured.reordered, "early": measured.early}
    return ", ".join(parts + [f"{count} of {measured.sent} {name}" for name, count in counts.items() if count])


def _raise_if_failed(verification: Verification) -> None:
    if verification.reasons:
        raise WorkError("netem does not match the condition: " + "; ".join(verification.reasons))
