"""Outages of the network and killed or suspended processes, at full rate: when the vehicle stops and is driven again.

One drive has all outages in turn. An observer independent of server and client records the commands that arrive at the
vehicle's machine, `counting.py` decides which of them are stale, and the server's record says which were accepted and
when the vehicle stopped. `docs/outages.md` has a table.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median

import numpy as np
import pytest
from tests.field.counting import OutageEffects, measure, table
from tests.field.driving import TCP, Drive, driven
from tests.field.namespaces import Field, Way, plain_field
from tests.support.stalls import BUSY_SHARE, LONG_STALL_MS, Stalls

from lavt.clock import pause
from lavt.domain import NS_PER_S
from lavt.experiment.runs.processes import LAVT
from lavt.recording.record import read_record

pytestmark = [pytest.mark.timeout(900), pytest.mark.usefixtures("namespaces")]
"""The drive of the fixture takes two minutes on a quiet machine."""

DEGRADED_AFTER_S = 0.3
STOP_AFTER_S = 0.5
STOP_MPS2 = 4.0
"""The design's limits, repeated here so that a change in the code fails a test."""

WAYS: dict[str, Sequence[Way]] = {"downlink": ("downlink",), "uplink": ("uplink",), "both ways": ("downlink", "uplink")}
SHORT_S = 0.3
LONG_S = (1.0, 3.0)
"""Shorter and longer than the routers' lease of 2 s."""
DOWN_S = 3.0
SPEED_MPS = 5.0
LOAD_MARGIN_S = 0.15
"""The delay that other programs may add to a single time."""
MEDIAN_MARGIN_S = 0.03
BEFORE_S = 0.5
"""A stall this long before an outage can explain that the vehicle is degraded already when it begins."""
MAX_UNOBSERVED = 0.05
"""The share of accepted commands that may have been dropped on their way to the observer."""
MARGIN_S = 0.5
"""Time for the brake pressure to build up."""
RECOVERY_S = 10.0
"""From the end of an outage until the vehicle is driven again; 1.0 s of it is arming."""
RECOVERY_NS = round(RECOVERY_S * NS_PER_S)
MEDIAN_RECOVERY_S = 3.0

SHORT = tuple(f"{name} {SHORT_S:g} s{again}" for again in ("", ", again") for name in WAYS)
LONG = (*(f"{name} {duration_s:g} s" for duration_s in LONG_S for name in WAYS), "both ways 10 s")
KILLED = ("vehicle's router killed", "operator's router killed", "client killed")
FROZEN = "client frozen"
STOPPING = (*LONG, *KILLED, FROZEN)
SERVER = "server killed"
ALL = (*SHORT, *STOPPING, SERVER)

BUFFERED = ("both ways 1 s", "both ways 3 s")
"""Outages of the link that buffers messages."""
ACCEPTS_EVERYTHING = str(Path(__file__).parents[1] / "realtime" / "server_that_accepts_everything.py")

Tell = Callable[[str], None]


@dataclass(frozen=True)
class Driven:
    """The directory of a drive through outages, and the effects of each outage."""

    work: Path
    rows: dict[str, OutageEffects]


def begin_ns(row: OutageEffects, after_s: float = 0.0) -> int:
    """Return the begin of an outage, or some seconds after it."""
    return row.outage.begin.mono_ns + round(after_s * NS_PER_S)


@pytest.fixture(scope="module")
def field(namespaces: None) -> Iterator[Field]:  # noqa: ARG001 (skips)
    with plain_field() as field:
        yield field


def cut(drive: Drive, names: Sequence[str]) -> None:
    for name in names:
        ways, duration = name.removesuffix(", again").removesuffix(" s").rsplit(" ", 1)
        drive.reach(SPEED_MPS)
        drive.cut(name, WAYS[ways], float(duration))
        pause(NS_PER_S)  # the server's status is up to 0.2 s old


def finish(drive: Drive, work: Path, tell: Tell, title: str) -> Driven:
    rows = measure(drive)
    (work / "outages.md").write_text(table(rows) + "\n")
    tell(f"{title}\n{table(rows)}")
    return Driven(work, {row.outage.name: row for row in rows})


