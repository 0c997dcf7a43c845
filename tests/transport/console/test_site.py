from __future__ import annotations

import json
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st

from lavt.transport.console.page_messages import PAGE_VERSION
from lavt.transport.console.site import (
    HEADERS,
    NOT_A_HELLO,
    PAGE_FILES,
    WRONG_TOKEN,
    WRONG_VERSION,
    ConsoleSite,
    page_headers,
)

SITE = ConsoleSite(8000, "secret")
HOST = ["127.0.0.1:8000"]
ORIGIN = ["http://127.0.0.1:8000"]


def status(path: str, hosts: list[str], origins: list[str]) -> int | None:
    answer = SITE.answer("GET", path, hosts, origins)
    return None if answer is None else answer.status


@pytest.mark.parametrize("host", ["127.0.0.1", "localhost", "LOCALHOST", "[::1]"])
def test_the_page_is_served_at_this_machine(host: str) -> None:
    """The page and its files are served at each loopback address and name."""
    for path in ("/", "/index.html", "/main.js", "/console.css"):
        assert status(path, [f"{host}:8000"], []) == 200


@pytest.mark.parametrize(
    "hosts",
    [
        [],
        [""],
        ["127.0.0.1"],
        ["127.0.0.1:8001"],
        ["attacker.example:8000"],
        ["127.0.0.1:8000.attacker.example"],
        ["localhost:8000", "localhost:8000"],
        ["0.0.0.0:8000"],
    ],
)
def test_another_host_is_rejected(hosts: list[str]) -> None:
    """A request for another host, as after DNS rebinding, gets 421 for files and for the socket."""
    assert status("/", hosts, []) == 421
    assert status("/socket", hosts, ORIGIN) == 421


@pytest.mark.parametrize(
    "origins",
    [
        [],
        ["null"],
        [""],
        ["http://attacker.example"],
        ["http://127.0.0.1:8001"],
        ["https://127.0.0.1:8000"],
        ["http://127.0.0.1"],
        ["http://127.0.0.1:8000", "http://127.0.0.1:8000"],
        ["http://127.0.0.1:8000/"],
    ],
)
def test_the_socket_needs_the_sites_origin(origins: list[str]) -> None:
    """The socket opens only with one Origin, which is this site."""
    assert status("/socket", HOST, origins) == 403
    assert status("/socket", HOST, ORIGIN) is None


@pytest.mark.parametrize("method", ["HEAD", "POST", "PUT", "OPTIONS", "DELETE", "CONNECT", "get"])
def test_only_get_is_allowed(method: str) -> None:
    """A request with another method gets 405 with the allowed one, for files and for the socket."""
    for path in ("/", "/socket"):
        answer = SITE.answer(method, path, HOST, ORIGIN)
        assert answer is not None
        assert (answer.status, page_headers(answer)["Allow"]) == (405, "GET")
    assert "Allow" not in page_headers(SITE._files["/"])


def test_foreign_pages_get_no_files() -> None:
    """A request for a file with a foreign Origin is rejected."""
    assert status("/main.js", HOST, ["http://attacker.example"]) == 403
    assert status("/main.js", HOST, ORIGIN) == 200


@pytest.mark.parametrize("path", ["/../site.py", "/page/../../site.py", "/no", "//", "/%2e%2e/site.py", "", "x" * 5000])
def test_only_the_pages_files_are_served(path: str) -> None:
    """Only the files of the page are served."""
    assert status(path, HOST, []) == 404


def hello(**changes: object) -> str:
    return json.dumps({"type": "hello", "version": PAGE_VERSION, "token": "secret", **changes})


def test_the_first_message_has_the_token() -> None:
    """A page is accepted with the token and the version; anything else is rejected with a code and a sentence."""
    assert SITE.reject_hello(hello()) is None
    for token in ("", "secre", "secrets", "SECRET", "\ud800", "é"):
        assert SITE.reject_hello(hello(token=token)) in (WRONG_TOKEN, NOT_A_HELLO)
    assert SITE.reject_hello(hello(token="wrong")) is WRONG_TOKEN
    assert SITE.reject_hello(hello(version=0)) is WRONG_VERSION
    assert SITE.reject_hello(hello(version=0, token="wrong")) is WRONG_TOKEN
    assert SITE.reject_hello('{"type": "stop"}') is NOT_A_HELLO
    assert SITE.reject_hello(b"\xff\x00") is NOT_A_HELLO


@given(st.text() | st.binary())
def test_no_other_first_message_is_accepted(data: str | bytes) -> None:
    """Whatever arrives first, it is rejected without an error."""
    assert SITE.reject_hello(data) is not None


def test_every_answer_has_the_security_headers() -> None:
    """Files and errors have the policy on contents, and no header allows other sites anything."""
    for path in ("/", "/no"):
        answer = SITE.answer("GET", path, HOST, [])
        assert answer is not None
        headers = page_headers(answer)
        assert headers.items() >= HEADERS.items()
        assert not [name for name in headers if name.lower().startswith("access-control")]
    policy = HEADERS["Content-Security-Policy"]
    assert "default-src 'none'" in policy
    assert "frame-ancestors 'none'" in policy
    assert "unsafe" not in policy


def test_the_page_fetches_nothing_from_elsewhere() -> None:
    """The files of the page name no other site, have no inline script or style, and import only each other."""
    for path in PAGE_FILES.iterdir():
        text = path.read_text()
        assert not re.search(r"https?://|//cdn|@import|url\(", text), path
        assert not re.search(r"<script(?![^>]*\bsrc=)|<style|\bstyle=|\bon\w+=\"", text), path
        for imported in re.findall(r'from "\./([^"]+)"', text):
            assert (PAGE_FILES / imported).is_file()
    assert f"const VERSION = {PAGE_VERSION};" in (PAGE_FILES / "connection.js").read_text()
