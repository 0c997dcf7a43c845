"""Hostile pages of the console: each attack sends as fast as it can, until it is ended.

They use sockets without a library, so that one process can send more than the console can read.

    python -m benchmarks.pages.floods URL ATTACK
"""

from __future__ import annotations

import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Final
from urllib.parse import urlsplit

from lavt.clock import pause
from lavt.domain import NS_PER_MS
from lavt.transport.console.page_messages import PAGE_VERSION

REPOSITORY = Path(__file__).parents[2]
TEXT, CONTINUATION, PING, PONG = 0x1, 0x0, 0x9, 0xA
BATCH: Final = 2000
"""Frames in one call."""
KEY: Final = f"{'A' * 22}=="
UPGRADE: Final = f"Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: {KEY}"
RETRY_NS: Final = 5 * NS_PER_MS


def frame(opcode: int, payload: bytes = b"", *, is_final: bool = True) -> bytes:
    """Return a frame of WebSocket with the mask 0; the payload has at most 125 bytes or more than that in 16 bits."""
    length = (
        bytes([0x80 | len(payload)]) if len(payload) < 126 else bytes([0x80 | 126]) + len(payload).to_bytes(2, "big")
    )
    return bytes([0x80 * is_final | opcode]) + length + bytes(4) + payload


def open_socket(url: str, *, shows_token: bool = True) -> socket.socket:
    """Return a socket at which the console has a page; `shows_token`: the page has sent its first message."""
    address = urlsplit(url)
    sock = socket.create_connection((address.hostname, address.port), timeout=10)
    request = f"GET /socket HTTP/1.1\r\nHost: {address.netloc}\r\nOrigin: http://{address.netloc}\r\n{UPGRADE}\r\n\r\n"
    sock.sendall(request.encode())
    if shows_token:
        hello = {"type": "hello", "version": PAGE_VERSION, "token": address.fragment}
        sock.sendall(frame(TEXT, json.dumps(hello).encode()))
    return sock


@contextmanager
def reading(sock: socket.socket) -> Iterator[None]:
    """Read and discard all that arrives during the `with` block, which closes the socket at its end."""

    def read() -> None:
        with suppress(OSError):
            while sock.recv(2**20):
                pass

    reader = threading.Thread(target=read, daemon=True)
    reader.start()
    try:
        yield
    finally:
        sock.close()
        reader.join()


def repeat(first: bytes, more: bytes) -> Callable[[str], None]:
    """Return an attack that opens a page, sends `first` once and then `more`, and opens it again when it is closed."""

    def attack(url: str) -> None:
        sock = open_socket(url)
        with reading(sock):
            sock.sendall(first)
            while True:
                sock.sendall(more)

    return attack


def dribble(url: str) -> None:
    """Send one long message after the other, byte by byte."""
    sock = open_socket(url)
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    data = frame(TEXT, b" " * 1000)
    with reading(sock):
        while True:
            for byte in data:
                sock.send(bytes([byte]))


def connect_only(url: str) -> None:
    """Make connections that send nothing, and close them."""
    address = urlsplit(url)
    while True:
        socket.create_connection((address.hostname, address.port), timeout=10).close()


def request_files(url: str) -> None:
    """Request the page again and again."""
    address = urlsplit(url)
    while True:
        with socket.create_connection((address.hostname, address.port), timeout=10) as sock:
            sock.sendall(f"GET / HTTP/1.1\r\nHost: {address.netloc}\r\n\r\n".encode())
            while sock.recv(2**16):
                pass


def reopen(url: str) -> None:
    """Open pages with the token, let each send a second's messages, and close it."""
    inputs = frame(TEXT, b"{}") * 100
    while True:
        with open_socket(url) as sock:
            sock.sendall(inputs)
            sock.recv(4096)


def ping_without_token(url: str) -> None:
    """Open sockets that show no token, and send pings."""
    while True:
        with open_socket(url, shows_token=False) as sock:
            sock.sendall(frame(PING) * BATCH)
            sock.recv(4096)


def spin(_url: str) -> None:
    """Send nothing, and use a processor: what any program on this machine can do."""
    while True:
        pass


ATTACKS: Final[Mapping[str, Callable[[str], None]]] = {
    "none": lambda _url: pause(10**15),
    "busy processor": spin,
    "pings": repeat(b"", frame(PING, b"x" * 125) * BATCH),
    "empty pings": repeat(b"", frame(PING) * BATCH),
    "pongs": repeat(b"", frame(PONG) * BATCH),
    "fragments": repeat(frame(TEXT, is_final=False), frame(CONTINUATION, is_final=False) * BATCH),
    "messages": repeat(b"", frame(TEXT, b"{}") * BATCH),
    "bytes": dribble,
    "connections": connect_only,
    "requests": request_files,
    "new pages": reopen,
    "pings without token": ping_without_token,
}


@contextmanager
def flooding(url: str, attack: str) -> Iterator[None]:
    """Attack the console at `url` from another process during the `with` block."""
    attacker = subprocess.Popen(
        [sys.executable, "-m", "benchmarks.pages.floods", url, attack],
        cwd=REPOSITORY,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(REPOSITORY / "src"), str(REPOSITORY)])},
    )
    try:
        yield
    finally:
        attacker.kill()
        attacker.wait()


def main() -> None:
    """Attack the console at the address of the first argument as the second one says, again after each end."""
    _, url, name = sys.argv
    while True:
        with suppress(OSError):
            ATTACKS[name](url)
        pause(RETRY_NS)


if __name__ == "__main__":
    main()
