"""Measure how fast the loop runs in virtual time, and how much of a frame's time each stage takes.

    python benchmarks/virtual_loop.py [--settings full bare geometry] [--routes a_key] [--repetitions 5] [--limit-s 600]

The program drives like `lavt run` (`plan_run`, `build_loop`, `drive`), at L0, with everything recorded. It divides the
virtual time of the drive by the CPU time of this process and its children. It prints medians over the repetitions.
Building the loop (reading the road, painting the ground, opening the codec) is not part of a drive and is printed
separately. Imports are not measured. One more drive has a timer around each stage. The stages together must not take
longer than this drive.

The last line is JSON: the speed of each setting relative to real time, and the time of two stages with the setting
`full`. Values that were not measured are null.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import sysconfig
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import cv2

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.domain import NS_PER_S
from lavt.errors import WorkError
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.virtual_run import VirtualLoop, build_loop, drive
from lavt.node import Node, Stage

SETTINGS = {
    "full": ("vehicle.scenery=full", "fidelity=video"),
    "bare": ("vehicle.scenery=none", "fidelity=pixels"),
    "geometry": ("fidelity=geometry",),
}
"""Changes of the config by setting: the whole loop; without scenery and codec; without pixels."""

PARTS = {
    "render": (("camera", "capture"),),
    "encode": (("camera", "encode"),),
    "decode": (("driver", "decode"),),
    "perception": (("driver", "perceive"),),
    "control": (("driver", "decide"), ("driver", "command")),
}
"""Node and stage of each timed part; the rest is the simulator, packets, links, safety, records and the runtime."""

JSON_KEYS = ("full_speedup", "bare_speedup", "geometry_speedup", "perception_ms", "render_ms")
"""Keys of the JSON in the last line; a speedup is the speed of a setting relative to real time."""


@dataclass(frozen=True, slots=True)
class DriveCost:
    """The virtual time, CPU times and frames of one drive."""

    simulated_s: float
    build_cpu_s: float
    drive_cpu_s: float
    frames: int


def cpu_s() -> float:
    """Return the user and system CPU time of this process and of its ended children."""
    process, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return process.ru_utime + process.ru_stime + children.ru_utime + children.ru_stime


def drive_once(
    changes: Iterable[str], limit_s: float, instrument: Callable[[VirtualLoop], None] | None = None
) -> DriveCost:
    """Drive one run of `configs/demo.yaml` with changes, and return its cost; `instrument` can change the loop."""
    planned = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes))
    with TemporaryDirectory() as folder:
        begin_s = cpu_s()
        loop = build_loop(planned, Path(folder) / "run")
        if instrument is not None:
            instrument(loop)
        built_s = cpu_s()
        drive(loop, limit_ns=round(limit_s * NS_PER_S))
        driven_s = cpu_s()
    frames = loop.server.camera.counts["frames_sent"]
    return DriveCost(loop.runtime.true_ns / NS_PER_S, built_s - begin_s, driven_s - built_s, frames)


def stages_ms(changes: Iterable[str], limit_s: float) -> dict[str, float]:
    """Drive with a timer around each stage; return the CPU milliseconds per frame of each part and of the rest.

    Raise `WorkError` if a part took no time, or if all parts together took longer than the drive.
    """
    spent_s: defaultdict[tuple[str, str], float] = defaultdict(float)

    def timed(node: Node, name: str, stage: Callable[..., Any]) -> Stage:
        def run(value: Any, now: Any) -> Any:
            begin_s = cpu_s()
            result = stage(value, now)
            spent_s[node.name, name] += cpu_s() - begin_s
            return result

        return name, run

    def instrument_stages(loop: VirtualLoop) -> None:
        for host in loop.runtime.hosts.values():
            for runner in host.runners.values():  # the runtime has looked up the pipelines already
                for pipeline in runner.pipelines.values():
                    pipeline.stages = [timed(runner.node, name, function) for name, function in pipeline.stages]

    drive_cost = drive_once(changes, limit_s, instrument_stages)
    parts_ms = {
        part: 1e3 * sum(spent_s[stage] for stage in stages) / drive_cost.frames for part, stages in PARTS.items()
    }
    return with_rest(parts_ms, 1e3 * drive_cost.drive_cpu_s / drive_cost.frames)


def with_rest(parts_ms: Mapping[str, float], whole_ms: float) -> dict[str, float]:
    """Return the times of the parts, and of the rest: the time of the whole minus that of all parts.

    Raise `WorkError` if a part took no time, because then it was not measured, or if the rest is negative.
    """
    unmeasured = [part for part, duration_ms in parts_ms.items() if duration_ms <= 0]
    if unmeasured:
        raise WorkError(f"{', '.join(unmeasured)} took no time: the timer is not where the work is done")
    rest_ms = whole_ms - sum(parts_ms.values())
    if rest_ms < 0:
        raise WorkError(f"the stages took {sum(parts_ms.values()):.3f} ms of a frame's {whole_ms:.3f} ms")
    return {**parts_ms, "rest": rest_ms}


def measure(names: Iterable[str], routes: Sequence[str], repetitions: int, limit_s: float) -> dict[str, float | None]:
    """Measure the named settings and print the results; return the values of the JSON."""
    cv2.setNumThreads(1)
    samples: defaultdict[str, list[float]] = defaultdict(list)
    for name in names:
        for route in routes:
            changes = (*SETTINGS[name], f"vehicle.route={route}")
            drives = [drive_once(changes, limit_s) for _ in range(repetitions)]
            speed = median(cost.simulated_s / cost.drive_cpu_s for cost in drives)
            speed_with_building = median(cost.simulated_s / (cost.drive_cpu_s + cost.build_cpu_s) for cost in drives)
            building_s = median(cost.build_cpu_s for cost in drives)
            frame_ms = median(1e3 * cost.drive_cpu_s / cost.frames for cost in drives)
            parts_ms = stages_ms(changes, limit_s)
            samples[f"{name}_speedup"].append(speed)
            if name == "full":
                samples["perception_ms"].append(parts_ms["perception"])
                samples["render_ms"].append(parts_ms["render"])
            print(f"{name}, {route}: {drives[0].simulated_s:.1f} s simulated, {repetitions} drives")
            print(f"  {speed:.2f} times real time; with {building_s:.2f} s to build the loop {speed_with_building:.2f}")
            parts = ", ".join(f"{part} {ms:.3f}" for part, ms in parts_ms.items())
            timed_ms = sum(parts_ms.values())
            print(f"  a frame {frame_ms:.3f} ms; with a timer around each stage {timed_ms:.3f} ms: {parts}")
    return {name: round(median(samples[name]), 3) if samples[name] else None for name in JSON_KEYS}


def machine() -> str:
    """Return a description of the machine and the Python build, on which the results depend."""
    info = Path("/proc/cpuinfo")
    lines = info.read_text().splitlines() if info.exists() else []
    cpu = next((line.partition(":")[2].strip() for line in lines if "model name" in line), platform.machine())
    optimized = "--enable-optimizations" in (sysconfig.get_config_var("CONFIG_ARGS") or "")
    built = "with" if optimized else "without"
    python = f"Python {platform.python_version()} built {built} profile-guided optimization"
    return f"{cpu}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}; {python}"


def main() -> None:
    """Measure everything."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--settings", nargs="+", choices=SETTINGS, default=list(SETTINGS))
    parser.add_argument("--routes", nargs="+", default=["a_key"])
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--limit-s", type=float, default=600.0)
    arguments = parser.parse_args()
    print(machine())
    print(json.dumps(measure(arguments.settings, arguments.routes, arguments.repetitions, arguments.limit_s)))


if __name__ == "__main__":
    main()
