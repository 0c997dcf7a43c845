"""Compare the measurements of `lavt server` and `lavt client`, on two machines with separate clocks, with the truth."""

from __future__ import annotations

import signal
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pytest
from tests.kernel.lane import clocks
from tests.kernel.lane.chrony import SERVE_OWN_CLOCK, correction_s, follow_server, start_chronyd, wait_synchronised
from tests.kernel.lane.driving import REPOSITORY, DriveResult, LoopPrograms, invalid_reasons, start_loop
from tests.kernel.lane.machine import Machine, wait_until
from tests.kernel.lane.netem import netem_on_ntp
from tests.kernel.lane.verdicts import MEDIAN_SHARE, require_completed, require_never_degraded, safety_changes
from tests.support.stalls import Stalls

from lavt.clock import MachineClock
from lavt.config_file import conditions
from lavt.domain import NS_PER_MS, NS_PER_S, FloatArray
from lavt.experiment.analysis.invalid_reason import InvalidCode

pytestmark = pytest.mark.timeout(1800)

DriveOnce = Callable[..., DriveResult]
TrueOffset = Callable[[], int]
ReportMeasurement = Callable[[str], None]
NTP_PORT = 11123
CLOCK = MachineClock()
CLIENT_NTP_CODES = (InvalidCode.NTP_THROUGH_DELAY, InvalidCode.NTP_NO_SAMPLE)
SHIFT_LIMIT_MS = 2
BASE_CONDITION = "L0"
DELAYED_CONDITION = "L5"
SMALL_PICTURES = ("camera.width_px=320", "camera.height_px=240", "camera.rate_hz=15")
"""A user-mode kernel has one processor and slow system calls. Its times vary less if pictures are small."""
SHORT_DRIVE = (
    f"vehicle.route={REPOSITORY / 'tests/kernel/roads/straight.yaml'}",
    "video.bit_rate_bps=500000",
    *SMALL_PICTURES,
)
SERVER_INJECTION = ("injection.interface=vec0", "injection.remote=true", "safety.picture_age_limit_ms=2000")


def client_changes_for(condition: str) -> tuple[str, ...]:
    return (*SMALL_PICTURES, "injection.interface=vec0", f"injection.condition={condition}")


@dataclass
class TrueOffsetSamples:
    """Samples of the true offset between the machines during a drive."""

    true_offset_ns: TrueOffset
    client: Machine
    report_measurement: ReportMeasurement
    client_wall_ns: list[int] = field(default_factory=list)
    offsets_ns: list[int] = field(default_factory=list)

    def sample(self, _loop: LoopPrograms | None = None) -> None:
        """Take a sample."""
        self.offsets_ns.append(self.true_offset_ns())
        self.client_wall_ns.append(self.client.call(clocks.read_wall_clock)[1])

    def check_drive(self, drive: DriveResult) -> None:
        """Require that each Delta is wrong by less than 1 ms and at most its bound, which is at most 2 ms."""
        drive_clocks = drive.measured.clocks
        assert drive_clocks.offset is not None
        sampled_ns, truth_ns = np.array(self.client_wall_ns), np.array(self.offsets_ns)
        began_ns, ended_ns = drive_clocks.client_wall_ns
        is_in_drive = (sampled_ns >= began_ns) & (sampled_ns <= ended_ns)
        assert is_in_drive.sum() >= 5, "there are too few samples of the truth"
        error_ns = np.abs(drive_clocks.offset.at(sampled_ns[is_in_drive]) - truth_ns[is_in_drive])
        bound_ns = drive_clocks.offset.bound_at(sampled_ns[is_in_drive])
        self.report_measurement(
            f"Delta by {drive_clocks.source}: largest error {error_ns.max() / 1e3:.0f} us, "
            f"bound {drive_clocks.bound_ms:.3f} ms"
        )
        assert np.all(error_ns < NS_PER_MS)
        assert np.all(error_ns <= bound_ns)
        assert drive_clocks.bound_ms is not None
        assert drive_clocks.bound_ms <= 2


@pytest.fixture
def truth(
    true_offset_ns: TrueOffset, client_machine: Machine, report_measurement: ReportMeasurement
) -> TrueOffsetSamples:
    return TrueOffsetSamples(true_offset_ns, client_machine, report_measurement)


@pytest.fixture
def chrony(server_machine: Machine, client_machine: Machine) -> None:
    """Set the server's clock 250 ms ahead and 30 ppm fast; the client's chrony only measures it."""
    server_machine.call(clocks.step, 250 * NS_PER_MS)
    server_machine.call(clocks.set_drift, 30)
    start_chronyd(server_machine, *SERVE_OWN_CLOCK)
    start_chronyd(client_machine, follow_server(server_machine.address))
    wait_synchronised(client_machine, updates=10)


