"""Whether the swing of a car on a straight road grows or dies away, measured on a drive without limits."""

from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np

from lavt.assembly.entropy import run_seed
from lavt.config import RunConfig
from lavt.domain import FloatArray
from lavt.experiment.runs.monitored_run import MonitoredRun, drive_monitored
from lavt.experiment.runs.plan import PlannedRun, plan_run
from lavt.vehicle.sim.simulator import start_of

ROAD = "straight"
LONGEST_S = 45.0
"""Of a drive, from before the arming on."""
CALM_START = (0.02, math.radians(0.2))
"""At most so far aside and turned a car begins: a swing that is small has room to grow."""

SETTLED_SHARE = 0.01
"""The speed has settled when it stays this near to the one the drive ends with."""
SMALL_SWING_M = 0.2
"""So far from the centre tyres, wheel and commands are far from every limit, and the loop is linear."""
HALF_SWINGS_AT_LEAST = 4


def half_swings(time_s: FloatArray, cross_track_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Give time and size of the largest distance from the centre in each whole half swing.

    A half swing reaches from one crossing of the centre to the next.
    """
    crossings = np.flatnonzero(np.diff(np.signbit(cross_track_m))) + 1
    size_m = np.abs(cross_track_m)
    largest = [begin + int(np.argmax(size_m[begin:end])) for begin, end in itertools.pairwise(crossings)]
    return time_s[largest], size_m[largest]


def growth_per_s(drive: MonitoredRun) -> float:
    """Give the rate in 1/s at which the swing grows, negative where it dies away: d/dt of the logarithm of its size.

    It is the slope of the straight line of least squares through the logarithms of the largest distances from the
    centre in each half swing, from when the speed has settled until the swing is over `SMALL_SWING_M` or the vehicle's
    safety changes a command. With fewer than four half swings in there it is infinite: positive where the swing was
    over before, negative where it died away without swinging, or where nobody drove.
    """
    if len(drive.time_s) == 0:
        return -math.inf
    unsettled = np.flatnonzero(np.abs(drive.speed_mps / drive.speed_mps[-1] - 1) > SETTLED_SHARE)
    begin = int(unsettled[-1]) + 1 if len(unsettled) else 0
    begin_s = float(drive.time_s[min(begin, len(drive.time_s) - 1)])
    limited_s = drive.limited_s[drive.limited_s >= begin_s]
    large_s = drive.time_s[(drive.time_s >= begin_s) & (np.abs(drive.cross_track_m) > SMALL_SWING_M)]
    end_s = min((float(times[0]) for times in (limited_s, large_s) if len(times)), default=math.inf)
    within = (drive.time_s >= begin_s) & (drive.time_s < end_s)
    time_s, size_m = half_swings(drive.time_s[within], drive.cross_track_m[within])
    if len(time_s) < HALF_SWINGS_AT_LEAST:
        return -math.inf if end_s == math.inf else math.inf
    return float(np.polyfit(time_s, np.log(size_m), 1)[0])


def straight_run(config: RunConfig) -> PlannedRun:
    """Plan the drive of `config` on a straight road instead of its route, with a calm start.

    Its seed is the first of a series that belongs to the run's own, for which the start lies within `CALM_START`.
    """
    vehicle = config.vehicle.model_copy(update={"route": ROAD})
    planned = plan_run(config.model_copy(update={"vehicle": vehicle}), name=ROAD)
    own = run_seed(config.seed, config.vehicle.route, config.repetition)
    return replace(planned, seed=calm_seed(own))


def calm_seed(seed: int) -> int:
    """Give the first seed of a series, which belongs to `seed`, that has a calm start."""
    most_m, most_rad = CALM_START
    seeds = (run_seed(seed, ROAD, number) for number in itertools.count())
    return next(
        each
        for each in seeds
        for _, aside_m, turned_rad in [start_of(each)]
        if abs(aside_m) <= most_m and abs(turned_rad) <= most_rad
    )


def straight_growth(config: RunConfig) -> tuple[float, float]:
    """Drive `config` straight on, and give the total delay in ms and the growth of the swing in 1/s."""
    drive = drive_monitored(straight_run(config), limit_s=LONGEST_S)
    return drive.total_delay_ms, growth_per_s(drive)
