"""Failures of threads: if a thread ends with an error, its whole process fails instead of going on without it."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager


@contextmanager
def fail_on_thread_errors(fail: Callable[[BaseException], None]) -> Iterator[None]:
    """Call `fail` with each error that ends a thread of this process during the `with` block.

    This applies to all threads, including those of libraries and those that were started before.
    """
    previous_hook = threading.excepthook

    def handle(arguments: threading.ExceptHookArgs) -> None:
        fail(arguments.exc_value or arguments.exc_type())

    threading.excepthook = handle
    try:
        yield
    finally:
        threading.excepthook = previous_hook
