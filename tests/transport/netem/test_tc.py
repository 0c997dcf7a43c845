from __future__ import annotations

import errno
import json
import os
import socket
import threading
from collections.abc import Callable
from dataclasses import asdict
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.support.clocks import ManualClock

from lavt.assembly.injection import netem_flows
from lavt.clock import MachineClock, pause
from lavt.config_file import condition
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError, WorkError
from lavt.transport.emulation.impairment import (
    DISTRIBUTIONS,
    ExemptPort,
    ImpairedFlow,
    Impairment,
    check_flows,
    check_netem_impairment,
)
from lavt.transport.netem.correlated_jitter import CorrelatedJitter, next_deviation
from lavt.transport.netem.netem import NetemInterface, run_tc
from lavt.transport.netem.probe import ProbeResult, judge, measure, probes, summarize
from lavt.transport.netem.state import (
    NO_OWNER,
    AppliedState,
    Owner,
    StateFiles,
    boot_id,
    current_process,
    flows_from,
    network_namespace,
    start_ticks,
)
from lavt.transport.netem.tc import (
    Command,
    Qdisc,
    as_typed,
    difference,
    expected_filter,
    filters,
    first_commands,
    netem_arguments,
    parse_filters,
    parse_impairment,
    parse_qdiscs,
    set_impairment,
)

VIDEO = ImpairedFlow("video", "udp", 5600, "source", Impairment(150))
CONTROL = ImpairedFlow("control", "udp", 7448, "destination", Impairment(75))

QDISCS = json.dumps([
    {"kind": "prio", "handle": "4c56:", "root": True, "options": {"bands": 6}, "qlen": 0},
    {
        "kind": "netem", "handle": "4c01:", "parent": "4c56:4", "qlen": 7,
        "options": {"limit": 10000, "delay": {"delay": 0.15, "jitter": 0, "correlation": 0},
                    "rate": {"rate": 1250000000}, "ecn": False, "gap": 0},
    },
])  # fmt: skip
FREE = '[{"kind":"noqueue","handle":"0:","root":true,"refcnt":2,"options":{}}]'
FILTERS = """filter protocol ip pref 1 u32 chain 0
filter protocol ip pref 1 u32 chain 0 fh 800: ht divisor 1
filter protocol ip pref 1 u32 chain 0 fh 800::800 order 2048 key ht 800 bkt 0 *flowid 4c56:4 not_in_hw
  match 45000000/ff000000 at 0
  match 00000000/00001fff at 4
  match 00110000/00ff0000 at 8
  match 15e00000/ffff0000 at 20
  match 80000000/c0000000 at 28
filter protocol ipv6 pref 2 u32 chain 0 fh 801::800 order 2048 key ht 801 bkt 0 flowid 4c56:4 not_in_hw
  match 00001100/0000ff00 at 4
  match 15e00000/ffff0000 at 40
  match 80000000/c0000000 at 48
"""


def test_the_commands_of_a_condition_are_these() -> None:
    """L4 with the state held on one machine is three netems behind a prio of six bands, and two filters for each."""
    flows = netem_flows(condition("L4"), "both", video_port=5600, control_port=7448, state_delay="with_video")
    ip = "u32 match u8 0x45 0xff at 0 match u16 0x0000 0x1fff at 6"
    assert [as_typed(each) for each in first_commands("eth0", flows)] == [
        "tc qdisc add dev eth0 root handle 4c56: prio bands 6",
        "tc qdisc add dev eth0 parent 4c56:4 handle 4c01: netem limit 10000 delay 150ms rate 10gbit",
        f"tc filter add dev eth0 parent 4c56: protocol ip prio 1 {ip} match ip protocol 17 0xff "
        "match ip sport 5600 0xffff match u8 0x80 0xc0 at 28 classid 4c56:4",
        "tc filter add dev eth0 parent 4c56: protocol ipv6 prio 2 u32 match ip6 protocol 17 0xff "
        "match ip6 sport 5600 0xffff match u8 0x80 0xc0 at 48 classid 4c56:4",
        "tc qdisc add dev eth0 parent 4c56:5 handle 4c02: netem limit 10000 delay 75ms rate 10gbit",
        f"tc filter add dev eth0 parent 4c56: protocol ip prio 3 {ip} match ip protocol 17 0xff "
        "match ip dport 7448 0xffff classid 4c56:5",
        "tc filter add dev eth0 parent 4c56: protocol ipv6 prio 4 u32 match ip6 protocol 17 0xff "
        "match ip6 dport 7448 0xffff classid 4c56:5",
        "tc qdisc add dev eth0 parent 4c56:6 handle 4c03: netem limit 10000 delay 150ms rate 10gbit",
        f"tc filter add dev eth0 parent 4c56: protocol ip prio 5 {ip} match ip protocol 17 0xff "
        "match ip sport 7448 0xffff classid 4c56:6",
        "tc filter add dev eth0 parent 4c56: protocol ipv6 prio 6 u32 match ip6 protocol 17 0xff "
        "match ip6 sport 7448 0xffff classid 4c56:6",
    ]


