"""`lavt stop`: the emergency stop, from anywhere that reaches the vehicle's session."""

from __future__ import annotations

import queue
from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.build.entropy import MachineEntropy
from lavt.cli import console
from lavt.cli.router import find
from lavt.clock import MachineClock
from lavt.config import ClientConfig
from lavt.config_file import load_config
from lavt.domain import Now, SessionReply, SessionRequest
from lavt.errors import WorkError
from lavt.node import Send
from lavt.transport.messages import decode, encode
from lavt.transport.zenoh_link import REPLY_TIMEOUT_S, ZenohLink, quiet_logs


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

    link = ZenohLink(
        clock,
        deliver,
        side="client",
        path=find(Path(settings.zenoh.session)),
        router=settings.zenoh.router,
        vehicle=settings.vehicle_id,
        who=settings.who,
    )
    try:
        instance, number = MachineEntropy().number(64), clock.now().wall_ns
        reply = _ask(link, replies, SessionRequest("emergency_stop", settings.who, instance, number))
        if not reply.granted:  # numbers only grow, and this machine's clock is behind the last one
            number = reply.emergency_stop + 1
            reply = _ask(link, replies, SessionRequest("emergency_stop", settings.who, instance, number))
        if not reply.granted:
            raise WorkError(f"the vehicle refused the emergency stop: {reply.because}")
        console.show(f"{settings.vehicle_id} was told to stop")
    finally:
        link.close()


def _ask(link: ZenohLink, replies: queue.Queue[bytes], request: SessionRequest) -> SessionReply:
    link.send(Send("session", encode(request)))
    try:
        return decode(SessionReply, replies.get(timeout=REPLY_TIMEOUT_S + 1))
    except queue.Empty:
        raise WorkError("no vehicle answers; is its server running, and is vehicle_id right?") from None
