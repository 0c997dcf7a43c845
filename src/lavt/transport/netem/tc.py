"""Make the tc commands for flows, and parse what tc reports. This module runs no command.

The root of an interface becomes a `prio` qdisc with six bands. Filters send each impaired flow to its own band, which
has its own netem. All other traffic uses the first three bands, as with the kernel's default qdisc:

    root 4c56: prio ── 4c56:1 .. 4c56:3             all other traffic, not impaired
                    ├─ 4c56:4 netem 4c01: video     RTP and sender reports, but not path validation on the same port
                    ├─ 4c56:5 netem 4c02: control
                    └─ 4c56:6 netem 4c03: state

The handles identify LAVT's qdiscs. netem keeps packets in order only if it has a rate (measured; tc-netem(8) does not
mention it). So a flow without a requested rate gets 10 Gbit/s, which costs 1 us per packet. Then packets overtake
others only if `reorder` requests it; neither jitter nor a change to a shorter delay reorders packets. The emulated link
(`transport/emulation/link.py`) does the same.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, Literal, NamedTuple

from msgspec import Struct

from lavt.errors import WorkError
from lavt.transport.emulation.impairment import (
    ORDER_RATE_BPS,
    ImpairedFlow,
    Impairment,
    burst_probabilities,
    has_loss_bursts,
)

Command = list[str]
"""A command and its arguments."""

ROOT: Final = "4c56:"
"""Handle of LAVT's root qdisc, "LV" in ASCII."""
BANDS: Final = 6
MIN_LIMIT_PACKETS: Final = 10_000
LIMIT_PACKETS_PER_S: Final = 2_000
"""The queue limit for each second of delay. The video sends about 400 packets per second, the control 50."""
TC_STEP_MS: Final = 0.002
"""tc counts delays in microseconds, and each conversion loses up to one microsecond."""


class FlowPlacement(Struct, frozen=True):
    """Where a flow is delayed: its band, the handle of its netem, and the number of its first filter."""

    band: int
    handle: str
    filter_number: int

    @property
    def parent(self) -> str:
        """The band in tc's notation."""
        return f"{ROOT}{self.band}"


PLACES: Final[Mapping[str, FlowPlacement]] = {
    "video": FlowPlacement(4, "4c01:", 1),
    "control": FlowPlacement(5, "4c02:", 3),
    "state": FlowPlacement(6, "4c03:", 5),
}
"""Where each flow is delayed, by its name."""


class U32Match(Struct, frozen=True):
    """One match of a u32 filter: `text` is tc's input for the match, which tc reports as offset, bits and mask."""

    text: str
    offset: int
    bits: int
    mask: int

    @property
    def read_back(self) -> tuple[int, int, int]:
        """Offset, bits and mask, as tc reports them."""
        return self.offset, self.bits, self.mask


class TcFilter(Struct, frozen=True):
    """A u32 filter that sends matching packets of one IP version to a flow's band."""

    filter_number: int
    version: Literal["ip", "ipv6"]
    matches: tuple[U32Match, ...]
    parent: str


def filters(flow: ImpairedFlow) -> list[TcFilter]:
    """Return the filters of a flow, for IPv4 and for IPv6.

    They match only packets whose ports are at fixed offsets: unfragmented packets and first fragments, without IPv4
    options or IPv6 extension headers. On the video's port they match only payloads that begin like RTP and RTCP
    (version 2).
    """
    placement = PLACES[flow.name]
    protocol_number = {"udp": 17, "tcp": 6}[flow.protocol]
    direction, shift = {"source": ("sport", 16), "destination": ("dport", 0)}[flow.end]
    port_bits, port_mask = flow.port << shift, 0xFFFF << shift
    matches4: tuple[U32Match, ...] = (
        U32Match("u8 0x45 0xff at 0", 0, 0x45000000, 0xFF000000),
        U32Match("u16 0x0000 0x1fff at 6", 4, 0, 0x1FFF),
        U32Match(f"ip protocol {protocol_number} 0xff", 8, protocol_number << 16, 0xFF0000),
        U32Match(f"ip {direction} {flow.port} 0xffff", 20, port_bits, port_mask),
    )
    matches6: tuple[U32Match, ...] = (
        U32Match(f"ip6 protocol {protocol_number} 0xff", 4, protocol_number << 8, 0xFF00),
        U32Match(f"ip6 {direction} {flow.port} 0xffff", 40, port_bits, port_mask),
    )
    if flow.name == "video":
        matches4 += (U32Match("u8 0x80 0xc0 at 28", 28, 0x80000000, 0xC0000000),)
        matches6 += (U32Match("u8 0x80 0xc0 at 48", 48, 0x80000000, 0xC0000000),)
    return [
        TcFilter(placement.filter_number, "ip", matches4, placement.parent),
        TcFilter(placement.filter_number + 1, "ipv6", matches6, placement.parent),
    ]


def add_root(interface: str) -> Command:
    """Return the command that creates a root qdisc with bands for flows."""
    return ["tc", "qdisc", "add", "dev", interface, "root", "handle", ROOT, "prio", "bands", str(BANDS)]