@pytest.fixture(scope="module")
def all_outages(field: Field, tmp_path_factory: pytest.TempPathFactory, tell: Tell) -> Driven:
    """Drive through all outages in turn, the killed server last."""
    work = tmp_path_factory.mktemp("outages")
    with driven(field, work) as drive:
        cut(drive, (*SHORT, *LONG))
        for name, role in zip(KILLED, ("vehicle-router", "operator-router", "client"), strict=True):
            drive.reach(SPEED_MPS)
            drive.kill_and_restart(name, role, DOWN_S)
        drive.reach(SPEED_MPS)
        drive.freeze(FROZEN, "client", DOWN_S)
        drive.reach(SPEED_MPS)
        drive.kill_and_restart(SERVER, "server", DOWN_S)
        drive.reach(SPEED_MPS)
    return finish(drive, work, tell, "routers as shipped")


def drive_with_buffering_link(field: Field, work: Path, tell: Tell, title: str, program: tuple[str, ...]) -> Driven:
    with driven(field, work, TCP, program) as drive:
        cut(drive, BUFFERED)
        drive.reach(SPEED_MPS)
    return finish(drive, work, tell, title)


@pytest.fixture(scope="module")
def buffered(field: Field, tmp_path_factory: pytest.TempPathFactory, tell: Tell) -> Driven:
    """Drive with routers linked by TCP with a lease of 10 s."""
    return drive_with_buffering_link(field, tmp_path_factory.mktemp("kept"), tell, "TCP, lease 10 s", LAVT)


@pytest.fixture(scope="module")
def buffered_unguarded(field: Field, tmp_path_factory: pytest.TempPathFactory, tell: Tell) -> Driven:
    """Drive with the same routers and a server that accepts every command."""
    work = tmp_path_factory.mktemp("unguarded")
    return drive_with_buffering_link(field, work, tell, "TCP, lease 10 s, no checks", (ACCEPTS_EVERYTHING,))


@pytest.mark.parametrize("outage", STOPPING)
def test_a_command_timeout_degrades_and_stops_in_time(all_outages: Driven, stalls: Stalls, outage: str) -> None:
    """300 ms after the last command from a newer picture the vehicle is degraded; 200 ms later the safe stop begins."""
    row = all_outages.rows[outage]
    degraded_s, stop_s = row.command_gap_at_degraded_s, row.command_gap_at_safe_stop_s

    assert stop_s is not None
    assert stop_s >= STOP_AFTER_S
    with stalls.judging(begin_ns(row, -BEFORE_S), begin_ns(row, STOP_AFTER_S + LOAD_MARGIN_S)):
        assert degraded_s is not None, "the vehicle was degraded before the outage"
        assert degraded_s <= DEGRADED_AFTER_S + LOAD_MARGIN_S
        assert stop_s <= STOP_AFTER_S + LOAD_MARGIN_S
    assert degraded_s >= DEGRADED_AFTER_S


def test_the_median_stop_begins_half_a_second_after_an_outage(all_outages: Driven, stalls: Stalls) -> None:
    """In the median over all outages the vehicle is degraded 0.3 s, and its safe stop begins 0.5 s, after the begin."""
    rows = [all_outages.rows[outage] for outage in STOPPING]

    with stalls.judging(begin_ns(rows[0]), begin_ns(rows[-1], RECOVERY_S), share=BUSY_SHARE):
        assert median(row.to_degraded_s or 0.0 for row in rows) <= DEGRADED_AFTER_S + MEDIAN_MARGIN_S
        assert median(row.to_safe_stop_s or 0.0 for row in rows) <= STOP_AFTER_S + MEDIAN_MARGIN_S
        assert median(row.command_gap_at_safe_stop_s or 0.0 for row in rows) <= STOP_AFTER_S + MEDIAN_MARGIN_S


@pytest.mark.parametrize("outage", STOPPING)
def test_the_vehicle_is_stationary_in_time(all_outages: Driven, outage: str) -> None:
    """In a safe stop the vehicle decelerates with 4 m/s2 until it is stationary."""
    row = all_outages.rows[outage]

    assert row.stopping_s is not None
    assert row.stopped_from_mps is not None
    assert row.stopping_s <= row.stopped_from_mps / STOP_MPS2 + MARGIN_S


