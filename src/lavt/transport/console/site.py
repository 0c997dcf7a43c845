"""The web site of the console: its files, and the rules for requests, without I/O.

Any web page in the person's browser can send requests to this machine, so a request is checked before it is answered:
the `Host` is an address of this machine (otherwise a foreign name leads here: DNS rebinding), and the `Origin` is this
site. The token is not part of any request; the page sends it as its first message.
"""

from __future__ import annotations

import hmac
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from lavt.errors import BadMessage
from lavt.transport.console.page_messages import PAGE_VERSION, parse_hello

SOCKET_PATH: Final = "/socket"
HOSTS: Final = ("127.0.0.1", "[::1]", "localhost")
PAGE_FILES: Final = Path(__file__).parent / "page"
CONTENT_TYPES: Final = {
    ".html": "text/html; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
}
HEADERS: Final = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Embedder-Policy": "require-corp",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}
"""The headers of every answer. With the two policies on openers and embedders, the page's clock has a resolution of 5
us instead of 100."""


class SiteAnswer(NamedTuple):
    """An answer to an HTTP request."""

    status: int
    content_type: str
    body: bytes


class Closing(NamedTuple):
    """Why the socket of a page is closed: a code of WebSocket for applications, and a sentence for the person."""

    code: int
    reason: str


WRONG_TOKEN: Final = Closing(4401, "wrong token: open the address that lavt has printed")
WRONG_VERSION: Final = Closing(4426, "this page is of another version of lavt: reload it")
NOT_A_HELLO: Final = Closing(4400, "not a page of lavt")
TOO_MANY_PAGES: Final = Closing(4429, "too many pages are open: close one")
TOO_MANY_OPENINGS: Final = Closing(4430, "too many pages have connected just now: this one tries again")
TOO_MANY_MESSAGES: Final = Closing(4408, "this page has sent too much: it was closed, and connects again")


class ConsoleSite:
    """The files of the page, and the rules for requests to `port` of this machine."""

    def __init__(self, port: int, token: str, folder: Path = PAGE_FILES) -> None:
        self._hosts = {f"{host}:{port}" for host in HOSTS}
        self._origins = {f"http://{host}" for host in self._hosts}
        self._token = token.encode()
        self._files = {
            f"/{path.name}": SiteAnswer(200, CONTENT_TYPES[path.suffix], path.read_bytes())
            for path in sorted(folder.iterdir())
            if path.suffix in CONTENT_TYPES
        }
        self._files["/"] = self._files["/index.html"]

    def answer(self, method: str, path: str, hosts: Sequence[str], origins: Sequence[str]) -> SiteAnswer | None:
        """Return the answer to a request with these `Host` and `Origin` headers; None: the socket may be opened."""
        if len(hosts) != 1 or hosts[0].lower() not in self._hosts:
            return _error(421, "this host is not served here")
        if method != "GET":
            return _error(405, "only GET is allowed here")
        if path == SOCKET_PATH:
            is_own = len(origins) == 1 and origins[0] in self._origins
            return None if is_own else _error(403, "only the page of this site may open the socket")
        if any(origin not in self._origins for origin in origins):
            return _error(403, "only this site may use its files")
        return self._files.get(path.partition("?")[0]) or _error(404, "there is no such file")

    def reject_hello(self, data: str | bytes) -> Closing | None:
        """Return why the first message of a page is rejected; None: it is accepted."""
        try:
            hello = parse_hello(data)
        except BadMessage:
            return NOT_A_HELLO
        if not hmac.compare_digest(hello.token.encode(errors="surrogatepass"), self._token):
            return WRONG_TOKEN
        return None if hello.version == PAGE_VERSION else WRONG_VERSION


def _error(status: int, text: str) -> SiteAnswer:
    return SiteAnswer(status, "text/plain; charset=utf-8", f"{text}\n".encode())


def page_headers(answer: SiteAnswer) -> Mapping[str, str]:
    """Return all headers of an answer."""
    allowed = {"Allow": "GET"} if answer.status == 405 else {}
    return {**HEADERS, **allowed, "Content-Type": answer.content_type, "Content-Length": str(len(answer.body))}