def set_impairment(
    interface: str, name: str, impairment: Impairment, *, verb: Literal["add", "change"], tables: str = ""
) -> Command:
    """Return the command that sets a flow's impairment.

    It has all arguments, also those that are 0, because tc's `change` keeps the old value of some missing arguments.
    tc has no table of the uniform distribution; `tables` is the directory with LAVT's table.
    """
    placement = PLACES[name]
    uniform = (
        ["env", f"TC_LIB_DIR={tables}"] if impairment.jitter_ms and impairment.jitter_distribution == "uniform" else []
    )
    target = ["dev", interface, "parent", placement.parent, "handle", placement.handle]
    return [*uniform, "tc", "qdisc", verb, *target, *netem_arguments(impairment)]


def netem_arguments(impairment: Impairment) -> list[str]:
    """Return netem's arguments for an impairment. They leave out correlated jitter, which `CorrelatedJitter` makes."""
    limit = max(MIN_LIMIT_PACKETS, math.ceil(LIMIT_PACKETS_PER_S * impairment.longest_ms / 1000))
    arguments = ["netem", "limit", str(limit), "delay", f"{_plain(impairment.delay_ms)}ms"]
    if impairment.jitter_ms and not impairment.jitter_correlation:
        arguments += [f"{_plain(impairment.jitter_ms)}ms", "distribution", impairment.jitter_distribution]
    if impairment.loss and impairment.loss_burst_packets > 1:
        arguments += ["loss", "gemodel", *(f"{_plain(100 * share)}%" for share in burst_probabilities(impairment))]
    elif impairment.loss:
        arguments += ["loss", "random", f"{_plain(100 * impairment.loss)}%"]
    if impairment.reorder:
        arguments += ["reorder", f"{_plain(100 * impairment.reorder)}%"]
    return [*arguments, "rate", f"{impairment.rate_bps}bit" if impairment.rate_bps else "10gbit"]


def add_filter(interface: str, tc_filter: TcFilter) -> Command:
    """Return the command that adds a filter."""
    arguments = " ".join(f"match {match.text}" for match in tc_filter.matches)
    target = ["dev", interface, "parent", ROOT, "protocol", tc_filter.version, "prio", str(tc_filter.filter_number)]
    return ["tc", "filter", "add", *target, "u32", *arguments.split(), "classid", tc_filter.parent]


def delete_filter(interface: str, filter_number: int, version: str) -> Command:
    """Return the command that deletes one filter."""
    target = ["dev", interface, "parent", ROOT, "protocol", version, "prio", str(filter_number)]
    return ["tc", "filter", "del", *target, "u32"]


def delete_filters(interface: str) -> Command:
    """Return the command that deletes all filters."""
    return ["tc", "filter", "del", "dev", interface, "parent", ROOT]


def delete_root(interface: str) -> Command:
    """Return the command that deletes the root qdisc, so that the interface gets its default back."""
    return ["tc", "qdisc", "del", "dev", interface, "root"]


def show_qdiscs(interface: str) -> Command:
    """Return the command that lists the qdiscs."""
    return ["tc", "-j", "-s", "qdisc", "show", "dev", interface]


def show_filters(interface: str) -> Command:
    """Return the command that lists LAVT's filters, as text, because u32's JSON repeats a key."""
    return ["tc", "filter", "show", "dev", interface, "parent", ROOT]


def first_commands(interface: str, flows: Sequence[ImpairedFlow], *, tables: str = "") -> list[Command]:
    """Return all commands for an interface without qdiscs of LAVT."""
    commands = [add_root(interface)]
    for flow in flows:
        commands.append(set_impairment(interface, flow.name, flow.impairment, verb="add", tables=tables))
        commands += [add_filter(interface, tc_filter) for tc_filter in filters(flow)]
    return commands


def as_typed(command: Sequence[str]) -> str:
    """Return a command as it would be typed."""
    return shlex.join(command)


class Qdisc(Struct, frozen=True):
    """A queueing discipline as tc reports it; `parent` is "root" for the root."""

    kind: str
    handle: str
    parent: str
    options: Any
    waiting_packets: int


def parse_qdiscs(text: str) -> list[Qdisc]:
    """Parse the output of `tc -j -s qdisc show`. Raise `WorkError` for anything else."""
    try:
        return [
            Qdisc(
                str(entry["kind"]),
                str(entry["handle"]),
                "root" if entry.get("root") else str(entry.get("parent", "")),
                dict(entry.get("options") or {}),
                int(entry.get("qlen", 0)),
            )
            for entry in json.loads(text or "[]")
        ]
    except (ValueError, TypeError, KeyError, AttributeError, RecursionError) as error:
        raise WorkError(f"could not parse tc's list of qdiscs: {text[:200]!r}") from error


_FILTER: Final = re.compile(r"protocol (\S+) pref (\d+) u32 .*flowid (\S+)")
_MATCH: Final = re.compile(r"^\s*match ([0-9a-f]{8})/([0-9a-f]{8}) at (\d+)$")


class FoundFilter(NamedTuple):
    """A u32 filter as tc reports it."""

    number: int
    version: str
    """The IP version: "ip" or "ipv6"."""
    band: str
    matches: frozenset[tuple[int, int, int]]
    """Offset, bits and mask of each match."""


