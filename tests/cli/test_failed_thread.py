"""Test that a command fails if one of its threads fails."""

from __future__ import annotations

import itertools
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest
import zenoh
from tests.support.command_line import Run
from tests.support.ports import free_port

from lavt.config_file import shipped
from lavt.transport import udp_link
from lavt.transport.zenoh_link import ZenohLink
from lavt.transport.zenoh_session import Router

LOOPBACK = "127.0.0.1"
NO_ROUTER = "tcp/127.0.0.1:1"
SENDING_PERIOD_S = 0.05


def fail(*_: Any) -> Any:
    raise RuntimeError("a receiving thread is broken")


@contextmanager
def sending(port: int) -> Iterator[None]:
    """Send datagrams to a port of this machine."""
    is_over = threading.Event()

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            while not is_over.wait(SENDING_PERIOD_S):
                sender.sendto(b"x", (LOOPBACK, port))

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        is_over.set()
        thread.join()


@pytest.mark.parametrize("command", ["watch", "rendezvous", "server"])
def test_a_command_fails_with_its_receiving_thread(command: str, run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """If a receiving thread fails, the command exits with code 1 instead of running on without receiving."""
    port = free_port()
    arguments = {
        "watch": ["--bind", LOOPBACK, "--port", str(port)],
        "rendezvous": [
            str(shipped("configs/rendezvous.yaml")),
            *(
                word
                for change in (f"bind={LOOPBACK}", f"video_port={port}", "probe_port=0")
                for word in ("--set", change)
            ),
        ],
        "server": [
            str(shipped("configs/server.yaml")),
            *("--set", f"video.bind={LOOPBACK}", "--set", f"video.port={port}", "--set", "clock.probe_port=0"),
            *("--set", f"zenoh.router={NO_ROUTER}", "--set", "vehicle.scenery=none"),
        ],
    }
    monkeypatch.setattr(udp_link, "arrival", fail)
    with sending(port):
        result = run(command, *arguments[command])
    assert result.code == 1, result
    assert "RuntimeError" in result.err.splitlines()[-1]


def test_a_server_fails_if_a_session_opened_later_cannot_declare(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the declarations of a session that opens in the background fail, the server exits with code 1."""
    endpoint = f"tcp/{LOOPBACK}:{free_port(socket.SOCK_STREAM)}"
    router = Router(shipped("zenoh-configs/router-server.json5"), {"listen/endpoints": [endpoint]})
    open_session, attempts = zenoh.open, itertools.count()

    def open_later(config: zenoh.Config) -> zenoh.Session:
        if next(attempts) == 0:
            raise zenoh.ZError("no router")
        return open_session(config)

    monkeypatch.setattr(zenoh, "open", open_later)
    monkeypatch.setattr(ZenohLink, "_declare", fail)
    settings = (f"video.bind={LOOPBACK}", f"video.port={free_port()}", "clock.probe_port=0", "vehicle.scenery=none")
    changes = (word for change in (*settings, f"zenoh.router={endpoint}") for word in ("--set", change))
    try:
        result = run("server", str(shipped("configs/server.yaml")), *changes)
    finally:
        router.close()
    assert result.code == 1, result
    assert "RuntimeError" in result.err.splitlines()[-1]