@pytest.mark.parametrize(
    ("impairment", "words"),
    [
        (Impairment(), "delay 0ms rate 10gbit"),
        (Impairment(75, 10), "delay 75ms 10ms distribution normal rate 10gbit"),
        (Impairment(75, 10, jitter_correlation=0.9), "delay 75ms rate 10gbit"),
        (Impairment(75, 10, jitter_distribution="pareto"), "delay 75ms 10ms distribution pareto rate 10gbit"),
        (Impairment(75, loss=0.1), "delay 75ms loss random 10% rate 10gbit"),
        (Impairment(75, loss=0.1, loss_burst_packets=5), "delay 75ms loss gemodel 2.222222% 20% rate 10gbit"),
        (Impairment(75, rate_bps=2_000_000), "delay 75ms rate 2000000bit"),
        (Impairment(75, reorder=0.25), "delay 75ms reorder 25% rate 10gbit"),
        (Impairment(0.123), "delay 0.123ms rate 10gbit"),
    ],
)
def test_a_law_in_the_words_of_netem(impairment: Impairment, words: str) -> None:
    """Each law has exactly these arguments, always with limit, delay and rate, as a change keeps what is not named."""
    assert " ".join(netem_arguments(impairment)) == f"netem limit 10000 {words}"


def test_a_long_delay_has_room_for_its_packets() -> None:
    """Of 60 s of delay, 2000 packets a second have room; of less than 5 s there are 10 000."""
    assert netem_arguments(Impairment(60_000))[:3] == ["netem", "limit", "120000"]
    assert netem_arguments(Impairment(4_900))[:3] == ["netem", "limit", "10000"]


def test_a_uniform_law_names_the_directory_of_its_table() -> None:
    """A uniform jitter is given by a table of ours: without any, a change would keep that of the law before."""
    command = set_impairment(
        "lo", "video", Impairment(75, 10, jitter_distribution="uniform"), verb="change", tables="/run/lavt"
    )
    assert command[:3] == ["env", "TC_LIB_DIR=/run/lavt", "tc"]
    assert command[-5:-2] == ["10ms", "distribution", "uniform"]


