"""Measure how long the loop's stages and links take, and write `configs/costs.yaml` for virtual time.

The program makes drives in real time over the loopback, without injection, and takes medians and quantiles from their
records. A timeline in a record has the times at which a message arrived at a node and at which each stage ended. A wait
is the time between the arrival of a message and the beginning of the first stage. The delay of a link is the time
between the end of the sender's pipeline and the arrival at the receiver. All times are of one clock, because all
processes run on one machine. Only messages of the driving interval count, not those of the start.

Then it prints, for each stage and link, the rank correlation of consecutive values. Virtual time draws independently,
as if it were 0. `docs/virtual_time.md` describes the model.

    python benchmarks/measure_costs.py [--drives 5] [--out configs/costs.yaml] [--medians-only] [--allow-busy]
"""

from __future__ import annotations

import argparse
import os
import platform
import sys
from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NamedTuple

import numpy as np
import yaml
from scipy.stats import spearmanr

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.quiet import require_quiet

from lavt.clock import MachineClock
from lavt.config import RunConfig
from lavt.config_file import load_config, shipped
from lavt.errors import LavtError, WorkError
from lavt.experiment.analysis.metrics import driving_interval
from lavt.experiment.runs.plan import plan_run
from lavt.experiment.runs.run import run_once
from lavt.recording.record import Record, read_record

NS_PER_US = 1000.0
LEVELS = (0.0, 0.01, 0.05, 0.1, 0.25, 0.5, 0.75, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 1.0)
Samples = dict[str, list[float]]
"""Durations in microseconds, in order of time, by link or by "node.stage"."""


class TimelineRow(NamedTuple):
    """A timeline of a record; `ends` are pairs of stage and time, of which the first is the beginning of the first."""

    node: str
    channel: str
    stamp_ns: int
    arrived_ns: int
    ends: list[tuple[str, int]]


def timelines(record: Record, interval: tuple[int, int]) -> list[TimelineRow]:
    """Return the timelines of a record whose message arrived in the interval."""
    table = record.table("timeline")
    columns = (
        table.texts("node"),
        table.texts("channel"),
        table.ints("stamp_ns").tolist(),
        table.ints("arrived_mono_ns").tolist(),
        table.objects("stages"),
    )
    rows = (TimelineRow(*row) for row in zip(*columns, strict=True))
    return [row for row in rows if interval[0] <= row.arrived_ns <= interval[1]]


def add_stages(rows: Sequence[TimelineRow], stages: Samples) -> None:
    """Add the duration of every stage, and the wait of every message."""
    for row in rows:
        _, first_begin_ns = row.ends[0]
        if row.channel != "wake":
            stages[f"{row.node}.wait_{row.channel}"].append((first_begin_ns - row.arrived_ns) / NS_PER_US)
        for (_, begin_ns), (name, end_ns) in pairwise(row.ends):
            stages[f"{row.node}.{name}"].append((end_ns - begin_ns) / NS_PER_US)


def add_link(senders: Sequence[TimelineRow], receivers: Sequence[TimelineRow], delays_us: list[float]) -> None:
    """Add the delay of each first message with a stamp: from the sender's last stage to the arrival at the receiver."""
    sent_ns: dict[int, int] = {}
    for row in senders:
        sent_ns.setdefault(row.stamp_ns, row.ends[-1][1])
    delays_us.extend(
        (row.arrived_ns - sent_ns.pop(row.stamp_ns)) / NS_PER_US for row in receivers if row.stamp_ns in sent_ns
    )


def add_drive(server: Record, client: Record, stages: Samples, links: Samples) -> None:
    """Add everything that the two records of a drive show. States contain their send times."""
    began_ns, ended_ns, _ = driving_interval(server)
    rows = [*timelines(server, (began_ns, ended_ns)), *timelines(client, (began_ns, ended_ns))]
    add_stages(rows, stages)

    def of(node: str, channel: str) -> list[TimelineRow]:
        return [row for row in rows if (row.node, row.channel) == (node, channel)]

    add_link(of("camera", "wake"), of("driver", "access_unit"), links["video"])
    add_link(of("driver", "view"), of("actuator", "control"), links["control"])
    state = client.table("state")
    state = state.where((state.mono_ns >= began_ns) & (state.mono_ns <= ended_ns))
    links["state"] += ((state.wall_ns - state.ints("sent_wall_ns")) / NS_PER_US).tolist()


def quantiles_us(samples_us: Sequence[float]) -> list[float]:
    """Return the quantiles at `LEVELS`. A delay by the wall clock that is slightly negative counts as 0."""
    return [round(max(0.0, float(value)), 1) for value in np.quantile(samples_us, LEVELS)]