def describe_drive(drive: DriveResult) -> str:
    """Return the measurements of a drive in one line."""
    result = drive.result
    tau_v, tau_c, loop, delta = (result[key] for key in ("tau_v_ms", "tau_c_ms", "loop_ms", "delta"))
    return (
        f"{result['route']} under {result['condition']}: {result['ending']}, tau_v {tau_v['p50']:.2f}, tau_c "
        f"{tau_c['p50']:.2f}, loop {loop['p50']:.2f} ms, Delta {delta['ms']:.3f} ms +- {delta['bound_ms']:.3f}, drift "
        f"{delta['drift_ppm']:.1f} ppm, closure error p95 {drive.measured.closure_p95_ms}, {result['invalid_reasons']}"
    )


@pytest.mark.usefixtures("chrony")
def test_latencies_of_a_drive_are_true(
    drive: DriveOnce, truth: TrueOffsetSamples, report_measurement: ReportMeasurement, stalls: Stalls
) -> None:
    """Over two machines route A key is completed, Delta is within its bound, and the loop's parts add up."""
    finished_drive = drive(
        "route", server=("vehicle.route=a_key", "video.bit_rate_bps=1000000"), meanwhile=truth.sample
    )
    report_measurement(describe_drive(finished_drive))
    require_completed(finished_drive, stalls)
    assert finished_drive.result["delta"]["source"] == "chrony"
    assert finished_drive.result["delta"]["drift_ppm"] == pytest.approx(30, abs=5)
    assert finished_drive.measured.closure_p95_ms is not None
    assert finished_drive.measured.closure_p95_ms < 1
    assert 0 < finished_drive.result["tau_c_ms"]["p50"] < 50, "an offset of 250 ms would show"
    truth.check_drive(finished_drive)


@pytest.mark.usefixtures("chrony")
def test_conditions_shift_latencies_by_their_delay(
    drive: DriveOnce,
    truth: TrueOffsetSamples,
    server_machine: Machine,
    client_machine: Machine,
    *,
    report_measurement: ReportMeasurement,
    stalls: Stalls,
) -> None:
    """Under L5 the medians of tau_v and tau_c are those of L0 plus the injected delay within 2 ms."""
    qdiscs = [machine.run(["tc", "qdisc", "show", "dev", "vec0"]) for machine in (server_machine, client_machine)]

    def median_ms(name: str) -> FloatArray:
        finished_drive = drive(
            name, server=(*SHORT_DRIVE, *SERVER_INJECTION), client=client_changes_for(name), meanwhile=truth.sample
        )
        report_measurement(describe_drive(finished_drive))
        assert finished_drive.measured.closure_p95_ms is not None
        assert finished_drive.measured.closure_p95_ms < 1, name
        truth.check_drive(finished_drive)
        return np.array([finished_drive.result["tau_v_ms"]["p50"], finished_drive.result["tau_c_ms"]["p50"]])

    since_ns = CLOCK.now().mono_ns
    base_ms = median_ms(BASE_CONDITION)
    requested = conditions()[DELAYED_CONDITION]
    error_ms = median_ms(DELAYED_CONDITION) - base_ms - np.array([requested.video_ms, requested.control_ms])
    with stalls.excusing_failures(since_ns, share=MEDIAN_SHARE):
        assert np.max(np.abs(error_ms)) <= SHIFT_LIMIT_MS, f"{DELAYED_CONDITION} is off by {error_ms} ms"
    after = [machine.run(["tc", "qdisc", "show", "dev", "vec0"]) for machine in (server_machine, client_machine)]
    assert after == qdiscs


def test_delta_is_true_while_the_server_clock_is_slewed(
    drive: DriveOnce, truth: TrueOffsetSamples, server_machine: Machine, client_machine: Machine
) -> None:
    """While chrony slews the server's clock towards a third clock, Delta is within its bound and 1 ms of the truth."""
    server_machine.start_python(
        "tests.kernel.lane.ntp_server", "127.0.0.1", str(NTP_PORT), str(400 * NS_PER_MS), "20"
    ).first_line()
    # During the drive the third clock's answers are delayed much more than before. By default chrony would reject them.
    third_clock = f"{follow_server('127.0.0.1', NTP_PORT)} maxdelaydevratio 1000"
    start_chronyd(server_machine, third_clock, "maxslewrate 500", "allow", adjusts_clock=True)
    wait_synchronised(server_machine, updates=4)
    start_chronyd(client_machine, follow_server(server_machine.address))
    wait_synchronised(client_machine, updates=10)
    finished_drive = drive("slewed", server=SHORT_DRIVE, client=SMALL_PICTURES, meanwhile=truth.sample)
    assert abs(correction_s(server_machine)) > 0.005, "the clock is no longer slewed"
    truth.check_drive(finished_drive)


