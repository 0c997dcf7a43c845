"""UDP sockets for the video and the clock probe, with arrival times from the kernel."""

from __future__ import annotations

import errno
import socket
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from typing import Any

from lavt.clock import Clock
from lavt.domain import Now
from lavt.errors import UserError
from lavt.node import Send
from lavt.transport.arrival import ANCILLARY_BYTES, arrival, enable_arrival_times

Deliver = Callable[[str, Any, Now, Any], None]
"""Takes (channel, payload, arrived, peer) of each received message."""

RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
MAX_DATAGRAM_BYTES = 65_535


class UdpLink:
    """A UDP socket and a thread that receives.

    Received datagrams are delivered on `channel`; `name` is the purpose of the port in error messages. Without `remote`
    the peer of a `Send` is the destination address. A client passes the address of its server as `remote`. Then all
    datagrams go to that host, and the peer of a `Send` is only a port, which is used if the port of `remote` is 0.
    Datagrams from any other address than the server's are counted and not delivered. For a link that only receives,
    `only_from` is the numeric address of the only permitted host. Raises `UserError` for a port that cannot be opened
    and for an unknown host.
    """

    def __init__(
        self,
        clock: Clock,
        channel: str,
        *,
        bind: tuple[str, int],
        remote: tuple[str, int] | None = None,
        only_from: str | None = None,
        name: str = "video",
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._clock = clock
        self._channel = channel
        self._remote = None if remote is None else (resolve_host("video.server", remote[0]), remote[1])
        self._server: tuple[str, int] | None = None
        self._only_from = only_from
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        enable_arrival_times(self._socket)
        try:
            self._socket.bind(bind)
        except (OSError, ValueError) as error:
            self._socket.close()
            raise UserError(
                f"the {name} port {bind[0]}:{bind[1]} cannot be opened ({_reason(error)}): choose another, or 0 for any"
            ) from error
        self._buffer = memoryview(bytearray(MAX_DATAGRAM_BYTES))
        self._closing = False
        self._thread: threading.Thread | None = None

    @property
    def port(self) -> int:
        """The UDP port of the socket."""
        return int(self._socket.getsockname()[1])

    def start(self, deliver: Deliver) -> None:
        """Start to receive; the receiving thread calls `deliver`."""
        self._thread = threading.Thread(target=self._receive, args=(deliver,), name="udp", daemon=True)
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Send datagrams; count those that the system rejects."""
        for send in sends:
            address = send.peer
            if self._remote is not None:
                host, port = self._remote
                address = self._server = (host, port or send.peer)
            try:
                self._socket.sendto(send.payload, socket.MSG_DONTWAIT, address)
            except OSError:  # the datagram is lost, as on the network: no frame waits for an earlier one
                self.counts["datagrams_not_sent"] += 1

    def close(self) -> None:
        """Stop receiving and close the socket."""
        self._closing = True
        with suppress(OSError):  # it raises "not connected", but still ends the wait in recvmsg
            self._socket.shutdown(socket.SHUT_RD)
        if self._thread is not None:
            self._thread.join()
        self._socket.close()

    def _receive(self, deliver: Deliver) -> None:
        """Deliver datagrams, with one blocking system call each."""
        buffer = self._buffer
        while True:
            try:
                length, ancillary, _flags, address = self._socket.recvmsg_into((buffer,), ANCILLARY_BYTES)
            except OSError as error:  # an ICMP error for a datagram sent before
                if self._closing:
                    return
                if error.errno == errno.EBADF:
                    raise
                self.counts["datagrams_rejected"] += 1
                continue
            if self._closing:
                return
            if self._is_stranger(address):
                self.counts["datagrams_from_strangers"] += 1
                continue
            deliver(self._channel, bytes(buffer[:length]), arrival(ancillary, self._clock.now()), address)

    def _is_stranger(self, address: tuple[str, int]) -> bool:
        if self._only_from is not None and address[0] != self._only_from:
            return True
        return self._remote is not None and address != self._server


def resolve_host(key: str, host: str) -> str:
    """Return the numeric address of a host; raise `UserError` that names the config `key` if the host is unknown.

    Callers resolve a host only once, so that no datagram waits for a name server and senders can be compared by
    address.
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, ValueError) as error:
        raise UserError(f"{key}: the host {host!r} is not known ({_reason(error)}): name another") from error


def _reason(error: OSError | ValueError) -> str:
    """Return the reason why an address cannot be used; a ValueError comes from a host that is not a valid name."""
    return str(error.strerror if isinstance(error, OSError) else error)
