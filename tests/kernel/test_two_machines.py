"""`lavt server` and `lavt client` on two machines with clocks of their own: what they say, against the truth."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from tests.kernel.lane import clocks
from tests.kernel.lane.chrony import SERVING, correction_s, following, start_chronyd, wait_synchronised
from tests.kernel.lane.driving import REPOSITORY, Drive, Loop, reasons_against, start_loop
from tests.kernel.lane.machine import Machine, wait_until
from tests.kernel.lane.netem import netem_on_ntp
from tests.kernel.lane.verdicts import MEDIAN_SHARE, changes_of_safety, require_completed, require_never_degraded
from tests.support.stalls import Stalls

from lavt.clock import MachineClock
from lavt.config_file import conditions
from lavt.domain import NS_PER_MS, NS_PER_S, FloatArray

pytestmark = pytest.mark.timeout(1800)

DriveOnce = Callable[..., Drive]
TrueOffset = Callable[[], int]
Tell = Callable[[str], None]
NTP_PORT = 11123
CLOCK = MachineClock()
CLIENT_NTP = "the NTP of the client "
SHIFT_LIMIT_MS = 2
PAPER = ("L0", "L1", "L2", "L3", "L4", "L5")
SMALL = ("camera.width_px=320", "camera.height_px=240", "camera.rate_hz=15")
"""A user-mode kernel has one processor and dear system calls: with less to do it is steadier."""
SHORT = (f"vehicle.route={REPOSITORY / 'tests/kernel/roads/straight.yaml'}", "video.bit_rate_bps=500000", *SMALL)
SERVER = ("injection.interface=vec0", "injection.remote=true", "safety.picture_age_limit_ms=2000")


def under(condition: str) -> tuple[str, ...]:
    return (*SMALL, "injection.interface=vec0", f"injection.condition={condition}")


@dataclass
class Truth:
    """The true offset between the machines, noted again and again while something goes on."""

    true_offset_ns: TrueOffset
    client: Machine
    tell: Tell
    client_wall_ns: list[int] = field(default_factory=list)
    offsets_ns: list[int] = field(default_factory=list)

    def note(self, _loop: Loop | None = None) -> None:
        """Note it now."""
        self.offsets_ns.append(self.true_offset_ns())
        self.client_wall_ns.append(self.client.call(clocks.reading)[1])

    def hold_against(self, drive: Drive) -> None:
        """Delta is within 1 ms of the truth at every moment noted in the drive, the truth inside its bound of 2 ms."""
        found = drive.measured.clocks
        assert found.offset is not None
        at_ns, truth_ns = np.array(self.client_wall_ns), np.array(self.offsets_ns)
        began_ns, ended_ns = found.client_wall_ns
        within = (at_ns >= began_ns) & (at_ns <= ended_ns)
        assert within.sum() >= 5, "the truth was noted too seldom"
        error_ns = np.abs(found.offset.at(at_ns[within]) - truth_ns[within])
        bound_ns = found.offset.bound_at(at_ns[within])
        self.tell(
            f"Delta by {found.source}: largest error {error_ns.max() / 1e3:.0f} us, bound {found.bound_ms:.3f} ms"
        )
        assert np.all(error_ns < NS_PER_MS)
        assert np.all(error_ns <= bound_ns)
        assert found.bound_ms is not None
        assert found.bound_ms <= 2


@pytest.fixture
def truth(true_offset_ns: TrueOffset, client_machine: Machine, tell: Tell) -> Truth:
    return Truth(true_offset_ns, client_machine, tell)


@pytest.fixture
def chrony(server_machine: Machine, client_machine: Machine) -> None:
    """The server's clock is 250 ms ahead and runs 30 ppm fast; the client's chrony follows it, and touches no clock."""
    server_machine.call(clocks.step, 250 * NS_PER_MS)
    server_machine.call(clocks.drift, 30)
    start_chronyd(server_machine, *SERVING)
    start_chronyd(client_machine, following(server_machine.address))
    wait_synchronised(client_machine, updates=10)


def in_short(drive: Drive) -> str:
    """Say what was measured in a drive."""
    result = drive.result
    tau_v, tau_c, loop, delta = (result[key] for key in ("tau_v_ms", "tau_c_ms", "loop_ms", "delta"))
    return (
        f"{result['route']} under {result['condition']}: {result['ending']}, tau_v {tau_v['p50']:.2f}, tau_c "
        f"{tau_c['p50']:.2f}, loop {loop['p50']:.2f} ms, Delta {delta['ms']:.3f} ms +- {delta['bound_ms']:.3f}, drift "
        f"{delta['drift_ppm']:.1f} ppm, closure p95 {drive.measured.closure_p95_ms}, {result['invalid_reasons']}"
    )


@pytest.mark.usefixtures("chrony")
def test_a_route_is_driven_and_its_latencies_are_true(
    drive: DriveOnce, truth: Truth, tell: Tell, stalls: Stalls
) -> None:
    """Over two machines the key part of route A is driven to its end; Delta is true to its bound; the loop closes."""
    driven = drive("route", server=("vehicle.route=a_key", "video.bit_rate_bps=1000000"), meanwhile=truth.note)
    tell(in_short(driven))
    require_completed(driven, stalls)
    assert driven.result["delta"]["source"] == "chrony"
    assert driven.result["delta"]["drift_ppm"] == pytest.approx(30, abs=5)
    assert driven.measured.closure_p95_ms is not None
    assert driven.measured.closure_p95_ms < 1
    truth.hold_against(driven)


@pytest.mark.usefixtures("chrony")
def test_each_condition_shifts_tau_v_and_tau_c_by_what_it_injects(
    drive: DriveOnce, truth: Truth, server_machine: Machine, client_machine: Machine, *, tell: Tell, stalls: Stalls
) -> None:
    """Under each of L0 to L5 median tau_v and tau_c are those of L0 plus what is injected, to 2 ms; nothing stays."""
    queues = [machine.run(["tc", "qdisc", "show", "dev", "vec0"]) for machine in (server_machine, client_machine)]

    def median_ms(name: str) -> FloatArray:
        driven = drive(name, server=(*SHORT, *SERVER), client=under(name), meanwhile=truth.note)
        tell(in_short(driven))
        assert driven.measured.closure_p95_ms is not None
        assert driven.measured.closure_p95_ms < 1, name
        truth.hold_against(driven)
        return np.array([driven.result["tau_v_ms"]["p50"], driven.result["tau_c_ms"]["p50"]])

    since_ns = CLOCK.now().mono_ns
    base_ms = median_ms("L0")
    for name in PAPER[1:]:
        requested = conditions()[name]
        off_ms = median_ms(name) - base_ms - np.array([requested.video_ms, requested.control_ms])
        with stalls.judging(since_ns, share=MEDIAN_SHARE):
            assert np.max(np.abs(off_ms)) <= SHIFT_LIMIT_MS, f"{name} is off by {off_ms} ms"
    after = [machine.run(["tc", "qdisc", "show", "dev", "vec0"]) for machine in (server_machine, client_machine)]
    assert after == queues


def test_delta_is_true_while_the_server_is_slewed_towards_a_third_clock(
    drive: DriveOnce, truth: Truth, server_machine: Machine, client_machine: Machine
) -> None:
    """While chrony steers the server's clock towards a third one, Delta is within 1 ms of the truth, in its bound."""
    server_machine.start_python(
        "tests.kernel.lane.ntp_server", "127.0.0.1", str(NTP_PORT), str(400 * NS_PER_MS), "20"
    ).first_line()
    # The drive delays the third clock's answers by far more than they varied before, and chrony would drop them.
    third = f"{following('127.0.0.1', NTP_PORT)} maxdelaydevratio 1000"
    start_chronyd(server_machine, third, "maxslewrate 500", "allow", adjusts_clock=True)
    wait_synchronised(server_machine, updates=4)
    start_chronyd(client_machine, following(server_machine.address))
    wait_synchronised(client_machine, updates=10)
    driven = drive("slewed", server=SHORT, client=SMALL, meanwhile=truth.note)
    assert abs(correction_s(server_machine)) > 0.005, "it slews still"
    truth.hold_against(driven)


