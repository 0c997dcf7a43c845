"""`lavt netem`: delay injected by the kernel of this machine."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Annotated, Any

import typer

from lavt.assembly.injection import Protocol, Role, StateDelay, netem_flows
from lavt.cli import console
from lavt.config_file import condition
from lavt.errors import UserError, WorkError
from lavt.transport.clock_sync import probe
from lavt.transport.emulation.impairment import ExemptPort, check_flows
from lavt.transport.netem.netem import NetemInterface, Verification
from lavt.transport.netem.probe import ProbeResult
from lavt.transport.netem.state import DIRECTORY
from lavt.transport.netem.tc import Command, as_typed, first_commands

Interface = Annotated[str, typer.Option(help="The network interface, such as eth0: the one that faces the other side.")]
ProbePort = Annotated[int, typer.Option(help="UDP port of the clock probe, which is never delayed.", min=1, max=65535)]
MADE_BY_HAND = "what was made by hand"


def register(app: typer.Typer) -> None:
    """Add the commands."""
    netem = typer.Typer(no_args_is_help=True, help="Delay injected by the kernel (tc netem), see docs/netem.md.")
    for command in (show, apply, verify, clear):
        netem.command(command.__name__)(command)
    app.add_typer(netem, name="netem")


def show(interface: Interface, as_json: console.Json = False) -> None:
    """Show what an interface holds, as the kernel tells it.

    Example: lavt netem show --interface eth0
    """
    status = NetemInterface(interface).status()
    applied = status["applied"] if status["ours"] else None
    impairments = (
        {name: asdict(impairment) for name, impairment in status["impairments"].items()} if status["ours"] else {}
    )
    if as_json:
        whose = None if applied is None else {"condition": applied.condition, "owner_pid": applied.owner[0] or None}
        console.show_json({**status, "impairments": impairments, "applied": whose})
        return
    if not status["ours"]:
        console.show(f"{interface} holds nothing of ours: {', '.join(status['queues']) or 'no queue'}")
        return
    console.show(f"{interface} holds {MADE_BY_HAND if applied is None else applied.description}")
    for name, impairment in impairments.items():
        told = ", ".join(
            f"{key} {value:g}" for key, value in impairment.items() if isinstance(value, int | float) and value
        )
        console.show(f"  {name}: {told or 'nothing'}")


def apply(
    name: Annotated[str, typer.Argument(metavar="CONDITION", help="A condition of netem/conditions.yaml, such as L4.")],
    interface: Interface,
    role: Annotated[Role, typer.Option(help="What this machine is; both: server and client on one machine.")],
    video_port: Annotated[int, typer.Option(help="The server's UDP port of the video.", min=1, max=65535)] = 5600,
    control_port: Annotated[
        int, typer.Option(help="Port of the server's router, to which the client's dials.", min=1, max=65535)
    ] = 7448,
    protocol: Annotated[Protocol, typer.Option(help="What the routers talk by: udp (also QUIC) or tcp.")] = "udp",
    probe_port: ProbePort = probe.DEFAULT_PORT,
    state_delay: Annotated[StateDelay, typer.Option(help="with_video: delay the state like the video.")] = "none",
    hold: Annotated[bool, typer.Option("--hold", help="Stay, and put the interface back at the end (Ctrl-C).")] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the commands for a free interface only.")] = False,
    as_json: console.Json = False,
) -> None:
    """Delay what this machine sends as a condition asks, verify it by reading back and by measuring, and leave it so.

    What is there already is changed without losing a packet. Where the verification fails, the interface is put back;
    where the change itself fails, and a delay was there before, it is said that something is left.

    Example: lavt netem apply L4 --role server --interface eth0
    """
    flows = netem_flows(
        condition(name), role, video_port=video_port, control_port=control_port, protocol=protocol,
        state_delay=state_delay,
    )  # fmt: skip
    exempt = [ExemptPort("udp", probe_port, "the clock probe")]
    check_flows(flows, exempt)
    netem = NetemInterface(interface, persistent=not hold)
    if dry_run:
        _tell_commands(first_commands(interface, flows, tables=str(DIRECTORY)), as_json, interface, name)
        return
    _say_restored(netem.check())
    with console.until_told() as told:
        was_held = netem.status()["ours"]
        try:
            commands = netem.apply(flows, exempt=exempt, condition=name)
            if not as_json:
                _show_commands(commands)
            found = netem.verify(flows, exempt=exempt)
            _tell(found, as_json, {"interface": interface, "condition": name, "commands": commands})
            if hold and not found.reasons:
                told.wait()
        except BaseException:
            _put_back(netem, was_held)
            raise
        if hold or found.reasons or told.is_set():
            for command in netem.clear():
                console.say(as_typed(command))
    _fail(found)
    if told.is_set() and not hold:
        raise WorkError(f"stopped; {interface} is as it was")


def verify(interface: Interface, probe_port: ProbePort = probe.DEFAULT_PORT, as_json: console.Json = False) -> None:
    """Verify what was applied to an interface by reading back and by measuring.

    Example: lavt netem verify --interface eth0
    """
    netem = NetemInterface(interface)
    applied = netem.applied()
    if applied is None:
        raise UserError(f"nothing was applied to {interface}: apply a condition first (`lavt netem apply`)")
    exempt = [ExemptPort("udp", probe_port, "the clock probe")]
    found = netem.verify(applied.flows, exempt=exempt)
    _tell(found, as_json, {"interface": interface, "condition": applied.condition})
    _fail(found)


def clear(
    interface: Interface,
    at_once: Annotated[bool, typer.Option("--at-once", help="Do not wait for what is under way: it is lost.")] = False,
    as_json: console.Json = False,
) -> None:
    """Put an interface back as it was, whoever delays it, and say who did; what is under way is waited for.

    Example: lavt netem clear --interface eth0
    """
    netem = NetemInterface(interface)
    _say_restored(netem.restore())
    applied = netem.applied()
    commands = netem.clear(at_once=at_once, any_owner=True)
    if commands:
        console.say(f"lavt: taken away: {MADE_BY_HAND if applied is None else applied.description}")
    _tell_commands(commands, as_json, interface, "")
    if not as_json:
        console.show(f"{interface} is as it was" if commands else f"{interface} holds nothing of ours")


def _put_back(netem: NetemInterface, was_held: bool) -> None:
    """Leave an interface as it was before a change that failed; where it was held, say how to find out what is left."""
    if not was_held:
        netem.clear()
        return
    console.say(
        f"lavt: {netem.interface} was held before, and is left as it is now: `lavt netem show --interface "
        f"{netem.interface}` tells what is left, `lavt netem clear --interface {netem.interface}` takes it away"
    )


def _tell_commands(commands: Sequence[Command], as_json: bool, interface: str, name: str) -> None:
    if as_json:
        console.show_json({"interface": interface, "condition": name, "commands": commands})
    else:
        _show_commands(commands)


def _show_commands(commands: Sequence[Command]) -> None:
    for command in commands:
        console.show(as_typed(command))


def _say_restored(sentences: Sequence[str]) -> None:
    for sentence in sentences:
        console.say(f"lavt: {sentence}")


def _tell(found: Verification, as_json: bool, what: Mapping[str, Any]) -> None:
    """Tell what was measured and what is wrong with it."""
    if as_json:
        measured = {name: asdict(each) for name, each in found.measured.items()}
        console.show_json({**what, "measured": measured, "reasons": found.reasons})
        return
    for name, each in found.measured.items():
        console.show(f"measured: {name}: {_words(each)}")
    if not found.reasons:
        console.show("read back and measured as asked")


def _words(measured: ProbeResult) -> str:
    parts = ["no delay measured"]
    if measured.median_ms is not None:
        parts = [f"{measured.median_ms:.2f} ms (p5 {measured.p5_ms:.2f}, p95 {measured.p95_ms:.2f})"]
    counts = {"lost": measured.lost, "reordered": measured.reordered, "early": measured.early}
    return ", ".join(parts + [f"{count} of {measured.sent} {name}" for name, count in counts.items() if count])


def _fail(found: Verification) -> None:
    if found.reasons:
        raise WorkError("netem does not do as asked: " + "; ".join(found.reasons))
