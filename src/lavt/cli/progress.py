"""Progress of long work: a bar on a terminal, lines elsewhere."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from lavt.cli import console
from lavt.clock import Clock, MachineClock
from lavt.domain import NS_PER_S


@contextmanager
def progress(title: str, total: int, *, clock: Clock | None = None) -> Iterator[Callable[[str], None]]:
    """Yield a function; call it with one line of text whenever one of the `total` runs is done."""
    if not sys.stderr.isatty():
        console.print_message(f"{title}: {total} runs")
        yield _line_printer(total, clock or MachineClock())
        return
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeRemainingColumn(),
        TextColumn("{task.fields[last]}", markup=False),
    )
    with Progress(*columns, console=Console(stderr=True)) as bar:
        task = bar.add_task(title, total=total, last="")
        yield lambda line: bar.update(task, advance=1, last=line)


def _line_printer(total: int, clock: Clock) -> Callable[[str], None]:
    """Return a function that prints a line with the number of runs done and the estimated time left."""
    start_ns, done = clock.now().mono_ns, 0

    def print_line(line: str) -> None:
        nonlocal done
        done += 1
        time_left_s = (clock.now().mono_ns - start_ns) / done * (total - done) / NS_PER_S
        console.print_message(f"{done} of {total}, {format_time_left(time_left_s)}: {line}")

    return print_line


def format_time_left(left_s: float) -> str:
    """Format the time left in round numbers."""
    minutes = left_s / 60
    if minutes < 1:
        return f"{left_s:.0f} s left"
    return f"{minutes:.0f} min left" if minutes < 120 else f"{minutes / 60:.0f} h left"