def test_delay_on_the_path_of_ntp_before_it_synchronised_is_told(
    drive: DriveOnce, server_machine: Machine, client_machine: Machine, tell: Tell
) -> None:
    """Where NTP went through 75 ms in one direction from the start, the run is invalid, and the reason is the path."""
    start_chronyd(server_machine, *SERVING)
    with netem_on_ntp(client_machine):
        start_chronyd(client_machine, following(server_machine.address))
        wait_synchronised(client_machine, updates=10)
        driven = drive("before", server=SHORT, client=SMALL, about=CLIENT_NTP)
    [reason] = reasons_against(driven)
    tell(reason)
    assert "the NTP of the client goes through injected delay" in reason


@pytest.mark.usefixtures("chrony")
def test_delay_on_the_path_of_ntp_after_it_synchronised_is_told(
    drive: DriveOnce, client_machine: Machine, tell: Tell
) -> None:
    """Where NTP is put through delay after it synchronised, the run is invalid because its samples stand still."""
    with netem_on_ntp(client_machine):
        driven = drive("after", server=SHORT, client=SMALL, about=CLIENT_NTP)
    reasons = reasons_against(driven)
    tell("; ".join(reasons))
    assert any("accepted no sample" in reason for reason in reasons)
    assert all(reason.startswith(CLIENT_NTP) for reason in reasons)


