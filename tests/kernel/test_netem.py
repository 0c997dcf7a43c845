from __future__ import annotations

import json
import math
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from statistics import fmean, median, quantiles
from typing import Any

import pytest
from scipy.stats import spearmanr
from tests.kernel.lane.verdicts import MEDIAN_SHARE
from tests.kernel.namespaces import DEVICES, Flight, Flown, command, fly, inside, make_pair, take_pair_away
from tests.support.stalls import Stalls

from lavt.assembly.injection import Role, netem_flows
from lavt.cli import console
from lavt.cli.main import app
from lavt.clock import MachineClock, pause
from lavt.config import RunConfig
from lavt.config_file import condition, load_config, shipped
from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.experiment.runs.netem_run import NetemRun, netem_reasons
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.transport.emulation.impairment import ExemptPort, ImpairedFlow, Impairment
from lavt.transport.netem.netem import NetemInterface

CLOCK = MachineClock()
VIDEO, CONTROL, PROBE = 5600, 7448, 5602
ALWAYS_EXEMPT = [ExemptPort("udp", PROBE, "the clock probe")]
L = ("L0", "L1", "L2", "L3", "L4", "L5")
MEDIANS = pytest.mark.judges_times(share=MEDIAN_SHARE)
"""For tests whose assertions are about medians or other quantiles of delays."""

HELD = [
    Flight("video", "server", "udp", VIDEO, 40_000),
    Flight("video over IPv6", "server", "udp", VIDEO, 40_001, version=6),
    Flight("control", "client", "udp", 40_002, CONTROL),
    Flight("control over IPv6", "client", "udp", 40_003, CONTROL, version=6),
]
UNTOUCHED = [
    Flight("challenges of the video's path", "server", "udp", VIDEO, 40_010, first_byte=ord("L")),
    Flight("RTCP and hellos upstream", "client", "udp", 40_011, VIDEO),
    Flight("state", "server", "udp", CONTROL, 40_012),
    Flight("NTP down", "server", "udp", 123, 123),
    Flight("NTP up", "client", "udp", 124, 123),
    Flight("ssh down", "server", "tcp", 22, 40_013),
    Flight("ssh up", "client", "tcp", 40_014, 22),
    Flight("clock probe down", "server", "udp", PROBE, 40_015),
    Flight("clock probe up", "client", "udp", 40_016, PROBE),
    Flight("tcp to the control's port", "client", "tcp", 40_017, CONTROL),
    Flight("udp to the client's control port", "server", "udp", 40_018, 40_019),
]


@pytest.fixture(scope="module")
def baseline() -> Iterator[dict[str, float]]:
    """Two namespaces, and the median delay of every flight between them without anything injected."""
    make_pair()
    fly([*HELD, *UNTOUCHED], 3, 10)  # whoever asks for addresses first waits for them
    yield {name: median(flown.delays_ms) for name, flown in fly([*HELD, *UNTOUCHED], 30, 10).items()}
    take_pair_away()


@pytest.fixture
def sides(baseline: dict[str, float], tmp_path: Path) -> Iterator[dict[str, NetemInterface]]:
    """The interfaces of both sides; nothing is left on them."""
    del baseline
    made = {name: NetemInterface(device, directory=tmp_path) for name, device in DEVICES.items()}
    yield made
    for name, netem in made.items():
        inside(name, lambda netem=netem: netem.clear(at_once=True, any_owner=True))  # type: ignore[misc]


def hold(sides: dict[str, NetemInterface], name: str) -> None:
    """Apply a condition on both sides, each its own part."""
    roles: Sequence[Role] = ("server", "client")
    for role in roles:
        flows = netem_flows(condition(name), role, video_port=VIDEO, control_port=CONTROL)
        inside(role, lambda role=role, flows=flows: sides[role].apply(flows, exempt=ALWAYS_EXEMPT, condition=name))  # type: ignore[misc]


def hold_video(sides: dict[str, NetemInterface], impairment: Impairment) -> None:
    """Give the server's video a law."""
    inside("server", lambda: sides["server"].apply([ImpairedFlow("video", "udp", VIDEO, "source", impairment)]))


