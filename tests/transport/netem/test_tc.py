from __future__ import annotations

import errno
import json
import os
import socket
import threading
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any
from unittest.mock import MagicMock

import msgspec
import numpy as np
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
from lavt.transport.netem import queue_probe
from lavt.transport.netem.correlated_jitter import CorrelatedJitter, next_deviation
from lavt.transport.netem.netem import NetemInterface, run_tc
from lavt.transport.netem.queue_probe import ProbeResult, judge, measure, queue_probes, summarize
from lavt.transport.netem.state import (
    NO_OWNER,
    AppliedState,
    Owner,
    StateFiles,
    boot_id,
    current_process,
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

QDISCS = json.dumps(
    [
        {"kind": "prio", "handle": "4c56:", "root": True, "options": {"bands": 6}, "qlen": 0},
        {
            "kind": "netem",
            "handle": "4c01:",
            "parent": "4c56:4",
            "qlen": 7,
            "options": {
                "limit": 10000,
                "delay": {"delay": 0.15, "jitter": 0, "correlation": 0},
                "rate": {"rate": 1250000000},
                "ecn": False,
                "gap": 0,
            },
        },
    ]
)
NO_QDISC = '[{"kind":"noqueue","handle":"0:","root":true,"refcnt":2,"options":{}}]'
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


def test_commands_of_a_condition() -> None:
    """L4 with delayed state on one machine is a prio with six bands and three netems, each with two filters."""
    flows = netem_flows(condition("L4"), "both", video_port=5600, control_port=7448, state_delay="with_video")
    ip = "u32 match u8 0x45 0xff at 0 match u16 0x0000 0x1fff at 6"
    assert [as_typed(command) for command in first_commands("eth0", flows)] == [
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
    ("impairment", "arguments"),
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
def test_netem_arguments_of_an_impairment(impairment: Impairment, arguments: str) -> None:
    """The arguments always include limit, delay and rate, because tc keeps the old value of an omitted argument."""
    assert " ".join(netem_arguments(impairment)) == f"netem limit 10000 {arguments}"


def test_queue_limit_grows_with_the_delay() -> None:
    """Delays over 5 s get a limit of 2000 packets per second of delay; shorter ones get 10 000."""
    assert netem_arguments(Impairment(60_000))[:3] == ["netem", "limit", "120000"]
    assert netem_arguments(Impairment(4_900))[:3] == ["netem", "limit", "10000"]


def test_uniform_jitter_uses_the_distribution_of_lavt() -> None:
    """Uniform jitter uses a distribution from LAVT: without one, a change would keep the previous distribution."""
    command = set_impairment(
        "lo", "video", Impairment(75, 10, jitter_distribution="uniform"), verb="change", tables="/run/lavt"
    )
    assert command[:3] == ["env", "TC_LIB_DIR=/run/lavt", "tc"]
    assert command[-5:-2] == ["10ms", "distribution", "uniform"]


def tc_options(arguments: list[str]) -> dict[str, Any]:
    """Return the options that tc would report for a netem with these arguments."""
    text = " ".join(arguments[3:])
    numbers = [float(word.rstrip("%gmbits")) for word in arguments if word[0].isdigit()]
    options: dict[str, Any] = {"limit": int(arguments[2]), "gap": 0}
    remaining_numbers = iter(numbers[1:])
    options["delay"] = {"delay": next(remaining_numbers) / 1000, "jitter": 0.0}
    if "distribution" in text:
        options["delay"]["jitter"] = next(remaining_numbers) / 1000
    if "random" in text:
        options["loss-random"] = {"loss": next(remaining_numbers) / 100}
    if "gemodel" in text:
        options["loss-gemodel"] = {"p": next(remaining_numbers) / 100, "r": next(remaining_numbers) / 100}
    if "reorder" in text:
        options |= {"reorder": {"reorder": next(remaining_numbers) / 100}, "gap": 1}
    options["rate"] = {"rate": 1_250_000_000 if text.endswith("10gbit") else int(next(remaining_numbers)) // 8}
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
def test_any_impairment_is_parsed_back(impairment: Impairment) -> None:
    """Tc's report of a netem with the arguments of an impairment does not differ from that impairment."""
    options = tc_options(netem_arguments(impairment))
    reported = [Qdisc("prio", "4c56:", "root", {}, 0), Qdisc("netem", "4c01:", "4c56:4", options, 0)]
    flow = ImpairedFlow("video", "udp", 5600, "source", impairment)
    assert difference(flow, reported, [expected_filter(tc_filter) for tc_filter in filters(flow)]) == []
    if impairment.loss and impairment.loss_burst_packets > 1:
        assert parse_impairment(options).loss_burst_packets == pytest.approx(impairment.loss_burst_packets, rel=1e-3)


def test_output_of_tc_is_parsed() -> None:
    """Qdiscs in JSON and filters in text, as iproute2 6.1 prints them, are parsed and match the request."""
    qdiscs, parsed_filters = parse_qdiscs(QDISCS), parse_filters(FILTERS)

    assert [(qdisc.kind, qdisc.handle, qdisc.parent, qdisc.waiting_packets) for qdisc in qdiscs] == [
        ("prio", "4c56:", "root", 0),
        ("netem", "4c01:", "4c56:4", 7),
    ]
    assert parse_impairment(qdiscs[1].options) == Impairment(150)
    assert parsed_filters == [expected_filter(tc_filter) for tc_filter in filters(VIDEO)]
    assert difference(VIDEO, qdiscs, parsed_filters) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"delay": {"delay": 0.1}}, "delay_ms is 100 instead of 150"),
        ({"limit": 1000}, "limit"),
        ({"rate": {}}, "no rate"),
        ({"loss-random": {"loss": 0.5}}, "loss is 0.5 instead of 0"),
    ],
)
def test_differences_are_reported(change: dict[str, Any], message: str) -> None:
    """A different delay, loss or limit is reported, and so is a missing filter, netem or rate."""
    qdiscs = parse_qdiscs(QDISCS)
    qdiscs[1].options.update(change)
    reasons = " ".join(difference(VIDEO, qdiscs, parse_filters(FILTERS)))

    assert message in reasons
    assert "no filter for ipv6" in " ".join(difference(VIDEO, qdiscs, parse_filters(FILTERS)[:1]))
    assert difference(CONTROL, qdiscs, []) == ["control (udp destination port 7448) has no netem"]


