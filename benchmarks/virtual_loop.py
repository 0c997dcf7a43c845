"""How fast the loop runs in virtual time, and where the time of a frame goes.

    python benchmarks/virtual_loop.py [--settings full bare geometry] [--routes a_key] [--repetitions 5] [--limit-s 600]

Drives the way `lavt run` does (`plan_run`, `build_loop`, `drive`), at L0, with everything recorded. What is counted is
CPU time of this process and its children, as the operating system has it, against the virtual time that went by in the
drive: medians over the repetitions. Building the loop (reading the road, painting the ground, opening the codec) is
no part of a drive and has a figure of its own; imports have none. The stages are timed in one more drive, hop by hop,
and have to make up that drive.

The last line is JSON: how many times real time each setting reaches, and two stages of the one with everything; null
is what was not measured.
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
"""By the name that the JSON has with `_x`: the whole loop, that without scenery and codec, that without pixels."""

PARTS = {
    "render": (("camera", "capture"),),
    "encode": (("camera", "encode"),),
    "decode": (("driver", "decode"),),
    "perception": (("driver", "perceive"),),
    "control": (("driver", "decide"), ("driver", "command")),
}
"""Hops that make up a stage; what is left is "rest": car and judge, packets, links, safety, records, the runtime."""

SAID = ("full_x", "bare_x", "geometry_x", "perception_ms", "render_ms")
"""What the last line says."""


@dataclass(frozen=True, slots=True)
class Driven:
    """One drive: virtual time, CPU times, frames."""

    simulated_s: float
    build_cpu_s: float
    drive_cpu_s: float
    frames: int


def cpu_s() -> float:
    """CPU time of this process and the children that have ended, user and system."""
    own, children = resource.getrusage(resource.RUSAGE_SELF), resource.getrusage(resource.RUSAGE_CHILDREN)
    return own.ru_utime + own.ru_stime + children.ru_utime + children.ru_stime


def drive_once(changes: Iterable[str], limit_s: float, change: Callable[[VirtualLoop], None] | None = None) -> Driven:
    """Drive one run of `configs/demo.yaml` with changes, the loop itself too where asked, and measure it."""
    planned = plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes))
    with TemporaryDirectory() as folder:
        begin_s = cpu_s()
        loop = build_loop(planned, Path(folder) / "run")
        if change is not None:
            change(loop)
        built_s = cpu_s()
        drive(loop, limit_ns=round(limit_s * NS_PER_S))
        driven_s = cpu_s()
    frames = loop.server.camera.counts["frames_sent"]
    return Driven(loop.runtime.true_ns / NS_PER_S, built_s - begin_s, driven_s - built_s, frames)


def stages_ms(changes: Iterable[str], limit_s: float) -> dict[str, float]:
    """Drive once more with a stopwatch in each stage; return milliseconds of CPU time for each frame, with the rest.

    Raises `WorkError` where the stages do not make up the drive.
    """
    spent_s: defaultdict[tuple[str, str], float] = defaultdict(float)

    def timed(node: Node, name: str, stage: Callable[..., Any]) -> Stage:
        def run(value: Any, now: Any) -> Any:
            begin_s = cpu_s()
            result = stage(value, now)
            spent_s[node.name, name] += cpu_s() - begin_s
            return result

        return name, run

    def watch(loop: VirtualLoop) -> None:
        for host in loop.runtime.hosts.values():
            for runner in host.runners.values():  # the runtime has looked up the pipelines already
                runner.pipelines = {
                    channel: (tuple(timed(runner.node, name, stage) for name, stage in stages), ends_ns)
                    for channel, (stages, ends_ns) in runner.pipelines.items()
                }

    driven = drive_once(changes, limit_s, watch)
    parts = {part: 1e3 * sum(spent_s[stage] for stage in stages) / driven.frames for part, stages in PARTS.items()}
    return with_rest(parts, 1e3 * driven.drive_cpu_s / driven.frames)


def with_rest(stages: Mapping[str, float], whole: float) -> dict[str, float]:
    """Return the stages and what they leave of the whole, in its unit.

    Raises `WorkError` where a stage took no time, so that it was not measured, or where all took more than the whole.
    """
    nothing = [stage for stage, took in stages.items() if took <= 0]
    if nothing:
        raise WorkError(f"{', '.join(nothing)} took no time: the stopwatch is not where the work is done")
    rest = whole - sum(stages.values())
    if rest < 0:
        raise WorkError(f"the stages took {sum(stages.values()):.3f} ms of a frame's {whole:.3f} ms")
    return {**stages, "rest": rest}


def measure(names: Iterable[str], routes: Sequence[str], repetitions: int, limit_s: float) -> dict[str, float | None]:
    """Measure the named settings and print what was found; returns what the last line says."""
    cv2.setNumThreads(1)
    found: defaultdict[str, list[float]] = defaultdict(list)
    for name in names:
        for route in routes:
            changes = (*SETTINGS[name], f"vehicle.route={route}")
            drives = [drive_once(changes, limit_s) for _ in range(repetitions)]
            speed = median(each.simulated_s / each.drive_cpu_s for each in drives)
            whole = median(each.simulated_s / (each.drive_cpu_s + each.build_cpu_s) for each in drives)
            building_s = median(each.build_cpu_s for each in drives)
            frame_ms = median(1e3 * each.drive_cpu_s / each.frames for each in drives)
            stages = stages_ms(changes, limit_s)
            found[f"{name}_x"].append(speed)
            if name == "full":
                found["perception_ms"].append(stages["perception"])
                found["render_ms"].append(stages["render"])
            print(f"{name}, {route}: {drives[0].simulated_s:.1f} s simulated, {repetitions} drives")
            print(f"  {speed:.2f} times real time; with {building_s:.2f} s to build the loop {whole:.2f}")
            parts = ", ".join(f"{stage} {ms:.3f}" for stage, ms in stages.items())
            print(f"  a frame {frame_ms:.3f} ms; with a stopwatch {sum(stages.values()):.3f} ms: {parts}")
    return {name: round(median(found[name]), 3) if found[name] else None for name in SAID}


def machine() -> str:
    """Name what the figures depend on."""
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
