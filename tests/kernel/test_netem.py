"""tc netem on a real kernel: the impairments of each condition, and the commands that apply and clear them."""

from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from itertools import pairwise, takewhile
from pathlib import Path
from statistics import fmean, median, quantiles
from typing import Any, Literal

import pytest
from scipy.stats import spearmanr
from tests.kernel.lane.verdicts import MEDIAN_SHARE
from tests.kernel.namespaces import (
    DEVICES,
    Arrivals,
    ProbeFlow,
    command,
    create_namespaces,
    delete_namespaces,
    inside,
    send_flows,
)
from tests.support.command_line import CommandResult
from tests.support.stalls import Stalls

from lavt.assembly.injection import Role, netem_flows
from lavt.cli import console
from lavt.cli.main import build_app
from lavt.clock import MachineClock, pause
from lavt.config import RunConfig
from lavt.config_file import condition, load_config, shipped
from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.experiment.runs.netem_run import NetemRun, netem_invalid_reasons
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow, Impairment
from lavt.transport.netem.netem import NetemInterface

CLOCK = MachineClock()
VIDEO_PORT, CONTROL_PORT, PROBE_PORT = 5600, 7448, 5602
ALWAYS_EXEMPT = [ExemptPort("udp", PROBE_PORT, "the clock probe")]
CONDITIONS = ("L0", "L1", "L2", "L3", "L4", "L5")
JUDGES_MEDIANS = pytest.mark.judges_times(share=MEDIAN_SHARE)
"""For tests whose assertions are about medians or other quantiles of delays."""

VIDEO_FLOW = ProbeFlow("video", "server", "udp", VIDEO_PORT, 40_000)
DELAYED_FLOWS = [
    VIDEO_FLOW,
    ProbeFlow("video over IPv6", "server", "udp", VIDEO_PORT, 40_001, version=6),
    ProbeFlow("control", "client", "udp", 40_002, CONTROL_PORT),
    ProbeFlow("control over IPv6", "client", "udp", 40_003, CONTROL_PORT, version=6),
]
UNDELAYED_FLOWS = [
    ProbeFlow("challenges of the video's path", "server", "udp", VIDEO_PORT, 40_010, first_byte=ord("L")),
    ProbeFlow("RTCP and hellos upstream", "client", "udp", 40_011, VIDEO_PORT),
    ProbeFlow("state", "server", "udp", CONTROL_PORT, 40_012),
    ProbeFlow("NTP down", "server", "udp", 123, 123),
    ProbeFlow("NTP up", "client", "udp", 124, 123),
    ProbeFlow("ssh down", "server", "tcp", 22, 40_013),
    ProbeFlow("ssh up", "client", "tcp", 40_014, 22),
    ProbeFlow("clock probe down", "server", "udp", PROBE_PORT, 40_015),
    ProbeFlow("clock probe up", "client", "udp", 40_016, PROBE_PORT),
    ProbeFlow("tcp to the control's port", "client", "tcp", 40_017, CONTROL_PORT),
    ProbeFlow("udp to the client's control port", "server", "udp", 40_018, 40_019),
]


@pytest.fixture(scope="module")
def baseline() -> Iterator[dict[str, float]]:
    """Create two namespaces, and return the median delay of every flow without injection; delete them afterwards."""
    create_namespaces()
    send_flows([*DELAYED_FLOWS, *UNDELAYED_FLOWS], 3, 10)  # the first packets wait for address resolution
    yield {
        name: median(arrivals.delays_ms)
        for name, arrivals in send_flows([*DELAYED_FLOWS, *UNDELAYED_FLOWS], 30, 10).items()
    }
    delete_namespaces()