def queues(side: str) -> Any:
    return json.loads(command(f"tc -n {side} -j qdisc show dev {DEVICES[side]}"))


@MEDIANS
def test_each_condition_shifts_video_and_control_and_nothing_else(
    baseline: dict[str, float], sides: dict[str, NetemInterface]
) -> None:
    """Under L0 to L5 medians of video and control shift as asked within 1 ms, and all others by less than 1 ms."""
    shifts_ms = {}
    for name in L:
        hold(sides, name)
        flown = fly([*HELD, *UNTOUCHED], 40, 20)
        requested = condition(name)
        for flight, arrived in flown.items():
            wanted_ms = requested.video_ms if flight.startswith("video") else requested.control_ms
            wanted_ms = wanted_ms if flight in {each.name for each in HELD} else 0.0
            shifts_ms[name, flight] = median(arrived.delays_ms) - baseline[flight] - wanted_ms
            assert set(arrived.numbers) == set(range(40))
    assert {key: shift_ms for key, shift_ms in shifts_ms.items() if abs(shift_ms) >= 1} == {}


@MEDIANS
def test_the_state_is_held_where_that_is_requested(
    baseline: dict[str, float], sides: dict[str, NetemInterface]
) -> None:
    """With state_delay with_video, what the server's router sends is held as long as the video, by tcp as by udp."""
    for protocol in ("udp", "tcp"):
        flows = netem_flows(
            condition("L1"), "server", video_port=VIDEO, control_port=CONTROL, state_delay="with_video",
            protocol="udp" if protocol == "udp" else "tcp",
        )  # fmt: skip
        inside("server", lambda flows=flows: sides["server"].apply(flows))  # type: ignore[misc]
        held = Flight("state now", "server", "udp" if protocol == "udp" else "tcp", CONTROL, 40_020)
        other = Flight("control now", "client", "udp", 40_021, CONTROL)
        flown = fly([held, other], 20, 10)
        assert abs(median(flown["state now"].delays_ms) - baseline["state"] - 75) < 1
        assert median(flown["control now"].delays_ms) < 1


@MEDIANS
def test_control_by_tcp_is_held(sides: dict[str, NetemInterface]) -> None:
    """Where the routers talk by tcp, the control to the server's router is held, and udp to that port is not."""
    flows = netem_flows(condition("L4"), "client", video_port=VIDEO, control_port=CONTROL, protocol="tcp")
    inside("client", lambda: sides["client"].apply(flows))
    flights = [Flight("tcp", "client", "tcp", 40_030, CONTROL), Flight("udp", "client", "udp", 40_031, CONTROL)]
    flown = fly(flights, 20, 20)

    assert abs(median(flown["tcp"].delays_ms) - 75) < 1
    assert median(flown["udp"].delays_ms) < 1


def test_no_packet_is_lost_or_reordered_by_a_change(sides: dict[str, NetemInterface]) -> None:
    """From 0 to 150 to 30 to 225 ms and cleared, at 200 packets a second: all arrive, in the order of sending."""
    hold_video(sides, Impairment())

    def change() -> None:
        for delay_ms in (150, 30, 225):
            hold_video(sides, Impairment(delay_ms))
            pause(400 * NS_PER_MS)
        inside("server", sides["server"].clear)

    flown = fly([HELD[0]], 100, 5, at={50: change})["video"]

    assert flown.numbers == list(range(flown.sent))
    assert max(flown.delays_ms) > 224
    assert queues("server")[0]["kind"] == "noqueue"


def test_clearing_leaves_the_queue_as_it_was(sides: dict[str, NetemInterface]) -> None:
    """What `tc -j qdisc show` says before a condition is applied and after it is cleared is the same."""
    before = queues("server"), queues("client")
    hold(sides, "L5")
    held = queues("server"), queues("client")
    for name, netem in sides.items():
        inside(name, netem.clear)

    assert held != before
    assert (queues("server"), queues("client")) == before