def options_of(words: list[str]) -> dict[str, Any]:
    """Tell what tc tells of a netem that was made with these arguments: our own little tc."""
    text = " ".join(words[3:])
    numbers = [float(word.rstrip("%gmbits")) for word in words if word[0].isdigit()]
    options: dict[str, Any] = {"limit": int(words[2]), "gap": 0}
    rest = iter(numbers[1:])
    options["delay"] = {"delay": next(rest) / 1000, "jitter": 0.0}
    if "distribution" in text:
        options["delay"]["jitter"] = next(rest) / 1000
    if "random" in text:
        options["loss-random"] = {"loss": next(rest) / 100}
    if "gemodel" in text:
        options["loss-gemodel"] = {"p": next(rest) / 100, "r": next(rest) / 100}
    if "reorder" in text:
        options |= {"reorder": {"reorder": next(rest) / 100}, "gap": 1}
    options["rate"] = {"rate": 1_250_000_000 if text.endswith("10gbit") else int(next(rest)) // 8}
    return options


IMPAIRMENTS = st.builds(
    Impairment,
    delay_ms=st.floats(1, 1000),
    jitter_ms=st.just(0.0) | st.floats(0.1, 1),
    jitter_distribution=st.sampled_from(DISTRIBUTIONS),
    loss=st.just(0.0) | st.floats(0.001, 0.3),
    loss_burst_packets=st.just(0.0) | st.floats(1.5, 50),
    rate_bps=st.just(0) | st.integers(1000, 9_999_999_999),
    reorder=st.just(0.0) | st.floats(0.001, 0.9),
)


@given(IMPAIRMENTS)
def test_any_law_is_read_back_as_it_was_told(impairment: Impairment) -> None:
    """What a netem tells that was given the arguments of a law does not differ from that law."""
    options = options_of(netem_arguments(impairment))
    there = [Qdisc("prio", "4c56:", "root", {}, 0), Qdisc("netem", "4c01:", "4c56:4", options, 0)]
    flow = ImpairedFlow("video", "udp", 5600, "source", impairment)
    assert difference(flow, there, [expected_filter(each) for each in filters(flow)]) == []
    if impairment.loss and impairment.loss_burst_packets > 1:
        assert parse_impairment(options).loss_burst_packets == pytest.approx(impairment.loss_burst_packets, rel=1e-3)


def test_what_tc_tells_is_read() -> None:
    """Queues are read from JSON and filters from text, as iproute2 6.1 writes them, and agree with what was asked."""
    qdiscs, found = parse_qdiscs(QDISCS), parse_filters(FILTERS)

    assert [(each.kind, each.handle, each.parent, each.waiting_packets) for each in qdiscs] == [
        ("prio", "4c56:", "root", 0),
        ("netem", "4c01:", "4c56:4", 7),
    ]
    assert parse_impairment(qdiscs[1].options) == Impairment(150)
    assert found == [expected_filter(each) for each in filters(VIDEO)]
    assert difference(VIDEO, qdiscs, found) == []


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"delay": {"delay": 0.1}}, "delay_ms is 100 where 150 was asked"),
        ({"limit": 1000}, "room for 1000 packets only"),
        ({"rate": {}}, "packets overtake each other"),
        ({"loss-random": {"loss": 0.5}}, "loss is 0.5 where 0 was asked"),
    ],
)
def test_what_differs_is_said(change: dict[str, Any], said: str) -> None:
    """A delay, loss or limit that is not as asked is said, and so is a missing filter, netem or rate."""
    qdiscs = parse_qdiscs(QDISCS)
    qdiscs[1].options.update(change)
    reasons = " ".join(difference(VIDEO, qdiscs, parse_filters(FILTERS)))

    assert said in reasons
    assert "has no filter for ipv6" in " ".join(difference(VIDEO, qdiscs, parse_filters(FILTERS)[:1]))
    assert difference(CONTROL, qdiscs, []) == ["control (udp destination port 7448) has no netem"]


@given(st.text())
def test_garbage_from_tc_is_an_error_of_ours(text: str) -> None:
    """Whatever tc says instead of JSON is a `WorkError`, and text without filters has none."""
    try:
        qdiscs = parse_qdiscs(text)
    except WorkError:
        qdiscs = []
    assert qdiscs == []
    assert parse_filters(text) == []


@pytest.mark.parametrize("text", ["[1]", '{"kind": 1}', '[{"kind": "x"}]', '[{"kind":"x","handle":"1:","qlen":"a"}]'])
def test_other_json_from_tc_is_an_error_of_ours(text: str) -> None:
    """JSON that does not hold queues is a `WorkError`."""
    with pytest.raises(WorkError, match="not understood"):
        parse_qdiscs(text)


@pytest.mark.parametrize("options", [{"delay": 3}, {"delay": {"delay": "x"}}, {"loss-gemodel": {}}, {"gap": 1}])
def test_other_options_from_tc_are_an_error_of_ours(options: dict[str, Any]) -> None:
    """Options that are not a netem's are a `WorkError`."""
    with pytest.raises(WorkError, match="not understood"):
        parse_impairment(options)


@pytest.mark.parametrize(
    ("impairment", "said"),
    [
        (Impairment(-1), "below zero"),
        (Impairment(float("nan")), "below zero or infinite"),
        (Impairment(5, loss=1), "shares below 1"),
        (Impairment(5, jitter_ms=6), "delays below zero"),
        (Impairment(0, reorder=0.1), "needs a delay"),
        (Impairment(5, loss=0.9, loss_burst_packets=2), "longer bursts or less loss"),
        (Impairment(5, rate_bps=4), "rate_bps"),
        (Impairment(5, 1, 0.5, "pareto"), "correlated jitter is normal"),
        (Impairment(5, 1, 0, "poisson"), "one of normal, uniform"),  # type: ignore[arg-type]
    ],
)
def test_what_netem_cannot_do_is_rejected(impairment: Impairment, said: str) -> None:
    """A law that netem cannot do is refused in one sentence that names the flow."""
    with pytest.raises(UserError, match=said) as rejected:
        check_netem_impairment("video", impairment)
    assert str(rejected.value).startswith("video: ")


