"""`lavt stop`: trigger an emergency stop from any machine that can reach the vehicle's router."""

from __future__ import annotations

import queue
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import typer
from msgspec.structs import replace

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.security import build_authenticator, build_gateway
from lavt.assembly.zenoh import program_sessions
from lavt.cli import console
from lavt.clock import Clock, MachineClock, pause
from lavt.config import ClientConfig
from lavt.config_file import load_config
from lavt.domain import NS_PER_S, Now, SessionReply, SessionRequest
from lavt.errors import BadMessage, UserError, WorkError
from lavt.node import Send
from lavt.transport.messages import decode, encode
from lavt.transport.security.gateway import Carry
from lavt.transport.zenoh_link import ZenohLink
from lavt.transport.zenoh_session import RouterUnreachable, quiet_logs

RETRY_PERIOD_S = 0.1
"""How long to wait for a confirmation before the stop is sent again. A flood of queries makes repetition necessary.
Measured with 1000 queries a second, of which the vehicle accepts 100: five of five stops succeeded within 30 tries, but
none of six stops that were sent only once."""
LINK_S = 3.0
"""How long to repeat the stop over one link, if there is another way to the vehicle."""
LEAST_S = 0.5
"""How long to repeat the stop over a link at least, even if the time is over."""
TIMEOUT_S = 10.0


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("stop")(stop)


def stop(
    config: Annotated[Path, typer.Argument(help="A client config in YAML, such as configs/client.yaml.")],
    timeout: Annotated[
        float,
        typer.Option(
            min=RETRY_PERIOD_S, max=86_400, help="How long to repeat the stop until the vehicle confirms it, in s."
        ),
    ] = TIMEOUT_S,
    changes: console.SetOption = None,
) -> None:
    """Trigger an emergency stop, whoever has control, and wait until the vehicle confirms it.

    The exit code is 0 only if the vehicle has confirmed the stop. The vehicle cannot be armed again until the emergency
    stop is cleared:
    lavt client configs/client.yaml --set controller.clear_emergency_stop=true

    Example: lavt stop configs/client.yaml
    """
    console.reserve_stdout()
    settings, clock = load_config(ClientConfig, config, changes or []), MachineClock()
    with _not_sent():
        authenticator = build_authenticator(settings)  # the vehicle also accepts a stop that an expired key has signed
        sessions = program_sessions(settings)
        if not settings.security.key:  # then nothing shows whether the running client dials the same vehicle
            sessions.reverse()
    quiet_logs()
    replies = queue.Queue[bytes]()

    def deliver(channel: str, payload: Any, _arrived: Now, _peer: Any) -> None:
        if channel == "session_reply":
            replies.put(payload)

    request = SessionRequest("emergency_stop", settings.who, MachineEntropy().number(64), clock.now().wall_ns)
    until_ns, was_sent = clock.now().mono_ns + round(timeout * NS_PER_S), False
    errors: dict[int, UserError] = {}
    while clock.now().mono_ns < until_ns or not (errors or was_sent):
        for number, session in enumerate(sessions):
            try:
                link = ZenohLink(clock, side="client", settings=session, vehicle=settings.vehicle_id, who=settings.who)
            except UserError as error:
                errors[number] = error
                continue
            was_sent = True
            with closing(link):
                gateway = build_gateway(authenticator, deliver, link.send, lambda: (0, -1))
                link.start(gateway.receive, queries_only=True)
                left_s = (until_ns - clock.now().mono_ns) / NS_PER_S
                if _is_confirmed(gateway.send, replies, request, clock, max(LEAST_S, min(left_s, LINK_S))):
                    console.print_result(f"{settings.vehicle_id} accepted the emergency stop")
                    return
        if len(errors) == len(sessions) and not any(isinstance(error, RouterUnreachable) for error in errors.values()):
            break  # wrong settings, which another attempt would not change
        pause(round(RETRY_PERIOD_S * NS_PER_S))
    if not was_sent:
        direct = len(sessions) - 1 if settings.security.key else 0
        with _not_sent():
            raise errors[direct]
    raise WorkError(
        f"the emergency stop was NOT confirmed within {timeout:g} s, and the vehicle may still be moving: stop it by "
        "other means and repeat this command. Is its server running, is vehicle_id correct, and do the keys match? "
        "Run `lavt doctor CONFIG` to find out"
    )


@contextmanager
def _not_sent() -> Iterator[None]:
    """Add to each `UserError` that the emergency stop was not sent."""
    try:
        yield
    except UserError as error:
        raise UserError(f"the emergency stop was NOT sent, so stop the vehicle by other means: {error}") from error


def _is_confirmed(
    send: Carry, replies: queue.Queue[bytes], request: SessionRequest, clock: Clock, timeout_s: float
) -> bool:
    """Send the request until the vehicle confirms the stop or the time is over; return whether it was confirmed.

    A single query can be lost or exceed the vehicle's rate limit. Repeated queries with the same number are one stop.
    If somebody has cleared this stop before its confirmation arrived, it gets a new number.
    """
    until_ns = clock.now().mono_ns + round(timeout_s * NS_PER_S)
    while clock.now().mono_ns < until_ns:
        send(Send("session", encode(request)))
        reply = _reply_to(request, replies, clock)
        if reply is not None and reply.granted:
            return True
        if reply is not None:
            request = replace(request, number=request.number + 1)
    return False


def _reply_to(request: SessionRequest, replies: queue.Queue[bytes], clock: Clock) -> SessionReply | None:
    """Return the first reply with the number of the request; None if there is none within `RETRY_PERIOD_S`."""
    until_ns = clock.now().mono_ns + round(RETRY_PERIOD_S * NS_PER_S)
    while (wait_ns := until_ns - clock.now().mono_ns) > 0:
        with suppress(queue.Empty, BadMessage):
            reply = decode(SessionReply, replies.get(timeout=wait_ns / NS_PER_S))
            if reply.emergency_stop == request.number:
                return reply
    return None
