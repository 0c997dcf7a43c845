"""Run lanes sequentially, each with a time limit, and print the results in a table."""

from __future__ import annotations

import os
import re
import signal
import subprocess
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.lanes import REPOSITORY, LaneSpec

from lavt.clock import MachineClock, pause
from lavt.domain import NS_PER_MS, NS_PER_S

LOW_PRIORITY = 19
POLL_NS = 100 * NS_PER_MS
GRACE_NS = 10 * NS_PER_S
"""Time for a lane to end after SIGINT, and again after SIGTERM."""
OUTCOMES = ("passed", "failed", "error", "skipped", "rerun", "inconclusive")
SUMMARY = re.compile(r"^=+ (.*) in [\d.]+s(?: \([\d:]+\))? =+$", re.MULTILINE)
COLOURS = re.compile(r"\x1b\[[\d;]*m")

Write = Callable[[str], None]


def parse_counts(output: str) -> Counter[str]:
    """Return the numbers of passed, failed and other tests from pytest's closing lines in an output."""
    counts: Counter[str] = Counter()
    for line in SUMMARY.findall(COLOURS.sub("", output)):
        for number, word in re.findall(r"(\d+) (\w+)", line):
            counts[word.removesuffix("s") if word == "errors" else word] += int(number)
    return counts


@dataclass
class LaneOutcome:
    """The result of a lane."""

    name: str
    took_s: float
    counts: Counter[str]
    failures: list[str] = field(default_factory=list)
    """The reasons why the lane failed; empty if it passed."""


class RunningLane:
    """The commands of a lane, run sequentially, with their output in a file."""

    def __init__(self, spec: LaneSpec, folder: Path, *, niceness: int = 0, beside: RunningLane | None = None) -> None:
        self.spec = spec
        self._beside = beside
        """This lane starts with the last command of that one."""
        self._niceness = niceness
        self._waiting_commands = list(spec.commands)
        self._command = ""
        self._process: subprocess.Popen[bytes] | None = None
        self._output = folder / f"{spec.name}.output"
        # The kernel lane's machines can write to the folder of the progress file, so this folder has no other files.
        self._progress = folder / spec.name / "progress"
        self._progress.parent.mkdir()
        self._output.touch()
        self._returned_bytes = 0
        self._began_ns: int | None = None
        self._ended_ns = 0
        self.failures: list[str] = []
        self.running = True

    @property
    def is_at_last_command(self) -> bool:
        """Whether the last command was started."""
        return not self._waiting_commands

    def poll(self) -> None:
        """Check the running command, start the next one, and end a lane that exceeds its time limit."""
        if not self.running or (self._beside is not None and not self._beside.is_at_last_command):
            return
        now_ns = self._ended_ns = MachineClock().now().mono_ns
        if self._began_ns is None:
            self._began_ns = now_ns
        if self._process is not None and self._process.poll() is not None:
            if code := self._process.returncode:
                self.failures.append(f"`{self._command}` ended with {code}")
            self._process = None
        if now_ns - self._began_ns > self.spec.limit_min * 60 * NS_PER_S:
            running_test = self._progress.read_text() if self._progress.exists() else ""
            self.failures.append(
                f"took longer than {self.spec.limit_min:g} min, and was at: {running_test or 'no test'}"
            )
            self.end()
        elif self._process is None and self._waiting_commands:
            self._process = self._start(self._waiting_commands.pop(0))
        elif self._process is None:
            self.running = False

    def _start(self, command: tuple[str, ...]) -> subprocess.Popen[bytes]:
        self._command = " ".join([Path(command[0]).name, *command[1:]])
        with self._output.open("ab") as output:
            process = subprocess.Popen(
                ["nice", "-n", str(self._niceness), *command] if self._niceness else command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                cwd=REPOSITORY,
                env={**os.environ, "LAVT_PROGRESS": str(self._progress)},
            )
        if self._niceness:
            # Each lane is a session. If the kernel groups processes by session, `nice` has no effect between groups.
            with suppress(OSError):
                Path(f"/proc/{process.pid}/autogroup").write_text(str(self._niceness))
        return process

    def end(self) -> None:
        """End the lane and all its processes, first as Ctrl-C does, so that pytest reports the failures so far."""
        self.running = False
        self._waiting_commands.clear()
        if self._process is None:
            return
        leader, clock = self._process.pid, MachineClock()
        whole_group = -leader  # for `os.kill`, the negative number of a group's leader means all its processes
        with suppress(ProcessLookupError):
            for signal_number, target in ((signal.SIGINT, leader), (signal.SIGTERM, whole_group)):
                os.kill(target, signal_number)
                limit_ns = clock.now().mono_ns + GRACE_NS
                while self._process.poll() is None and clock.now().mono_ns < limit_ns:
                    pause(POLL_NS)
            os.kill(whole_group, signal.SIGKILL)
        self._process.wait()

    def new_output(self) -> str:
        """Return the output since the last call."""
        with self._output.open("rb") as output:
            output.seek(self._returned_bytes)
            chunk = output.read()
        self._returned_bytes += len(chunk)
        return chunk.decode(errors="replace")

    def outcome(self) -> LaneOutcome:
        """Return the result."""
        counts = parse_counts(self._output.read_text(errors="replace"))
        took_s = 0.0 if self._began_ns is None else (self._ended_ns - self._began_ns) / NS_PER_S
        return LaneOutcome(self.spec.name, took_s, counts, self.failures)