def test_most_outages_of_300_ms_cause_no_stop(all_outages: Driven, stalls: Stalls) -> None:
    """Most outages of 0.3 s lead to degraded at most, and then the drive continues at once.

    After lost commands QUIC, on which the routers' link is based, may delay the next ones until it has probed.
    """
    rows = [all_outages.rows[name] for name in SHORT]
    without_stop = [row for row in rows if row.to_safe_stop_s is None]

    with stalls.judging(begin_ns(rows[0]), begin_ns(rows[-1], RECOVERY_S)):
        assert len(without_stop) >= len(SHORT) / 2
        assert all((row.to_driving_s or 0.0) < MARGIN_S for row in without_stop)


@pytest.mark.parametrize("outage", [*STOPPING, SERVER])
def test_the_drive_recovers_by_itself(all_outages: Driven, stalls: Stalls, outage: str) -> None:
    """After an outage a client that may arm again drives again within 10 s."""
    row = all_outages.rows[outage]

    assert row.to_driving_s is not None
    with stalls.judging(row.outage.end.mono_ns, row.outage.end.later(RECOVERY_NS).mono_ns, stall_ms=LONG_STALL_MS):
        assert 0 < row.to_driving_s <= RECOVERY_S


def test_the_median_recovery_is_short(all_outages: Driven, stalls: Stalls) -> None:
    """In the median the vehicle is driven again within 3 s of an outage's end, of which arming takes one."""
    rows = [all_outages.rows[outage] for outage in (*STOPPING, SERVER)]

    with stalls.judging(begin_ns(rows[0]), begin_ns(rows[-1], RECOVERY_S), share=BUSY_SHARE):
        assert median(row.to_driving_s or 0.0 for row in rows) <= MEDIAN_RECOVERY_S


@pytest.mark.parametrize("outage", ALL)
def test_nothing_stale_is_accepted(all_outages: Driven, stalls: Stalls, outage: str) -> None:
    """No command that is stale by the observer's record is accepted, and the observer recorded the accepted ones."""
    row = all_outages.rows[outage]

    assert row.stale_accepted == 0
    assert row.accepted > 20
    with stalls.judging(begin_ns(row), row.outage.end.later(RECOVERY_NS).mono_ns):
        assert row.accepted_unobserved <= row.accepted * MAX_UNOBSERVED


@pytest.mark.parametrize("outage", BUFFERED)
def test_buffered_stale_commands_are_rejected(buffered: Driven, stalls: Stalls, outage: str) -> None:
    """Commands that a link buffered in an outage reach the vehicle stale, and none of them is accepted."""
    row = buffered.rows[outage]

    assert row.stale_observed > 0
    assert row.stale_accepted == 0
    with stalls.judging(begin_ns(row), row.outage.end.later(RECOVERY_NS).mono_ns):
        assert row.accepted_unobserved <= row.accepted * MAX_UNOBSERVED


@pytest.mark.parametrize("outage", BUFFERED)
def test_a_server_without_checks_accepts_stale_commands(buffered_unguarded: Driven, outage: str) -> None:
    """Without the server's checks stale commands are accepted, so the tests above can fail."""
    assert buffered_unguarded.rows[outage].stale_accepted > 0


def test_the_drive_is_at_full_rate(all_outages: Driven, stalls: Stalls) -> None:
    """In the median the client sends a command at least every 20 ms, and the server 30 pictures a second."""
    client = read_record(all_outages.work / "client-1" / "client.mcap")
    server = read_record(all_outages.work / "server-1" / "server.mcap")
    commands_ns = client.table("control").mono_ns
    between_commands_s = np.diff(commands_ns) / NS_PER_S
    between_frames_s = np.diff(server.table("frame").ints("stamped_mono_ns")) / NS_PER_S
    between_pictures_s = np.diff(client.table("picture").mono_ns) / NS_PER_S

    with stalls.judging(int(commands_ns[0]), int(commands_ns[-1]), share=BUSY_SHARE):
        assert np.median(between_commands_s) <= 0.021
        assert np.median(between_frames_s) == pytest.approx(1 / 30, abs=0.003)
        assert np.median(between_pictures_s) == pytest.approx(1 / 30, abs=0.005)