@pytest.fixture
def sides(baseline: dict[str, float], tmp_path: Path) -> Iterator[dict[str, NetemInterface]]:
    """Return the interfaces of both sides, and clear them afterwards."""
    del baseline
    interfaces = {name: NetemInterface(device, directory=tmp_path) for name, device in DEVICES.items()}
    yield interfaces
    for name, netem in interfaces.items():
        inside(name, lambda netem=netem: netem.clear(at_once=True, any_owner=True))  # type: ignore[misc]


def apply_condition(sides: dict[str, NetemInterface], name: str) -> None:
    """Apply each side's part of a condition."""
    roles: Sequence[Role] = ("server", "client")
    for role in roles:
        flows = netem_flows(condition(name), role, video_port=VIDEO_PORT, control_port=CONTROL_PORT)
        inside(role, lambda role=role, flows=flows: sides[role].apply(flows, exempt=ALWAYS_EXEMPT, condition=name))  # type: ignore[misc]


def apply_to_video(sides: dict[str, NetemInterface], impairment: Impairment) -> None:
    """Apply an impairment to the server's video."""
    inside("server", lambda: sides["server"].apply([ImpairedFlow("video", "udp", VIDEO_PORT, "source", impairment)]))


def qdiscs(side: str) -> Any:
    return json.loads(command(f"tc -n {side} -j qdisc show dev {DEVICES[side]}"))


@JUDGES_MEDIANS
def test_each_condition_delays_only_video_and_control(
    baseline: dict[str, float], sides: dict[str, NetemInterface]
) -> None:
    """Under L0 to L5 the medians of only video and control shift, by the requested delay, within 1 ms."""
    shifts_ms = {}
    for name in CONDITIONS:
        apply_condition(sides, name)
        arrivals = send_flows([*DELAYED_FLOWS, *UNDELAYED_FLOWS], 40, 20)
        requested = condition(name)
        for flow_name, arrived in arrivals.items():
            expected_ms = requested.video_ms if flow_name.startswith("video") else requested.control_ms
            expected_ms = expected_ms if flow_name in {flow.name for flow in DELAYED_FLOWS} else 0.0
            shifts_ms[name, flow_name] = median(arrived.delays_ms) - baseline[flow_name] - expected_ms
            assert set(arrived.numbers) == set(range(40))
    assert {key: shift_ms for key, shift_ms in shifts_ms.items() if abs(shift_ms) >= 1} == {}


@JUDGES_MEDIANS
def test_state_is_delayed_where_requested(baseline: dict[str, float], sides: dict[str, NetemInterface]) -> None:
    """With `state_delay: with_video`, packets from the server's router get the video's delay, over TCP and over UDP."""
    transports: tuple[Literal["udp", "tcp"], ...] = ("udp", "tcp")
    for transport in transports:
        flows = netem_flows(
            condition("L1"),
            "server",
            video_port=VIDEO_PORT,
            control_port=CONTROL_PORT,
            state_delay="with_video",
            protocol=transport,
        )
        inside("server", lambda flows=flows: sides["server"].apply(flows))  # type: ignore[misc]
        state_flow = ProbeFlow("state now", "server", transport, CONTROL_PORT, 40_020)
        control_flow = ProbeFlow("control now", "client", "udp", 40_021, CONTROL_PORT)
        arrivals = send_flows([state_flow, control_flow], 20, 10)
        assert abs(median(arrivals["state now"].delays_ms) - baseline["state"] - 75) < 1
        assert median(arrivals["control now"].delays_ms) < 1


@JUDGES_MEDIANS
def test_control_over_tcp_is_delayed(sides: dict[str, NetemInterface]) -> None:
    """With routers over TCP, control to the server's router over TCP is delayed, and UDP to that port is not."""
    flows = netem_flows(condition("L4"), "client", video_port=VIDEO_PORT, control_port=CONTROL_PORT, protocol="tcp")
    inside("client", lambda: sides["client"].apply(flows))
    sent = [
        ProbeFlow("tcp", "client", "tcp", 40_030, CONTROL_PORT),
        ProbeFlow("udp", "client", "udp", 40_031, CONTROL_PORT),
    ]
    arrivals = send_flows(sent, 20, 20)

    assert abs(median(arrivals["tcp"].delays_ms) - 75) < 1
    assert median(arrivals["udp"].delays_ms) < 1


