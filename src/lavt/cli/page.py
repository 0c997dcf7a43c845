"""Show a person a page of the console in their browser."""

from __future__ import annotations

import os
import webbrowser
from pathlib import Path

from lavt.cli import console


def show_page(url: str, work: Path, *, opens_page: bool, purpose: str = "drive from") -> None:
    """Print the page's address with its purpose, and open the page if this machine has a display."""
    console.print_message(f"lavt: {purpose} {url}")
    if opens_page and (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        # The address has the token. As an argument of the browser, other users could read it in the list of processes.
        redirection = work / "console.html"
        redirection.write_text(f'<!doctype html><meta http-equiv="refresh" content="0; url={url}">\n')
        webbrowser.open(redirection.as_uri())
