"""Test that a panic of native code is noticed, and that other texts on standard error are passed on."""

from __future__ import annotations

import os
import queue
import subprocess
import sys
import threading

import pytest

from lavt.runtime.native_panics import NativePanic, fail_on_panics

WAIT_S = 30.0
PANIC = (
    "\nthread 'net-1' (5954) panicked at /zenoh/src/net/routing/dispatcher/resource.rs:491:27:\n"
    "called `Option::unwrap()` on a `None` value\n"
)
LOCATION = "/zenoh/src/net/routing/dispatcher/resource.rs:491:27"


def write_as_native_code(text: str) -> None:
    os.write(2, text.encode())


@pytest.mark.parametrize("chunk_bytes", [1000, 7])
def test_a_panic_is_reported_once(chunk_bytes: int, capsys: pytest.CaptureFixture[str]) -> None:
    """A panic leads to one error with its location, even if its text arrives in pieces; the text is passed on."""
    errors = queue.Queue[BaseException]()
    with fail_on_panics(errors.put):
        for start in range(0, len(PANIC), chunk_bytes):
            write_as_native_code(PANIC[start : start + chunk_bytes])
        error = errors.get(timeout=WAIT_S)
    assert isinstance(error, NativePanic)
    assert LOCATION in str(error)
    assert "\n" not in str(error)
    assert errors.empty()
    assert capsys.readouterr().err == PANIC


def test_other_texts_are_no_panic(capsys: pytest.CaptureFixture[str]) -> None:
    """Messages of native code are passed on without an error, also a message that only mentions a panic."""
    errors, text = queue.Queue[BaseException](), "[x264] warning\nsomething panicked at noon\nno line end"
    with fail_on_panics(errors.put):
        write_as_native_code(text)
    assert capsys.readouterr().err == text
    assert errors.empty()


def test_standard_error_is_restored() -> None:
    """After the block, standard error leads to where it led before, and no thread is left."""
    before, threads = os.fstat(2), set(threading.enumerate())
    with fail_on_panics(lambda _: None):
        assert os.fstat(2).st_ino != before.st_ino
    assert os.fstat(2).st_ino == before.st_ino
    assert set(threading.enumerate()) == threads


def test_a_process_that_cannot_end_is_ended() -> None:
    """A process whose main thread waits for ever ends with the given code, and its queued messages are printed."""
    program = (
        "import sys, threading\n"
        "from lavt.runtime.native_panics import end_in_any_case\n"
        "from lavt.runtime.output import queue_output\n"
        "queue_output('stderr')\n"
        "print('lavt: failed', file=sys.stderr)\n"
        "end_in_any_case(3, 0.2)\n"
        "threading.Event().wait()\n"
    )
    result = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60, check=False)
    assert (result.returncode, result.stderr) == (3, "lavt: failed\n")
