"""Controllers that know the delay of their loop: one lane keeper, and a table of what each of them does about it.

`docs/compensation.md` has the theory, and how each setting in the tables was found.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

from lavt.control.loop_history import LoopHistory
from lavt.control.prediction import MAX_GAP_NS, MAX_LOOP_NS, CarModel, Motion, predict_path
from lavt.control.preset import Preset
from lavt.control.pure_pursuit import (
    PlanarPose,
    RememberedLane,
    clamp,
    lookahead_m,
    pursuit_curvature_per_m,
    pursuit_path_per_m,
    steering_rad,
)
from lavt.control.speed_control import SpeedKeeper
from lavt.domain import NS_PER_S, PATH_POINTS, PATH_STEP_M, Decision, Lane

MODEL_MEMORY_S: Final = MAX_GAP_NS / NS_PER_S
"""A model that uses no reports begins this long before the picture, with the wheels at the angle commanded then."""
DELAY_WEIGHT: Final = 0.05
"""Weight of the newest total delay in the moving average by which lookahead and speed are scheduled: 0.7 s at 30 Hz."""

Schedule = tuple[tuple[float, float], ...]
"""Total delays (s), each with a value; linear in between, and constant outside."""

LOOKAHEADS_S: Final[Schedule] = (
    (0.081, 1.01),
    (0.156, 1.28),
    (0.231, 1.55),
    (0.306, 1.82),
    (0.406, 2.17),
    (0.531, 2.61),
)
"""The lookahead (s) by total delay: the smallest one with 30 degrees of phase margin. At 30 km/h the
longest lookahead is 2.4 s."""
SPEEDS_MPS: Final[Schedule] = (
    (0.081, 8.33),
    (0.156, 6.75),
    (0.231, 5.64),
    (0.306, 4.83),
    (0.406, 4.04),
    (0.531, 3.34),
    (0.681, 2.77),
    (0.881, 2.25),
    (1.081, 1.89),
)
"""The speed by total delay: the highest one with 30 degrees of phase margin, with the lookahead distance of 30 km/h."""


@dataclass(frozen=True, slots=True)
class Variant:
    """What a controller does about the delay of its loop."""

    lookahead_s: float
    """The lookahead in seconds, if no config changes it."""
    predicts: bool = True
    """Whether it moves the seen lane to the pose at which its command will act."""
    uses_reports: bool = True
    """Whether the prediction uses the reported wheel angles and speeds; otherwise only the commands sent."""
    measures_delay: bool = True
    """Whether the delay is measured; otherwise it is `CompensationSettings.constant_delay_s`."""
    lookaheads_s: Schedule = ()
    """The lookahead by total delay; empty: constant."""
    speeds_mps: Schedule = ()
    """The highest speed by total delay, with a constant lookahead distance; empty: the preset's speed."""


VARIANTS: Final[dict[str, Variant]] = {
    "predictive": Variant(0.63),
    "smith": Variant(1.18, uses_reports=False),
    "constant_delay": Variant(0.63, measures_delay=False),
    "scheduled_lookahead": Variant(1.01, predicts=False, lookaheads_s=LOOKAHEADS_S),
    "slow_down": Variant(1.01, predicts=False, speeds_mps=SPEEDS_MPS),
}
"""The controllers by kind. `benchmarks/tune_compensation.py` finds their settings, by one rule and without a drive."""


@dataclass(frozen=True, slots=True)
class CompensationSettings:
    """What the controllers know of car and camera; the defaults are the built-in ones."""

    steering_lag_s: float = 0.12
    """Time constant with which the wheels follow a command."""
    steering_dead_time_s: float = 0.0
    """Time until the wheels begin to follow a command."""
    steering_rate_radps: float = 0.534
    """The largest rate of the wheels' angle."""
    camera_delay_s: float = 0.008
    """Time from the exposure of a picture to its stamp."""
    average_lag_s: float = 0.022
    """By how much the detector's moving average makes the lane older: two thirds of the time between pictures."""
    delay_error_s: float = 0.0
    """Added to the delay, to show what a wrong estimate costs."""
    constant_delay_s: float = 0.39
    """The total delay, from the exposure, that a controller assumes which does not measure it."""