@given(st.text())
def test_garbage_from_tc_raises_work_errors(text: str) -> None:
    """Arbitrary text has no qdiscs and no filters; parsing it raises nothing but `WorkError`."""
    try:
        qdiscs = parse_qdiscs(text)
    except WorkError:
        qdiscs = []
    assert qdiscs == []
    assert parse_filters(text) == []


@pytest.mark.parametrize("text", ["[1]", '{"kind": 1}', '[{"kind": "x"}]', '[{"kind":"x","handle":"1:","qlen":"a"}]'])
def test_unexpected_json_from_tc_raises_a_work_error(text: str) -> None:
    """JSON that is not a list of qdiscs raises `WorkError`."""
    with pytest.raises(WorkError, match="could not parse"):
        parse_qdiscs(text)


@pytest.mark.parametrize("options", [{"delay": 3}, {"delay": {"delay": "x"}}, {"loss-gemodel": {}}, {"gap": 1}])
def test_unexpected_options_from_tc_raise_a_work_error(options: dict[str, Any]) -> None:
    """Options that are not a netem's raise `WorkError`."""
    with pytest.raises(WorkError, match="could not parse"):
        parse_impairment(options)


@pytest.mark.parametrize(
    ("impairment", "message"),
    [
        (Impairment(-1), "not negative"),
        (Impairment(float("nan")), "finite"),
        (Impairment(5, loss=1), "must be below 1"),
        (Impairment(5, jitter_ms=6), "negative delays"),
        (Impairment(0, reorder=0.1), "needs a delay"),
        (Impairment(5, loss=0.9, loss_burst_packets=2), "longer bursts or less loss"),
        (Impairment(5, rate_bps=4), "rate_bps"),
        (Impairment(5, 1, 0.5, "pareto"), "must have the jitter_distribution normal"),
        (Impairment(5, 1, 0, "poisson"), "one of normal, uniform"),  # type: ignore[arg-type]
    ],
)
def test_impossible_impairments_are_rejected(impairment: Impairment, message: str) -> None:
    """An impairment that netem cannot produce is rejected with a message that names the flow."""
    with pytest.raises(UserError, match=message) as rejected:
        check_netem_impairment("video", impairment)
    assert str(rejected.value).startswith("video: ")


