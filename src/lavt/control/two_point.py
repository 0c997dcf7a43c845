"""A model of a human driver: the two-point visual control model of steering, with a reaction delay and a muscle lag.

The model (D. D. Salvucci and R. Gray, A Two-Point Visual Control Model of Steering, Perception 33, 2004, pp. 1233-1248)
turns the steering wheel by what it sees of two points of the lane's centre, a near one and a far one:

    d wheel/dt = far_gain d far/dt + near_gain d near/dt + near_integral_gain min(near, near_angle_limit)

`far` and `near` are the visual angles of the points, measured from the direction of the car. The law is applied once
for each picture, in the form of differences. A change of the wheel that a picture causes begins `reaction_delay_s`
after this picture was seen. The arms follow it with a first-order lag:

    d hands/dt = (wheel(t - reaction_delay) - hands) / neuromuscular_lag
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

from lavt.control.preset import Preset
from lavt.control.pure_pursuit import (
    RememberedLane,
    clamp,
    curvature_per_m,
    lookahead_m,
    pursuit_path_per_m,
    steering_rad,
)
from lavt.control.speed_control import SpeedKeeper
from lavt.domain import NS_PER_S, Decision, Lane
from lavt.streams import IndexedStream

TWO_POINT = "two_point"
"""The kind of controller that is this model."""
STATIONARY_MPS = 0.5
"""Below this speed the model does not steer, and forgets what it saw."""
MAX_STEP_S = 0.1
"""The longest time between two pictures over which the near angle is integrated."""


@dataclass(frozen=True, slots=True)
class TwoPointSettings:
    """The settings of the model; `docs/controllers.md` cites the sources of the values."""

    far_gain: float = 6.4
    """Angle of the steering wheel for each angle of change of the far point: 16 x 0.40."""
    near_gain: float = 1.6
    """The same for the near point: 4 x 0.40."""
    near_integral_gain_per_s: float = 1.2
    """Rate of the steering wheel for each angle of the near point: 3 x 0.40."""
    near_angle_limit_rad: float = 0.07
    """Largest near angle that is integrated."""
    near_point_m: float = 8.0
    """Distance of the near point, ahead of the rear axle as all distances of a lane."""
    far_point_s: float = 4.0
    """Distance of the far point, in seconds of driving, if the lane is seen as far as this."""
    far_point_min_m: float = 20.0
    """Smallest distance of the far point, if the lane is seen as far as this."""
    eye_ahead_m: float = 1.6
    """Position of the eye, ahead of the rear axle: that of the simulator's camera."""
    steering_ratio: float = 16.0
    """Angle of the steering wheel for each angle of the road wheels, of the simulator's default car."""
    reaction_delay_s: float = 0.12
    """Time from seeing a picture to the beginning of the movement that it causes."""
    neuromuscular_lag_s: float = 0.11
    """Time constant of the arms."""
    noise_rad: float = 0.0
    """Standard deviation of the noise of each seen angle, independent between pictures."""