def average_lag_s(rate_hz: float) -> float:
    """Return the age that the detector's moving average adds to a lane at a frame rate, to 1 ms.

    To first order, an average with the weight w = 0.6 for the newest lane is the lane (1 - w) / w frame periods before.
    """
    return round(2 / 3 / rate_hz, 3)


class CompensatingController:
    """A lane keeper that knows the delay of its loop, and does what its variant says.

    `history` gets the vehicle's states and the commands sent. Until the delay is known, and while pictures from before
    a step of the vehicle's clock arrive, it drives as the lane keeper does, and looks as far ahead as the last known
    delay takes. Without a lane it follows the last lane and uses no pedal.
    """

    def __init__(
        self, variant: Variant, preset: Preset, *, wheelbase_m: float, settings: CompensationSettings | None = None
    ) -> None:
        self.history = LoopHistory()
        self._variant = variant
        self._preset = preset
        self._settings = settings or CompensationSettings()
        self._car = CarModel(
            wheelbase_m=wheelbase_m,
            steering_rate_radps=self._settings.steering_rate_radps,
            steering_lag_s=self._settings.steering_lag_s,
        )
        self._speed_keeper = SpeedKeeper(preset.speed_mps, preset.lane_confidence)
        self._remembered = RememberedLane(preset.lane_confidence)
        self._curvature_per_m = 0.0
        self._stamp_ns: int | None = None
        self._lane_ns: int | None = None
        """When the car was where the remembered lane shows it, on the vehicle's wall clock."""
        self._delay_ns: int | None = None
        """The vehicle's wall clock when a command takes effect minus this machine's clock at its sending."""
        self._total_delay_s: float | None = None
        self._decided_ns: int | None = None

    def note_stamp(self, stamp_ns: int) -> None:
        """Note the stamp of the picture whose lane the next call of `decide` gets."""
        self._stamp_ns = stamp_ns

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return steering along the lane, from where the car will be, and the pedals that keep the speed."""
        step_s = 0.0 if self._decided_ns is None else (now_ns - self._decided_ns) / NS_PER_S
        self._decided_ns = now_ns
        if self._remembered.update(lane, speed_mps * step_s, self._curvature_per_m) and self._stamp_ns is not None:
            exposed_ns = self._stamp_ns - round(self._settings.camera_delay_s * NS_PER_S)
            self._lane_ns = exposed_ns - round(self._settings.average_lag_s * NS_PER_S)
            if self.history.is_comparable(self._stamp_ns, now_ns):
                self._measure_delay(exposed_ns, now_ns)
            else:  # the vehicle's clock was set since the picture
                self._delay_ns = None
        followed = self._remembered.lane
        predicted = self._predict_pose(speed_mps, now_ns) if self._variant.predicts else None
        pose = predicted or self._remembered.pose
        limit_per_m = self._preset.curvature_limit_per_m(speed_mps, self._car.wheelbase_m)
        distance_m = self._lookahead_m(speed_mps, is_predicted=predicted is not None)
        self._curvature_per_m = clamp(pursuit_curvature_per_m(followed, distance_m, pose), limit_per_m)
        if self._variant.speeds_mps and self._total_delay_s is not None:
            highest_mps = interpolate(self._variant.speeds_mps, self._total_delay_s)
            self._speed_keeper.full_speed_mps = min(self._preset.speed_mps, highest_mps)
        throttle, brake = self._speed_keeper.pedals(lane.confidence, speed_mps, step_s)
        return Decision(
            steering_rad=steering_rad(self._curvature_per_m, self._car.wheelbase_m),
            throttle=throttle,
            brake=brake,
            path_curvature_per_m=path_from(followed, distance_m, limit_per_m, pose, self._curvature_per_m),
        )

    def _measure_delay(self, exposed_ns: int, now_ns: int) -> None:
        """Update the delays by a picture that was exposed at `exposed_ns`; what is unknown with this clock remains.

        A total delay that no loop has is left out of the average: the picture is the first one after a step of the
        clock.
        """
        settings = self._settings
        if not self._variant.measures_delay:
            self._delay_ns = exposed_ns + round(settings.constant_delay_s * NS_PER_S) - now_ns
        else:
            measured_ns = self.history.delay.last_ns(now_ns)
            self._delay_ns = None if measured_ns is None else measured_ns + round(settings.delay_error_s * NS_PER_S)
        if self._delay_ns is None:
            return
        total_ns = now_ns + self._delay_ns - exposed_ns
        if not -MAX_LOOP_NS <= total_ns <= MAX_LOOP_NS:
            return
        total_s = total_ns / NS_PER_S
        before_s = self._total_delay_s
        self._total_delay_s = total_s if before_s is None else before_s + DELAY_WEIGHT * (total_s - before_s)

    def _predict_pose(self, speed_mps: float, now_ns: int) -> PlanarPose | None:
        """Return the pose at which a command that is sent now acts, in the frame of the remembered lane.

        None: it is not known when that is, or the reports do not suffice.
        """
        if self._delay_ns is None or self._lane_ns is None:
            return None
        since_ns = self._lane_ns
        delay_ns = self._delay_ns + round(self._settings.steering_dead_time_s * NS_PER_S)
        if self._variant.uses_reports:
            motions = self.history.motions(since_ns)
            commands = self.history.commands(delay_ns, min(since_ns, motions[-1].at_ns)) if motions else []
        else:
            begin_ns = since_ns - MAX_GAP_NS
            commands = self.history.commands(delay_ns, begin_ns)
            motions = [Motion(begin_ns, speed_mps, commands[0].steering_rad)] if commands else []
        predicted = predict_path(self._car, motions, commands, since_ns, now_ns + delay_ns)
        return None if predicted is None else predicted.path[-1]

    def _lookahead_m(self, speed_mps: float, *, is_predicted: bool) -> float:
        """Return the lookahead distance at this speed and delay."""
        variant, lookahead_s = self._variant, self._preset.lookahead_s
        if variant.speeds_mps:  # at any speed, that of the highest one
            return lookahead_m(lookahead_s, max(speed_mps, self._preset.speed_mps))
        if self._total_delay_s is None or is_predicted:
            return lookahead_m(lookahead_s, speed_mps)
        if variant.lookaheads_s:
            return lookahead_m(interpolate(variant.lookaheads_s, self._total_delay_s), speed_mps)
        # The lookahead of a variant that predicts is too short without a prediction.
        return lookahead_m(max(lookahead_s, interpolate(LOOKAHEADS_S, self._total_delay_s)), speed_mps)


def path_from(
    lane: Lane, distance_m: float, limit_per_m: float, pose: PlanarPose, steering_per_m: float
) -> tuple[float, ...]:
    """Return the curvatures of the path that pure pursuit drives from `pose`, counted from the origin.

    Up to the pose, the car is already on its way; there the curvature is `steering_per_m`.
    """
    points_before = min(max(round(pose[0] / PATH_STEP_M), 0), PATH_POINTS)
    path_per_m = pursuit_path_per_m(lane, distance_m, limit_per_m, pose)
    return (*(steering_per_m,) * points_before, *path_per_m)[:PATH_POINTS]


def interpolate(schedule: Schedule, at: float) -> float:
    """Return the value of a schedule."""
    for (before, value_before), (after, value_after) in pairwise(schedule):
        if at < after:
            share = max(0.0, (at - before) / (after - before))
            return value_before + share * (value_after - value_before)
    return schedule[-1][1]
