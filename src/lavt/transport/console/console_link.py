"""The link to the pages of the console: a web server on the loopback addresses of this machine, with a thread.

It is the only module that imports `websockets`, and it does so when a link is built.
"""

from __future__ import annotations

import asyncio
import itertools
import logging
import socket
import threading
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from lavt.clock import Clock
from lavt.domain import Now
from lavt.errors import UserError, WorkError
from lavt.node import Send
from lavt.transport.console.listeners import ignore_paused_accepts, open_listeners
from lavt.transport.console.message_limit import MessageLimit
from lavt.transport.console.page_messages import MAX_PAGE_MESSAGE_BYTES
from lavt.transport.console.read_limit import (
    CONNECTIONS_PER_S,
    MAX_CONNECTIONS,
    MAX_OPENINGS,
    OPENINGS_PER_S,
    ReadLimits,
    RefillingLimit,
)
from lavt.transport.console.site import (
    HEADERS,
    PAGE_FILES,
    TOO_MANY_MESSAGES,
    TOO_MANY_OPENINGS,
    TOO_MANY_PAGES,
    ConsoleSite,
    page_headers,
)
from lavt.transport.console.strangers import Strangers

if TYPE_CHECKING:
    from websockets.asyncio.server import Server, ServerConnection
    from websockets.frames import Frame
    from websockets.http11 import Request, Response

Deliver = Callable[[str, Any, Now, Any], None]
"""Takes (channel, payload, arrived, peer) of each message; the peer is the number of the page."""

MAX_PAGES: Final = 8
MAX_QUEUED: Final = 16
"""Messages to a page that does not read them: all access units that may be on the way fit, and further statuses are
dropped."""
MAX_UNSENT_BYTES: Final = 8 * 2**20
"""A connection that reads nothing is closed when this much waits for it, such as answers to its pings. All access units
of a page that may be on the way are smaller."""
HELLO_TIMEOUT_S: Final = 5.0
CLOSE_TIMEOUT_S: Final = 1.0
MISSING: Final = "the console is a web page, which needs the package websockets: pip install -e '.[console]'"


class _Page:
    """The connection to one page, and the messages that wait to be sent to it."""

    def __init__(self, connection: ServerConnection) -> None:
        self.connection = connection
        self.waiting: asyncio.Queue[str | bytes] = asyncio.Queue(MAX_QUEUED)
        self.limit = MessageLimit()


