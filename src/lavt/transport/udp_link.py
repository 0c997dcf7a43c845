"""UDP sockets, one on each side for the video and one for the probe, with the kernel's time of arrival."""

from __future__ import annotations

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
"""(channel, payload, arrived, peer): what a link does with what comes in."""

RECEIVE_BUFFER_BYTES = 4 * 1024 * 1024
LONGEST_DATAGRAM = 65_535


class UdpLink:
    """A UDP socket and a thread that receives.

    `channel` names what comes in, `name` says what the port is for. `peer` of what goes out is an address, or for a
    client, whose server is known by `remote`, the port, which counts where that of `remote` is 0. A client hears its
    server only: what comes from elsewhere is counted, not delivered. Who only listens may name the one host, by its
    number, that is heard (`only_from`). Raises `UserError` for a port that cannot be opened and for a host that is not
    known.
    """

    def __init__(
        self,
        clock: Clock,
        channel: str,
        deliver: Deliver,
        *,
        bind: tuple[str, int],
        remote: tuple[str, int] | None = None,
        only_from: str | None = None,
        name: str = "video",
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._clock = clock
        self._channel = channel
        self._deliver = deliver
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
                f"the {name} port {bind[0]}:{bind[1]} cannot be opened ({_why(error)}): choose another, or 0 for any"
            ) from error
        self._room = memoryview(bytearray(LONGEST_DATAGRAM))
        self._closing = False
        self._thread = threading.Thread(target=self._receive, name="udp", daemon=True)

    @property
    def port(self) -> int:
        """The port that was opened."""
        return int(self._socket.getsockname()[1])

    def start(self) -> None:
        """Begin to receive."""
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Send datagrams; what the network refuses is counted."""
        for send in sends:
            address = send.peer
            if self._remote is not None:
                address = self._server = (self._remote[0], self._remote[1] or send.peer)
            try:
                self._socket.sendto(send.payload, socket.MSG_DONTWAIT, address)
            except OSError:  # what the system cannot take now is lost, as on the way: no frame waits for the one before
                self.counts["datagrams_not_sent"] += 1

    def close(self) -> None:
        """Stop receiving and close the socket."""
        self._closing = True
        with suppress(OSError):  # it says that there is no connection, and ends the waiting all the same
            self._socket.shutdown(socket.SHUT_RD)
        if self._thread.is_alive():
            self._thread.join()
        self._socket.close()

    def _receive(self) -> None:
        """Deliver what comes, one datagram for each call of the system; the waiting is in it."""
        room = self._room
        while True:
            try:
                length, ancillary, _flags, address = self._socket.recvmsg_into((room,), ANCILLARY_BYTES)
            except OSError:  # an ICMP error of an earlier datagram
                if self._closing:
                    return
                self.counts["datagrams_rejected"] += 1
                continue
            if self._closing:
                return
            if self._is_stranger(address):
                self.counts["datagrams_from_strangers"] += 1
                continue
            self._deliver(self._channel, bytes(room[:length]), arrival(ancillary, self._clock.now()), address)

    def _is_stranger(self, address: tuple[str, int]) -> bool:
        if self._only_from is not None and address[0] != self._only_from:
            return True
        return self._remote is not None and address != self._server


def resolve_host(key: str, host: str) -> str:
    """Look a host up, once: no datagram waits for a name server, and senders are compared by their numbers.

    Raises `UserError` naming the config `key` where nobody knows the host.
    """
    try:
        return socket.gethostbyname(host)
    except (OSError, ValueError) as error:
        raise UserError(f"{key}: the host {host!r} is not known ({_why(error)}): name another") from error


def _why(error: OSError | ValueError) -> str:
    """Say why an address cannot be used; a ValueError is that of a host that cannot be a name at all."""
    return str(error.strerror if isinstance(error, OSError) else error)
