"""The first question to a CARLA server, against programs that answer anything; the wheel is not needed."""

from __future__ import annotations

import socket
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.support.ports import free_port_pair

from lavt.cli.main import main
from lavt.config_file import shipped
from lavt.vehicle.carla import library, probe
from lavt.vehicle.carla.probe import NoServerError, ask_episode, ask_version

ANSWER = msgspec.msgpack.encode([1, 1, None, [[1, "0.9.16"]]])


@contextmanager
def answering(*parts: bytes, stays: bool = False) -> Iterator[int]:
    """Listen on a port, and answer a request with some parts; then hang up, or stay silent until the end."""
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as listener:

        def serve() -> None:
            connection, _ = listener.accept()
            with connection:
                connection.recv(4096)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                for part in parts:
                    connection.sendall(part)
                if stays:
                    ended.wait()

        thread = threading.Thread(target=serve)
        thread.start()
        try:
            yield listener.getsockname()[1]
        finally:
            ended.set()
            thread.join()


def ask(*parts: bytes, timeout_s: float = 20.0, stays: bool = False) -> str | None:
    with answering(*parts, stays=stays) as port:
        return ask_version("127.0.0.1", port, timeout_s)


@pytest.mark.parametrize("parts", [(ANSWER,), (ANSWER[:1], ANSWER[1:7], ANSWER[7:])])
def test_a_server_says_its_version(parts: tuple[bytes, ...]) -> None:
    """The version is read, however the answer is divided, and without waiting for the end of the connection."""
    assert ask(*parts, stays=True) == "0.9.16"


@pytest.mark.parametrize(("result", "episode"), [([[1, [7, [b"token"]]]], 7), ([[0, ["busy"]]], None)])
def test_a_server_says_its_episode(result: object, episode: int | None) -> None:
    """The number of the server's world is read; an error of the server gives none."""
    with answering(msgspec.msgpack.encode([1, 0, None, result])) as port:
        assert ask_episode("127.0.0.1", port, 20.0) == episode


def test_an_unknown_form_of_answer_is_left_to_the_package() -> None:
    """A server that speaks msgpack-rpc but packs its version in another way has an unknown version."""
    assert ask(msgspec.msgpack.encode([1, 1, None, {"version": "0.9.16"}])) is None


@pytest.mark.parametrize(
    "part",
    [b"SSH-2.0-OpenSSH_9.2\r\n", b"HTTP/1.1 400 Bad Request\r\n\r\n", b"", ANSWER[:5], b"\x94\xc1", b"\x94" * 5000],
)
def test_another_program_is_named(part: bytes) -> None:
    """A program that is no CARLA server is recognized by its answer, or because it hangs up."""
    with pytest.raises(NoServerError, match="another program answers"):
        ask(part)


def test_a_silent_program_is_named() -> None:
    """A program that does not answer is left after the time-out."""
    with pytest.raises(NoServerError, match=r"no answer came within 0\.05 s"):
        ask(timeout_s=0.05, stays=True)


def test_a_port_without_a_program_and_an_unknown_host_are_named_at_once() -> None:
    """A refused connection and a name that cannot be resolved need no time-out."""
    with pytest.raises(NoServerError, match="no program listens there"):
        ask_version("127.0.0.1", free_port_pair(socket.SOCK_STREAM), 20.0)
    for host in ("nowhere.invalid", "a..b", "x" * 300):
        with pytest.raises(NoServerError, match="the host is unknown"):
            ask_version(host, 2000, 20.0)


@pytest.mark.full
def test_a_sweep_without_a_server_says_so_once(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A sweep whose CARLA server is absent ends before its first run, with one sentence and exit code 2."""
    port, out = free_port_pair(socket.SOCK_STREAM), tmp_path / "out"
    monkeypatch.setattr(library, "version", lambda _: library.SUPPORTED)
    changes = ("--set", f"vehicle.carla.port={port}", "--set", "routes=[a_key]", "--set", "conditions=[L0]")
    words = ["sweep", str(shipped("configs/paper_carla.yaml")), *changes, "--out", str(out)]
    monkeypatch.setattr(sys, "argv", ["lavt", *words])
    with pytest.raises(SystemExit) as raised:
        main()
    assert raised.value.code == 2
    (sentence,) = capsys.readouterr().err.splitlines()
    assert f"no CARLA server answers at 127.0.0.1:{port}, because no program listens there" in sentence
    assert not out.exists()


@settings(max_examples=40)
@given(st.binary(max_size=40))
def test_any_answer_gives_a_version_or_a_reason(answer: bytes) -> None:
    """Whatever another program sends, nothing but the expected error is raised."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(answer)
        theirs.shutdown(socket.SHUT_WR)
        try:
            assert len(probe._read_answer(ours)) == 4
        except probe.NoServerError as error:
            assert str(error) == "another program answers"  # noqa: PT017 (either outcome is right)