@pytest.mark.parametrize(
    ("flows", "message"),
    [
        ([ImpairedFlow("video", "udp", 5602, "source", Impairment(5))], "the clock probe"),
        ([ImpairedFlow("control", "udp", 5602, "destination", Impairment(5))], "the clock probe"),
        ([ImpairedFlow("video", "udp", 123, "source", Impairment(5))], "NTP"),
        ([ImpairedFlow("control", "tcp", 22, "destination", Impairment(5))], "ssh"),
        ([ImpairedFlow("video", "udp", 0, "source", Impairment(5))], "port number"),
        ([VIDEO, ImpairedFlow("state", "udp", 5600, "source", Impairment(5))], "the same packets as video"),
        ([], "no flow"),
    ],
)
def test_flows_on_exempt_ports_are_rejected(flows: list[ImpairedFlow], message: str) -> None:
    """A flow from or to a port of NTP, ssh or the clock probe is rejected. So are two flows with the same packets."""
    with pytest.raises(UserError, match=message):
        check_flows(flows, [ExemptPort("udp", 5602, "the clock probe")])


class FakeTc:
    """A simulated tc, which reports the qdiscs and filters that a test sets, and records its commands."""

    def __init__(self, qdiscs: str = NO_QDISC, filters: str = "") -> None:
        self.qdiscs, self.filters, self.commands = qdiscs, filters, list[str]()
        self.rejects: Callable[[Command], bool] = lambda _command: False

    def __call__(self, command: Command) -> str:
        """Run a command."""
        if "show" in command:
            return self.filters if "filter" in command else self.qdiscs
        if self.rejects(command):
            raise WorkError("rejected")
        self.commands.append(" ".join(command))
        return ""


def test_change_runs_only_the_necessary_commands(tmp_path: Path) -> None:
    """A new delay takes one command and no filters; the filters of a flow that is no longer requested are deleted."""
    tc = FakeTc(QDISCS, FILTERS)
    netem = NetemInterface("eth0", directory=tmp_path, run=tc, persistent=True)
    netem.apply([ImpairedFlow("video", "udp", 5600, "source", Impairment(30))])
    first_change = list(tc.commands)
    netem.apply([CONTROL])

    assert first_change == [
        "tc qdisc change dev eth0 parent 4c56:4 handle 4c01: netem limit 10000 delay 30ms rate 10gbit"
    ]
    assert [command.split(" u32")[0] for command in tc.commands[1:]] == [
        "tc qdisc change dev eth0 parent 4c56:4 handle 4c01: netem limit 10000 delay 0ms rate 10gbit",
        "tc qdisc add dev eth0 parent 4c56:5 handle 4c02: netem limit 10000 delay 75ms rate 10gbit",
        "tc filter del dev eth0 parent 4c56: protocol ip prio 1",
        "tc filter del dev eth0 parent 4c56: protocol ipv6 prio 2",
        "tc filter add dev eth0 parent 4c56: protocol ip prio 3",
        "tc filter add dev eth0 parent 4c56: protocol ipv6 prio 4",
    ]


