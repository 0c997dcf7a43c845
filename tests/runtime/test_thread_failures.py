"""Test that a thread that ends with an error ends the runtime, and so its process."""

from __future__ import annotations

import queue
import socket
import threading
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from typing import Any

import pytest
from tests.vehicle.moving_video import MODEL, write_video

from lavt.clock import MachineClock
from lavt.node import Send
from lavt.runtime.realtime import RealRuntime
from lavt.runtime.thread_failures import fail_on_thread_errors
from lavt.transport.netem.injector import InjectionOrder, Injector
from lavt.transport.rendezvous.link import RendezvousLink
from lavt.transport.security.envelope import OperatorAuthenticator
from lavt.transport.security.gateway import ClientGateway
from lavt.transport.udp_link import UdpLink
from lavt.vehicle import video_device

LOOPBACK = "127.0.0.1"
WAIT_S = 30.0
CLOCK = MachineClock()


class BrokenError(Exception):
    """The error that the tests raise in threads."""


def raise_broken(*_: Any) -> Any:
    """Raise `BrokenError`, as a stand-in for any function."""
    raise BrokenError


class NullRecorder:
    """A recorder that discards its entries."""

    def write(self, topic: str, payload: Any, now: Any) -> None:
        """Discard one entry."""


@pytest.fixture
def runtime() -> Iterator[RealRuntime]:
    runtime = RealRuntime(CLOCK, [], NullRecorder(), raise_broken)
    with fail_on_thread_errors(runtime.fail):
        yield runtime


def break_udp(stack: ExitStack) -> None:
    """Make a thread fail at processing a datagram."""
    link = stack.enter_context(closing(UdpLink(CLOCK, "rtp", bind=(LOOPBACK, 0))))
    link.start(raise_broken)
    sender = stack.enter_context(socket.socket(socket.AF_INET, socket.SOCK_DGRAM))
    sender.sendto(b"x", (LOOPBACK, link.port))


def break_closed_socket(stack: ExitStack) -> None:
    """Make a thread fail because its socket is closed, although its link is open."""
    link = stack.enter_context(closing(UdpLink(CLOCK, "rtp", bind=(LOOPBACK, 0))))
    link._socket.close()
    link.start(lambda *_: None)


def break_registration(stack: ExitStack) -> None:
    """Make a thread fail at registering with a rendezvous."""
    link = RendezvousLink(CLOCK, "rtp", bind=(LOOPBACK, 0), rendezvous=(LOOPBACK, 9), registration=raise_broken)
    stack.enter_context(closing(link)).start(lambda *_: None)


def break_injector(stack: ExitStack) -> None:
    """Make a thread fail at delivering the result of an order."""
    injector = stack.enter_context(closing(Injector(CLOCK, raise_broken, None)))
    injector.send(Send("inject", InjectionOrder(1, "L0", ())))


def break_gateway(_stack: ExitStack) -> None:
    """Make a thread fail at sending a query."""
    authenticator: Any = OperatorAuthenticator
    ClientGateway(raise_broken, raise_broken, authenticator)._send_in_thread(Send("session", b""))


BREAKS = [break_udp, break_closed_socket, break_registration, break_injector, break_gateway]


@pytest.mark.parametrize("break_thread", BREAKS)
def test_an_error_in_a_thread_ends_the_runtime(runtime: RealRuntime, break_thread: Callable[[ExitStack], None]) -> None:
    """An error in a thread of a link, of the injector or of a gateway ends the runtime."""
    with ExitStack() as stack:
        break_thread(stack)
        assert runtime.stopped.wait(WAIT_S)
    assert isinstance(runtime.failed, BrokenError | OSError)


def test_an_error_of_the_clock_source_ends_the_runtime(runtime: RealRuntime) -> None:
    """An error in the thread that queries the source of time ends the runtime."""
    runtime._send("clock", ())
    assert runtime.stopped.wait(WAIT_S)
    assert isinstance(runtime.failed, BrokenError)


def test_an_error_of_a_camera_device_ends_the_runtime(
    runtime: RealRuntime, tmp_path: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """An error in the thread that reads a camera device ends the runtime."""
    file = write_video(tmp_path / "camera.avi", rate_hz=30)
    with closing(video_device.VideoDevice(str(file), model=MODEL, rate_hz=30, clock=CLOCK)):
        monkeypatch.setattr(video_device, "_read_picture", raise_broken)
        assert runtime.stopped.wait(WAIT_S)
    assert isinstance(runtime.failed, BrokenError)


def test_an_exit_of_a_thread_ends_the_runtime(runtime: RealRuntime) -> None:
    """A thread that raises `SystemExit` ends the runtime, although Python itself would ignore this."""

    def leave() -> None:
        raise SystemExit

    threading.Thread(target=leave).start()
    assert runtime.stopped.wait(WAIT_S)
    assert isinstance(runtime.failed, SystemExit)


def test_the_former_handler_is_restored() -> None:
    """After the context is left, errors in threads are handled as before."""
    previous_hook, errors = threading.excepthook, queue.Queue[BaseException]()
    with fail_on_thread_errors(errors.put):
        thread = threading.Thread(target=raise_broken)
        thread.start()
        thread.join()
    assert isinstance(errors.get_nowait(), BrokenError)
    assert threading.excepthook == previous_hook
