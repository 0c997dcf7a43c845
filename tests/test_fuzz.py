from __future__ import annotations

import mmap
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import fuzz
from benchmarks.fuzzing.mutation import Chance, Corpus, next_input
from benchmarks.fuzzing.target import Target

from lavt.safety.gate import RejectionReason, SafetyGate

INPUTS_OF_EACH, ALL_INPUTS = 250, 500_000
"""Half a million inputs take some 15 s of CPU time."""
VALID = Corpus([bytes(range(64))], fields=((2, 4),))


def fuzz_with(name: str, feed: object, monkeypatch: pytest.MonkeyPatch) -> fuzz.Outcome:
    """Fuzz a target with a given `feed` function."""
    target = Target({"any": VALID}, feed, lambda: 0)  # type: ignore[arg-type]
    monkeypatch.setitem(fuzz.TARGETS, name, (lambda _seed: target, 1.0))
    return fuzz.fuzz(name, 20_000, 1)


@pytest.fixture(scope="module")
def secure() -> None:
    """Skip a test without the libraries of some targets."""
    for module in ("cryptography", "pylibsrtp"):
        pytest.importorskip(module, reason="an extra: pip install -e '.[secure]'")


@pytest.mark.usefixtures("secure")
@pytest.mark.parametrize("name", fuzz.TARGETS)
def test_damaged_inputs_cause_no_error(name: str) -> None:
    """Damaged inputs cause no error in a parser, and some of them are rejected."""
    outcome = fuzz.fuzz(name, INPUTS_OF_EACH, 1)
    assert outcome.failure == ""
    assert outcome.inputs == INPUTS_OF_EACH
    assert outcome.rejected > 0


@pytest.mark.full
@pytest.mark.usefixtures("secure")
def test_damaged_inputs_cause_no_error_and_no_memory_growth() -> None:
    """Many damaged inputs cause no error in any parser and no growth of memory."""
    completed = subprocess.run(
        [sys.executable, Path(fuzz.__file__), "--inputs", str(ALL_INPUTS)],
        capture_output=True,
        text=True,
        check=False,
        timeout=280,
    )
    assert completed.returncode == 0, completed.stdout + completed.stderr
    lines = completed.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines[:-1]] == list(fuzz.TARGETS)
    assert abs(int(lines[-1].split()[0]) - ALL_INPUTS) < len(fuzz.TARGETS)  # shares are rounded
    assert lines[-1].endswith("nothing broke, nothing grew")


def test_inputs_follow_from_the_seed() -> None:
    """The same seed gives the same inputs, another seed gives other inputs, and most inputs are invalid."""
    first, repeated, with_other_seed = (
        [next_input(VALID, chance) for _ in range(1000)] for chance in (Chance(1, "x"), Chance(1, "x"), Chance(2, "x"))
    )
    assert first == repeated != with_other_seed
    assert 100 < first.count(VALID.entries[0]) < 400


def test_an_error_is_reported_with_its_input(monkeypatch: pytest.MonkeyPatch) -> None:
    """A parser that raises for one value of one byte is reported with the input, the input's number and the seed."""

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        if len(data) == 64 and data[2] == 0xFF:
            raise ValueError("planted")

    outcome = fuzz_with("planted", feed, monkeypatch)
    assert outcome.failure.startswith(f"planted broke at input {outcome.inputs - 1} of seed 1, on any: 00")
    assert "ValueError: planted" in outcome.problem


def test_growth_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    """A parser that keeps a page of memory for each input is reported as grown."""
    kept: list[mmap.mmap] = []

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        page = mmap.mmap(-1, mmap.PAGESIZE)  # new memory, not memory that earlier tests have freed
        page[0] = len(data) & 0xFF
        kept.append(page)

    outcome = fuzz_with("hoarder", feed, monkeypatch)
    assert outcome.failure == ""
    assert outcome.problem == f"hoarder grew by {outcome.grown_kb} kB"
    assert outcome.grown_kb > 16_000


def test_an_accepted_replay_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the gate's check of sequence numbers the fuzzer finds that a replayed command is accepted."""
    rejection_reason = SafetyGate.rejection_reason

    def without_sequence_check(self: SafetyGate, *arguments: object) -> RejectionReason | None:
        reason = rejection_reason(self, *arguments)  # type: ignore[arg-type]
        return None if reason is RejectionReason.OLD_SEQUENCE else reason

    monkeypatch.setattr(SafetyGate, "rejection_reason", without_sequence_check)
    assert "a stranger's command was accepted" in fuzz.fuzz("vehicle_driven", 5000, 1).failure
