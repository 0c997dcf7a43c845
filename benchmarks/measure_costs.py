"""Measure the durations of the loop's stages and links, and write them to `configs/costs.yaml` for virtual time.

The program makes drives in real time over the loopback, without injection, and takes medians from their records. A
timeline in a record has the times at which a message arrived at a node and at which each stage ended. A wait is the
time between the arrival of a message and the beginning of the first stage. The delay of a link is the time between the
end of the sender's pipeline and the arrival at the receiver. Both are times of the same clock, because all processes
run on one machine.

    python benchmarks/measure_costs.py [--drives 3] [--out configs/costs.yaml]
"""

from __future__ import annotations

import argparse
import os
import platform
from collections import defaultdict
from itertools import pairwise
from pathlib import Path
from statistics import median
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import yaml

from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.recording.record import Record, read_record

NS_PER_US = 1000.0
StageSamples = dict[tuple[str, str], list[float]]
"""Durations in microseconds by node and stage."""


def timelines(record: Record) -> list[tuple[str, str, int, int, list[tuple[str, int]]]]:
    """Return node, channel, stamp, arrival and stage ends of every timeline of a record.

    The stage ends are pairs of stage and time. The first pair is not a stage: its time is the beginning of the first
    stage.
    """
    table = record.table("timeline")
    columns = (
        table.texts("node"),
        table.texts("channel"),
        table.ints("stamp_ns").tolist(),
        table.ints("arrived_mono_ns").tolist(),
        table.objects("stages"),
    )
    return list(zip(*columns, strict=True))


def add_stages(record: Record, stages: StageSamples) -> None:
    """Add the duration of every stage, and the wait of every message."""
    for node, channel, _stamp_ns, arrived_ns, ends in timelines(record):
        _, first_begin_ns = ends[0]
        if channel != "wake":
            stages[node, f"wait_{channel}"].append((first_begin_ns - arrived_ns) / NS_PER_US)
        for (_, begin_ns), (name, end_ns) in pairwise(ends):
            stages[node, name].append((end_ns - begin_ns) / NS_PER_US)


def add_links(server: Record, client: Record, links: dict[str, list[float]]) -> None:
    """Add the delays of the links. Frames are matched by their stamps; commands and states contain their send times."""
    sent_ns_by_stamp = {stamp_ns: ends[-1][1] for node, _, stamp_ns, _, ends in timelines(server) if node == "camera"}
    for node, channel, stamp_ns, arrived_ns, _ in timelines(client):
        if node == "driver" and channel == "access_unit" and stamp_ns in sent_ns_by_stamp:
            links["video"].append((arrived_ns - sent_ns_by_stamp[stamp_ns]) / NS_PER_US)
    admission = server.table("admission")
    links["control"] += ((admission.ints("received_wall_ns") - admission.ints("sent_wall_ns")) / NS_PER_US).tolist()
    state = client.table("state")
    links["state"] += ((state.wall_ns - state.ints("sent_wall_ns")) / NS_PER_US).tolist()


def measure_costs(drives: int) -> dict[str, Any]:
    """Make `drives` drives, and return the content of `configs/costs.yaml`."""
    stages: StageSamples = defaultdict(list)
    links: dict[str, list[float]] = defaultdict(list)
    loads = []
    for index in range(drives):
        with TemporaryDirectory() as folder:
            changes = ["time=real", "network.injection=none", f"seed={index + 1}"]
            out = Path(folder) / "run"
            result = run_once(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), changes)), out)
            latencies = (f"{name[:-3]} {result[name]['p50']:.2f} ms" for name in ("tau_v_ms", "tau_c_ms", "loop_ms"))
            print(f"drive {index + 1}: {result['ending']}, {', '.join(latencies)}")
            server, client = read_record(out / "server.mcap"), read_record(out / "client.mcap")
            add_stages(server, stages)
            add_stages(client, stages)
            add_links(server, client, links)
            loads.append(os.getloadavg()[0])
    stage_us: dict[str, dict[str, float]] = defaultdict(dict)
    for (node, stage), samples in sorted(stages.items()):
        stage_us[node][stage] = round(median(samples), 1)
    link_us = {name: round(float(np.median(samples)), 1) for name, samples in sorted(links.items())}
    # A command's send time is read before the driver's stage `command`, so the measured delay contains this stage.
    link_us["control"] = round(link_us["control"] - stage_us["driver"]["command"], 1)
    machine = f"{os.cpu_count()} cores, {platform.machine()}, load {max(loads):.1f}, {drives} drives"
    return {
        "measured_on": machine,
        "stages_us": {node: dict(durations_us) for node, durations_us in stage_us.items()},
        "links_us": link_us,
    }


def main() -> None:
    """Measure the costs and write the file."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drives", type=int, default=3)
    parser.add_argument("--out", type=Path, default=shipped("configs/costs.yaml"))
    arguments = parser.parse_args()
    costs = measure_costs(arguments.drives)
    head = "# Medians in microseconds, written by benchmarks/measure_costs.py; virtual time runs on them.\n"
    arguments.out.write_text(head + yaml.safe_dump(costs, sort_keys=False))
    print(arguments.out.read_text())


if __name__ == "__main__":
    main()
