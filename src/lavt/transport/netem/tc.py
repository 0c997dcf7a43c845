"""What tc is told and what it says: commands for laws and flows, and their reading back. Nothing is run here.

The queue of an interface becomes a `prio` with six bands. Everything goes through the first three, as it did before by
the kernel's own rule; a flow that is to be held is sent by a filter to a band of its own, with a netem of its own:

    root 4c56: prio ── 4c56:1 .. 4c56:3   everything else, untouched
                    ├─ 4c56:4 netem 4c01: video     RTP and sender reports, not the challenges of its path
                    ├─ 4c56:5 netem 4c02: control
                    └─ 4c56:6 netem 4c03: state

Handles are our own, so that ours is known from somebody else's. netem keeps order only where it has a rate (measured;
tc-netem(8) does not say so): a flow without one gets 10 Gbit/s, which costs a packet a microsecond. So nothing
overtakes where that is not asked for, neither by jitter nor when a delay becomes shorter, as in
`transport/emulation/delay_line.py`.
"""

from __future__ import annotations

import json
import math
import re
import shlex
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final, Literal

from lavt.errors import WorkError
from lavt.transport.emulation.impairment import ORDER_RATE_BPS, ImpairedFlow, Impairment, bursts, gilbert
from lavt.value import value

Command = list[str]
"""A command and its arguments."""

ROOT: Final = "4c56:"
"""Handle of our root, "LV" in ASCII: what has it is ours."""
BANDS: Final = 6
LEAST_LIMIT_PACKETS: Final = 10_000
PACKETS_PER_S: Final = 2_000
"""Room for so many packets in each second of delay; the video has about 400 in a second, the control 50."""
TC_STEP_MS: Final = 0.002
"""tc counts delays in microseconds, and loses up to one in each conversion."""


@value
class FlowPlacement:
    """Where a flow's packets are held: the band, the handle of its netem, and the first of its filters' numbers."""

    band: int
    handle: str
    number: int

    @property
    def parent(self) -> str:
        """The band as tc names it."""
        return f"{ROOT}{self.band}"


PLACES: Final[Mapping[str, FlowPlacement]] = {
    "video": FlowPlacement(4, "4c01:", 1),
    "control": FlowPlacement(5, "4c02:", 3),
    "state": FlowPlacement(6, "4c03:", 5),
}


@value
class U32Match:
    """One condition of a u32 filter: as tc is told it, and as it is read back, 32 bits at an offset."""

    text: str
    offset: int
    bits: int
    mask: int

    @property
    def read_back(self) -> tuple[int, int, int]:
        """Offset, bits and mask."""
        return self.offset, self.bits, self.mask


@value
class TcFilter:
    """Sends the packets of one IP version that match to a flow's band."""

    number: int
    version: Literal["ip", "ipv6"]
    matches: tuple[U32Match, ...]
    parent: str


def filters(flow: ImpairedFlow) -> list[TcFilter]:
    """Give the filters of a flow, for IPv4 and for IPv6.

    Whole packets only (no fragments but the first, no IPv4 options, no IPv6 extension headers): the bytes looked at are
    then what they are taken for. Of the video's port only what begins like RTP and RTCP, whose version is 2.
    """
    place = PLACES[flow.name]
    number = {"udp": 17, "tcp": 6}[flow.protocol]
    direction, shift = {"source": ("sport", 16), "destination": ("dport", 0)}[flow.end]
    port_bits, port_mask = flow.port << shift, 0xFFFF << shift
    matches4: tuple[U32Match, ...] = (
        U32Match("u8 0x45 0xff at 0", 0, 0x45000000, 0xFF000000),
        U32Match("u16 0x0000 0x1fff at 6", 4, 0, 0x1FFF),
        U32Match(f"ip protocol {number} 0xff", 8, number << 16, 0xFF0000),
        U32Match(f"ip {direction} {flow.port} 0xffff", 20, port_bits, port_mask),
    )
    matches6: tuple[U32Match, ...] = (
        U32Match(f"ip6 protocol {number} 0xff", 4, number << 8, 0xFF00),
        U32Match(f"ip6 {direction} {flow.port} 0xffff", 40, port_bits, port_mask),
    )
    if flow.name == "video":
        matches4 += (U32Match("u8 0x80 0xc0 at 28", 28, 0x80000000, 0xC0000000),)
        matches6 += (U32Match("u8 0x80 0xc0 at 48", 48, 0x80000000, 0xC0000000),)
    return [
        TcFilter(place.number, "ip", matches4, place.parent),
        TcFilter(place.number + 1, "ipv6", matches6, place.parent),
    ]