def test_change_neither_loses_nor_reorders_packets(sides: dict[str, NetemInterface]) -> None:
    """At 200 packets/s all packets arrive in order while the delay becomes 150, 30 and 225 ms and is then cleared."""
    apply_to_video(sides, Impairment())

    def change() -> None:
        for delay_ms in (150, 30, 225):
            apply_to_video(sides, Impairment(delay_ms))
            pause(400 * NS_PER_MS)
        inside("server", sides["server"].clear)

    arrivals = send_flows([VIDEO_FLOW], 100, 5, at={50: change})["video"]

    assert arrivals.numbers == list(range(arrivals.sent))
    assert max(arrivals.delays_ms) > 224
    assert qdiscs("server")[0]["kind"] == "noqueue"


def test_clearing_restores_the_qdiscs(sides: dict[str, NetemInterface]) -> None:
    """`tc -j qdisc show` prints the same before a condition is applied and after it is cleared."""
    before = qdiscs("server"), qdiscs("client")
    apply_condition(sides, "L5")
    with_delay = qdiscs("server"), qdiscs("client")
    for name, netem in sides.items():
        inside(name, netem.clear)

    assert with_delay != before
    assert (qdiscs("server"), qdiscs("client")) == before


OWNER = """
import sys
from pathlib import Path
from lavt.clock import pause
from lavt.transport.emulation.impairment import ImpairedFlow, Impairment
from lavt.transport.netem.netem import NetemInterface
netem = NetemInterface("va", directory=Path(sys.argv[1]))
netem.apply([ImpairedFlow("video", "udp", 5600, "source", Impairment(150))], condition="L2")
print("applied", flush=True)
pause(60_000_000_000)
"""