def parse_filters(text: str) -> list[FoundFilter]:
    """Parse the u32 filters in the output of `tc filter show`; other lines are skipped."""
    found: list[tuple[int, str, str, set[tuple[int, int, int]]]] = []
    last_matches: set[tuple[int, int, int]] = set()
    for line in text.splitlines():
        if (head := _FILTER.search(line)) is not None:
            version, number, band = head.groups()
            last_matches = set()
            found.append((int(number), version, band, last_matches))
        elif (match := _MATCH.match(line)) is not None:
            bits, mask, offset = match.groups()
            last_matches.add((int(offset), int(bits, 16), int(mask, 16)))
    return [FoundFilter(number, version, band, frozenset(matches)) for number, version, band, matches in found]


def expected_filter(tc_filter: TcFilter) -> FoundFilter:
    """Return the filter that tc should report for `tc_filter`."""
    matches = frozenset(match.read_back for match in tc_filter.matches)
    return FoundFilter(tc_filter.filter_number, tc_filter.version, tc_filter.parent, matches)


def parse_impairment(options: Mapping[str, Any]) -> Impairment:
    """Return the impairment of a netem's options. tc does not report the distribution; the result has the normal one.

    Raise `WorkError` for options that are not netem's.
    """
    try:
        delay = options.get("delay", {})
        loss, burst = float(options.get("loss-random", {}).get("loss", 0.0)), 0.0
        if (model := options.get("loss-gemodel")) is not None:
            p_begin, p_end = float(model["p"]), float(model["r"])
            loss, burst = p_begin / (p_begin + p_end), 1 / p_end
        rate_bps = 8 * int(options.get("rate", {}).get("rate", 0))
        return Impairment(
            delay_ms=1000 * float(delay.get("delay", 0.0)),
            jitter_ms=1000 * float(delay.get("jitter", 0.0)),
            loss=loss,
            loss_burst_packets=burst,
            rate_bps=0 if rate_bps == ORDER_RATE_BPS else rate_bps,
            reorder=float(options["reorder"]["reorder"]) if options.get("gap") else 0.0,
        )
    except (ValueError, TypeError, KeyError, AttributeError, ZeroDivisionError) as error:
        raise WorkError(f"could not parse tc's options of a netem: {str(options)[:200]!r}") from error


def difference(flow: ImpairedFlow, qdiscs: Iterable[Qdisc], found: Iterable[FoundFilter]) -> list[str]:
    """Compare a flow with tc's report, and return a message for each difference."""
    placement, requested = PLACES[flow.name], flow.impairment
    netem = next((qdisc for qdisc in qdiscs if qdisc.handle == placement.handle), None)
    if netem is None or netem.kind != "netem" or netem.parent != placement.parent:
        return [f"{flow.description} has no netem"]
    actual_impairment = parse_impairment(netem.options)
    # With correlated jitter, LAVT changes netem's delay in steps, and netem itself has no jitter. The delay stays less
    # than 8 standard deviations from the requested one.
    is_correlated = bool(requested.jitter_correlation)
    burst_packets = requested.loss_burst_packets * has_loss_bursts(requested)
    delay_tolerance_ms = TC_STEP_MS + 8 * requested.jitter_ms * is_correlated
    jitter_ms = 0.0 if is_correlated else requested.jitter_ms
    reasons = [
        f"{flow.description}: {name} is {actual:g} instead of {expected:g}"
        for name, actual, expected, tolerance in (
            ("delay_ms", actual_impairment.delay_ms, requested.delay_ms, delay_tolerance_ms),
            ("jitter_ms", actual_impairment.jitter_ms, jitter_ms, TC_STEP_MS),
            ("loss", actual_impairment.loss, requested.loss, 1e-5),
            ("loss_burst_packets", actual_impairment.loss_burst_packets, burst_packets, 1e-3),
            ("rate_bps", actual_impairment.rate_bps, requested.rate_bps, 8),
            ("reorder", actual_impairment.reorder, requested.reorder, 1e-5),
        )
        if abs(actual - expected) > tolerance + 1e-5 * expected
    ]
    if int(netem.options.get("limit", 0)) < MIN_LIMIT_PACKETS:
        reasons.append(f"{flow.description}: its queue limit is only {netem.options.get('limit')} packets")
    if not netem.options.get("rate"):
        reasons.append(f"{flow.description}: it has no rate, so packets overtake each other")
    actual_filters = set(found)
    reasons += [
        f"{flow.description} has no filter for {tc_filter.version}"
        for tc_filter in filters(flow)
        if expected_filter(tc_filter) not in actual_filters
    ]
    return reasons


def uniform_table() -> str:
    """Return the uniform distribution as a table for tc; half of its width is 8192."""
    return "# uniform, for tc netem\n" + "".join(f"{number}\n" for number in range(-8192, 8193, 16))


def _plain(number: float) -> str:
    """Format a number without an exponent, to tc's precision."""
    return f"{number:.6f}".rstrip("0").rstrip(".") or "0"
