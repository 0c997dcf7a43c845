"""Test standard streams whose texts are queued and written by a thread, so that an unread pipe blocks no program."""

from __future__ import annotations

import os
import select
import signal
import subprocess
import sys
import threading
from collections.abc import Iterator

import pytest

from lavt.runtime.output import QueuedOutput

LINES = 10_000
END_LIMIT_S = 30


@pytest.fixture
def pipe() -> Iterator[tuple[int, int]]:
    read_end, write_end = os.pipe()
    yield read_end, write_end
    for end in (read_end, write_end):
        os.close(end)


def test_texts_are_written_in_order(pipe: tuple[int, int]) -> None:
    """Texts with any characters are written in order and completely."""
    output = QueuedOutput(pipe[1])
    print("one é", 2, file=output, flush=True)
    output.write("lone \udcff\n")
    output.finish()
    assert os.read(pipe[0], 100).decode() == "one é 2\nlone \\udcff\n"
    assert output.dropped == 0


def test_an_unread_pipe_blocks_nobody(pipe: tuple[int, int]) -> None:
    """While a pipe is full, writing and finishing return; the oldest texts are dropped and counted."""
    output = QueuedOutput(pipe[1], capacity=10)
    for number in range(LINES):
        output.write(f"{number:99d}\n")
    output.finish(timeout_s=0.01)
    assert output.dropped > LINES / 2
    received = list[int]()

    def read() -> None:
        with os.fdopen(os.dup(pipe[0])) as stream:
            received.extend(int(line) for _, line in zip(range(LINES - output.dropped), stream, strict=False))

    reader = threading.Thread(target=read)
    reader.start()
    reader.join()
    assert len(received) + output.dropped == LINES
    assert received == sorted(received)
    assert received[-1] == LINES - 1


def test_a_reader_that_has_ended_blocks_nobody() -> None:
    """Texts for a closed pipe are dropped and counted."""
    read_end, write_end = os.pipe()
    os.close(read_end)
    output = QueuedOutput(write_end)
    output.write("one\n")
    output.finish()
    assert output.dropped == 1
    os.close(write_end)


PRINTS_UNTIL_STOPPED = """
import os, sys
from lavt.cli import console
from lavt.errors import WorkError

def run():
    with console.stop_on_signals() as stop:
        while not stop.wait(0.0001):
            console.print_result("x" * 10_000)
            console.print_message("x" * 10_000)
            os.write({descriptor}, b".")
    raise WorkError("stopped")

console.run_command(run)
"""


@pytest.mark.parametrize("signal_number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_a_program_whose_output_is_not_read(signal_number: signal.Signals) -> None:
    """A program continues although its output pipes are full and nobody reads them; Ctrl-C and SIGTERM end it."""
    progress_read_end, progress_write_end = os.pipe()
    program = PRINTS_UNTIL_STOPPED.format(descriptor=progress_write_end)
    command = [sys.executable, "-c", program]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, pass_fds=[progress_write_end]
    ) as process:
        try:
            received = 0
            while received < 100:  # 1 MB of output for each pipe, which holds 64 KiB
                assert select.select([progress_read_end], [], [], END_LIMIT_S)[0]
                received += len(os.read(progress_read_end, 100))
            process.send_signal(signal_number)
            assert process.wait(END_LIMIT_S) == 1
        finally:
            process.kill()
    os.close(progress_read_end)
    os.close(progress_write_end)


FAILS_UNEXPECTEDLY = """
from lavt.cli import console

def run():
    with console.stop_on_signals():
        raise RuntimeError("unexpected")

console.run_command(run)
"""


def test_an_unexpected_error_is_printed() -> None:
    """The traceback of an unexpected error is printed although the output is queued."""
    completed = subprocess.run(
        [sys.executable, "-c", FAILS_UNEXPECTEDLY], capture_output=True, text=True, timeout=END_LIMIT_S, check=False
    )
    assert completed.returncode == 1
    assert "RuntimeError: unexpected" in completed.stderr