def costs(
    stages: Mapping[str, Sequence[float]], links: Mapping[str, Sequence[float]], measured_on: str
) -> dict[str, Any]:
    """Return the content of `configs/costs.yaml`."""
    stage_us: dict[str, dict[str, float]] = defaultdict(dict)
    stage_quantiles_us: dict[str, dict[str, list[float]]] = defaultdict(dict)
    for name, samples in sorted(stages.items()):
        node, _, stage = name.partition(".")
        stage_us[node][stage] = round(float(np.median(samples)), 1)
        stage_quantiles_us[node][stage] = quantiles_us(samples)
    return {
        "measured_on": measured_on,
        "stages_us": dict(stage_us),
        "links_us": {name: round(float(np.median(samples)), 1) for name, samples in sorted(links.items())},
        "levels": list(LEVELS),
        "stage_quantiles_us": dict(stage_quantiles_us),
        "link_quantiles_us": {name: quantiles_us(samples) for name, samples in sorted(links.items())},
    }


def correlation(samples: Sequence[float]) -> float:
    """Return the rank correlation of consecutive values; NaN for fewer than 10 values and for equal ones."""
    if len(samples) < 10 or len(set(samples)) == 1:
        return float("nan")
    return float(spearmanr(samples[:-1], samples[1:]).statistic)


def print_correlations(samples_by_name: Mapping[str, Sequence[float]]) -> None:
    """Print the number of values, the median, the 95th percentile and the correlation of each stage and link."""
    print(f"{'stage or link':32}{'n':>7}{'p50, us':>10}{'p95, us':>10}{'correlation':>13}")
    for name, samples in samples_by_name.items():
        p50, p95 = np.percentile(samples, [50, 95])
        print(f"{name:32}{len(samples):7}{p50:10.1f}{p95:10.1f}{correlation(samples):13.2f}")


def measure(drives: int, *, allow_busy: bool, changes: Sequence[str] = ()) -> dict[str, Any]:
    """Make `drives` drives, print what they show, and return the content of `configs/costs.yaml`."""
    stages: Samples = defaultdict(list)
    links: Samples = defaultdict(list)
    busy, jitter_ms = [], []
    for index in range(drives):
        busy.append(require_quiet(allow_busy=allow_busy))
        with TemporaryDirectory() as folder:
            all_changes = ["time=real", "network.injection=none", f"seed={index + 1}", *changes]
            out = Path(folder) / "run"
            result = run_once(plan_run(load_config(RunConfig, shipped("configs/demo.yaml"), all_changes)), out)
            is_used = result["valid"] or allow_busy
            if is_used:
                add_drive(read_record(out / "server.mcap"), read_record(out / "client.mcap"), stages, links)
        latencies = (
            f"{name[:-3]} {result[name]['p50']:.2f} ms (p95 {result[name]['p95']:.2f})"
            for name in ("tau_v_ms", "tau_c_ms", "loop_ms")
            if result[name]["n"]
        )
        reasons = ", ".join(reason["code"] for reason in result["invalid_reasons"]) or "valid"
        used = "" if is_used else ", not used"
        print(f"drive {index + 1}: {result['ending']}, {reasons}{used}, {', '.join(latencies)}", flush=True)
        if is_used and result["loop_jitter_ms"] is not None:
            jitter_ms.append(result["loop_jitter_ms"])
    if not jitter_ms:
        raise WorkError("no drive was valid: wait until the machine is quiet, or give --allow-busy")
    print_correlations({**dict(sorted(stages.items())), **links})
    day = np.datetime64(MachineClock().now().wall_ns, "ns").astype("datetime64[D]")
    measured_on = (
        f"{os.cpu_count()} cores, {platform.machine()}, {day}, {len(jitter_ms)} drives, "
        f"busy before a drive {max(busy):.0%}, load {os.getloadavg()[0]:.1f}, loop jitter up to {max(jitter_ms):.1f} ms"
    )
    return costs(stages, links, measured_on)


def main() -> None:
    """Measure the costs and write the file."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--drives", type=int, default=5)
    parser.add_argument("--out", type=Path, default=shipped("configs/costs.yaml"))
    parser.add_argument("--medians-only", action="store_true", help="write no quantiles, so that costs are constant")
    parser.add_argument("--allow-busy", action="store_true", help="measure on a busy machine, too")
    parser.add_argument(
        "--set", action="append", default=[], dest="changes", help="a change of the config, as KEY=VALUE"
    )
    arguments = parser.parse_args()
    measured = measure(arguments.drives, allow_busy=arguments.allow_busy, changes=arguments.changes)
    if arguments.medians_only:
        measured = {key: measured[key] for key in ("measured_on", "stages_us", "links_us")}
    head = (
        "# Times in microseconds, written by benchmarks/measure_costs.py; docs/virtual_time.md describes their use.\n"
    )
    arguments.out.write_text(head + yaml.safe_dump(measured, sort_keys=False, default_flow_style=None, width=150))
    print(f"wrote {arguments.out}: {measured['measured_on']}")


if __name__ == "__main__":
    try:
        main()
    except LavtError as error:
        raise SystemExit(str(error)) from error
