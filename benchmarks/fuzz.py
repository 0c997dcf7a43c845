"""Fuzz everything that reads bytes from outside, and report errors, violated invariants and memory growth.

    python benchmarks/fuzz.py [--inputs 10000000] [--seed 1] [--jobs 2] [--only vehicle_driven]

Inputs are random noise, and valid messages and datagrams that are truncated, spliced, replayed, or changed in single
bits or fields. The seed determines the inputs. A target is a real node or parser with simulated time, in a process of
its own. Each target gets a share of the inputs. Needs the extra `secure` (pip install 'lavt[secure]').

After each input the target checks its invariants, for example: no command of a stranger is accepted, no video is sent
to an address that was not validated, no unsigned message is accepted, and the other side can decode every sent message.
Memory growth is the resident memory at the end minus the resident memory after the first fifth of the inputs.

Exits with 1 if a target broke or its memory grew; the output contains the input that broke it.
"""

from __future__ import annotations

import argparse
import gc
import os
import resource
import sys
import traceback
from collections.abc import Callable
from concurrent.futures import Future, ProcessPoolExecutor
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parents[1]))  # for the package `benchmarks`

from benchmarks.fuzzing import camera, operator_side, pages, rendezvous, secured, vehicle
from benchmarks.fuzzing.mutation import Chance, next_input
from benchmarks.fuzzing.target import Target

from lavt.errors import UserError

TARGETS: dict[str, tuple[Callable[[int], Target], float]] = {
    "vehicle_at_rest": (vehicle.vehicle_at_rest, 0.15),
    "vehicle_driven": (vehicle.vehicle_driven, 0.15),
    "condition_at_vehicle": (vehicle.condition_at_vehicle, 0.05),
    "feedback": (camera.feedback, 0.15),
    "probe_at_vehicle": (camera.probe_at_vehicle, 0.03),
    "driver": (operator_side.driver, 0.12),
    "driver_who_stops": (partial(operator_side.driver, stops_after=500), 0.03),
    "condition_at_operator": (operator_side.condition_at_operator, 0.02),
    "video": (operator_side.video, 0.14),
    "pictures": (operator_side.pictures, 0.01),
    "probe_at_operator": (operator_side.probe_at_operator, 0.02),
    "stamps": (operator_side.stamps, 0.03),
    "gateway_of_vehicle": (secured.gateway_of_vehicle, 0.03),
    "gateway_of_operator": (secured.gateway_of_operator, 0.03),
    "encrypted_video": (secured.encrypted_video, 0.03),
    "encrypted_feedback": (secured.encrypted_feedback, 0.02),
    "rendezvous": (rendezvous.rendezvous, 0.03),
    "driving_page": (pages.driving_page, 0.03),
    "watching_page": (pages.watching_page, 0.02),
    "console_site": (pages.console_site, 0.02),
}
"""The function that makes each target, and the target's share of the inputs."""

WARM_UP_SHARE = 0.2
"""The share of the inputs after which buffers have reached their final size."""

MAX_GROWTH_KB = 4096
"""Memory has grown if it has increased by more than this limit. Allocators cause smaller changes at any time."""


@dataclass(frozen=True)
class Outcome:
    """The result of fuzzing one target."""

    name: str
    inputs: int
    cpu_s: float
    rejected: int
    grown_kb: int
    summary: str
    """The summary that the target returned; empty if it returned none."""
    failure: str
    """The input that broke the target, and the error; empty if the target did not break."""

    @property
    def line(self) -> str:
        """The outcome in one line."""
        rate = self.inputs / self.cpu_s if self.cpu_s else 0.0
        line = f"{self.name}: {self.inputs} inputs, {rate:.0f}/s, {self.rejected} rejected, {self.grown_kb:+d} kB"
        return line + (f", {self.summary}" if self.summary else "")

    @property
    def problem(self) -> str:
        """The failure or the growth; empty if there is neither."""
        grown = f"{self.name} grew by {self.grown_kb} kB" if self.grown_kb > MAX_GROWTH_KB else ""
        return self.failure or grown


def memory_kb() -> int:
    """Return the resident memory of this process."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def cpu_s() -> float:
    """Return the CPU time of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def fuzz(name: str, inputs: int, seed: int) -> Outcome:
    """Feed inputs to one target until one of them breaks it, or until `inputs` have been fed."""
    target = TARGETS[name][0](seed)
    chance = Chance(seed, name)
    channels = tuple(target.corpora)
    begin_s, memory_after_warm_up_kb, summary, failure = cpu_s(), 0, "", ""
    number, channel, data = -1, "", b""
    try:
        for number in range(inputs):
            if number == int(WARM_UP_SHARE * inputs):
                memory_after_warm_up_kb = memory_kb()
            channel = chance.choice(channels)
            data = next_input(target.corpora[channel], chance)
            target.feed(channel, data, chance)
        summary = target.finish()
    except Exception:  # any error is reported
        failure = f"{name} broke at input {number} of seed {seed}, on {channel}: {data.hex()}\n{traceback.format_exc()}"
    took_s = cpu_s() - begin_s
    grown_kb = memory_kb() - memory_after_warm_up_kb
    return Outcome(name, number + 1, took_s, target.rejected_count(), grown_kb, summary, failure)


def fuzz_all(names: list[str], inputs: int, seed: int, jobs: int) -> list[Outcome]:
    """Fuzz the named targets, each in a process of its own, and print a line for each target, in the given order."""
    shares = sum(TARGETS[name][1] for name in names)
    outcomes = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        futures: dict[str, Future[Outcome]] = {
            name: pool.submit(fuzz, name, max(1, round(inputs * TARGETS[name][1] / shares)), seed) for name in names
        }
        for future in futures.values():
            outcomes.append(future.result())
            print(outcomes[-1].line, flush=True)
    return outcomes


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10_000_000, help="number of inputs for all targets together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="number of processes")
    parser.add_argument("--only", action="append", choices=TARGETS, help="a target by name; repeatable")
    options = parser.parse_args(words)
    if options.inputs < 1 or options.jobs < 1:
        parser.error("--inputs and --jobs must be above zero")
    return options


def main() -> int:
    """Fuzz, and return the exit code: 1 if a target broke or its memory grew, 2 if a Python module is missing."""
    options = arguments()
    try:
        outcomes = fuzz_all(options.only or list(TARGETS), options.inputs, options.seed, options.jobs)
    except (ImportError, UserError) as error:
        print(f"{error}: pip install 'lavt[secure]'", file=sys.stderr)
        return 2
    problems = [outcome.problem for outcome in outcomes if outcome.problem]
    inputs, took_s = sum(outcome.inputs for outcome in outcomes), sum(outcome.cpu_s for outcome in outcomes)
    print("\n".join(problems) or f"{inputs} inputs in {took_s:.0f} s of CPU time: nothing broke, nothing grew")
    return 1 if problems else 0


if __name__ == "__main__":
    sys.exit(main())