OWNER = """
import sys
from pathlib import Path
from lavt.cli import console
from lavt.cli.main import app
from lavt.clock import MachineClock, pause
from lavt.transport.netem import Flow, Law
from lavt.transport.netem_control import Netem
netem = Netem("va", directory=Path(sys.argv[1]))
netem.apply([Flow("video", "udp", 5600, "source", Law(150))], condition="L2")
print("held", flush=True)
pause(60_000_000_000)
"""


def test_a_delay_whose_owner_was_killed_is_taken_away_at_the_next_start(
    sides: dict[str, NetemInterface], tmp_path: Path
) -> None:
    """SIGKILL of the owner leaves the delay; whoever next asks for netem there puts the queue back, and says so."""
    before = queues("server")
    start = lambda: subprocess.Popen(  # noqa: E731
        [sys.executable, "-B", "-c", OWNER, str(tmp_path)], stdout=subprocess.PIPE, text=True
    )
    with inside("server", start) as owner:
        assert owner.stdout is not None
        assert owner.stdout.readline() == "held\n"
        with pytest.raises(UserError, match=f"L2 on va, of process {owner.pid}"):
            inside("server", sides["server"].check)
        owner.send_signal(signal.SIGKILL)
    left = queues("server")
    said = inside("server", sides["server"].check)

    assert left != before
    assert said == [f"va was still held (L2 on va, of process {owner.pid}, which has died): it is put back"]
    assert queues("server") == before
    assert inside("server", sides["server"].check) == []


def test_somebody_elses_queue_is_rejected_and_left_alone(sides: dict[str, NetemInterface]) -> None:
    """An interface whose root somebody made is refused, and neither applying nor clearing changes it."""
    command("tc -n server qdisc add dev va root handle 1: prio bands 4")
    there = queues("server")
    try:
        with pytest.raises(UserError, match="va has a queue that is not ours"):
            hold_video(sides, Impairment(75))
        with pytest.raises(UserError, match="va has a queue that is not ours"):
            inside("server", lambda: sides["server"].clear(any_owner=True))
        assert queues("server") == there
    finally:
        command("tc -n server qdisc del dev va root")


@MEDIANS
@pytest.mark.parametrize(
    ("distribution", "least_ms", "most_ms"),
    [("normal", 9, 19), ("uniform", 7, 14), ("pareto", 4, 12), ("paretonormal", 4, 12)],
)
def test_jitter_spreads_and_keeps_order(
    sides: dict[str, NetemInterface], distribution: Any, least_ms: float, most_ms: float
) -> None:
    """Half of the packets are within 13.5 ms (normal) or 10 ms (uniform) under 10 ms of jitter, none is overtaken."""
    hold_video(sides, Impairment(75, jitter_ms=5, jitter_distribution="pareto"))  # a table that must not stay
    hold_video(sides, Impairment(75, jitter_ms=10, jitter_distribution=distribution))
    flown = fly([HELD[0]], 100, 30)["video"]
    p5, p25, p75, p95 = (quantiles(flown.delays_ms, n=20)[index] for index in (0, 4, 14, 18))

    assert len(flown.arrived) == 100
    assert flown.inversions == 0
    assert least_ms < p75 - p25 < most_ms
    if distribution == "uniform":
        assert 65 <= p5 < p95 < 87


@MEDIANS
def test_jitter_in_order_is_later(sides: dict[str, NetemInterface]) -> None:
    """At 300 packets a second, 10 ms of normal jitter in order add 3 to 9 ms to the median: the late hold up others."""
    hold_video(sides, Impairment(75, jitter_ms=10))
    flown = fly([HELD[0]], 400, 1000 / 300)["video"]

    assert flown.inversions == 0
    assert 3 < median(flown.delays_ms) - 75 < 9