@pytest.mark.parametrize(
    ("flows", "said"),
    [
        ([ImpairedFlow("video", "udp", 5602, "source", Impairment(5))], "would cover the clock probe"),
        ([ImpairedFlow("control", "udp", 5602, "destination", Impairment(5))], "would cover the clock probe"),
        ([ImpairedFlow("video", "udp", 123, "source", Impairment(5))], "would cover NTP"),
        ([ImpairedFlow("control", "tcp", 22, "destination", Impairment(5))], "would cover ssh"),
        ([ImpairedFlow("video", "udp", 0, "source", Impairment(5))], "is no port"),
        ([VIDEO, ImpairedFlow("state", "udp", 5600, "source", Impairment(5))], "the same packets as video"),
        ([], "no flow"),
    ],
)
def test_flows_that_must_not_be_held_are_rejected(flows: list[ImpairedFlow], said: str) -> None:
    """A flow on a port of NTP, ssh or the clock probe is refused at either end, as are two with the same packets."""
    with pytest.raises(UserError, match=said):
        check_flows(flows, [ExemptPort("udp", 5602, "the clock probe")])


class Tc:
    """A tc that tells what it is given and notes what it is told."""

    def __init__(self, qdiscs: str = FREE, filters_told: str = "") -> None:
        self.qdiscs, self.filters_told, self.told = qdiscs, filters_told, list[str]()
        self.rejects: Callable[[Command], bool] = lambda _command: False

    def __call__(self, command: Command) -> str:
        """Run a command."""
        if "show" in command:
            return self.filters_told if "filter" in command else self.qdiscs
        if self.rejects(command):
            raise WorkError("rejected")
        self.told.append(" ".join(command))
        return ""


def test_a_change_touches_only_what_differs(tmp_path: Path) -> None:
    """A new delay is one change and no filter; what is no longer asked for is held no more, and its filters go."""
    tc = Tc(QDISCS, FILTERS)
    netem = NetemInterface("eth0", directory=tmp_path, run=tc, persistent=True)
    netem.apply([ImpairedFlow("video", "udp", 5600, "source", Impairment(30))])
    one = list(tc.told)
    netem.apply([CONTROL])

    assert one == ["tc qdisc change dev eth0 parent 4c56:4 handle 4c01: netem limit 10000 delay 30ms rate 10gbit"]
    assert [each.split(" u32")[0] for each in tc.told[1:]] == [
        "tc qdisc change dev eth0 parent 4c56:4 handle 4c01: netem limit 10000 delay 0ms rate 10gbit",
        "tc qdisc add dev eth0 parent 4c56:5 handle 4c02: netem limit 10000 delay 75ms rate 10gbit",
        "tc filter del dev eth0 parent 4c56: protocol ip prio 1",
        "tc filter del dev eth0 parent 4c56: protocol ipv6 prio 2",
        "tc filter add dev eth0 parent 4c56: protocol ip prio 3",
        "tc filter add dev eth0 parent 4c56: protocol ipv6 prio 4",
    ]


def test_a_first_application_that_fails_is_undone(tmp_path: Path) -> None:
    """Where a filter is refused on a free interface, the root is deleted again and nothing is written down."""
    tc = Tc()
    tc.rejects = lambda command: "filter" in command
    netem = NetemInterface("eth0", directory=tmp_path, run=tc)
    with pytest.raises(WorkError, match="rejected"):
        netem.apply([VIDEO])

    assert tc.told[-1] == "tc qdisc del dev eth0 root"
    assert netem.applied() is None


def test_somebody_elses_root_is_rejected(tmp_path: Path) -> None:
    """A root with a handle that is not ours is refused, and tc is told nothing."""
    tc = Tc('[{"kind":"fq_codel","handle":"8001:","root":true}]')
    netem = NetemInterface("eth0", directory=tmp_path, run=tc)
    uses: list[Callable[[], object]] = [lambda: netem.apply([VIDEO]), lambda: netem.clear(any_owner=True), netem.check]
    for use in uses:
        with pytest.raises(UserError, match=r"\(fq_codel 8001:\)"):
            use()
    assert tc.told == []