def test_failed_first_application_is_undone(tmp_path: Path) -> None:
    """If the first application to an interface fails at a filter, the root qdisc is deleted and no state is stored."""
    tc = FakeTc()
    tc.rejects = lambda command: "filter" in command
    netem = NetemInterface("eth0", directory=tmp_path, run=tc)
    with pytest.raises(WorkError, match="rejected"):
        netem.apply([VIDEO])

    assert tc.commands[-1] == "tc qdisc del dev eth0 root"
    assert netem.applied() is None


def test_foreign_root_qdisc_is_rejected(tmp_path: Path) -> None:
    """A root qdisc with a foreign handle is rejected before any command runs."""
    tc = FakeTc('[{"kind":"fq_codel","handle":"8001:","root":true}]')
    netem = NetemInterface("eth0", directory=tmp_path, run=tc)
    calls: list[Callable[[], object]] = [lambda: netem.apply([VIDEO]), lambda: netem.clear(any_owner=True), netem.check]
    for call in calls:
        with pytest.raises(UserError, match=r"\(fq_codel 8001:\)"):
            call()
    assert tc.commands == []


def test_impairment_of_another_program_is_not_changed(tmp_path: Path) -> None:
    """An impairment that a live process owns, or that was left in place, is not changed by another program."""
    tc = FakeTc(QDISCS, FILTERS)
    owner = os.getppid(), start_ticks(os.getppid())
    StateFiles(tmp_path).write(AppliedState("eth0", network_namespace(), boot_id(), owner, "L3", (VIDEO,)))
    with pytest.raises(UserError, match=rf"L3 on eth0, .*process {owner[0]}"):
        NetemInterface("eth0", directory=tmp_path, run=tc).apply([VIDEO])
    StateFiles(tmp_path).remove("eth0")
    with pytest.raises(UserError, match="a delay on eth0, left in place"):
        NetemInterface("eth0", directory=tmp_path, run=tc).check()
    assert tc.commands == []


@pytest.mark.parametrize("owner", [(os.getppid(), start_ticks(os.getppid())), NO_OWNER, None])
def test_impairment_of_another_owner_is_cleared_only_on_demand(tmp_path: Path, owner: Owner | None) -> None:
    """A program clears another owner's impairment only with `any_owner`, with and without a state file."""
    tc, files = FakeTc(QDISCS, FILTERS), StateFiles(tmp_path)
    if owner is not None:
        files.write(AppliedState("eth0", network_namespace(), boot_id(), owner, "L3", (VIDEO,)))
    stored_before = files.read("eth0")
    with pytest.raises(UserError, match="eth0"), NetemInterface("eth0", directory=tmp_path, run=tc) as netem:
        netem.check()

    assert netem.clear() == []
    assert tc.commands == []
    assert files.read("eth0") == stored_before
    assert netem.clear(at_once=True, any_owner=True) == [["tc", "qdisc", "del", "dev", "eth0", "root"]]
    assert files.read("eth0") is None


@pytest.mark.parametrize("state_is_stored", [True, False])
def test_persistent_impairment_is_cleared_by_a_persistent_interface(tmp_path: Path, state_is_stored: bool) -> None:
    """Impairments that `lavt netem apply` or a script left in place are cleared by a persistent interface."""
    tc = FakeTc(QDISCS, FILTERS)
    if state_is_stored:
        StateFiles(tmp_path).write(AppliedState("eth0", network_namespace(), boot_id(), NO_OWNER, "L3", (VIDEO,)))
    assert NetemInterface("eth0", directory=tmp_path, run=tc, persistent=True).clear(at_once=True) != []


