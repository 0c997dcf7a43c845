from __future__ import annotations

import itertools
import json
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import closing, contextmanager
from typing import Any

import numpy as np
import pytest
from tests.support.command_line import Run
from tests.support.ports import free_port

from lavt.cli import watch
from lavt.clock import MachineClock
from lavt.transport.rtp.rtp import Packetizer
from lavt.transport.video.h264 import Encoder
from lavt.transport.video.stamp import rtp_timestamp, write_stamp
from lavt.transport.video.stamp_check import LEARNED_AFTER

pytestmark = [pytest.mark.realtime, pytest.mark.judges_times]

WIDTH_PX, HEIGHT_PX, RATE_HZ = 128, 96, 30
EXIT_TIMEOUT_S = 60.0


@pytest.fixture
def run(run: Run) -> Run:
    """Return a function that runs `lavt watch`."""
    return lambda *arguments: run("watch", "--bind", "127.0.0.1", *arguments)


@pytest.fixture
def port() -> int:
    """Return a free UDP port."""
    return free_port()


@contextmanager
def sending(port: int, *, base: int = 0, garbage: bool = False) -> Iterator[socket.socket]:
    """Send stamped keyframes to a port of this machine; `base` is added to their RTP timestamps."""
    is_over, clock = threading.Event(), MachineClock()
    encoder = Encoder(WIDTH_PX, HEIGHT_PX, rate_hz=RATE_HZ, bit_rate_bps=1_000_000, gop_frames=1)
    packetizer = Packetizer(7, 0)

    def send() -> None:
        for number in itertools.count():
            picture = np.full((HEIGHT_PX, WIDTH_PX, 3), 100 + number % 50, np.uint8)
            stamp_ns = clock.now().wall_ns
            write_stamp(picture, stamp_ns)
            unit = encoder.encode(picture)
            datagrams = packetizer.packetize(unit, (rtp_timestamp(stamp_ns) + base) % 2**32)
            for datagram in [*datagrams, *([b"LAVT", b"", b"\x80" * 5] if garbage else [])]:
                sender.sendto(datagram, ("127.0.0.1", port))
            if is_over.wait(1 / RATE_HZ):
                return

    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        sender.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        try:
            yield sender
        finally:
            is_over.set()
            thread.join()


def parse_lines(out: str) -> list[tuple[str, Any]]:
    """Parse lines of JSON with one key each; return the keys with their values."""
    return [next(iter(json.loads(line).items())) for line in out.splitlines()]


def test_a_stream_of_lavt(run: Run, port: int) -> None:
    """All stamps of a LAVT sender are accepted; a line per second and a summary are printed, and nothing is sent."""
    with sending(port) as sender:
        code, out, err = run("--port", str(port), "--seconds", "2", "--json")
        sender.setblocking(False)
        with pytest.raises(BlockingIOError):
            sender.recv(2048)
    printed = parse_lines(out)
    assert (code, err) == (0, "")
    assert [kind for kind, _ in printed] == ["watching", "second", "second", "summary"]
    assert printed[0][1] == {"port": port}
    first, second, summary = (values for _, values in printed[1:])
    assert summary["pictures"] == summary["stamps_accepted"] >= first["pictures"] + second["pictures"] > RATE_HZ
    assert (summary["stamps_unreadable"], summary["lost"], summary["reordered"]) == (0, 0, 0)
    assert summary["packets"] >= summary["pictures"]
    assert 0 < summary["latency_median_ms"] <= summary["latency_p95_ms"]
    assert summary["latency_median_ms"] < 100
    assert summary["check"] == watch.CHECKS["lavt"]


def test_a_foreign_stream(run: Run, port: int) -> None:
    """All stamps of a foreign sender are accepted, except the first four, from which the base is learned."""
    with sending(port, base=123_456_789):
        code, out, _ = run("--port", str(port), "--seconds", "1", "--json", "--sender", "foreign")
    kind, summary = parse_lines(out)[-1]
    assert (code, kind) == (0, "summary")
    assert summary["stamps_unreadable"] == LEARNED_AFTER - 1
    assert summary["stamps_accepted"] == summary["pictures"] - summary["stamps_unreadable"] > 0
    assert summary["check"] == watch.CHECKS["foreign"]


def test_a_foreign_stream_without_the_option(run: Run, port: int) -> None:
    """Without --sender foreign, a foreign sender's stamps are rejected with the reason, and the option is named."""
    with sending(port, base=123_456_789):
        code, out, err = run("--port", str(port), "--seconds", "1")
    header, second, summary, check = out.splitlines()
    assert code == 0
    assert header.startswith(f"watching UDP port {port}; ")
    assert " 0 stamps accepted, " in second
    assert "latency unknown" in second
    assert summary.startswith("summary: ")
    assert check == watch.CHECKS["lavt"]
    assert err.count("\n") == 1
    assert "--sender" in err


def test_another_host(run: Run, port: int) -> None:
    """With --from, packets of that host are accepted from any port, and packets of other hosts are only counted."""
    with sending(port):
        code, out, _ = run("--port", str(port), "--seconds", "1", "--json", "--from", "127.0.0.2")
        result = run("--port", str(port), "--seconds", "1", "--json", "--from", "localhost")
    summary = parse_lines(out)[-1][1]
    assert (code, summary["packets"]) == (1, 0)
    assert summary["datagrams_from_strangers"] > 0
    summary = parse_lines(result.out)[-1][1]
    assert (result.code, summary["datagrams_from_strangers"]) == (0, 0)


def test_garbage(run: Run, port: int) -> None:
    """Datagrams that are not RTP are counted and dropped."""
    with sending(port, garbage=True):
        code, out, err = run("--port", str(port), "--seconds", "1", "--json")
    summary = parse_lines(out)[-1][1]
    assert (code, err) == (0, "")
    assert summary["datagrams_unreadable"] > summary["pictures"] > 0
    assert summary["stamps_unreadable"] == 0


def test_no_packet(run: Run, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without packets, a hint is printed once, a line is printed each second, and the exit code is 1."""
    monkeypatch.setattr(watch, "HINT_AFTER_S", 1)
    code, out, err = run("--port", str(port), "--seconds", "2", "--json")
    assert code == 1
    assert [kind for kind, _ in parse_lines(out)] == ["watching", "second", "second", "summary"]
    hint, error = err.splitlines()
    assert "0 other datagrams, 0 from other hosts" in hint
    assert error.startswith("lavt: ")


def test_ctrl_c() -> None:
    """Ctrl-C ends the command with exit code 0 and the summary."""
    arguments = [sys.executable, "-m", "lavt", "watch", "--bind", "127.0.0.1", "--port", "0", "--json"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        with sending(json.loads(process.stdout.readline())["watching"]["port"]):
            assert any(json.loads(process.stdout.readline())["second"]["pictures"] for _ in range(int(EXIT_TIMEOUT_S)))
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=EXIT_TIMEOUT_S)
    assert (process.returncode, err) == (0, "")
    kind, summary = parse_lines(out)[-1]
    assert kind == "summary"
    assert summary["stamps_accepted"] > 0
