from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import pytest

from lavt.domain import NS_PER_S, Now
from lavt.transport.clock_sync import clock_report
from lavt.transport.clock_sync.clock_report import (
    ClockReport,
    host_addresses,
    kernel_identity,
    plain_address,
    query_clock,
    unknown_clock,
)
from lavt.transport.clock_sync.persistent_process import Completed

FIB_TRIE = """Main:
  +-- 0.0.0.0/1 2 0 2
     +-- 10.9.0.0/24 2 0 2
        +-- 10.9.0.0/30 2 0 2
           |-- 10.9.0.0
              /24 link UNICAST
           |-- 10.9.0.2
              /32 host LOCAL
        |-- 10.9.0.255
           /32 link BROADCAST
     +-- 127.0.0.0/8 2 0 2
        +-- 127.0.0.0/31 1 0 0
           |-- 127.0.0.0
              /8 host LOCAL
           |-- 127.0.0.1
              /32 host LOCAL
        |-- 127.255.255.255
           /32 link BROADCAST
"""
"""/proc/net/fib_trie of a kernel with one network card."""
IF_INET6 = """fe80000000000000000000fffe000002 02 40 20 80     vec0
00000000000000000000000000000001 01 80 10 80       lo
"""
"""/proc/net/if_inet6 of the same kernel."""


def test_kernel_identity_is_constant() -> None:
    """A kernel's identity does not change while the kernel runs."""
    assert kernel_identity() == kernel_identity()


def test_kernel_identity_is_the_boot_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A kernel's identity is its boot identifier without white space, or empty if there is none."""
    monkeypatch.setattr(clock_report, "BOOT_ID", tmp_path / "boot_id")
    assert kernel_identity() == ""
    (tmp_path / "boot_id").write_text(" 5b1c\n")
    assert kernel_identity() == "5b1c"


class AdvancingClock:
    """A clock that advances by the same time between two readings."""

    def __init__(self, step_ns: int) -> None:
        self._step_ns = step_ns
        self._mono_ns = 0

    def now(self) -> Now:
        """Return both clocks."""
        self._mono_ns += self._step_ns
        return Now(self._mono_ns, self._mono_ns + 1)


@pytest.mark.parametrize(("took_ns", "in_time"), [(2 * NS_PER_S, True), (2 * NS_PER_S + 1, False)])
def test_answer_within_two_seconds_counts(took_ns: int, *, in_time: bool) -> None:
    """An answer within 2 s is parsed with the clocks before and after the query; a later one is a missed poll."""
    queries: list[tuple[Sequence[str], float]] = []

    def run(command: Sequence[str], timeout_s: float) -> Completed:
        queries.append((command, timeout_s))
        return Completed(0, "answer")

    def parse(host: str, output: str, before: Now, after: Now) -> ClockReport:
        return ClockReport(before.mono_ns, after.mono_ns, host, output)

    report = query_clock(
        ("tool",), AdvancingClock(took_ns), run, source="chrony", absent="tool is not installed", parse=parse
    )
    assert queries == [(("tool",), 2.0)]
    assert report == (ClockReport(took_ns, 2 * took_ns, kernel_identity(), "answer") if in_time else None)


def test_host_addresses_of_both_families(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The host's own addresses of both families are listed, without networks, broadcast addresses and loopback."""
    (tmp_path / "four").write_text(FIB_TRIE)
    (tmp_path / "six").write_text(IF_INET6)
    monkeypatch.setattr(clock_report, "IPV4_ROUTES", tmp_path / "four")
    monkeypatch.setattr(clock_report, "IPV6_ADDRESSES", tmp_path / "six")
    assert host_addresses() == ("10.9.0.2", "fe80::ff:fe00:2")


@pytest.mark.parametrize("text", ["", "garbage", "/32 host LOCAL\n", "|-- \n/32 host LOCAL\n", "z" * 32 + " 02\n"])
def test_without_kernel_tables_there_are_no_addresses(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, text: str
) -> None:
    """If the kernel's tables are missing or cannot be parsed, there are no addresses."""
    monkeypatch.setattr(clock_report, "IPV4_ROUTES", tmp_path / "none")
    monkeypatch.setattr(clock_report, "IPV6_ADDRESSES", tmp_path / "none")
    assert host_addresses() == ()
    (tmp_path / "none").write_text(text)
    assert host_addresses() == ()


def test_addresses_have_a_canonical_form() -> None:
    """Two spellings of an address have the same canonical form; other text has none."""
    assert plain_address("FD09:0:0::1") == plain_address("fd09::1") == "fd09::1"
    assert plain_address("gps") == plain_address("") == ""


def test_unknown_correction_has_a_reason() -> None:
    """If the correction is unknown, the report has the clock readings and a reason, but no correction or bound."""
    report = unknown_clock(Now(1, 2), "kernel", "chrony", "chrony is not installed")
    assert (report.mono_ns, report.wall_ns, report.status) == (1, 2, "chrony is not installed")
    assert (report.correction_s, report.bound_s) == (None, None)
    status = "chrony is not installed"
    assert report == ClockReport(1, 2, "kernel", "chrony", status=status, addresses=host_addresses())