@pytest.mark.parametrize(
    "abandoned", [{"boot": "an earlier boot"}, {"owner": (2**22 + 1, 5)}, {"owner": (os.getpid(), 5)}]
)
def test_abandoned_impairment_is_cleared(tmp_path: Path, abandoned: dict[str, Any]) -> None:
    """An impairment of an earlier boot, or of a dead process, is cleared, even if the process number was reused."""
    tc = FakeTc(QDISCS, FILTERS)
    fields = {"boot": boot_id(), "owner": current_process(), **abandoned}
    StateFiles(tmp_path).write(
        AppliedState("eth0", network_namespace(), fields["boot"], fields["owner"], "L3", (VIDEO,))
    )
    (message,) = NetemInterface("eth1", directory=tmp_path, run=tc).restore()

    assert "found L3 on eth0" in message
    assert tc.commands == ["tc qdisc del dev eth0 root"]
    assert StateFiles(tmp_path).read("eth0") is None


@pytest.mark.parametrize(
    ("interface", "qdiscs", "outcome", "is_kept"),
    [
        ("lo", '[{"kind":"fq_codel","handle":"8001:","root":true}]', "could not be restored: lo has a root", True),
        ("lo", "garbage", "could not be restored: could not parse", True),
        ("nowhere0", "garbage", "no longer exists", False),
    ],
)
def test_failed_restoration_is_reported_and_kept(
    tmp_path: Path, interface: str, qdiscs: str, outcome: str, is_kept: bool
) -> None:
    """A failed restoration is reported with its reason, and the state is kept unless the interface is missing."""
    abandoned = AppliedState(interface, network_namespace(), "an earlier boot", current_process(), "L3", (VIDEO,))
    StateFiles(tmp_path).write(abandoned)
    (message,) = NetemInterface("eth1", directory=tmp_path, run=FakeTc(qdiscs)).restore()

    assert f"found L3 on {interface}, " in message
    assert f"process {os.getpid()}" in message
    assert outcome in message
    assert (StateFiles(tmp_path).read(interface) is not None) == is_kept


@pytest.mark.parametrize("name", ["state", "table"])
def test_unwritable_directory_is_reported_before_tc_runs(tmp_path: Path, name: str) -> None:
    """A file that cannot be written is reported before tc runs, so existing impairments stay."""
    tc = FakeTc(QDISCS, FILTERS)
    file = {"state": f"netem-{network_namespace()}-eth0.json", "table": "uniform.dist"}[name]
    (tmp_path / f"{file}.part").mkdir()
    flow = ImpairedFlow("video", "udp", 5600, "source", Impairment(75, 10, jitter_distribution="uniform"))
    with pytest.raises(UserError, match=r"\(Is a directory\)"):
        NetemInterface("eth0", directory=tmp_path, run=tc, persistent=True).apply([flow])

    assert tc.commands == []
    assert not (tmp_path / f"netem-{network_namespace()}-eth0.json").exists()


@pytest.mark.parametrize(
    "text", ["", "{}", "[]", "null", '{"interface": 3, "owner": 7}', '{"owner": [1, 2], "flows": [{}]}']
)
def test_broken_state_file_is_ignored(tmp_path: Path, text: str) -> None:
    """A broken state file is treated as missing, and is replaced."""
    (tmp_path / f"netem-{network_namespace()}-eth0.json").write_text(text)
    netem = NetemInterface("eth0", directory=tmp_path, run=FakeTc())
    assert netem.applied() is None
    netem.apply([VIDEO], condition="L2")
    applied = netem.applied()
    assert applied is not None
    assert (applied.condition, applied.flows, applied.owner) == ("L2", (VIDEO,), current_process())


def test_flows_survive_json() -> None:
    """Flows are the same after a round trip through JSON."""
    assert msgspec.json.decode(msgspec.json.encode((VIDEO, CONTROL)), type=tuple[ImpairedFlow, ...]) == (VIDEO, CONTROL)


@pytest.mark.parametrize("name", ["", "eth0/1", "-x", "a" * 16, "a b", ".."])
def test_invalid_interface_name_is_rejected(name: str) -> None:
    """An interface name has up to 15 characters without space and slash, and does not look like an option of tc."""
    with pytest.raises(UserError, match="not an interface name"):
        NetemInterface(name)