@MEDIANS
def test_correlated_jitter_wanders(sides: dict[str, NetemInterface]) -> None:
    """With a correlation of 0.9 the delays of packets 20 ms apart are correlated by 0.6 to 0.97, in order."""
    hold_video(sides, Impairment(75, jitter_ms=10, jitter_correlation=0.9))
    flown = fly([HELD[0]], 400, 20)["video"]
    delays_ms = flown.in_order_of_sending_ms
    found = float(spearmanr(delays_ms[:-1], delays_ms[1:]).statistic)  # of ranks: a stall of the machine counts as one

    assert len(flown.arrived) == 400
    assert flown.inversions == 0
    assert 0.6 < found < 0.97
    p25, _, p75 = quantiles(delays_ms, n=4)
    assert 7 < p75 - p25 < 20


def runs_of_lost(flown: Flown) -> list[int]:
    """Lengths of the runs of lost packets."""
    return [after - before - 1 for before, after in pairwise(sorted(flown.numbers)) if after - before > 1]


def test_loss_is_as_requested(sides: dict[str, NetemInterface]) -> None:
    """Of 1000 packets a tenth are lost, within four standard deviations, each by itself."""
    hold_video(sides, Impairment(75, loss=0.1))
    flown = fly([HELD[0]], 1000, 2)["video"]
    lost = 1000 - len(flown.arrived)

    assert abs(lost - 100) < 4 * math.sqrt(1000 * 0.1 * 0.9)
    assert fmean(runs_of_lost(flown)) < 1.5  # 1 / (1 - 0.1) is expected


def test_loss_comes_in_bursts_where_requested(sides: dict[str, NetemInterface]) -> None:
    """A tenth lost in bursts of 5: of 3000 packets the mean burst is 3.3 to 7.5 and the loss 5 to 16 %."""
    hold_video(sides, Impairment(10, loss=0.1, loss_burst_packets=5))
    flown = fly([HELD[0]], 3000, 1)["video"]
    lost = 3000 - len(flown.arrived)

    assert 3.3 < fmean(runs_of_lost(flown)) < 7.5
    assert 150 < lost < 480


@MEDIANS
def test_rate_spaces_packets(sides: dict[str, NetemInterface]) -> None:
    """At 2 Mbit/s packets of 1042 bytes, sent 1 ms apart, leave 4.17 ms apart in the median."""
    hold_video(sides, Impairment(20, rate_bps=2_000_000))
    flown = fly([Flight("video", "server", "udp", VIDEO, 40_000, bytes_each=1000)], 60, 1)["video"]
    stamps_ns = [stamp_ns for _, _, stamp_ns in flown.arrived]
    spacing_ms = median(after - before for before, after in pairwise(stamps_ns)) / NS_PER_MS

    assert len(flown.arrived) == 60
    assert flown.inversions == 0
    assert abs(spacing_ms - 1042 * 8 / 2_000_000 * 1000) < 0.2


@MEDIANS
def test_reordering_is_as_requested(sides: dict[str, NetemInterface]) -> None:
    """A quarter of 400 packets are not delayed, within four standard deviations, and only these overtake."""
    hold_video(sides, Impairment(75, jitter_ms=5, reorder=0.25))
    flown = fly([HELD[0]], 400, 5)["video"]
    early = [number for number, delay_ms, _ in flown.arrived if delay_ms < 30]
    held = [number for number, delay_ms, _ in flown.arrived if delay_ms >= 30]

    assert len(flown.arrived) == 400
    assert abs(len(early) - 100) < 4 * math.sqrt(400 * 0.25 * 0.75)
    assert held == sorted(held)


SCRIPTS: list[tuple[str, Role, str, str]] = [
    ("server.sh va 150", "server", "va", "L4"),
    ("client.sh vb 75", "client", "vb", "L4"),
]


@pytest.mark.parametrize(("script", "side", "device", "name"), SCRIPTS)
def test_the_scripts_do_what_the_command_does(
    sides: dict[str, NetemInterface], script: str, side: Role, device: str, name: str
) -> None:
    """What tc tells after a script of `netem/` is what it tells after the command's code, and clear.sh clears it."""
    folder = shipped("netem/conditions.yaml").parent

    def told() -> tuple[Any, str]:
        return queues(side), command(f"tc -n {side} filter show dev {device}")

    free = told()
    command(f"ip netns exec {side} sh {folder}/{script}")
    by_script = told()
    command(f"ip netns exec {side} sh {folder}/clear.sh {device}")
    cleared = told()
    hold(sides, name)

    assert by_script == told()
    assert cleared == free