def test_what_another_program_owns_is_rejected(tmp_path: Path) -> None:
    """A delay that a living process owns, or that was left in place, is not changed by another program of ours."""
    tc = Tc(QDISCS, FILTERS)
    owner = os.getppid(), start_ticks(os.getppid())
    StateFiles(tmp_path).write(AppliedState("eth0", network_namespace(), boot_id(), owner, "L3", (VIDEO,)))
    with pytest.raises(UserError, match=f"there is L3 on eth0, of process {owner[0]}"):
        NetemInterface("eth0", directory=tmp_path, run=tc).apply([VIDEO])
    StateFiles(tmp_path).remove("eth0")
    with pytest.raises(UserError, match="a delay on eth0, left in place"):
        NetemInterface("eth0", directory=tmp_path, run=tc).check()
    assert tc.told == []


@pytest.mark.parametrize("owner", [(os.getppid(), start_ticks(os.getppid())), NO_OWNER, None])
def test_what_somebody_else_owns_is_cleared_only_on_demand(tmp_path: Path, owner: Owner | None) -> None:
    """A program clears neither another's delay nor one left in place, with a file or without; on demand it does."""
    tc, files = Tc(QDISCS, FILTERS), StateFiles(tmp_path)
    if owner is not None:
        files.write(AppliedState("eth0", network_namespace(), boot_id(), owner, "L3", (VIDEO,)))
    there = files.read("eth0")
    with pytest.raises(UserError, match="there is"), NetemInterface("eth0", directory=tmp_path, run=tc) as netem:
        netem.check()

    assert netem.clear() == []
    assert tc.told == []
    assert files.read("eth0") == there
    assert netem.clear(at_once=True, any_owner=True) == [["tc", "qdisc", "del", "dev", "eth0", "root"]]
    assert files.read("eth0") is None


@pytest.mark.parametrize("written", [True, False])
def test_what_was_left_in_place_is_cleared_by_who_leaves_in_place(tmp_path: Path, written: bool) -> None:
    """What `lavt netem apply` or a script left, the command that leaves in place owns, and clears."""
    tc = Tc(QDISCS, FILTERS)
    if written:
        StateFiles(tmp_path).write(AppliedState("eth0", network_namespace(), boot_id(), NO_OWNER, "L3", (VIDEO,)))
    assert NetemInterface("eth0", directory=tmp_path, run=tc, persistent=True).clear(at_once=True) != []


@pytest.mark.parametrize("dead", [{"boot": "an earlier boot"}, {"owner": (2**22 + 1, 5)}, {"owner": (os.getpid(), 5)}])
def test_what_the_dead_left_is_taken_away(tmp_path: Path, dead: dict[str, Any]) -> None:
    """What belongs to an earlier boot, or a process that is no more, is cleared, also where its number came again."""
    tc = Tc(QDISCS, FILTERS)
    fields = {"boot": boot_id(), "owner": current_process(), **dead}
    StateFiles(tmp_path).write(
        AppliedState("eth0", network_namespace(), fields["boot"], fields["owner"], "L3", (VIDEO,))
    )
    said = NetemInterface("eth1", directory=tmp_path, run=tc).restore()

    assert len(said) == 1
    assert "eth0 was still held (L3 on eth0" in said[0]
    assert tc.told == ["tc qdisc del dev eth0 root"]
    assert StateFiles(tmp_path).read("eth0") is None


@pytest.mark.parametrize(
    ("interface", "qdiscs", "became", "kept"),
    [
        ("lo", '[{"kind":"fq_codel","handle":"8001:","root":true}]', "it is not put back: lo has a queue that", True),
        ("lo", "garbage", "it is not put back: tc told its queues", True),
        ("nowhere0", "garbage", "the interface is gone", False),
    ],
)
def test_what_cannot_be_put_back_is_said_and_kept(
    tmp_path: Path, interface: str, qdiscs: str, became: str, kept: bool
) -> None:
    """What cannot be put back is said with its reason and tried again; an interface that is gone is forgotten."""
    dead = AppliedState(interface, network_namespace(), "an earlier boot", current_process(), "L3", (VIDEO,))
    StateFiles(tmp_path).write(dead)
    said = NetemInterface("eth1", directory=tmp_path, run=Tc(qdiscs)).restore()

    assert len(said) == 1
    assert (
        f"{interface} was still held (L3 on {interface}, of process {os.getpid()}, which has died): {became}" in said[0]
    )
    assert (StateFiles(tmp_path).read(interface) is not None) == kept


