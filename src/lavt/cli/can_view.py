"""What a person or a program sees of a bus: a table that changes on a terminal, lines elsewhere, or JSON."""

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
    """Shows a bus second by second, and in the end the whole of it."""

    def __init__(self, traffic: BusTraffic, counts: Mapping[str, int], as_json: bool) -> None:
        self._traffic, self._counts, self._as_json = traffic, counts, as_json
        self._live: Live | None = None
        self._known: set[str] = set()

    @contextmanager
    def showing(self) -> Iterator[None]:
        """Have the terminal, where there is one, for the time of a `with`."""
        if self._as_json or not sys.stdout.isatty():
            yield
            return
        with Live(Text("nothing yet"), console=Console(), auto_refresh=False) as self._live:
            yield
        self._live = None

    def second(self, passed_ns: int, now_ns: int) -> None:
        """Show what came since the last time."""
        told = self._traffic.take_period(now_ns)
        if self._as_json:
            console.show_json({"second": self._as_data(passed_ns, told)})
        elif self._live is not None:
            self._live.update(_table(told, self._rest()), refresh=True)
        else:
            for each in told:
                if each.wrong or each.changed or each.facts.name not in self._known:
                    self._known.add(each.facts.name)
                    console.show(f"{passed_ns / NS_PER_S:.0f} s  {_line(each)}")

    def summary(self, passed_ns: int, now_ns: int) -> None:
        """Show what came in all."""
        told = self._traffic.total(now_ns)
        if self._as_json:
            console.show_json({"summary": self._as_data(passed_ns, told)})
            return
        console.show(f"in all, in {passed_ns / NS_PER_S:.1f} s:")
        for line in [*map(_line, told), *self._rest()]:
            console.show(f"  {line}")

    def _rest(self) -> list[str]:
        """Tell what belongs to no message."""
        unknown = [f"{identifier_words(*key)} {count} times" for key, count in sorted(self._traffic.unknown.items())]
        dropped = [f"{name.replace('_', ' ')} {count}" for name, count in self._counts.items() if count]
        lines = {"in no message of the DBC": unknown, "dropped": dropped}
        return [f"{what}: {', '.join(words)}" for what, words in lines.items() if words]

    def _as_data(self, passed_ns: int, told: Sequence[MessageSummary]) -> dict[str, Any]:
        unknown: Counter[str] = Counter()
        for key, count in self._traffic.unknown.items():
            unknown[identifier_words(*key)] += count
        return {
            "passed_s": round(passed_ns / NS_PER_S, 3),
            "messages": [_message_data(each) for each in told],
            "unknown": unknown,
            "dropped": {name: count for name, count in self._counts.items() if count},
        }


def identifier_words(identifier: int, is_extended: bool) -> str:
    """Say an identifier as CAN tools do: three digits, or eight of one of 29 bits."""
    if (identifier, is_extended) == OTHER_IDENTIFIERS:
        return "others"
    return f"0x{identifier:0{8 if is_extended else 3}X}"


def _line(told: MessageSummary) -> str:
    facts = told.facts
    parts = [
        f"{facts.name} {identifier_words(facts.identifier, facts.is_extended)}  {told.frames} times, {_rate(told)}",
        ", ".join(_words(told)),
        f"changed: {', '.join(told.changed)}" if told.changed else "",
        f"WRONG: {'; '.join(told.wrong)}" if told.wrong else "",
    ]
    return "  ".join(part for part in parts if part)


def _rate(told: MessageSummary) -> str:
    nominal = f" of {NS_PER_S / told.facts.period_ns:g}" if told.facts.period_ns else ""
    return f"{told.rate_hz:.1f}{nominal} per s"


def _words(told: MessageSummary) -> list[str]:
    words = (signal_text(told.facts.signals[name], value) for name, value in told.values.items())
    return [each for each in words if each]


def _table(told: Sequence[MessageSummary], rest: Sequence[str]) -> Table:
    table = Table(expand=True, caption="\n".join([*rest, "? marks what is unverified; Ctrl-C ends"]))
    for heading in ("message", "", "per s", "says", "wrong"):
        table.add_column(heading, overflow="fold", ratio=4 if heading == "says" else None)
    for each in told:
        says = Text()
        for name, value in each.values.items():
            words = signal_text(each.facts.signals[name], value)
            says.append(f"{words}  " if words else "", style="bold yellow" if name in each.changed else "")
        table.add_row(
            each.facts.name,
            identifier_words(each.facts.identifier, each.facts.is_extended),
            f"{each.rate_hz:.1f}",
            says,
            Text("; ".join(each.wrong), style="bold red"),
        )
    return table


def _message_data(told: MessageSummary) -> dict[str, Any]:
    signals = told.facts.signals
    return {
        "message": told.facts.name,
        "identifier": told.facts.identifier,
        "is_extended": told.facts.is_extended,
        "frames": told.frames,
        "rate_hz": round(told.rate_hz, 2),
        "signals": {
            name: {
                "value": value,
                "unit": signals[name].unit,
                "name": None if value is None else signals[name].names.get(signals[name].number(value)),
                "unverified": signals[name].is_unverified,
            }
            for name, value in told.values.items()
        },
        "changed": told.changed,
        "wrong": told.wrong,
    }