def add_root(interface: str) -> Command:
    """Give the command that makes room for flows of their own."""
    return ["tc", "qdisc", "add", "dev", interface, "root", "handle", ROOT, "prio", "bands", str(BANDS)]


def set_impairment(
    interface: str, name: str, impairment: Impairment, *, verb: Literal["add", "change"], tables: str = ""
) -> Command:
    """Give the command that gives a flow its law, with all arguments: `change` keeps some that are not named.

    `tables` is the directory of our own table of the uniform distribution, which tc has not: without any table a
    change would keep that of the law before.
    """
    place = PLACES[name]
    uniform = (
        ["env", f"TC_LIB_DIR={tables}"] if impairment.jitter_ms and impairment.jitter_distribution == "uniform" else []
    )
    return [
        *uniform, "tc", "qdisc", verb, "dev", interface, "parent", place.parent, "handle", place.handle,
        *netem_arguments(impairment),
    ]  # fmt: skip


def netem_arguments(impairment: Impairment) -> list[str]:
    """Give netem's own arguments for a law; what wanders (correlated jitter) is not netem's."""
    limit = max(LEAST_LIMIT_PACKETS, math.ceil(PACKETS_PER_S * impairment.longest_ms / 1000))
    words = ["netem", "limit", str(limit), "delay", f"{_plain(impairment.delay_ms)}ms"]
    if impairment.jitter_ms and not impairment.jitter_correlation:
        words += [f"{_plain(impairment.jitter_ms)}ms", "distribution", impairment.jitter_distribution]
    if impairment.loss and impairment.loss_burst_packets > 1:
        words += ["loss", "gemodel", *(f"{_plain(100 * share)}%" for share in gilbert(impairment))]
    elif impairment.loss:
        words += ["loss", "random", f"{_plain(100 * impairment.loss)}%"]
    if impairment.reorder:
        words += ["reorder", f"{_plain(100 * impairment.reorder)}%"]
    return [*words, "rate", f"{impairment.rate_bps}bit" if impairment.rate_bps else "10gbit"]


def add_filter(interface: str, each: TcFilter) -> Command:
    """Give the command that sends what matches to its band."""
    words = " ".join(f"match {match.text}" for match in each.matches)
    return [
        "tc", "filter", "add", "dev", interface, "parent", ROOT, "protocol", each.version, "prio", str(each.number),
        "u32", *words.split(), "classid", each.parent,
    ]  # fmt: skip


def delete_filter(interface: str, number: int, version: str) -> Command:
    """Give the command that takes one filter away."""
    return [
        "tc", "filter", "del", "dev", interface, "parent", ROOT, "protocol", version, "prio", str(number), "u32",
    ]  # fmt: skip


def delete_filters(interface: str) -> Command:
    """Give the command that takes all filters away."""
    return ["tc", "filter", "del", "dev", interface, "parent", ROOT]


def delete_root(interface: str) -> Command:
    """Give the command after which the interface has its own queue again."""
    return ["tc", "qdisc", "del", "dev", interface, "root"]


def show_qdiscs(interface: str) -> Command:
    """Give the command that tells the queues."""
    return ["tc", "-j", "-s", "qdisc", "show", "dev", interface]


def show_filters(interface: str) -> Command:
    """Give the command that tells our filters; as text, as the JSON of u32 has one key several times."""
    return ["tc", "filter", "show", "dev", interface, "parent", ROOT]


def first_commands(interface: str, flows: Sequence[ImpairedFlow], *, tables: str = "") -> list[Command]:
    """Give all commands for an interface that has nothing of ours."""
    commands = [add_root(interface)]
    for flow in flows:
        commands.append(set_impairment(interface, flow.name, flow.impairment, verb="add", tables=tables))
        commands += [add_filter(interface, each) for each in filters(flow)]
    return commands


def as_typed(command: Sequence[str]) -> str:
    """Give a command as one would type it."""
    return shlex.join(command)


@value
class Qdisc:
    """A queue as tc tells it; `parent` is "root" for the root."""

    kind: str
    handle: str
    parent: str
    options: Any
    waiting_packets: int


