"""What other web sites in the person's browser can reach. `tests/transport/console` attacks the server itself."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from urllib.parse import urlsplit

import pytest
from tests.browser.chromium import FOREIGN_NAME, Browser, wait_until
from tests.browser.conftest import PersonDrive, field

OPEN_SOCKET = """new Promise((resolve) => {
  const socket = new WebSocket("ws://%s/socket");
  socket.onopen = () => resolve("open");
  socket.onerror = () => resolve("error");
})"""
READ_FILE = 'fetch("http://%s/main.js").then(() => "read", () => "error")'


class QuietHandler(SimpleHTTPRequestHandler):
    """A handler that prints nothing."""

    def log_message(self, format: str, *_arguments: object) -> None:  # noqa: A002 (the library's)
        """Print nothing."""


@pytest.fixture
def foreign_origin(tmp_path: Path) -> Iterator[str]:
    """Serve a page of another site on this machine, and return its origin."""
    (tmp_path / "site").mkdir()
    (tmp_path / "site" / "index.html").write_text("<title>foreign</title>")
    server = ThreadingHTTPServer(
        ("127.0.0.1", 0), lambda *arguments: QuietHandler(*arguments, directory=str(tmp_path / "site"))
    )
    thread = threading.Thread(target=server.serve_forever)
    thread.start()
    try:
        yield f"http://{FOREIGN_NAME}:{server.server_port}"
    finally:
        server.shutdown()
        thread.join()
        server.server_close()


def test_a_foreign_site_cannot_use_the_console(
    person_drive: PersonDrive, browser: Browser, foreign_origin: str
) -> None:
    """Another site in the same browser can neither open the socket nor read files, under any name of this machine."""
    tab, port = person_drive.open(), urlsplit(person_drive.url).port
    foreign = browser.open(foreign_origin)
    wait_until("the foreign page is loaded", lambda: foreign.evaluate("document.title") == "foreign")
    for host in ("127.0.0.1", "localhost", FOREIGN_NAME):
        assert foreign.evaluate(OPEN_SOCKET % f"{host}:{port}") == "error"
        assert foreign.evaluate(READ_FILE % f"{host}:{port}") == "error"
    browser.close_tab(foreign)
    assert field(tab, "role") == "drives"


def test_the_console_is_not_served_under_a_foreign_name(person_drive: PersonDrive, browser: Browser) -> None:
    """Under a foreign name that leads to this machine, the browser gets no page, even with the token."""
    url = urlsplit(person_drive.url)
    tab = browser.open(f"http://{FOREIGN_NAME}:{url.port}/#{url.fragment}")
    wait_until("the answer is shown", lambda: "not served here" in (tab.evaluate("document.body?.innerText") or ""))
    browser.close_tab(tab)
