from __future__ import annotations

import mmap
import subprocess
import sys
from pathlib import Path

import pytest
from benchmarks import fuzz
from benchmarks.fuzzing.mutation import Chance, Corpus, an_input
from benchmarks.fuzzing.target import Target

from lavt.safety.gate import RejectionReason, SafetyGate

INPUTS = (50_000, 2_000_000)
"""Two million take a minute of CPU time, where it was measured."""
VALID = Corpus([bytes(range(64))], fields=((2, 4),))


def made_of(name: str, feed: object, monkeypatch: pytest.MonkeyPatch) -> fuzz.Outcome:
    """Fuzz a parser of the test's own."""
    target = Target({"any": VALID}, feed, lambda: 0)  # type: ignore[arg-type]
    monkeypatch.setitem(fuzz.TARGETS, name, (lambda _seed: target, 1.0))
    return fuzz.fuzz(name, 20_000, 1)


@pytest.mark.parametrize("inputs", [INPUTS[0], pytest.param(INPUTS[1], marks=pytest.mark.full)])
def test_damaged_inputs_break_nothing_and_nothing_grows(inputs: int) -> None:
    """What reads bytes from outside survives two million damaged inputs without an error, and memory does not grow."""
    for module in ("cryptography", "pylibsrtp"):
        pytest.importorskip(module, reason="an extra: pip install 'lavt[secure]'")
    done = subprocess.run(
        [sys.executable, Path(fuzz.__file__), "--inputs", str(inputs)], capture_output=True, text=True, check=False,
        timeout=280,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    lines = done.stdout.splitlines()
    assert [line.partition(":")[0] for line in lines[:-1]] == list(fuzz.TARGETS)
    assert abs(int(lines[-1].split()[0]) - inputs) < len(fuzz.TARGETS)  # shares are rounded
    assert lines[-1].endswith("nothing broke, nothing grew")


def test_inputs_follow_from_the_seed() -> None:
    """The same seed gives the same inputs, another one gives others, and hardly any of them is valid."""
    made = [
        [an_input(VALID, chance) for _ in range(1000)] for chance in (Chance(1, "x"), Chance(1, "x"), Chance(2, "x"))
    ]
    assert made[0] == made[1] != made[2]
    assert 100 < made[0].count(VALID.entries[0]) < 400


def test_an_error_is_told_with_the_input_that_led_to_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """A parser that raises for one byte in one place is found, and the input, its number and the seed are told."""

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        if len(data) == 64 and data[2] == 0xFF:
            raise ValueError("planted")

    outcome = made_of("planted", feed, monkeypatch)
    assert outcome.broke.startswith(f"planted broke at input {outcome.inputs - 1} of seed 1, on any: 00")
    assert "ValueError: planted" in outcome.wrong


def test_growth_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    """A parser that keeps a page of memory for each input has grown, though nothing broke."""
    kept: list[mmap.mmap] = []

    def feed(_channel: str, data: bytes, _chance: Chance) -> None:
        page = mmap.mmap(-1, mmap.PAGESIZE)  # memory of its own: what earlier tests have left over is not used for it
        page[0] = len(data) & 0xFF
        kept.append(page)

    outcome = made_of("hoarder", feed, monkeypatch)
    assert outcome.broke == ""
    assert outcome.wrong == f"hoarder grew by {outcome.grown_kb} kB"
    assert outcome.grown_kb > 16_000


def test_a_stranger_who_is_accepted_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the check of the sequence the fuzzer finds that a command of the operator's, said again, is obeyed."""
    rejection_reason = SafetyGate.rejection_reason

    def without_sequence(self: SafetyGate, *arguments: object) -> RejectionReason | None:
        reason = rejection_reason(self, *arguments)  # type: ignore[arg-type]
        return None if reason is RejectionReason.OLD_SEQUENCE else reason

    monkeypatch.setattr(SafetyGate, "rejection_reason", without_sequence)
    assert "a stranger's command was obeyed" in fuzz.fuzz("vehicle_driven", 5000, 1).broke
