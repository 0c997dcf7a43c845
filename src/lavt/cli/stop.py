"""`lavt stop`: the emergency stop, from anywhere that reaches the vehicle's session."""

from __future__ import annotations

import queue
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.security import gateway_of
from lavt.cli import console
from lavt.cli.router import find
from lavt.clock import MachineClock
from lavt.config import ClientConfig
from lavt.config_file import load_config
from lavt.domain import Now, SessionReply, SessionRequest
from lavt.errors import BadMessage, WorkError
from lavt.node import Send
from lavt.transport.messages import decode, encode
from lavt.transport.security.gateway import Carry
from lavt.transport.zenoh_link import ZenohLink, quiet_logs

AGAIN_S = 0.1
TRIES = 30
"""In 3 s. Under 1000 queries a second, of which the vehicle looks at 100, five stops of five got through (of single
queries none of six)."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("stop")(stop)


def stop(
    config: Annotated[Path, typer.Argument(help="A client config in YAML, such as configs/client.yaml.")],
    changes: console.Set = None,
) -> None:
    """Stop the vehicle at once, whoever drives it; before it can be armed again it must be cleared.

    To clear it: lavt client configs/client.yaml --set controller.clear_emergency_stop=true

    Example: lavt stop configs/client.yaml
    """
    console.keep_stdout_for_results()
    settings = load_config(ClientConfig, config, changes or [])
    quiet_logs()
    clock, replies = MachineClock(), queue.Queue[bytes]()

    def deliver(channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        if channel == "session_reply":
            replies.put(payload)

    gateway = gateway_of(settings, deliver, lambda *sends: link.send(*sends))
    link = ZenohLink(
        clock,
        gateway.receive,
        side="client",
        path=find(Path(settings.zenoh.session)),
        router=settings.zenoh.router,
        vehicle=settings.vehicle_id,
        who=settings.who,
    )
    try:
        instance, number = MachineEntropy().number(64), clock.now().wall_ns
        reply = _ask(gateway.send, replies, SessionRequest("emergency_stop", settings.who, instance, number))
        if not _stops(reply, number):  # numbers only grow, and this machine's clock is behind the last one
            number = reply.emergency_stop + 1
            reply = _ask(gateway.send, replies, SessionRequest("emergency_stop", settings.who, instance, number))
        if not _stops(reply, number):
            raise WorkError(f"the vehicle refused the emergency stop: {reply.reason}")
        console.show(f"{settings.vehicle_id} was told to stop")
    finally:
        link.close()


def _stops(reply: SessionReply, number: int) -> bool:
    """Whether the vehicle has been stopped under this number: now, or by a query whose answer was lost."""
    return reply.granted or reply.emergency_stop == number


def _ask(send: Carry, replies: queue.Queue[bytes], request: SessionRequest) -> SessionReply:
    """Ask until there is an answer to this number; to say it twice stops the vehicle once.

    One query may be lost, or be one of too many that come to the vehicle.
    """
    for _ in range(TRIES):
        send(Send("session", encode(request)))
        with suppress(queue.Empty, BadMessage):
            reply = decode(SessionReply, replies.get(timeout=AGAIN_S))
            if reply.granted or reply.emergency_stop >= request.number:  # any other answers the number before
                return reply
    raise WorkError(
        "no vehicle answers; is its server running, is vehicle_id right, and do the keys fit? "
        "`lavt doctor CONFIG` finds out"
    )