@pytest.mark.parametrize("name", ["state", "table"])
def test_a_directory_that_cannot_be_written_is_a_sentence(tmp_path: Path, name: str) -> None:
    """Where a file of ours cannot be written, that is said before tc is told anything, and what is held goes on."""
    tc = Tc(QDISCS, FILTERS)
    file = {"state": f"netem-{network_namespace()}-eth0.json", "table": "uniform.dist"}[name]
    (tmp_path / f"{file}.part").mkdir()
    flow = ImpairedFlow("video", "udp", 5600, "source", Impairment(75, 10, jitter_distribution="uniform"))
    with pytest.raises(UserError, match=r"\(Is a directory\)"):
        NetemInterface("eth0", directory=tmp_path, run=tc, persistent=True).apply([flow])

    assert tc.told == []
    assert not (tmp_path / f"netem-{network_namespace()}-eth0.json").exists()


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", "null", '{"interface": 3, "owner": 7}', '{"owner": [1, 2], "flows": [{}]}']
)
def test_a_broken_file_is_no_application(tmp_path: Path, text: str) -> None:
    """A file that is not one of ours counts as nothing, and is written anew."""
    (tmp_path / f"netem-{network_namespace()}-eth0.json").write_text(text)
    netem = NetemInterface("eth0", directory=tmp_path, run=Tc())
    assert netem.applied() is None
    netem.apply([VIDEO], condition="L2")
    applied = netem.applied()
    assert applied is not None
    assert (applied.condition, applied.flows, applied.owner) == ("L2", (VIDEO,), current_process())


def test_flows_are_read_as_they_were_written() -> None:
    """Flows come back from JSON as they were."""
    assert flows_from(json.loads(json.dumps([asdict(VIDEO), asdict(CONTROL)]))) == (VIDEO, CONTROL)


@pytest.mark.parametrize("name", ["", "eth0/1", "-x", "a" * 16, "a b", ".."])
def test_a_name_that_no_interface_has_is_rejected(name: str) -> None:
    """An interface's name is up to 15 characters without space and slash, and no option of tc."""
    with pytest.raises(UserError, match="no name of an interface"):
        NetemInterface(name)


def test_correlated_jitter_needs_somebody_who_stays(tmp_path: Path) -> None:
    """What ends at once cannot let a delay wander: refused with what to do instead."""
    with pytest.raises(UserError, match="--hold"):
        NetemInterface("eth0", directory=tmp_path, run=Tc(), persistent=True).apply(
            [ImpairedFlow("video", "udp", 5600, "source", Impairment(75, 5, 0.9))]
        )


def test_a_wandering_delay_is_correlated_as_requested_and_repeats() -> None:
    """Steps of the process have standard deviation 1 and are correlated by 0.9, and the same seed gives the same."""

    def walk(seed: int) -> list[float]:
        values, before = [], None
        for index in range(4000):
            values.append(next_deviation(Impairment(75, 10, 0.9), seed, "video", index, before))
            before = index, values[-1]
        return values

    values = walk(3)
    together = sum(a * b for a, b in pairwise(values)) / sum(a * a for a in values)
    assert abs(together - 0.9) < 0.03
    assert 0.8 < sum(a * a for a in values) / 4000 < 1.2
    assert walk(3) == values
    assert walk(4) != values


WANDERING = ImpairedFlow("video", "udp", 5600, "source", Impairment(75, 10, 0.9))


def tc_that(does: str, folder: Path) -> dict[str, str]:
    """Make a tc that does something else, and give the environment in which it is found."""
    program = folder / "tc"
    program.write_text(f"#!/bin/sh\n{does}\n")
    program.chmod(0o755)
    return {"PATH": f"{folder}:{os.environ['PATH']}"}


def test_the_tc_that_steps_a_delay_is_in_a_session_of_its_own(tmp_path: Path) -> None:
    """Ctrl-C at the terminal, which goes to a whole group of processes, does not reach it: it leads its own session."""
    said = tmp_path / "said"
    does = "cat > /dev/null; read pid name state parent group session rest < /proc/self/stat"
    does += f"; echo $pid $session > {said}"
    CorrelatedJitter("eth0", [WANDERING], tc_that(does, tmp_path), seed=1).stop()
    pid, session = said.read_text().split()

    assert session == pid