def test_correlated_jitter_needs_a_running_program(tmp_path: Path) -> None:
    """Correlated jitter that no running program would step is rejected, and the message suggests `--hold`."""
    with pytest.raises(UserError, match="--hold"):
        NetemInterface("eth0", directory=tmp_path, run=FakeTc(), persistent=True).apply(
            [ImpairedFlow("video", "udp", 5600, "source", Impairment(75, 5, 0.9))]
        )


def test_correlated_jitter_has_its_correlation_and_repeats() -> None:
    """The steps have standard deviation 1 and correlation 0.9, and the same seed gives the same steps."""

    def steps(seed: int) -> list[float]:
        values, previous = [], None
        for index in range(4000):
            values.append(next_deviation(Impairment(75, 10, 0.9), seed, "video", index, previous))
            previous = index, values[-1]
        return values

    values = steps(3)
    correlation = sum(earlier * later for earlier, later in pairwise(values)) / sum(value**2 for value in values)
    assert abs(correlation - 0.9) < 0.03
    assert 0.8 < sum(value**2 for value in values) / 4000 < 1.2
    assert steps(3) == values
    assert steps(4) != values


CORRELATED = ImpairedFlow("video", "udp", 5600, "source", Impairment(75, 10, jitter_correlation=0.9))


def fake_tc_environment(script: str, folder: Path) -> dict[str, str]:
    """Install a script as tc, and return the environment in which it is found."""
    program = folder / "tc"
    program.write_text(f"#!/bin/sh\n{script}\n")
    program.chmod(0o755)
    return {"PATH": f"{folder}:{os.environ['PATH']}"}


def test_tc_of_correlated_jitter_has_its_own_session(tmp_path: Path) -> None:
    """Ctrl-C at the terminal, which is sent to a process group, does not reach tc, which leads a session of its own."""
    message = tmp_path / "message"
    script = "cat > /dev/null; read pid name state parent group session rest < /proc/self/stat"
    script += f"; echo $pid $session > {message}"
    CorrelatedJitter("eth0", [CORRELATED], fake_tc_environment(script, tmp_path), seed=1).stop()
    pid, session = message.read_text().split()

    assert session == pid