def run_lanes(lanes: Sequence[LaneSpec], *, write: Write) -> int:
    """Run lanes in their order; return 0 if all passed, else 1.

    A lane that runs at the same time as others (`meanwhile`) starts with the last command of its lane, and goes on
    beside the lanes that follow. Its output is written at the end.
    """
    in_turn: list[RunningLane] = []
    background: list[RunningLane] = []
    began_ns = MachineClock().now().mono_ns
    with TemporaryDirectory(prefix="lavt-lanes-") as folder:
        try:
            for spec in lanes:
                lane = RunningLane(spec, Path(folder))
                in_turn.append(lane)
                if spec.meanwhile is not None:
                    background.append(RunningLane(spec.meanwhile, Path(folder), niceness=LOW_PRIORITY, beside=lane))
                _run_lane(lane, background, write)
            for lane in background:
                _run_lane(lane, background, write)
        finally:
            for lane in (*in_turn, *background):
                lane.end()
        outcomes = [lane.outcome() for lane in (*in_turn, *background)]
    write(f"\n{table(outcomes)}\n{closing_line(outcomes, (MachineClock().now().mono_ns - began_ns) / NS_PER_S)}\n")
    return int(any(outcome.failures for outcome in outcomes))


def _run_lane(lane: RunningLane, background: Sequence[RunningLane], write: Write) -> None:
    """Run a lane to its end, with the others in the background, and write its output."""
    write(f"\n---- {lane.spec.name}\n")
    while lane.running:
        for each in {lane, *background}:
            each.poll()
        write(lane.new_output())
        pause(POLL_NS)
    write(lane.new_output())


def table(outcomes: Sequence[LaneOutcome]) -> str:
    """Return a table with one line per lane, followed by the reasons for failures."""
    lines = [f"{'lane':<10}{'time':>8}" + "".join(f"{word:>{len(word) + 3}}" for word in OUTCOMES)]
    for outcome in outcomes:
        minutes, seconds = divmod(round(outcome.took_s), 60)
        numbers = "".join(f"{outcome.counts[word]:>{len(word) + 3}}" for word in OUTCOMES)
        lines.append(
            f"{outcome.name:<10}{f'{minutes}:{seconds:02}':>8}{numbers}{'   FAILED' if outcome.failures else ''}"
        )
    lines += [f"{outcome.name}: {reason}" for outcome in outcomes for reason in outcome.failures]
    return "\n".join(lines)


def closing_line(outcomes: Sequence[LaneOutcome], took_s: float) -> str:
    """Return the totals in pytest's format; a lane that failed without a failed test counts as one failure."""
    total = sum((outcome.counts for outcome in outcomes), Counter[str]())
    failed = (
        total["failed"]
        + total["error"]
        + sum(bool(outcome.failures) and not outcome.counts["failed"] + outcome.counts["error"] for outcome in outcomes)
    )
    other_counts = "".join(f", {total[word]} {word}" for word in ("skipped", "rerun", "inconclusive") if total[word])
    return f"{total['passed']} passed, {failed} failed{other_counts} in {took_s:.0f}s"