def test_a_wander_that_has_stopped_is_said_and_can_be_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the tc that steps a delay has ended by itself, that is a problem of its flow, and clearing goes on."""
    monkeypatch.setenv("PATH", tc_that("exit 1", tmp_path)["PATH"])
    tc = Tc()
    netem = NetemInterface("eth0", directory=tmp_path, run=tc)
    netem.apply([WANDERING, CONTROL])
    limit_ns = MachineClock().now().mono_ns + 10 * NS_PER_S
    while not netem.problems() and MachineClock().now().mono_ns < limit_ns:
        pause(NS_PER_MS)
    problems, tc.qdiscs = netem.problems(), QDISCS.replace('"qlen": 7', '"qlen": 0')

    (problem,) = problems
    assert problem.startswith("video (udp source port 5600): ")
    assert netem.clear()[-1] == ["tc", "qdisc", "del", "dev", "eth0", "root"]
    assert netem.problems() == []


def test_a_wander_without_a_step_for_a_second_has_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wander that steps is in no problem; one whose thread has died is, a second after its last step, not before."""
    monkeypatch.setattr(threading.Thread, "start", lambda _thread: None)
    monkeypatch.setattr(threading.Thread, "join", lambda _thread: None)
    clock = ManualClock()
    jitter = CorrelatedJitter("eth0", [WANDERING], tc_that("cat > /dev/null", tmp_path), seed=1, clock=clock)
    clock.mono_ns = NS_PER_S
    now = jitter.problems()
    clock.mono_ns += 1
    later = jitter.problems()
    jitter.stop()

    assert now == []
    assert later == ["video (udp source port 5600): its correlated jitter has stopped"]