def test_stopped_jitter_is_reported_and_can_be_cleared(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """If the tc process that steps the delay of a flow has ended, this is a problem, and clearing still works."""
    monkeypatch.setenv("PATH", fake_tc_environment("exit 1", tmp_path)["PATH"])
    tc = FakeTc()
    netem = NetemInterface("eth0", directory=tmp_path, run=tc)
    netem.apply([CORRELATED, CONTROL])
    deadline_ns = MachineClock().now().mono_ns + 10 * NS_PER_S
    while not netem.problems() and MachineClock().now().mono_ns < deadline_ns:
        pause(NS_PER_MS)
    problems, tc.qdiscs = netem.problems(), QDISCS.replace('"qlen": 7', '"qlen": 0')

    (problem,) = problems
    assert problem.startswith("video (udp source port 5600): ")
    assert netem.clear()[-1] == ["tc", "qdisc", "del", "dev", "eth0", "root"]
    assert netem.problems() == []


def test_jitter_without_a_step_for_a_second_has_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Jitter is reported as stopped when its last step is more than a second ago, and not before."""
    monkeypatch.setattr(threading.Thread, "start", lambda _thread: None)
    monkeypatch.setattr(threading.Thread, "join", lambda _thread: None)
    clock = ManualClock()
    jitter = CorrelatedJitter(
        "eth0", [CORRELATED], fake_tc_environment("cat > /dev/null", tmp_path), seed=1, clock=clock
    )
    clock.mono_ns = NS_PER_S
    at_one_second = jitter.problems()
    clock.mono_ns += 1
    later = jitter.problems()
    jitter.stop()

    assert at_one_second == []
    assert later == ["video (udp source port 5600): its correlated jitter has stopped"]


def test_verification_reports_stopped_jitter(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A verification reports stopped jitter along with the other differences."""
    netem = NetemInterface("eth0", directory=tmp_path, run=FakeTc(QDISCS, FILTERS))
    monkeypatch.setattr(netem, "measure", lambda *_arguments, **_more: AS_REQUESTED)
    monkeypatch.setattr(netem, "problems", lambda: ["stopped"])
    assert netem.verify([VIDEO]).reasons == ["stopped"]


def test_queue_probes_of_a_condition() -> None:
    """The queue probes for L4 cover its flows, the challenges, the other directions, NTP, ssh and the clock probe."""
    requested = queue_probes([VIDEO, CONTROL], [ExemptPort("udp", 5602, "the clock probe")])
    assert [(probe.name, probe.source, probe.destination, probe.impairment.delay_ms) for probe in requested] == [
        ("video", 5600, 9, 150),
        ("control", 9, 7448, 75),
        ("video, other direction", 9, 5600, 0),
        ("challenges of the video's path", 5600, 9, 0),
        ("control, other direction", 7448, 9, 0),
        ("NTP", 123, 123, 0),
        ("ssh", 22, 22, 0),
        ("the clock probe", 5602, 5602, 0),
    ]


def test_measured_packets_are_summarized() -> None:
    """Lost, reordered and early test packets are counted; the percentiles are those of the delayed packets."""
    delays = [(0, 75.0), (1, 75.2), (3, 75.1), (2, 75.3), (9, 0.1), (4, 75.0), (5, 75.0), (6, 75.0), (7, 75.0)]
    result = summarize(Impairment(75, reorder=0.25), 10, delays)

    assert (result.sent, result.lost, result.early) == (10, 1, 1)
    assert result.reordered == 5
    assert result.median_ms == 75.0
    assert summarize(Impairment(), 10, []) == ProbeResult(10, 10, 0, 0, None, None, None)


AS_REQUESTED = {
    probe.name: ProbeResult(
        50, 0, 0, 0, probe.impairment.delay_ms, probe.impairment.delay_ms, probe.impairment.delay_ms
    )
    for probe in queue_probes([VIDEO])
}
"""For each queue probe, the result of queues that do what was requested.

The fields of a `ProbeResult` are sent, lost, reordered, early, and the delay's 5th percentile, median and 95th.
"""


@pytest.mark.parametrize(
    ("impairment", "name", "measured", "message"),
    [
        (Impairment(150), "video", ProbeResult(50, 0, 0, 0, 148.0, 148.5, 149.0), "delayed by 148.50 ms"),
        (
            Impairment(150),
            "NTP",
            ProbeResult(50, 0, 0, 0, 150.0, 150.0, 150.0),
            "NTP was delayed by 150.00 ms instead of 0 ms",
        ),
        (
            Impairment(150),
            "video",
            ProbeResult(50, 1, 0, 0, 150.0, 150.0, 150.0),
            "1 of 50 packets were lost",
        ),
        (Impairment(150), "video", ProbeResult(50, 0, 2, 0, 150.0, 150.0, 150.0), "2 packets were reordered"),
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
            "191.10 ms (median)",
        ),
        (
            Impairment(150, 10, 0.9),
            "video",
            ProbeResult(50, 0, 0, 0, 140.0, 191.1, 195.0),
            "191.10 ms (median)",
        ),
        (Impairment(150, loss=0.1), "video", ProbeResult(50, 50, 0, 0, None, None, None), "50 of 50 packets were lost"),
        (
            Impairment(150, loss=0.1, loss_burst_packets=5),
            "video",
            ProbeResult(50, 48, 0, 0, 150.0, 150.0, 150.0),
            "48 of 50 packets were lost",
        ),
    ],
)
def test_each_measured_difference_is_reported(
    impairment: Impairment, name: str, measured: ProbeResult, message: str
) -> None:
    """If one quantity differs from the request, there is one message, about this quantity."""
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
    reasons = judge([flow], [], {**AS_REQUESTED, "video": good, name: measured})

    assert len(reasons) == 1
    assert message in reasons[0]
    assert judge([flow], [], {**AS_REQUESTED, "video": good}) == []