class TwoPointDriver:
    """A human driver's model that steers by two points of the lane, and keeps the speed as the lane keeper does.

    Without a lane it keeps the wheel where it last wanted it, and uses no pedal; the driver node then brakes and stops.
    The path for a vehicle without commands is the lane keeper's. Angles of the wheel are held as angles of the road
    wheels. Without `note_stamp`, the times between pictures are those between the calls of `decide`. The noise of the
    seen angles depends on `seed` only.
    """

    def __init__(
        self, preset: Preset, *, wheelbase_m: float, settings: TwoPointSettings | None = None, seed: int = 1
    ) -> None:
        self._preset = preset
        self._wheelbase_m = wheelbase_m
        self._settings = settings or TwoPointSettings()
        self._speed_keeper = SpeedKeeper(preset.speed_mps, preset.lane_confidence)
        self._remembered = RememberedLane(preset.lane_confidence)
        self._steering = SteeringLaw(self._settings, IndexedStream(seed, "two-point noise"))
        self._arms = Arms(self._settings)
        self._stamp_ns: int | None = None
        self._decided_ns: int | None = None

    def note_stamp(self, stamp_ns: int) -> None:
        """Note the stamp of the picture whose lane the next call of `decide` gets."""
        self._stamp_ns = stamp_ns

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return the wheel angle that the arms have reached at `now_ns`, and the pedals that keep the speed."""
        step_s = 0.0 if self._decided_ns is None else (now_ns - self._decided_ns) / NS_PER_S
        self._decided_ns = now_ns
        limit_per_m = self._preset.curvature_limit_per_m(speed_mps, self._wheelbase_m)
        limit_rad = steering_rad(limit_per_m, self._wheelbase_m)
        driven_per_m = curvature_per_m(self._arms.angle_rad, self._wheelbase_m)
        is_confident = self._remembered.update(lane, speed_mps * step_s, driven_per_m)
        if speed_mps < STATIONARY_MPS:
            self._steering, self._arms = self._steering.restarted(), Arms(self._settings)
        elif is_confident:
            stamp_ns = now_ns if self._stamp_ns is None else self._stamp_ns
            self._arms.intend(self._steering.see(lane, speed_mps, stamp_ns, limit_rad), now_ns)
        self._arms.advance(now_ns)
        throttle, brake = self._speed_keeper.pedals(lane.confidence, speed_mps, step_s)
        distance_m = lookahead_m(self._preset.lookahead_s, speed_mps)
        path_per_m = pursuit_path_per_m(self._remembered.lane, distance_m, limit_per_m, self._remembered.pose)
        return Decision(clamp(self._arms.angle_rad, limit_rad), throttle, brake, path_per_m)


class SteeringLaw:
    """The steering law: the wheel angle that the driver wants, from the lanes of successive pictures."""

    def __init__(self, settings: TwoPointSettings, noise: IndexedStream, pictures: int = 0) -> None:
        self._settings = settings
        self._noise = noise
        self._pictures = pictures
        self._wheel_rad = 0.0
        self._near_rad = self._far_rad = 0.0
        self._stamp_ns: int | None = None

    def restarted(self) -> SteeringLaw:
        """Return the law at rest: the wheel is straight, and no angle has been seen. The noise goes on."""
        return SteeringLaw(self._settings, self._noise, self._pictures)

    def see(self, lane: Lane, speed_mps: float, stamp_ns: int, limit_rad: float) -> float:
        """Return the wanted road wheel angle, within +-`limit_rad`, after seeing the lane of a picture.

        The first angles count as changes from straight ahead. So the driver starts with the wheel turned for a curve.
        """
        settings = self._settings
        near_rad, far_rad = self._angles_rad(lane, speed_mps)
        since_last_s = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) / NS_PER_S
        step_s = min(max(since_last_s, 0.0), MAX_STEP_S)
        turned_rad = (
            settings.far_gain * (far_rad - self._far_rad)
            + settings.near_gain * (near_rad - self._near_rad)
            + settings.near_integral_gain_per_s * clamp(near_rad, settings.near_angle_limit_rad) * step_s
        )
        self._near_rad, self._far_rad, self._stamp_ns = near_rad, far_rad, stamp_ns
        self._wheel_rad = clamp(self._wheel_rad + turned_rad / settings.steering_ratio, limit_rad)
        return self._wheel_rad

    def _angles_rad(self, lane: Lane, speed_mps: float) -> tuple[float, float]:
        """Return the visual angles of the near and the far point, left positive, with the noise."""
        settings = self._settings
        near_m = min(settings.near_point_m, lane.far_m)
        far_m = min(max(settings.far_point_s * speed_mps, settings.far_point_min_m), lane.far_m)
        near_rad, far_rad = self._angle_rad(lane, near_m), self._angle_rad(lane, far_m)
        if settings.noise_rad > 0:
            near_noise, far_noise = self._noise.at(self._pictures).normal(0.0, settings.noise_rad, 2)
            near_rad, far_rad = near_rad + float(near_noise), far_rad + float(far_noise)
        self._pictures += 1
        return near_rad, far_rad

    def _angle_rad(self, lane: Lane, ahead_m: float) -> float:
        c0, c1, c2 = lane.centre
        return math.atan2(c0 + (c1 + c2 * ahead_m) * ahead_m, ahead_m - self._settings.eye_ahead_m)


class Arms:
    """The reaction delay and the neuromuscular lag: the wheel angle, which follows the angle that was wanted earlier.

    Both are exact at every time at which `advance` is called: between two changes of the delayed wanted angle, the
    wheel angle is an exponential.
    """

    def __init__(self, settings: TwoPointSettings) -> None:
        self.angle_rad = 0.0
        self._delay_ns = round(settings.reaction_delay_s * NS_PER_S)
        self._lag_ns = settings.neuromuscular_lag_s * NS_PER_S
        self._wanted: deque[tuple[int, float]] = deque()
        """The wanted angles that are not yet in effect, each with the time at which it takes effect."""
        self._target_rad = 0.0
        self._advanced_ns = 0

    def intend(self, wanted_rad: float, now_ns: int) -> None:
        """Want a wheel angle from `now_ns` on; the arms begin to move after the reaction delay."""
        self._wanted.append((now_ns + self._delay_ns, wanted_rad))

    def advance(self, now_ns: int) -> None:
        """Move the wheel up to `now_ns`."""
        while self._wanted and self._wanted[0][0] <= now_ns:
            effective_ns, wanted_rad = self._wanted.popleft()
            self._approach(effective_ns)
            self._target_rad = wanted_rad
        self._approach(now_ns)

    def _approach(self, until_ns: int) -> None:
        elapsed_ns, self._advanced_ns = until_ns - self._advanced_ns, until_ns
        share_left = math.exp(-elapsed_ns / self._lag_ns) if self._lag_ns > 0 else 0.0
        self.angle_rad = self._target_rad + (self.angle_rad - self._target_rad) * share_left
