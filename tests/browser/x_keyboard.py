"""The keyboard of an X display: another client that grabs it, and its repeats."""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

CURRENT_TIME = 0
ASYNCHRONOUS = 1


@contextmanager
def _connection(name: str) -> Iterator[tuple[Any, ctypes.c_void_p]]:
    library = ctypes.CDLL("libX11.so.6")  # xdotool needs it, too
    library.XOpenDisplay.restype = ctypes.c_void_p
    library.XDefaultRootWindow.restype = ctypes.c_ulong
    display = ctypes.c_void_p(library.XOpenDisplay(name.encode()))
    assert display.value, f"no connection to the display {name}"
    try:
        yield library, display
    finally:
        library.XCloseDisplay(display)


@contextmanager
def grabbed_keyboard(name: str) -> Iterator[None]:
    """Take all keys away from other clients, without a window and without a key."""
    with _connection(name) as (library, display):
        root = ctypes.c_ulong(library.XDefaultRootWindow(display))
        result = library.XGrabKeyboard(display, root, False, ASYNCHRONOUS, ASYNCHRONOUS, ctypes.c_ulong(CURRENT_TIME))
        assert result == 0, f"the keyboard cannot be grabbed: {result}"
        library.XSync(display, False)
        yield


@contextmanager
def without_repeats(name: str) -> Iterator[None]:
    """Let the display repeat no key."""
    with _connection(name) as (library, display):
        library.XAutoRepeatOff(display)
        library.XSync(display, False)
        yield
        library.XAutoRepeatOn(display)
        library.XSync(display, False)