@pytest.mark.usefixtures("chrony")
@pytest.mark.parametrize("step_s", [1, -1])
def test_a_step_of_the_wall_clock_changes_no_safety_state(
    drive: DriveOnce, server_machine: Machine, step_s: int, stalls: Stalls
) -> None:
    """With the server's wall clock set by a second in the middle of a drive, no safety state changes; it is invalid."""
    stepped: list[Loop] = []

    def step(loop: Loop) -> None:
        if loop not in stepped and loop.server.latest().get("status", {}).get("progress_m", 0) > 30:
            stepped.append(loop)
            server_machine.call(clocks.step, step_s * NS_PER_S)

    driven = drive("stepped", server=SHORT, client=SMALL, about="the wall clock of the server stepped", meanwhile=step)
    said = changes_of_safety(driven)
    assert stepped
    require_completed(driven, stalls)
    require_never_degraded(driven, stalls)
    changes = ["disarmed -> arming", "arming -> driving", "driving -> safe_stop"]
    assert [each.partition(":")[0] for each in said] == changes
    assert said[-1].endswith("the drive is over")
    reasons = reasons_against(driven)
    assert len(reasons) == 1
    assert reasons[0].startswith(f"the wall clock of the server stepped by {step_s * 1000:+d}"[:-2])


def test_the_probe_alone_is_right_under_delay_of_the_control(
    drive: DriveOnce, truth: Truth, server_machine: Machine
) -> None:
    """Without chrony, 100 ms on the control leave Delta inside the probe's bound: nothing delays the probe's port."""
    server_machine.call(clocks.step, 250 * NS_PER_MS)
    driven = drive("probe", server=(*SHORT, *SERVER), client=under("L5"), meanwhile=truth.note)
    assert driven.result["delta"]["source"] == "probe"
    truth.hold_against(driven)


def test_the_delay_of_a_client_that_dies_ends_with_its_lease(
    server_machine: Machine, client_machine: Machine, tmp_path: Path
) -> None:
    """When the client is killed in the middle of a drive, the server's queue is soon as it was."""
    queues = ["tc", "qdisc", "show", "dev", "vec0"]
    before = server_machine.run(queues)
    loop = start_loop(
        server_machine, client_machine, tmp_path / "died", server_changes=(*SHORT, *SERVER), client_changes=under("L4")
    )
    wait_until("the video is delayed", lambda: "delay 150ms" in server_machine.run(queues), 60)
    loop.client.stop(signal.SIGKILL)
    wait_until("the delay has ended", lambda: server_machine.run(queues) == before, 30)
    assert loop.server.running
