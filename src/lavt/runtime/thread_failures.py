"""Failures of threads: a thread that ends with an error fails its process, instead of leaving it deaf or blind."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def fail_on_thread_errors(fail: Callable[[BaseException], None]) -> Iterator[None]:
    """Call `fail` with each error that ends a thread of this process while the context is entered.

    It applies to all threads, also to those of libraries and to those that were started before.
    """
    former = threading.excepthook

    def handle(arguments: threading.ExceptHookArgs) -> None:
        fail(arguments.exc_value or arguments.exc_type())

    threading.excepthook = handle
    try:
        yield
    finally:
        threading.excepthook = former