@pytest.mark.parametrize(
    ("impairment", "measured"),
    [
        (Impairment(150, loss=0.1, loss_burst_packets=5), ProbeResult(10, 10, 0, 0, None, None, None)),
        (Impairment(150, loss=0.1, loss_burst_packets=5), ProbeResult(50, 31, 0, 0, 150.0, 150.0, 150.0)),
        (Impairment(150, loss=0.5), ProbeResult(10, 9, 0, 0, None, None, None)),
        (Impairment(150, reorder=0.5), ProbeResult(10, 0, 8, 9, None, None, None)),
        (Impairment(150, 10), ProbeResult(50, 0, 0, 0, 140.0, 191.0, 195.0)),
        (Impairment(150, 10, rate_bps=20_000), ProbeResult(50, 0, 0, 0, 150.0, 400.0, 600.0)),
    ],
)
def test_plausible_measurements_are_accepted(impairment: Impairment, measured: ProbeResult) -> None:
    """Plausible shares of losses and reordering, a median that jitter allows, and any median with a rate pass."""
    flow = ImpairedFlow("video", "udp", 5600, "source", impairment)
    assert judge([flow], [], {**AS_REQUESTED, "video": measured}) == []


@pytest.mark.parametrize(("share", "burst_packets"), [(0.1, 5.0), (0.25, 1.0), (0.3, 20.0)])
def test_count_probabilities_are_those_of_a_simulated_chain(share: float, burst_packets: float) -> None:
    """The probability of each count agrees with its frequency in 20 000 simulated measurements of 50 packets."""
    runs, packets, generator = 20_000, 50, np.random.default_rng(5)
    end = 1 / burst_packets
    begin = share * end / (1 - share) if burst_packets > 1 else share
    end = end if burst_packets > 1 else 1 - share
    is_lost, lost = generator.random(runs) < share, np.zeros(runs, dtype=int)
    for _ in range(packets):
        lost += is_lost
        is_lost = generator.random(runs) < np.where(is_lost, 1 - end, begin)
    probabilities = queue_probe._count_probabilities(packets, share, 1 - begin - end)

    assert sum(probabilities) == pytest.approx(1)
    assert np.bincount(lost, minlength=packets + 1) / runs == pytest.approx(np.array(probabilities), abs=0.015)


def test_missing_interface_is_reported() -> None:
    """A missing interface is reported as such, whatever tc prints."""
    with pytest.raises(UserError, match=r"nowhere0|tc is not installed"):
        run_tc(["tc", "qdisc", "show", "dev", "nowhere0"])


@pytest.mark.parametrize("call", ["setsockopt", "bind", "getsockname", "sendto", "recvmsg"])
def test_measuring_an_interface_that_goes_down_fails(monkeypatch: pytest.MonkeyPatch, call: str) -> None:
    """A call of the packet socket that fails because the interface went down raises one `UserError`."""

    def fail(*_: object) -> None:
        raise OSError(errno.ENETDOWN, "Network is down")

    opened = MagicMock()
    opened.return_value.__enter__.return_value = opened.return_value
    opened.return_value.getsockname.return_value = ("eth0", 0, 0, 1, bytes(6))
    opened.return_value.recvmsg.side_effect = BlockingIOError
    getattr(opened.return_value, call).side_effect = fail
    monkeypatch.setattr(socket, "socket", opened)
    with pytest.raises(UserError, match=r"eth0 \(Network is down\)"):
        measure("eth0", queue_probes([VIDEO]), count=1)


def test_measuring_a_missing_interface_fails() -> None:
    """Measuring a missing interface raises a `UserError` that names it, or that asks for root."""
    with pytest.raises(UserError, match=r"nowhere0|only root may measure"):
        measure("nowhere0", queue_probes([VIDEO]))
