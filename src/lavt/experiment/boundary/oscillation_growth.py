"""The measured oscillation growth of a loop: whether a car's oscillation on a straight road grows or decays."""

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
from lavt.vehicle.sim.simulator import start_offset

ROAD = "straight"
DRIVE_LIMIT_S = 45.0
"""The longest drive, including the time before arming."""
NEAR_CENTRE_START = (0.02, math.radians(0.2))
"""The largest initial distance from the lane's centre (m) and heading error (rad). They are small, so that the
oscillation has room to grow."""

SETTLED_SHARE = 0.01
"""The speed has settled when it differs from the final speed by at most this share until the end of the drive."""
LINEAR_RANGE_M = 0.2
"""If the car is at most this far from the centre, tyres, steering angle and commands are far from every limit, so the
loop is linear."""
FEWEST_HALF_PERIODS = 4


def half_period_peaks(time_s: FloatArray, cross_track_m: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return times in s and values in m of the largest distance from the centre in each complete half period.

    A half period is the time between two successive crossings of the centre.
    """
    crossings = np.flatnonzero(np.diff(np.signbit(cross_track_m))) + 1
    distance_m = np.abs(cross_track_m)
    peaks = [start + int(np.argmax(distance_m[start:end])) for start, end in itertools.pairwise(crossings)]
    return time_s[peaks], distance_m[peaks]


def growth_per_s(drive: MonitoredRun) -> float:
    """Return the oscillation growth in 1/s: the slope of the logarithm of the amplitude, negative for a decay.

    The slope belongs to the least-squares line through the logarithms of the peaks of all half periods. The evaluation
    begins when the speed has settled. It ends early if the distance from the centre exceeds `LINEAR_RANGE_M`, or if a
    safety limit changes a command. With fewer than `FEWEST_HALF_PERIODS` the growth is infinite: positive if the
    evaluation ended early, and negative if there was no oscillation or no drive.
    """
    if len(drive.time_s) == 0:
        return -math.inf
    unsettled = np.flatnonzero(np.abs(drive.speed_mps / drive.speed_mps[-1] - 1) > SETTLED_SHARE)
    start = int(unsettled[-1]) + 1 if len(unsettled) else 0
    start_s = float(drive.time_s[min(start, len(drive.time_s) - 1)])
    limited_s = drive.limited_s[drive.limited_s >= start_s]
    large_s = drive.time_s[(drive.time_s >= start_s) & (np.abs(drive.cross_track_m) > LINEAR_RANGE_M)]
    end_s = min((float(times[0]) for times in (limited_s, large_s) if len(times)), default=math.inf)
    evaluated = (drive.time_s >= start_s) & (drive.time_s < end_s)
    time_s, peak_m = half_period_peaks(drive.time_s[evaluated], drive.cross_track_m[evaluated])
    if len(time_s) < FEWEST_HALF_PERIODS:
        return -math.inf if end_s == math.inf else math.inf
    return float(np.polyfit(time_s, np.log(peak_m), 1)[0])


def straight_run(config: RunConfig) -> PlannedRun:
    """Plan the run of `config` on a straight road instead of its route, with a start near the centre.

    A series of seeds is derived from the seed of `config`. The planned run gets the first of these seeds with a start
    near the centre (`NEAR_CENTRE_START`).
    """
    vehicle = config.vehicle.model_copy(update={"route": ROAD})
    planned = plan_run(config.model_copy(update={"vehicle": vehicle}), name=ROAD)
    route_seed = run_seed(config.seed, config.vehicle.route, config.repetition)
    return replace(planned, seed=near_centre_seed(route_seed))


def near_centre_seed(seed: int) -> int:
    """Return the first seed with a start near the centre in the series that is derived from `seed`."""
    limit_m, limit_rad = NEAR_CENTRE_START
    seeds = (run_seed(seed, ROAD, number) for number in itertools.count())
    return next(
        candidate
        for candidate in seeds
        for _, offset_m, heading_rad in [start_offset(candidate)]
        if abs(offset_m) <= limit_m and abs(heading_rad) <= limit_rad
    )


def straight_growth(config: RunConfig) -> tuple[float, float]:
    """Drive `config` on the straight road, and return the total delay in ms and the oscillation growth in 1/s."""
    drive = drive_monitored(straight_run(config), limit_s=DRIVE_LIMIT_S)
    return drive.total_delay_ms, growth_per_s(drive)