def test_delay_of_a_killed_owner_is_cleared_at_the_next_start(sides: dict[str, NetemInterface], tmp_path: Path) -> None:
    """SIGKILL of the owner leaves the delay; the next check reports the owner and restores the qdiscs."""
    before = qdiscs("server")
    start = lambda: subprocess.Popen(  # noqa: E731
        [sys.executable, "-B", "-c", OWNER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    with inside("server", start) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == "applied\n"
        with pytest.raises(UserError, match=f"L2 on va, .*process {owner.pid}"):
            inside("server", sides["server"].check)
        owner.send_signal(signal.SIGKILL)
    left_behind = qdiscs("server")
    output = inside("server", sides["server"].check)

    assert left_behind != before
    assert len(output) == 1
    assert f"process {owner.pid}" in output[0]
    assert qdiscs("server") == before
    assert inside("server", sides["server"].check) == []


def test_foreign_qdisc_is_rejected_and_left_alone(sides: dict[str, NetemInterface]) -> None:
    """An interface with a foreign root qdisc is rejected, and neither applying nor clearing changes it."""
    command("tc -n server qdisc add dev va root handle 1: prio bands 4")
    foreign = qdiscs("server")
    try:
        with pytest.raises(UserError, match="va has a root"):
            apply_to_video(sides, Impairment(75))
        with pytest.raises(UserError, match="va has a root"):
            inside("server", lambda: sides["server"].clear(any_owner=True))
        assert qdiscs("server") == foreign
    finally:
        command("tc -n server qdisc del dev va root")


@JUDGES_MEDIANS
@pytest.mark.parametrize(
    ("distribution", "min_ms", "max_ms"),
    [("normal", 7.9, 20.3), ("uniform", 5.8, 14.1), ("pareto", 3.0, 15.4), ("paretonormal", 4.3, 14.7)],
)
def test_jitter_spreads_delays_in_order(
    sides: dict[str, NetemInterface], distribution: Any, min_ms: float, max_ms: float
) -> None:
    """Under 10 ms of jitter the delays' interquartile range is that of the distribution, and no packet is reordered.

    The limits are those that one of 100 000 samples of 100 packets in order exceeds, drawn from tc's tables.
    """
    apply_to_video(
        sides, Impairment(75, jitter_ms=1, jitter_distribution="pareto")
    )  # the next call must replace this distribution
    apply_to_video(sides, Impairment(75, jitter_ms=10, jitter_distribution=distribution))
    arrivals = send_flows([VIDEO_FLOW], 100, 30)["video"]
    p5, p25, p75, p95 = (quantiles(arrivals.delays_ms, n=20)[index] for index in (0, 4, 14, 18))

    assert len(arrivals.arrived) == 100
    assert arrivals.inversions == 0
    assert min_ms < p75 - p25 < max_ms
    if distribution == "uniform":
        assert 65 <= p5 < p95 < 87


@JUDGES_MEDIANS
def test_jitter_in_order_increases_the_median(sides: dict[str, NetemInterface]) -> None:
    """At 300 packets/s, 10 ms of normal jitter in order add 3 to 9 ms to the median: late packets delay others."""
    apply_to_video(sides, Impairment(75, jitter_ms=10))
    arrivals = send_flows([VIDEO_FLOW], 400, 1000 / 300)["video"]

    assert arrivals.inversions == 0
    assert 3 < median(arrivals.delays_ms) - 75 < 9


@JUDGES_MEDIANS
def test_correlated_jitter_is_correlated(sides: dict[str, NetemInterface]) -> None:
    """With a correlation of 0.9, delays 20 ms apart have a correlation of 0.6 to 0.97, in order."""
    apply_to_video(sides, Impairment(75, jitter_ms=10, jitter_correlation=0.9))
    arrivals = send_flows([VIDEO_FLOW], 400, 20)["video"]
    delays_ms = arrivals.delays_in_sending_order_ms
    # The correlation of ranks counts a stall of the machine as one sample.
    rank_correlation = float(spearmanr(delays_ms[:-1], delays_ms[1:]).statistic)

    assert len(arrivals.arrived) == 400
    assert arrivals.inversions == 0
    assert 0.6 < rank_correlation < 0.97
    p25, _, p75 = quantiles(delays_ms, n=4)
    assert 7 < p75 - p25 < 20


def burst_lengths(arrivals: Arrivals) -> list[int]:
    """Return the lengths of the bursts of lost packets."""
    return [after - before - 1 for before, after in pairwise(sorted(arrivals.numbers)) if after - before > 1]


def test_loss_has_the_requested_share(sides: dict[str, NetemInterface]) -> None:
    """Of 1000 packets a tenth are lost, independently of each other, within four standard deviations."""
    apply_to_video(sides, Impairment(75, loss=0.1))
    arrivals = send_flows([VIDEO_FLOW], 1000, 2)["video"]
    lost = 1000 - len(arrivals.arrived)

    assert abs(lost - 100) < 4 * math.sqrt(1000 * 0.1 * 0.9)
    assert fmean(burst_lengths(arrivals)) < 1.5  # 1 / (1 - 0.1) is expected


def test_burst_loss_has_the_requested_length(sides: dict[str, NetemInterface]) -> None:
    """With 10 % loss in bursts of 5, 4 to 17 % of 3000 packets are lost, in bursts of 3 to 8.1 on average.

    One of 100 000 samples exceeds each limit.
    """
    apply_to_video(sides, Impairment(10, loss=0.1, loss_burst_packets=5))
    arrivals = send_flows([VIDEO_FLOW], 3000, 1)["video"]
    lost = 3000 - len(arrivals.arrived)

    assert 3.0 < fmean(burst_lengths(arrivals)) < 8.1
    assert 130 < lost < 520


@JUDGES_MEDIANS
def test_rate_limit_spaces_packets(sides: dict[str, NetemInterface]) -> None:
    """At 2 Mbit/s packets of 1042 bytes, sent 1 ms apart, leave 4.17 ms apart in the median."""
    apply_to_video(sides, Impairment(20, rate_bps=2_000_000))
    arrivals = send_flows([ProbeFlow("video", "server", "udp", VIDEO_PORT, 40_000, packet_bytes=1000)], 60, 1)["video"]
    received_ns = [packet.received_ns for packet in arrivals.arrived]
    spacing_ms = median(after - before for before, after in pairwise(received_ns)) / NS_PER_MS

    assert len(arrivals.arrived) == 60
    assert arrivals.inversions == 0
    assert abs(spacing_ms - 1042 * 8 / 2_000_000 * 1000) < 0.2


@JUDGES_MEDIANS
def test_reordering_has_the_requested_share(sides: dict[str, NetemInterface]) -> None:
    """A quarter of 400 packets are not delayed, within four standard deviations, and only these overtake others."""
    apply_to_video(sides, Impairment(75, jitter_ms=5, reorder=0.25))
    arrivals = send_flows([VIDEO_FLOW], 400, 5)["video"]
    undelayed_numbers = [packet.number for packet in arrivals.arrived if packet.delay_ms < 30]
    delayed_numbers = [packet.number for packet in arrivals.arrived if packet.delay_ms >= 30]

    assert len(arrivals.arrived) == 400
    assert abs(len(undelayed_numbers) - 100) < 4 * math.sqrt(400 * 0.25 * 0.75)
    assert delayed_numbers == sorted(delayed_numbers)


SCRIPTS_OF_ROLES: list[tuple[str, Role, str, str]] = [
    ("server.sh va 150", "server", "va", "L4"),
    ("client.sh vb 75", "client", "vb", "L4"),
]


@pytest.mark.parametrize(("script", "side", "device", "name"), SCRIPTS_OF_ROLES)
def test_scripts_and_command_have_the_same_effect(
    sides: dict[str, NetemInterface], script: str, side: Role, device: str, name: str
) -> None:
    """The scripts of `netem/` and `NetemInterface` make the same qdiscs and filters, and clear.sh deletes them."""
    folder = shipped("netem/conditions.yaml").parent

    def tc_output() -> tuple[Any, str]:
        return qdiscs(side), command(f"tc -n {side} filter show dev {device}")

    before = tc_output()
    command(f"ip netns exec {side} sh {folder}/{script}")
    by_script = tc_output()
    command(f"ip netns exec {side} sh {folder}/clear.sh {device}")
    cleared = tc_output()
    apply_condition(sides, name)

    assert by_script == tc_output()
    assert cleared == before


@pytest.fixture
def lavt(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Callable[..., CommandResult]:
    """Return a function that runs a command of LAVT in this process, since starting one takes seconds here."""
    monkeypatch.setattr(console, "queue_output", lambda *_: None)  # it would replace pytest's output

    def run(*arguments: str) -> CommandResult:
        with pytest.raises(SystemExit) as completed:
            console.run_command(lambda: build_app()(list(arguments)))
        output = capsys.readouterr()
        code = completed.value.code
        return CommandResult(code if isinstance(code, int) else 0, output.out, output.err)

    return run


@JUDGES_MEDIANS
def test_command_applies_verifies_and_clears(lavt: Callable[..., CommandResult]) -> None:
    """On lo, apply reports its measurements, verify finds a manual change, and clear restores the interface."""
    before = command("tc -j qdisc show dev lo")
    applied = lavt("netem", "apply", "L4", "--role", "both", "--interface", "lo")
    verified = lavt("netem", "verify", "--interface", "lo", "--json")
    status = lavt("netem", "show", "--interface", "lo")
    command("tc qdisc change dev lo parent 4c56:4 handle 4c01: netem limit 10000 delay 100ms rate 10gbit")
    changed = lavt("netem", "verify", "--interface", "lo")
    cleared = lavt("netem", "clear", "--interface", "lo")

    assert applied.code == 0, applied.err
    assert "tc qdisc add dev lo root handle 4c56: prio bands 6" in applied.out
    assert "\nverified: " in applied.out
    verification = json.loads(verified.out)
    assert (verified.code, verification["condition"], verification["reasons"]) == (0, "L4", [])
    assert abs(verification["measured"]["video"]["median_ms"] - 150) < 1
    assert "video: delay_ms 150\n" in status.out
    assert changed.code == 1
    assert "delay_ms is 100 instead of 150" in changed.err
    assert cleared.code == 0
    assert "removed: L4 on lo" in cleared.err
    assert command("tc -j qdisc show dev lo") == before


def test_apply_restores_the_interface_if_verification_fails(lavt: Callable[..., CommandResult]) -> None:
    """If `lavt netem apply` cannot measure because the interface is down, it exits with 2 and restores the qdisc."""
    command("ip link add idle type dummy")
    before = command("tc -j qdisc show dev idle")
    applied = lavt("netem", "apply", "L1", "--role", "server", "--interface", "idle")

    assert applied.code == 2
    assert "cannot measure idle" in applied.err
    assert command("tc -j qdisc show dev idle") == before
    command("ip link del idle")


@pytest.mark.parametrize(
    ("name", "with_signal"), [("L1", signal.SIGINT), ("L1", signal.SIGHUP), ("jitter_correlated", signal.SIGINT)]
)
def test_held_impairment_ends_with_its_command(
    lavt: Callable[..., CommandResult], stalls: Stalls, name: str, with_signal: signal.Signals
) -> None:
    """`lavt netem apply --hold` excludes other programs; a signal that ends the command restores the interface."""
    before = command("tc -j qdisc show dev lo")
    since_ns = CLOCK.now().mono_ns
    arguments = ["netem", "apply", name, "--role", "server", "--interface", "lo", "--hold", "--json"]
    with subprocess.Popen(
        [sys.executable, "-B", "-m", "lavt", *arguments], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as holder:
        assert holder.stdout is not None
        printed = holder.stdout.readline()
        with stalls.excusing_failures(since_ns, share=MEDIAN_SHARE):  # a failed verification ends the command
            assert printed, "the command has ended"
            assert json.loads(printed)["reasons"] == []
        rejected = lavt("netem", "apply", "L2", "--role", "server", "--interface", "lo")
        with_delay = command("tc -j qdisc show dev lo")
        os.killpg(holder.pid, with_signal)
        holder.wait(30)

    assert with_delay != before
    assert rejected.code == 2
    assert f"process {holder.pid}" in rejected.err
    assert holder.returncode == 0
    assert command("tc -j qdisc show dev lo") == before


def planned(*changes: str) -> PlannedRun:
    all_changes = ["time=real", "network.injection=netem", *changes]
    return plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), all_changes))


@JUDGES_MEDIANS
@pytest.mark.parametrize("name", ["L4", "jitter", "jitter_correlated", "loss", "loss_burst", "rate", "reorder"])
def test_each_condition_of_a_run_is_verified(name: str, tmp_path: Path) -> None:
    """Each condition is verified on lo before and after a run, on the run's ports, and lo is restored."""
    before = command("tc -j qdisc show dev lo")
    with NetemRun(planned(f"network.condition={name}"), NetemInterface("lo", directory=tmp_path)) as run:
        run.apply(video_port=40_100, control_port=40_101)
        report = json.loads(json.dumps(run.report()))

    assert netem_invalid_reasons(report) == []
    assert abs(report["after"]["NTP"]["median_ms"]) < 1
    assert command("tc -j qdisc show dev lo") == before


def test_drive_with_netem_measures_the_injected_delay(
    lavt: Callable[..., CommandResult], tmp_path: Path, stalls: Stalls
) -> None:
    """A short drive under L4 on lo measures 150 and 75 ms before and after the drive, and restores lo."""
    before = command("tc -j qdisc show dev lo")
    changes = [
        "time=real",
        "network.injection=netem",
        "network.condition=L4",
        "vehicle.time_limit_s=4",
        "vehicle.scenery=none",
        "camera.width_px=320",
        "camera.height_px=240",
        "camera.rate_hz=10",
        "record.video=false",
    ]
    set_options = [word for change in changes for word in ("--set", change)]
    out = tmp_path / "run"
    since_ns = CLOCK.now().mono_ns
    completed = lavt("run", str(shipped("configs/demo.yaml")), *set_options, "--out", str(out), "--json")
    assert completed.code == 0, completed.err[-500:]
    output = json.loads((out / "netem.json").read_text())
    result = json.loads((out / "result.json").read_text())

    errors_ms = [
        output[when][flow]["median_ms"] - requested_ms
        for when in ("before", "after")
        for flow, requested_ms in (("video", 150), ("control", 75))
    ]
    injection_reasons = [reason for reason in result["invalid_reasons"] if reason["code"] == "injection_differs"]
    with stalls.excusing_failures(since_ns, share=MEDIAN_SHARE):
        assert max(map(abs, errors_ms)) < 1, f"{errors_ms}, {injection_reasons}"
        assert not injection_reasons
    assert result["injection"] == "netem"
    assert command("tc -j qdisc show dev lo") == before


def test_interrupted_run_restores_the_loopback(tmp_path: Path) -> None:
    """SIGINT during a run with netem ends the run in order and restores lo."""
    before = command("tc -j qdisc show dev lo")
    arguments = ["run", str(shipped("configs/demo.yaml")), "--out", str(tmp_path / "run")]
    set_options = ["--set", "time=real", "--set", "network.injection=netem", "--set", "network.condition=L4"]
    with subprocess.Popen(
        [sys.executable, "-B", "-m", "lavt", *arguments, *set_options],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as run:
        for _ in range(600):
            if "4c02" in command("tc -j qdisc show dev lo"):  # the control's netem: the run has applied it
                break
            pause(100 * NS_PER_MS)
        with_delay = command("tc -j qdisc show dev lo")
        run.send_signal(signal.SIGINT)
        run.wait(60)

    assert "4c02" in with_delay
    assert run.returncode == 1
    assert command("tc -j qdisc show dev lo") == before


def test_a_second_interrupt_of_a_sweep_restores_the_loopback(tmp_path: Path) -> None:
    """The second Ctrl-C kills the run in progress, whose netem is then removed from lo by the sweep itself."""
    before = command("tc -j qdisc show dev lo")
    settings = ["time=real", "network.injection=netem", "network.inherent=loopback", "repetitions=2"]
    settings += ["conditions=[L4]", "routes=[a_key]"]
    arguments = [word for setting in settings for word in ("--set", setting)]
    with subprocess.Popen(
        [
            *(sys.executable, "-B", "-m", "lavt", "sweep", str(shipped("configs/sweep.yaml")), "--jobs", "1"),
            *("--out", str(tmp_path / "sweep"), *arguments),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    ) as sweep:
        assert sweep.stderr is not None
        for _ in range(900):
            if "4c02" in command("tc -j qdisc show dev lo"):
                break
            pause(100 * NS_PER_MS)
        os.killpg(sweep.pid, signal.SIGINT)
        printed = list(takewhile(lambda line: "Ctrl-C again" not in line, sweep.stderr))
        with_delay = command("tc -j qdisc show dev lo")
        os.killpg(sweep.pid, signal.SIGINT)
        _, rest = sweep.communicate(timeout=120)

    assert "4c02" in with_delay, "".join(printed) + rest
    assert sweep.returncode == 1
    assert "which has died: the interface is restored" in rest
    assert command("tc -j qdisc show dev lo") == before
