"""Gives damaged inputs to everything that reads bytes from outside, and tells whether anything broke or grew.

    python benchmarks/fuzz.py [--inputs 10000000] [--seed 1] [--jobs 2] [--only vehicle_driven]

Inputs are valid messages and datagrams with bits flipped, cut, spliced, single fields replaced by extreme values, said
again, or mere noise; they follow from the seed. Each target is the node itself, with time going by, in a process of its
own, and has its share of the inputs. Needs the extra `secure` (pip install 'lavt[secure]').

After each input the target looks whether something happened that no input may lead to: a stranger's command obeyed,
video sent where nobody asked, something let in that nobody signed, something sent that the other side cannot read.
Memory is what the process has in RAM at the end, against after the first fifth of its inputs.

Exit status 1 where anything broke or grew; the line says with which input.
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

sys.path.insert(0, str(Path(__file__).parents[1]))  # as a program it finds only what is beside it

from benchmarks.fuzzing import between, camera, operator_side, secured, vehicle
from benchmarks.fuzzing.mutation import Chance, an_input
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
    "rendezvous": (between.rendezvous, 0.03),
}
"""How each target is made, and its share of the inputs."""

WARM_UP = 0.2
GROWN_KB = 4096
"""More is growth: buffers have found their size after the first fifth, and an allocator moves some pages to and fro."""


@dataclass(frozen=True)
class Outcome:
    """What became of one target's inputs."""

    name: str
    inputs: int
    cpu_s: float
    rejected: int
    grown_kb: int
    said: str
    broke: str
    """Empty: nothing did."""

    @property
    def line(self) -> str:
        """The outcome in words."""
        rate = self.inputs / self.cpu_s if self.cpu_s else 0.0
        words = f"{self.name}: {self.inputs} inputs, {rate:.0f}/s, {self.rejected} refused, {self.grown_kb:+d} kB"
        return words + (f", {self.said}" if self.said else "")

    @property
    def wrong(self) -> str:
        """What is wrong; empty: nothing is."""
        grown = f"{self.name} grew by {self.grown_kb} kB" if self.grown_kb > GROWN_KB else ""
        return self.broke or grown


def memory_kb() -> int:
    """What this process has in RAM."""
    gc.collect()
    return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE") // 1024


def cpu_s() -> float:
    """CPU time of this process."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    return used.ru_utime + used.ru_stime


def fuzz(name: str, inputs: int, seed: int) -> Outcome:
    """Give so many inputs to one target, up to the first one that breaks it."""
    target = TARGETS[name][0](seed)
    chance = Chance(seed, name)
    channels = tuple(target.corpora)
    begin_s, warm_kb, said, broke = cpu_s(), 0, "", ""
    number, channel, data = -1, "", b""
    try:
        for number in range(inputs):
            if number == int(WARM_UP * inputs):
                warm_kb = memory_kb()
            channel = chance.choice(channels)
            data = an_input(target.corpora[channel], chance)
            target.feed(channel, data, chance)
        said = target.finish()
    except Exception:  # whatever it is, it is what was looked for
        broke = f"{name} broke at input {number} of seed {seed}, on {channel}: {data.hex()}\n{traceback.format_exc()}"
    return Outcome(name, number + 1, cpu_s() - begin_s, target.rejected(), memory_kb() - warm_kb, said, broke)


def fuzz_all(names: list[str], inputs: int, seed: int, jobs: int) -> list[Outcome]:
    """Fuzz the named targets, each in a process of its own; prints each line when it is there."""
    shares = sum(TARGETS[name][1] for name in names)
    outcomes = []
    with ProcessPoolExecutor(jobs, mp_context=get_context("spawn"), max_tasks_per_child=1) as pool:
        begun: dict[str, Future[Outcome]] = {
            name: pool.submit(fuzz, name, max(1, round(inputs * TARGETS[name][1] / shares)), seed) for name in names
        }
        for future in begun.values():
            outcomes.append(future.result())
            print(outcomes[-1].line, flush=True)
    return outcomes


def arguments(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--inputs", type=int, default=10_000_000, help="of all targets together")
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--jobs", type=int, default=os.cpu_count(), help="processes at a time")
    parser.add_argument("--only", action="append", choices=TARGETS, help="a target by name; may be given again")
    requested = parser.parse_args(words)
    if requested.inputs < 1 or requested.jobs < 1:
        parser.error("--inputs and --jobs must be above zero")
    return requested


def main() -> int:
    """Fuzz; 1 where something broke or grew."""
    requested = arguments()
    try:
        outcomes = fuzz_all(requested.only or list(TARGETS), requested.inputs, requested.seed, requested.jobs)
    except (ImportError, UserError) as error:
        print(f"{error}: pip install 'lavt[secure]'", file=sys.stderr)
        return 2
    wrong = [outcome.wrong for outcome in outcomes if outcome.wrong]
    inputs, took_s = sum(outcome.inputs for outcome in outcomes), sum(outcome.cpu_s for outcome in outcomes)
    print("\n".join(wrong) or f"{inputs} inputs in {took_s:.0f} s of CPU time: nothing broke, nothing grew")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