@dataclass(frozen=True)
class Ended:
    """What a command left."""

    code: int
    out: str
    err: str


@pytest.fixture
def lavt(capsys: pytest.CaptureFixture[str]) -> Callable[..., Ended]:
    """Give a function that runs a command of LAVT in this process: starting one takes seconds here."""

    def run(*words: str) -> Ended:
        with pytest.raises(SystemExit) as ended:
            console.run_command(lambda: app(list(words)))
        said = capsys.readouterr()
        code = ended.value.code
        return Ended(code if isinstance(code, int) else 0, said.out, said.err)

    return run


@MEDIANS
def test_the_command_applies_verifies_and_clears(lavt: Callable[..., Ended]) -> None:
    """On lo: apply exits 0 and says what it measured, verify finds what was changed by hand, clear puts it back."""
    before = command("tc -j qdisc show dev lo")
    applied = lavt("netem", "apply", "L4", "--role", "both", "--interface", "lo")
    verified = lavt("netem", "verify", "--interface", "lo", "--json")
    shown = lavt("netem", "show", "--interface", "lo")
    command("tc qdisc change dev lo parent 4c56:4 handle 4c01: netem limit 10000 delay 100ms rate 10gbit")
    changed = lavt("netem", "verify", "--interface", "lo")
    cleared = lavt("netem", "clear", "--interface", "lo")

    assert applied.code == 0, applied.err
    assert "tc qdisc add dev lo root handle 4c56: prio bands 6" in applied.out
    assert "read back and measured as asked" in applied.out
    answer = json.loads(verified.out)
    assert (verified.code, answer["condition"], answer["reasons"]) == (0, "L4", [])
    assert abs(answer["measured"]["video"]["median_ms"] - 150) < 1
    assert "video: delay_ms 150\n" in shown.out
    assert changed.code == 1
    assert "delay_ms is 100 where 150 was asked" in changed.err
    assert cleared.code == 0
    assert cleared.err == "lavt: taken away: L4 on lo, left in place\n"
    assert command("tc -j qdisc show dev lo") == before


def test_apply_puts_the_interface_back_where_it_cannot_be_verified(lavt: Callable[..., Ended]) -> None:
    """An apply whose measuring fails, as the interface is down, ends with 2 and leaves the queue as it was."""
    command("ip link add idle type dummy")
    before = command("tc -j qdisc show dev idle")
    applied = lavt("netem", "apply", "L1", "--role", "server", "--interface", "idle")

    assert applied.code == 2
    assert "idle cannot be measured" in applied.err
    assert command("tc -j qdisc show dev idle") == before
    command("ip link del idle")


@pytest.mark.parametrize(
    ("name", "number"), [("L1", signal.SIGINT), ("L1", signal.SIGHUP), ("jitter_correlated", signal.SIGINT)]
)
def test_a_held_delay_ends_with_its_command(
    lavt: Callable[..., Ended], stalls: Stalls, name: str, number: signal.Signals
) -> None:
    """`lavt netem apply --hold` holds, refuses others, and puts the interface back when the terminal ends its group."""
    before = command("tc -j qdisc show dev lo")
    since_ns = CLOCK.now().mono_ns
    words = ["netem", "apply", name, "--role", "server", "--interface", "lo", "--hold", "--json"]
    with subprocess.Popen(
        [sys.executable, "-B", "-m", "lavt", *words], stdout=subprocess.PIPE, text=True, start_new_session=True
    ) as active_operator:
        assert active_operator.stdout is not None
        answer = json.loads(active_operator.stdout.readline())
        measured_ns = CLOCK.now().mono_ns
        rejected = lavt("netem", "apply", "L2", "--role", "server", "--interface", "lo")
        held = command("tc -j qdisc show dev lo")
        os.killpg(active_operator.pid, number)
        active_operator.wait(30)

    with stalls.judging(since_ns, measured_ns, share=MEDIAN_SHARE):
        assert answer["reasons"] == []
    assert held != before
    assert rejected.code == 2
    assert f"{name} on lo, of process {active_operator.pid}" in rejected.err
    assert active_operator.returncode == 0
    assert command("tc -j qdisc show dev lo") == before


