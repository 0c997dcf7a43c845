"""`lavt stop`: trigger an emergency stop from any machine that can reach the vehicle's router."""

from __future__ import annotations

import queue
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

import typer

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.security import build_authenticator, build_gateway
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import ClientConfig
from lavt.config_file import find_file, load_config
from lavt.domain import Now, SessionReply, SessionRequest
from lavt.errors import BadMessage, WorkError
from lavt.node import Send
from lavt.transport.messages import decode, encode
from lavt.transport.security.gateway import Carry
from lavt.transport.zenoh_link import ZenohLink, quiet_logs

RETRY_PERIOD_S = 0.1
TRIES = 30
"""Number of tries, which take 3 s. Measured during a flood of 1000 queries a second, of which the vehicle accepts 100:
five of five stops succeeded with this number of tries, and none of six with a single query."""


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("stop")(stop)


def stop(
    config: Annotated[Path, typer.Argument(help="A client config in YAML, such as configs/client.yaml.")],
    changes: console.SetOption = None,
) -> None:
    """Trigger an emergency stop, whoever has control.

    The vehicle cannot be armed again until the emergency stop is cleared:
    lavt client configs/client.yaml --set controller.clear_emergency_stop=true

    Example: lavt stop configs/client.yaml
    """
    console.reserve_stdout()
    settings = load_config(ClientConfig, config, changes or [])
    authenticator = build_authenticator(settings)  # an expired key may stop the vehicle, too
    quiet_logs()
    clock, replies = MachineClock(), queue.Queue[bytes]()

    def deliver(channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        if channel == "session_reply":
            replies.put(payload)

    link = ZenohLink(
        clock,
        side="client",
        path=find_file(Path(settings.zenoh.session)),
        router=settings.zenoh.router,
        vehicle=settings.vehicle_id,
        who=settings.who,
    )
    gateway = build_gateway(authenticator, deliver, link.send, lambda: (0, -1))
    link.start(gateway.receive, queries_only=True)
    try:
        instance, stop_number = MachineEntropy().number(64), clock.now().wall_ns
        reply = _query(gateway.send, replies, SessionRequest("emergency_stop", settings.who, instance, stop_number))
        if not _is_stopped(reply, stop_number):  # numbers must increase, but this clock is behind the last number
            stop_number = reply.emergency_stop + 1
            reply = _query(gateway.send, replies, SessionRequest("emergency_stop", settings.who, instance, stop_number))
        if not _is_stopped(reply, stop_number):
            raise WorkError(f"the vehicle rejected the emergency stop: {reply.reason}")
        console.print_result(f"{settings.vehicle_id} accepted the emergency stop")
    finally:
        link.close()


def _is_stopped(reply: SessionReply, number: int) -> bool:
    """Return whether the vehicle accepted the stop of this number, now or in an earlier query whose reply was lost."""
    return reply.granted or reply.emergency_stop == number


def _query(send: Carry, replies: queue.Queue[bytes], request: SessionRequest) -> SessionReply:
    """Send the query until it is answered; return the reply, or raise `WorkError` after all tries.

    A single query may be lost or exceed the vehicle's rate limit. Repeated queries with one number count as one stop.
    """
    for _ in range(TRIES):
        send(Send("session", encode(request)))
        with suppress(queue.Empty, BadMessage):
            reply = decode(SessionReply, replies.get(timeout=RETRY_PERIOD_S))
            if reply.granted or reply.emergency_stop >= request.number:  # any other reply is to an earlier number
                return reply
    raise WorkError(
        "no vehicle answers; is its server running, is vehicle_id correct, and do the keys match? "
        "Run `lavt doctor CONFIG` to find out"
    )