def parse_qdiscs(text: str) -> list[Qdisc]:
    """Read what `tc -j -s qdisc show` prints; raises `WorkError` for anything else."""
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
        raise WorkError(f"tc told its queues in words that are not understood: {text[:200]!r}") from error


_FILTER: Final = re.compile(r"protocol (\S+) pref (\d+) u32 .*flowid (\S+)")
_MATCH: Final = re.compile(r"^\s*match ([0-9a-f]{8})/([0-9a-f]{8}) at (\d+)$")

FoundFilter = tuple[int, str, str, frozenset[tuple[int, int, int]]]
"""Number, IP version, band, and what it matches: (offset, bits, mask) each."""


def parse_filters(text: str) -> list[FoundFilter]:
    """Read the u32 filters out of what `tc filter show` prints; other lines are passed over."""
    found: list[tuple[int, str, str, set[tuple[int, int, int]]]] = []
    for line in text.splitlines():
        if (head := _FILTER.search(line)) is not None:
            found.append((int(head[2]), head[1], head[3], set()))
        elif (match := _MATCH.match(line)) is not None and found:
            found[-1][3].add((int(match[3]), int(match[1], 16), int(match[2], 16)))
    return [(number, version, band, frozenset(matches)) for number, version, band, matches in found]


def expected_filter(each: TcFilter) -> FoundFilter:
    """Give a filter as it is read back."""
    return each.number, each.version, each.parent, frozenset(match.read_back for match in each.matches)


def parse_impairment(options: Mapping[str, Any]) -> Impairment:
    """Give the law that a netem's options tell; the distribution is not told, and counts as normal.

    Raises `WorkError` for options that are not netem's.
    """
    try:
        delay = options.get("delay", {})
        loss, burst = float(options.get("loss-random", {}).get("loss", 0.0)), 0.0
        if (model := options.get("loss-gemodel")) is not None:
            into, out_of = float(model["p"]), float(model["r"])
            loss, burst = into / (into + out_of), 1 / out_of
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
        raise WorkError(f"tc told a netem in words that are not understood: {str(options)[:200]!r}") from error


def difference(flow: ImpairedFlow, qdiscs: Iterable[Qdisc], found: Iterable[FoundFilter]) -> list[str]:
    """Compare a flow with what was read back, in sentences; an empty list is as asked."""
    place, requested = PLACES[flow.name], flow.impairment
    netem = next((each for each in qdiscs if each.handle == place.handle), None)
    if netem is None or netem.kind != "netem" or netem.parent != place.parent:
        return [f"{flow.description} has no netem"]
    is_ = parse_impairment(netem.options)
    wanders = bool(requested.jitter_correlation)  # then the delay is where it has got to, and no jitter of netem's
    reasons = [
        f"{flow.description}: {name} is {there:g} where {wanted:g} was asked"
        for name, there, wanted, step in (
            ("delay_ms", is_.delay_ms, requested.delay_ms, TC_STEP_MS + 8 * requested.jitter_ms * wanders),
            ("jitter_ms", is_.jitter_ms, 0.0 if wanders else requested.jitter_ms, TC_STEP_MS),
            ("loss", is_.loss, requested.loss, 1e-5),
            ("loss_burst_packets", is_.loss_burst_packets, requested.loss_burst_packets * bursts(requested), 1e-3),
            ("rate_bps", is_.rate_bps, requested.rate_bps, 8),
            ("reorder", is_.reorder, requested.reorder, 1e-5),
        )
        if abs(there - wanted) > step + 1e-5 * wanted
    ]  # fmt: skip
    if int(netem.options.get("limit", 0)) < LEAST_LIMIT_PACKETS:
        reasons.append(f"{flow.description}: room for {netem.options.get('limit')} packets only")
    if not netem.options.get("rate"):
        reasons.append(f"{flow.description}: has no rate, so packets overtake each other")
    there_filters = set(found)
    reasons += [
        f"{flow.description} has no filter for {each.version}"
        for each in filters(flow)
        if expected_filter(each) not in there_filters
    ]
    return reasons


def uniform_table() -> str:
    """Give tc's table of the uniform distribution: the half width is 8192."""
    return "# uniform, for tc netem\n" + "".join(f"{number}\n" for number in range(-8192, 8193, 16))


def _plain(number: float) -> str:
    """Write a number without an exponent, to the precision that tc has."""
    return f"{number:.6f}".rstrip("0").rstrip(".") or "0"