def planned(*changes: str) -> PlannedRun:
    sets = ["time=real", "network.injection=netem", *changes]
    return plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), sets))


@MEDIANS
@pytest.mark.parametrize("name", ["L4", "jitter", "jitter_correlated", "loss", "loss_burst", "rate", "reorder"])
def test_what_holds_a_run_does_as_each_condition_asks(name: str, tmp_path: Path) -> None:
    """Each condition, as a run holds its ports on lo, is read back and measured as asked twice, and lo is as it was."""
    before = command("tc -j qdisc show dev lo")
    with NetemRun(planned(f"network.condition={name}"), NetemInterface("lo", directory=tmp_path)) as run:
        run.apply(video_port=40_100, control_port=40_101)
        report = json.loads(json.dumps(run.report()))

    assert netem_reasons(report) == []
    assert abs(report["after"]["NTP"]["median_ms"]) < 1
    assert command("tc -j qdisc show dev lo") == before


def test_a_drive_with_netem_is_measured_as_requested(
    lavt: Callable[..., Ended], tmp_path: Path, stalls: Stalls
) -> None:
    """A short drive under L4 on lo says before and after that 150 and 75 ms were injected, and leaves lo as it was."""
    before = command("tc -j qdisc show dev lo")
    sets = [
        "time=real", "network.injection=netem", "network.condition=L4", "vehicle.time_limit_s=4",
        "vehicle.scenery=none",
        "camera.width_px=320", "camera.height_px=240", "camera.rate_hz=10", "record.video=false",
    ]  # fmt: skip
    changes = [word for each in sets for word in ("--set", each)]
    out = tmp_path / "run"
    since_ns = CLOCK.now().mono_ns
    ended = lavt("run", str(shipped("configs/demo.yaml")), *changes, "--out", str(out), "--json")
    assert ended.code == 0, ended.err[-500:]
    said = json.loads((out / "netem.json").read_text())
    result = json.loads((out / "result.json").read_text())

    off_ms = [
        said[when][flow]["median_ms"] - requested_ms
        for when in ("before", "after")
        for flow, requested_ms in (("video", 150), ("control", 75))
    ]
    delayed = [reason for reason in result["invalid_reasons"] if "delayed" in reason]
    with stalls.judging(since_ns, share=MEDIAN_SHARE):
        assert max(map(abs, off_ms)) < 1, f"{off_ms}, {delayed}"
        assert not delayed
    assert result["injection"] == "netem"
    assert command("tc -j qdisc show dev lo") == before


def test_a_run_that_is_stopped_leaves_the_loopback_as_it_was(tmp_path: Path) -> None:
    """SIGINT in the middle of a run with netem ends it in order, and lo is as it was."""
    before = command("tc -j qdisc show dev lo")
    words = ["run", str(shipped("configs/demo.yaml")), "--out", str(tmp_path / "run")]
    sets = ["--set", "time=real", "--set", "network.injection=netem", "--set", "network.condition=L4"]
    with subprocess.Popen(
        [sys.executable, "-B", "-m", "lavt", *words, *sets],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    ) as run:
        for _ in range(600):
            if "4c02" in command("tc -j qdisc show dev lo"):  # the control's: the run has begun to hold
                break
            pause(100 * NS_PER_MS)
        held = command("tc -j qdisc show dev lo")
        run.send_signal(signal.SIGINT)
        run.wait(60)

    assert "4c02" in held
    assert run.returncode == 1
    assert command("tc -j qdisc show dev lo") == before