def test_ntp_through_delay_from_the_start_invalidates_the_run(
    drive: DriveOnce, server_machine: Machine, client_machine: Machine, report_measurement: ReportMeasurement
) -> None:
    """If NTP is delayed in one direction from the start, the run is invalid, and the reason names the client."""
    start_chronyd(server_machine, *SERVE_OWN_CLOCK)
    with netem_on_ntp(client_machine):
        start_chronyd(client_machine, follow_server(server_machine.address))
        wait_synchronised(client_machine, updates=10)
        finished_drive = drive("before", server=SHORT_DRIVE, client=SMALL_PICTURES, expected_codes=CLIENT_NTP_CODES)
    [reason] = invalid_reasons(finished_drive)
    report_measurement(reason.text)
    assert reason.code is InvalidCode.NTP_THROUGH_DELAY
    assert "client" in reason.text


@pytest.mark.usefixtures("chrony")
def test_ntp_through_delay_after_synchronisation_invalidates_the_run(
    drive: DriveOnce, client_machine: Machine, report_measurement: ReportMeasurement
) -> None:
    """If NTP is delayed after chrony has synchronised, the run is invalid, because chrony accepts no more samples."""
    with netem_on_ntp(client_machine):
        finished_drive = drive("after", server=SHORT_DRIVE, client=SMALL_PICTURES, expected_codes=CLIENT_NTP_CODES)
    reasons = invalid_reasons(finished_drive)
    report_measurement("; ".join(reason.text for reason in reasons))
    assert InvalidCode.NTP_NO_SAMPLE in {reason.code for reason in reasons}
    assert all("the NTP of the client " in reason.text for reason in reasons)


@pytest.mark.usefixtures("chrony")
def test_wall_clock_step_changes_no_safety_state(drive: DriveOnce, server_machine: Machine, stalls: Stalls) -> None:
    """If the server's wall clock steps back by 1 s during a drive, the drive is invalid but no safety state changes."""
    stepped_loops: list[LoopPrograms] = []

    def step(loop: LoopPrograms) -> None:
        if loop not in stepped_loops and loop.server.latest().get("status", {}).get("progress_m", 0) > 30:
            stepped_loops.append(loop)
            server_machine.call(clocks.step, -NS_PER_S)

    finished_drive = drive(
        "stepped",
        server=SHORT_DRIVE,
        client=SMALL_PICTURES,
        expected_codes=(InvalidCode.CLOCK_STEP,),
        meanwhile=step,
    )
    changes = safety_changes(finished_drive)
    assert stepped_loops
    require_completed(finished_drive, stalls)
    require_never_degraded(finished_drive, stalls)
    expected_changes = ["disarmed -> arming", "arming -> driving", "driving -> safe_stop"]
    assert [change.partition(":")[0] for change in changes] == expected_changes
    assert changes[-1].endswith("the drive is over")
    reasons = invalid_reasons(finished_drive)
    assert [reason.code for reason in reasons] == [InvalidCode.CLOCK_STEP]
    assert "the wall clock of the server stepped by -" in reasons[0].text


def test_probe_alone_is_true_under_control_delay(
    drive: DriveOnce, truth: TrueOffsetSamples, server_machine: Machine
) -> None:
    """Without chrony, Delta is within the probe's bound under L5, because L5 does not delay the probe."""
    server_machine.call(clocks.step, 250 * NS_PER_MS)
    finished_drive = drive(
        "probe", server=(*SHORT_DRIVE, *SERVER_INJECTION), client=client_changes_for("L5"), meanwhile=truth.sample
    )
    assert finished_drive.result["delta"]["source"] == "probe"
    truth.check_drive(finished_drive)


def test_delay_of_a_killed_client_ends_with_its_lease(
    server_machine: Machine, client_machine: Machine, tmp_path: Path
) -> None:
    """After the client is killed during a drive, the server's qdiscs are soon restored."""
    qdiscs = ["tc", "qdisc", "show", "dev", "vec0"]
    before = server_machine.run(qdiscs)
    loop = start_loop(
        server_machine,
        client_machine,
        tmp_path / "died",
        server_changes=(*SHORT_DRIVE, *SERVER_INJECTION),
        client_changes=client_changes_for("L4"),
    )
    wait_until("the video is delayed", lambda: "delay 150ms" in server_machine.run(qdiscs), 60)
    loop.client.stop(signal.SIGKILL)
    wait_until("the delay has ended", lambda: server_machine.run(qdiscs) == before, 30)
    assert loop.server.running
