"""Run a server or a client in the foreground: print its status, and stop or release the vehicle before it ends."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from lavt.assembly.side import Side
from lavt.cli import console
from lavt.cli.session_log import SessionLog, client_end_line, server_end_line
from lavt.domain import NS_PER_S, State
from lavt.errors import WorkError, describe_error
from lavt.nodes.client_session import ClientSession
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.safety.limits import LIMITS
from lavt.safety.state_machine import ACTIVE

PLAIN = (
    "lavt: this side is plain: nothing is encrypted or signed, and anyone who can reach the vehicle's router can drive "
    "(docs/security.md)"
)
STATUS_PERIOD_S = 0.2
POLL_PERIOD_S = 0.02
"""How often a side checks, before it ends, whether the vehicle is stationary (server) or released (client)."""
RELEASE_TIMEOUT_S = 1.0
"""How long a client waits for the answer to its release, before it ends; any network that is good enough for driving
delivers the answer sooner."""
STOP_TIMEOUT_S = 6.0
"""How long a server waits for the vehicle to be stationary, before it ends; a stop from 40 km/h with 4 m/s2 takes 2.8
s."""


def run_side(side: Side, client_name: str, *, once: bool, as_json: bool, ready: Mapping[str, Any]) -> None:
    """Run until Ctrl-C, until a part fails or, with `once`, until the drive has ended; print the session's log.

    `client_name` is empty for a server. With `as_json`, `ready` is printed when the side has started. At the end, a
    client releases the vehicle, and a server stops the vehicle. A second Ctrl-C ends the process immediately.
    """
    log, session, runtime = SessionLog(client_name), side.session, side.runtime
    with console.stop_on_signals() as stop, fail_on_thread_errors(runtime.fail):
        if side.is_plain:
            console.print_message(PLAIN)
        side.start()
        if as_json:
            console.print_json({"ready": dict(ready)})
        while not stop.wait(STATUS_PERIOD_S) and not runtime.stopped.is_set():
            _print_status(side, log, as_json=as_json)
            if once and side.live.ending() is not None:
                break
        if not runtime.stopped.is_set():
            stop.clear()
            last_line = _stop_vehicle(side, stop) if session is None else _release(side, stop, session)
            _print_status(side, log, as_json=as_json, last_line=last_line)
    if runtime.failed is not None:
        raise WorkError(f"stopped because a part failed: {describe_error(runtime.failed)}")


def _print_status(side: Side, log: SessionLog, *, as_json: bool, last_line: str = "") -> None:
    """Print the new lines of the log and then `last_line`; as JSON, print the status too."""
    session = side.session
    for update, received in side.live.take_updates():
        if isinstance(update, State):
            log.add_state(update, received.mono_ns, has_control=session is not None and session.has_control)
        else:
            log.add_rejection(update)
    log.set_ending(side.live.ending())
    status = side.live.status()
    if session is not None:
        if not last_line:
            log.set_phase(session.phase, session.reason)
        status |= {"phase": session.phase, "session": session.reason}
    lines = log.take_lines(side.clock.now().mono_ns) + [last_line] * bool(last_line)
    if as_json:
        console.print_json({"status": status, "ending": side.live.ending(), "said": lines})
        return
    for line in lines:
        console.print_result(line)


def _release(side: Side, stop: console.StopEvent, session: ClientSession) -> str:
    """Release the vehicle before the link closes, so that the vehicle stops; return the last log line."""
    if not session.has_control:
        return "the client ends; it had no control"
    side.send("operator", "release")
    _wait(side, stop, RELEASE_TIMEOUT_S, lambda: session.released)
    return client_end_line(released=session.released)


def _stop_vehicle(side: Side, stop: console.StopEvent) -> str:
    """Stop the vehicle, wait until it is stationary, and return the last log line."""
    side.send("server_ends", None)
    _wait(side, stop, STOP_TIMEOUT_S, lambda: _speed_unless_stopped_mps(side) is None)
    return server_end_line(_speed_unless_stopped_mps(side))


def _speed_unless_stopped_mps(side: Side) -> float | None:
    """Return the vehicle's speed; None if it is stationary and not armed. An armed stationary vehicle has speed 0.0."""
    status = side.live.status()
    speed_mps: float = status.get("speed_mps", 0.0)
    is_armed = status.get("safety") in ACTIVE
    return speed_mps if is_armed or abs(speed_mps) >= LIMITS.standstill_mps else None


def _wait(side: Side, stop: console.StopEvent, timeout_s: float, is_done: Callable[[], bool]) -> None:
    """Wait until `is_done()`, until the timeout, or until another stop signal."""
    end_ns = side.clock.now().mono_ns + round(timeout_s * NS_PER_S)
    while not is_done() and side.clock.now().mono_ns < end_ns and not stop.wait(POLL_PERIOD_S):
        pass
