"""Progress of long work: a bar on a terminal, a line now and then elsewhere."""

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
    """Give a function to be called with a line for each of `total` pieces that is done."""
    if not sys.stderr.isatty():
        console.say(f"{title}: {total} runs")
        yield _lines(total, clock or MachineClock())
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


def _lines(total: int, clock: Clock) -> Callable[[str], None]:
    """Say each line with how many are done and about how long the rest will take, at the pace so far."""
    begin_ns, done = clock.now().mono_ns, 0

    def tell(line: str) -> None:
        nonlocal done
        done += 1
        left_s = (clock.now().mono_ns - begin_ns) / done * (total - done) / NS_PER_S
        console.say(f"{done} of {total}, {left_words(left_s)}: {line}")

    return tell


def left_words(left_s: float) -> str:
    """Say a time that is left, about."""
    minutes = left_s / 60
    if minutes < 1:
        return f"{left_s:.0f} s left"
    return f"{minutes:.0f} min left" if minutes < 120 else f"{minutes / 60:.0f} h left"