def test_what_has_stopped_is_among_the_reasons(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A verification tells what has stopped, beside what was read back and measured."""
    netem = NetemInterface("eth0", directory=tmp_path, run=Tc(QDISCS, FILTERS))
    monkeypatch.setattr(netem, "measure", lambda *_arguments, **_more: JUDGED)
    monkeypatch.setattr(netem, "problems", lambda: ["stopped"])
    assert netem.verify([VIDEO]).reasons == ["stopped"]


def test_what_is_probed_beside_the_flows() -> None:
    """Beside L4's flows are probed: challenges, the other directions, NTP, ssh and the clock probe."""
    requested = probes([VIDEO, CONTROL], [ExemptPort("udp", 5602, "the clock probe")])
    assert [(each.name, each.source, each.destination, each.impairment.delay_ms) for each in requested] == [
        ("video", 5600, 9, 150),
        ("control", 9, 7448, 75),
        ("video, other direction", 9, 5600, 0),
        ("challenges of the video's path", 5600, 9, 0),
        ("control, other direction", 7448, 9, 0),
        ("NTP", 123, 123, 0),
        ("ssh", 22, 22, 0),
        ("the clock probe", 5602, 5602, 0),
    ]


def test_frames_are_summed_up() -> None:
    """Of 10 frames one is lost, one passed by a later one and one early; the delays are of those that were held."""
    delays = [(0, 75.0), (1, 75.2), (3, 75.1), (2, 75.3), (9, 0.1), (4, 75.0), (5, 75.0), (6, 75.0), (7, 75.0)]
    found = summarize(Impairment(75, reorder=0.25), 10, delays)

    assert (found.sent, found.lost, found.early) == (10, 1, 1)
    assert found.reordered == 5
    assert found.median_ms == 75.0
    assert summarize(Impairment(), 10, []) == ProbeResult(10, 10, 0, 0, None, None, None)


JUDGED = {
    each.name: ProbeResult(50, 0, 0, 0, each.impairment.delay_ms, each.impairment.delay_ms, each.impairment.delay_ms)
    for each in probes([VIDEO])
}


@pytest.mark.parametrize(
    ("impairment", "name", "found", "said"),
    [
        (Impairment(150), "video", ProbeResult(50, 0, 0, 0, 148.0, 148.5, 149.0), "delayed by 148.50 ms where 150 ms"),
        (
            Impairment(150),
            "NTP",
            ProbeResult(50, 0, 0, 0, 150.0, 150.0, 150.0),
            "NTP was delayed by 150.00 ms where 0 ms",
        ),
        (
            Impairment(150),
            "video",
            ProbeResult(50, 1, 0, 0, 150.0, 150.0, 150.0),
            "1 of 50 packets were lost where 0.0%",
        ),
        (Impairment(150), "video", ProbeResult(50, 0, 2, 0, 150.0, 150.0, 150.0), "2 packets were overtaken"),
        (Impairment(150), "video", ProbeResult(50, 50, 0, 0, None, None, None), "no packet came through"),
        (
            Impairment(150, loss=0.5),
            "video",
            ProbeResult(50, 5, 0, 0, 150.0, 150.0, 150.0),
            "5 of 50 packets were lost",
        ),
        (
            Impairment(150, reorder=0.5),
            "video",
            ProbeResult(50, 0, 0, 0, 150.0, 150.0, 150.0),
            "0 of 50 packets overtook",
        ),
        (Impairment(150, 10), "video", ProbeResult(50, 0, 0, 0, 150.0, 150.0, 150.5), "jitter of 0.50 ms"),
        (Impairment(150, 10), "video", ProbeResult(50, 0, 0, 0, 90.0, 150.0, 170.0), "delayed by 90.00 ms (p5)"),
        (
            Impairment(150, 10),
            "video",
            ProbeResult(50, 0, 0, 0, 140.0, 191.1, 195.0),
            "191.10 ms (median) where 191.00 ms",
        ),
        (
            Impairment(150, 10, 0.9),
            "video",
            ProbeResult(50, 0, 0, 0, 140.0, 191.1, 195.0),
            "191.10 ms (median) where 191.00 ms",
        ),
        (Impairment(150, loss=0.1), "video", ProbeResult(50, 50, 0, 0, None, None, None), "50 of 50 packets were lost"),
    ],
)
def test_what_is_measured_otherwise_than_requested_is_said(
    impairment: Impairment, name: str, found: ProbeResult, said: str
) -> None:
    """Each quantity that is not as asked is one sentence, and what is as asked is none."""
    flow = ImpairedFlow("video", "udp", 5600, "source", impairment)
    good = ProbeResult(
        50,
        round(50 * impairment.loss),
        5 * bool(impairment.reorder),
        round(50 * impairment.reorder),
        140.0,
        150.0,
        160.0,
    )
    reasons = judge([flow], [], {**JUDGED, "video": good, name: found})

    assert len(reasons) == 1
    assert said in reasons[0]
    assert judge([flow], [], {**JUDGED, "video": good}) == []


@pytest.mark.parametrize(
    ("impairment", "found"),
    [
        (Impairment(150, loss=0.1, loss_burst_packets=5), ProbeResult(10, 10, 0, 0, None, None, None)),
        (Impairment(150, loss=0.5), ProbeResult(10, 9, 0, 0, None, None, None)),
        (Impairment(150, reorder=0.5), ProbeResult(10, 0, 8, 9, None, None, None)),
        (Impairment(150, 10), ProbeResult(50, 0, 0, 0, 140.0, 191.0, 195.0)),
        (Impairment(150, 10, rate_bps=20_000), ProbeResult(50, 0, 0, 0, 150.0, 400.0, 600.0)),
    ],
)
def test_what_a_law_may_do_is_no_reason(impairment: Impairment, found: ProbeResult) -> None:
    """Possible shares of losses and overtaking, a late median that jitter allows, and any where there is a rate."""
    flow = ImpairedFlow("video", "udp", 5600, "source", impairment)
    assert judge([flow], [], {**JUDGED, "video": found}) == []


def test_a_rejection_of_tc_is_a_sentence() -> None:
    """An interface that is not there is said so, whatever tc calls it."""
    with pytest.raises(UserError, match=r"there is no interface nowhere0|no tc"):
        run_tc(["tc", "qdisc", "show", "dev", "nowhere0"])


@pytest.mark.parametrize("call", ["setsockopt", "bind", "getsockname", "sendto", "recvmsg"])
def test_an_interface_that_goes_down_cannot_be_measured(monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    """Whatever a packet socket refuses while it measures, as the interface went down, is one sentence."""

    def down(*_: object) -> None:
        raise OSError(errno.ENETDOWN, "Network is down")

    opened = MagicMock()
    opened.return_value.__enter__.return_value = opened.return_value
    opened.return_value.getsockname.return_value = ("eth0", 0, 0, 1, bytes(6))
    opened.return_value.recvmsg.side_effect = BlockingIOError
    getattr(opened.return_value, call).side_effect = down
    monkeypatch.setattr(socket, "socket", opened)
    with pytest.raises(UserError, match=r"eth0 cannot be measured \(Network is down\)"):
        measure("eth0", probes([VIDEO]), count=1)


def test_an_interface_that_is_not_there_cannot_be_measured() -> None:
    """Measuring says what is wrong with the interface, or that it needs root."""
    with pytest.raises(UserError, match=r"nowhere0 cannot be measured|only root may measure"):
        measure("nowhere0", probes([VIDEO]))