class ConsoleLink:
    """A web server for the page from which a person drives or watches, at 127.0.0.1 and, if this machine has it, ::1.

    `port` 0 is any free port. Messages of pages are delivered on the channels `page_opened`, `page_message` and
    `page_closed`, after the page has shown the token; their names begin with `prefix` instead of "page". The page has
    the files in `folder`; a longer message than `max_message_bytes` closes it. Raises `UserError` if the port cannot be
    opened or `websockets` is missing.
    """

    def __init__(
        self,
        clock: Clock,
        token: str,
        port: int = 0,
        *,
        folder: Path = PAGE_FILES,
        max_message_bytes: int = MAX_PAGE_MESSAGE_BYTES,
        prefix: Literal["page", "watch"] = "page",
    ) -> None:
        self.counts: Counter[str] = Counter()
        self._websockets = _import_websockets()
        self._clock = clock
        self._connection_limit = RefillingLimit(CONNECTIONS_PER_S, MAX_CONNECTIONS)
        self._opening_limit = RefillingLimit(OPENINGS_PER_S, MAX_OPENINGS)
        self._read_limits = ReadLimits()
        self._sockets = open_listeners(port, self._may_accept)
        self.port: int = self._sockets[0].getsockname()[1]
        self.url = f"http://127.0.0.1:{self.port}/#{token}"
        self._site = ConsoleSite(self.port, token, folder)
        self._max_message_bytes = max_message_bytes
        self._prefix = prefix
        self._loop = asyncio.new_event_loop()
        self._ends: asyncio.Future[None] = self._loop.create_future()
        """Done when the link is closed, or has failed."""
        self._pages: dict[int, _Page] = {}
        self._strangers = Strangers(self.counts)
        self._numbers = itertools.count(1)
        self._closing = False
        self._thread: threading.Thread | None = None

    def start(self, deliver: Deliver) -> None:
        """Start to serve; the link's thread calls `deliver`. If the thread ends before `close`, it raises."""
        self._thread = threading.Thread(target=self._run, args=(deliver,), name="console", daemon=True)
        self._thread.start()

    def send(self, *sends: Send) -> None:
        """Send messages to pages, whose numbers are the peers; those to closed pages are dropped."""
        with suppress(RuntimeError):  # the loop is closed
            self._loop.call_soon_threadsafe(self._enqueue, sends)

    def close(self) -> None:
        """Close all pages and the server."""
        self._closing = True
        if self._thread is None:
            for listener in self._sockets:
                listener.close()
            self._loop.close()
            return
        with suppress(RuntimeError):
            self._loop.call_soon_threadsafe(self._end)
        self._thread.join()

    def _end(self, error: BaseException | None = None) -> None:
        if self._ends.done():
            return
        if error is None:
            self._ends.set_result(None)
        else:
            self._ends.set_exception(error)

    def _run(self, deliver: Deliver) -> None:
        try:
            self._loop.run_until_complete(self._serve(deliver))
        finally:
            self._loop.close()
            for listener in self._sockets:
                listener.close()
        if not self._closing:
            raise WorkError("the web server of the console has ended")

    def _may_accept(self) -> bool:
        """Return whether one more connection may be accepted now."""
        if self._connection_limit.take(self._clock.now().mono_ns):
            return True
        self.counts["accepts_paused"] += 1
        return False

    async def _serve(self, deliver: Deliver) -> None:
        self._loop.set_exception_handler(ignore_paused_accepts)
        servers = [await self._start_server(listener, deliver) for listener in self._sockets]
        try:
            await self._ends
        finally:
            for server in servers:
                server.close()
            with suppress(TimeoutError):
                await asyncio.wait_for(asyncio.gather(*(server.wait_closed() for server in servers)), CLOSE_TIMEOUT_S)
            await _cancel_tasks()

    async def _start_server(self, listener: socket.socket, deliver: Deliver) -> Server:
        server: Server = await self._websockets.asyncio.server.serve(
            lambda connection: self._guard(connection, deliver),
            sock=listener,
            create_connection=_limited_connection(self._clock, self._strangers, self._read_limits, self.counts),
            process_request=self._process_request,
            compression=None,
            max_size=self._max_message_bytes,
            open_timeout=HELLO_TIMEOUT_S,
            close_timeout=CLOSE_TIMEOUT_S,
            server_header=None,
            logger=_silent_logger(),
        )
        return server

    def _process_request(self, connection: ServerConnection, request: Request) -> Response | None:
        """Answer a request for a file, or return None for a request that opens the socket."""
        headers = request.headers
        method = getattr(request, "method", "GET")  # older versions of `websockets` reject other methods
        answer = self._site.answer(method, request.path, headers.get_all("Host"), headers.get_all("Origin"))
        if answer is None:
            return None
        self.counts["requests_answered" if answer.status == HTTPStatus.OK else "requests_rejected"] += 1
        response = connection.respond(HTTPStatus(answer.status), "")
        for name in list(response.headers):
            if name.lower() not in ("date", "connection"):
                del response.headers[name]
        for name, value in page_headers(answer).items():
            response.headers[name] = value
        response.body = b"" if method == "HEAD" else answer.body
        return response

    async def _guard(self, connection: ServerConnection, deliver: Deliver) -> None:
        """Serve a connection; an error that is not a lost connection ends the link, and so the process."""
        try:
            with suppress(self._websockets.exceptions.ConnectionClosed):
                await self._serve_page(connection, deliver)
        except Exception as error:
            self._end(error)

    async def _serve_page(self, connection: ServerConnection, deliver: Deliver) -> None:
        try:
            hello = await asyncio.wait_for(connection.recv(), HELLO_TIMEOUT_S)
        except TimeoutError:
            self.counts["pages_rejected"] += 1
            return
        closing = self._site.reject_hello(hello)
        if closing is None and len(self._pages) >= MAX_PAGES:
            closing = TOO_MANY_PAGES
        if closing is None and not self._opening_limit.take(self._clock.now().mono_ns):
            closing = TOO_MANY_OPENINGS
        if closing is not None:
            self.counts["pages_rejected"] += 1
            await connection.close(*closing)
            return
        self._strangers.remove(connection)
        self._read_limits.admit(connection)
        number, page = next(self._numbers), _Page(connection)
        self._pages[number] = page
        writer = asyncio.create_task(self._write(page))
        try:
            deliver(f"{self._prefix}_opened", None, self._clock.now(), number)
            async for message in connection:
                now = self._clock.now()
                if page.limit.allows(message, now.mono_ns):
                    deliver(f"{self._prefix}_message", message, now, number)
                else:
                    self.counts["page_messages_too_many"] += 1
        finally:
            del self._pages[number]
            writer.cancel()
            deliver(f"{self._prefix}_closed", None, self._clock.now(), number)

    def _enqueue(self, sends: tuple[Send, ...]) -> None:
        for send in sends:
            page = self._pages.get(send.peer)
            if page is None:
                continue
            is_status = send.channel.endswith("_status")
            if page.waiting.qsize() >= (MAX_QUEUED // 2 if is_status else MAX_QUEUED):
                self.counts[f"{send.channel}_dropped"] += 1
            else:
                page.waiting.put_nowait(send.payload.decode() if is_status else send.payload)

    async def _write(self, page: _Page) -> None:
        """Send the waiting messages of a page, until it is closed; another error ends the link."""
        try:
            while True:
                await page.connection.send(await page.waiting.get())
        except self._websockets.exceptions.ConnectionClosed:
            return
        except Exception as error:
            self._end(error)


def _limited_connection(
    clock: Clock, strangers: Strangers, read_limits: ReadLimits, counts: Counter[str]
) -> type[ServerConnection]:
    """Return the class of connections that are limited in what they send, and in what waits to be sent to them.

    Their own errors, as for a request that is no valid HTTP, have the headers of the site.
    """
    from websockets.asyncio.server import ServerConnection  # noqa: PLC0415 (an optional package)

    class LimitedConnection(ServerConnection):
        is_over = False
        """It has sent too much, and nothing of it is read any more."""

        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            super().connection_made(transport)
            reject, receive_frame = self.protocol.reject, self.protocol.recv_frame

            def reject_with_headers(status: HTTPStatus | int, text: str) -> Response:
                response = reject(status, text)
                response.headers.update(HEADERS)
                return response

            def receive_limited(frame: Frame) -> None:
                """Process a frame; above the limit, close the connection, which discards the frames after it."""
                if read_limits.take(self, clock.now().mono_ns):
                    receive_frame(frame)
                elif not self.is_over:
                    self.end()

            self.protocol.reject = reject_with_headers  # type: ignore[method-assign]
            self.protocol.recv_frame = receive_limited  # type: ignore[method-assign]
            strangers.add(self, self.transport.abort)
            read_limits.add(self)

        def connection_lost(self, exc: Exception | None) -> None:
            strangers.remove(self)
            read_limits.remove(self)
            super().connection_lost(exc)

        def data_received(self, data: bytes) -> None:
            if self.is_over or not strangers.may_read(self, len(data)):
                return
            if not read_limits.take(self, clock.now().mono_ns):
                self.end()
                self.send_data()
                return
            super().data_received(data)
            if self.transport.get_write_buffer_size() > MAX_UNSENT_BYTES:
                counts["connections_not_reading"] += 1
                self.transport.abort()

        def end(self) -> None:
            """Tell the page why it is closed, and read nothing more; it has a second to take this."""
            self.is_over = True
            counts["connections_too_busy"] += 1
            self.protocol.fail(*TOO_MANY_MESSAGES)
            self.transport.pause_reading()
            self.loop.call_later(CLOSE_TIMEOUT_S, self.transport.abort)

    return LimitedConnection


def check_installed() -> None:
    """Raise `UserError` if `websockets` is not installed."""
    _import_websockets()


def _import_websockets() -> Any:
    try:
        import websockets.asyncio.server  # noqa: PLC0415 (an optional package)
        import websockets.exceptions  # noqa: PLC0415
    except ImportError:
        raise UserError(MISSING) from None
    return websockets


def _silent_logger() -> logging.Logger:
    """Return a logger that prints nothing: anybody on this machine can make connections that fail."""
    logger = logging.getLogger("lavt.console.websockets")
    logger.disabled = True
    return logger


async def _cancel_tasks() -> None:
    tasks = [task for task in asyncio.all_tasks() if task is not asyncio.current_task()]
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
