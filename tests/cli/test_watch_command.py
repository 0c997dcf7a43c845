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
ENDS_S = 60.0


@pytest.fixture
def run(run: Run) -> Run:
    """Return a function that runs `lavt watch`."""
    return lambda *arguments: run("watch", "--bind", "127.0.0.1", *arguments)


@pytest.fixture
def port() -> int:
    """A free UDP port."""
    return free_port()


@contextmanager
def sending(port: int, *, base: int = 0, garbage: bool = False) -> Iterator[socket.socket]:
    """Send stamped pictures, keyframes all, to a port of this machine; `base` is that of the RTP timestamps."""
    done, clock = threading.Event(), MachineClock()
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
            if done.wait(1 / RATE_HZ):
                return

    with closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as sender:
        sender.bind(("127.0.0.1", 0))
        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        try:
            yield sender
        finally:
            done.set()
            thread.join()


def lines(out: str) -> list[tuple[str, Any]]:
    """Take the lines of JSON apart, each of which is one object with one key."""
    return [next(iter(json.loads(line).items())) for line in out.splitlines()]


def test_a_stream_of_ours(run: Run, port: int) -> None:
    """All that ours sends arrives and is accepted: a line of JSON a second, the summary last, and nothing sent back."""
    with sending(port) as sender:
        code, out, err = run("--port", str(port), "--seconds", "2", "--json")
        sender.setblocking(False)
        with pytest.raises(BlockingIOError):
            sender.recv(2048)
    said = lines(out)
    assert (code, err) == (0, "")
    assert [kind for kind, _ in said] == ["watching", "second", "second", "summary"]
    assert said[0][1] == {"port": port}
    in_all = said[-1][1]
    assert in_all["pictures"] == in_all["stamps_accepted"] >= said[1][1]["pictures"] + said[2][1]["pictures"] > RATE_HZ
    assert (in_all["stamps_unreadable"], in_all["lost"], in_all["reordered"]) == (0, 0, 0)
    assert in_all["packets"] >= in_all["pictures"]
    assert 0 < in_all["latency_median_ms"] <= in_all["latency_p95_ms"]
    assert in_all["latency_median_ms"] < 100
    assert "less than 12 us" in in_all["check"]


def test_a_foreign_stream(run: Run, port: int) -> None:
    """Of a sender whose RTP clock has a base of its own all stamps but those that it is learned from are accepted."""
    with sending(port, base=123_456_789):
        code, out, _ = run("--port", str(port), "--seconds", "1", "--json", "--sender", "foreign")
    kind, in_all = lines(out)[-1]
    assert (code, kind) == (0, "summary")
    assert in_all["stamps_unreadable"] == LEARNED_AFTER - 1
    assert in_all["stamps_accepted"] == in_all["pictures"] - in_all["stamps_unreadable"] > 0
    assert "the check is weaker" in in_all["check"]


def test_a_foreign_stream_taken_for_ours(run: Run, port: int) -> None:
    """Stamps of a foreign sender that is taken for ours are not accepted: the line says why, and the end what to do."""
    with sending(port, base=123_456_789):
        code, out, err = run("--port", str(port), "--seconds", "1")
    header, second, in_all, check = out.splitlines()
    assert code == 0
    assert header.startswith(f"watching UDP port {port}; ")
    assert " 0 stamps accepted, " in second
    assert "latency unknown" in second
    assert in_all.startswith("in all: ")
    assert check == watch.CHECKS["lavt"]
    assert err.count("\n") == 1
    assert "--sender" in err


def test_another_host(run: Run, port: int) -> None:
    """With --from only that host is heard, at any port of it; the others are counted."""
    with sending(port):
        code, out, _ = run("--port", str(port), "--seconds", "1", "--json", "--from", "127.0.0.2")
        heard = run("--port", str(port), "--seconds", "1", "--json", "--from", "localhost")
    in_all = lines(out)[-1][1]
    assert (code, in_all["packets"]) == (1, 0)
    assert in_all["datagrams_from_strangers"] > 0
    in_all = lines(heard[1])[-1][1]
    assert (heard[0], in_all["datagrams_from_strangers"]) == (0, 0)


def test_garbage(run: Run, port: int) -> None:
    """What is no RTP is counted and dropped, between packets that are."""
    with sending(port, garbage=True):
        code, out, err = run("--port", str(port), "--seconds", "1", "--json")
    in_all = lines(out)[-1][1]
    assert (code, err) == (0, "")
    assert in_all["datagrams_unreadable"] > in_all["pictures"] > 0
    assert in_all["stamps_unreadable"] == 0


def test_nothing_comes(run: Run, port: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where nothing comes that is said once, with what to look for, the lines go on, and the end is 1."""
    monkeypatch.setattr(watch, "PATIENCE_S", 1)
    code, out, err = run("--port", str(port), "--seconds", "2", "--json")
    assert code == 1
    assert [kind for kind, _ in lines(out)] == ["watching", "second", "second", "summary"]
    nothing, ended = err.splitlines()
    assert "1 s (0 other datagrams, 0 from other hosts)" in nothing
    assert ended.startswith("lavt: ")


def test_ctrl_c() -> None:
    """Ctrl-C ends it with 0 and the summary."""
    arguments = [sys.executable, "-m", "lavt", "watch", "--bind", "127.0.0.1", "--port", "0", "--json"]
    with subprocess.Popen(arguments, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        with sending(json.loads(process.stdout.readline())["watching"]["port"]):
            assert any(json.loads(process.stdout.readline())["second"]["pictures"] for _ in range(int(ENDS_S)))
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=ENDS_S)
    assert (process.returncode, err) == (0, "")
    kind, in_all = lines(out)[-1]
    assert kind == "summary"
    assert in_all["stamps_accepted"] > 0
