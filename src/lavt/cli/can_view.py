"""The output of `lavt can monitor`: a live table on a terminal, lines elsewhere, or JSON."""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any

from rich.console import Console
from rich.live import Live
from rich.table import Table
from rich.text import Text

from lavt.cli import console
from lavt.domain import NS_PER_S
from lavt.vehicle.dbw.traffic import OTHER_IDENTIFIERS, BusTraffic, MessageSummary, signal_text


class BusView:
    """The messages on a bus, printed each second and, at the end, as a summary."""

    def __init__(self, traffic: BusTraffic, drop_counts: Mapping[str, int], as_json: bool) -> None:
        self._traffic, self._drop_counts, self._as_json = traffic, drop_counts, as_json
        self._live: Live | None = None
        self._printed: set[str] = set()
        """Names of the messages that have been printed."""

    @contextmanager
    def live_table(self) -> Iterator[None]:
        """Show a live table inside the `with` block if standard output is a terminal."""
        if self._as_json or not sys.stdout.isatty():
            yield
            return
        with Live(Text("no message yet"), console=Console(), auto_refresh=False) as self._live:
            yield
        self._live = None

    def show_second(self, elapsed_ns: int, now_ns: int) -> None:
        """Show the messages since the last call; the output names `elapsed_ns`, the time since the start."""
        messages = self._traffic.take_period(now_ns)
        if self._as_json:
            console.print_json({"second": self._as_data(elapsed_ns, messages)})
        elif self._live is not None:
            self._live.update(_table(messages, self._other_lines()), refresh=True)
        else:
            for message in messages:
                if message.wrong or message.changed or message.facts.name not in self._printed:
                    self._printed.add(message.facts.name)
                    console.print_result(f"{elapsed_ns / NS_PER_S:.0f} s  {_message_line(message)}")

    def show_summary(self, elapsed_ns: int, now_ns: int) -> None:
        """Show the messages since the start, which was `elapsed_ns` ago."""
        messages = self._traffic.total(now_ns)
        if self._as_json:
            console.print_json({"summary": self._as_data(elapsed_ns, messages)})
            return
        console.print_result(f"summary of {elapsed_ns / NS_PER_S:.1f} s:")
        for line in [*map(_message_line, messages), *self._other_lines()]:
            console.print_result(f"  {line}")

    def _other_lines(self) -> list[str]:
        """Return the lines on frames of unknown messages and on dropped frames."""
        unknown = [f"{format_identifier(*key)} {count} times" for key, count in sorted(self._traffic.unknown.items())]
        dropped = [f"{name.replace('_', ' ')} {count}" for name, count in self._drop_counts.items() if count]
        lines = {"not in the DBC": unknown, "dropped": dropped}
        return [f"{label}: {', '.join(counts)}" for label, counts in lines.items() if counts]

    def _as_data(self, elapsed_ns: int, messages: Sequence[MessageSummary]) -> dict[str, Any]:
        unknown: Counter[str] = Counter()
        for key, count in self._traffic.unknown.items():
            unknown[format_identifier(*key)] += count
        return {
            "passed_s": round(elapsed_ns / NS_PER_S, 3),
            "messages": [_message_data(message) for message in messages],
            "unknown": unknown,
            "dropped": {name: count for name, count in self._drop_counts.items() if count},
        }


def format_identifier(identifier: int, is_extended: bool) -> str:
    """Format an identifier as CAN tools do: three hexadecimal digits, or eight for a 29-bit identifier."""
    if (identifier, is_extended) == OTHER_IDENTIFIERS:
        return "others"
    return f"0x{identifier:0{8 if is_extended else 3}X}"


def _message_line(message: MessageSummary) -> str:
    facts = message.facts
    identifier = format_identifier(facts.identifier, facts.is_extended)
    parts = [
        f"{facts.name} {identifier}  {message.frames} times, {_rate_text(message)}",
        ", ".join(_signal_labels(message)),
        f"changed: {', '.join(message.changed)}" if message.changed else "",
        f"WRONG: {'; '.join(message.wrong)}" if message.wrong else "",
    ]
    return "  ".join(part for part in parts if part)


def _rate_text(message: MessageSummary) -> str:
    nominal = f" of {NS_PER_S / message.facts.period_ns:g}" if message.facts.period_ns else ""
    return f"{message.rate_hz:.1f}{nominal} per s"


def _signal_labels(message: MessageSummary) -> list[str]:
    labels = (signal_text(message.facts.signals[name], value) for name, value in message.values.items())
    return [label for label in labels if label]


def _table(messages: Sequence[MessageSummary], other_lines: Sequence[str]) -> Table:
    table = Table(expand=True, caption="\n".join([*other_lines, "? marks an unverified signal; Ctrl-C ends"]))
    for heading in ("message", "", "per s", "signals", "wrong"):
        table.add_column(heading, overflow="fold", ratio=4 if heading == "signals" else None)
    for message in messages:
        signals = Text()
        for name, value in message.values.items():
            label = signal_text(message.facts.signals[name], value)
            signals.append(f"{label}  " if label else "", style="bold yellow" if name in message.changed else "")
        table.add_row(
            message.facts.name,
            format_identifier(message.facts.identifier, message.facts.is_extended),
            f"{message.rate_hz:.1f}",
            signals,
            Text("; ".join(message.wrong), style="bold red"),
        )
    return table


def _message_data(message: MessageSummary) -> dict[str, Any]:
    signals = message.facts.signals
    return {
        "message": message.facts.name,
        "identifier": message.facts.identifier,
        "is_extended": message.facts.is_extended,
        "frames": message.frames,
        "rate_hz": round(message.rate_hz, 2),
        "signals": {
            name: {
                "value": value,
                "unit": signals[name].unit,
                "name": None if value is None else signals[name].names.get(signals[name].number(value)),
                "unverified": signals[name].is_unverified,
            }
            for name, value in message.values.items()
        },
        "changed": message.changed,
        "wrong": message.wrong,
    }
