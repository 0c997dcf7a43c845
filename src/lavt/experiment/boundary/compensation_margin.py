"""The stability of the lateral loop with a controller that predicts the pose, from a sampled-data model.

The car, the camera, the moving average of the lane and the total delay are those of
`lavt.experiment.boundary.delay_margin`. The controller is `lavt.control.compensation`, linearised about the centre of a
straight lane: from the averaged lane it predicts by the kinematic single-track model until its command takes effect,
with the true angles of the wheels as far as they are reported, and with its commands and an assumed lag after that.

All times are relative to the middle of the newest frame's exposure. The prediction is linear in the signals of
`OpenedLoop`, so that each of its values is a row over these signals.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from scipy.linalg import expm

from lavt.config import CompensationConfig, RunConfig
from lavt.config_file import conditions
from lavt.control.compensation import MODEL_MEMORY_S, VARIANTS, Variant, interpolate
from lavt.control.pure_pursuit import LOOKAHEAD_RANGE_M
from lavt.domain import FloatArray
from lavt.experiment.boundary.delay_margin import (
    DEFAULT_CAR,
    ComplexArray,
    LateralLoop,
    SampledPlant,
    run_loop,
    sampled_plant,
    smallest_unstable_s,
    spectral_radius,
)

_CAR = 5
"""Number of the car's states; lateral error, heading error and wheel angle are 2, 3 and 4."""
_SHORTEST_LAG_S = 0.005
"""In a prediction, a shorter steering lag counts as this one: back in time, the wheels' angle grows by exp(time / lag),
which would leave no digits."""


@dataclass(frozen=True, slots=True)
class Predictor:
    """What a predicting controller assumes; the defaults are exact knowledge of the default car."""

    steering_lag_s: float = DEFAULT_CAR.steering_lag_s
    steering_dead_time_s: float = 0.0
    wheelbase_m: float = DEFAULT_CAR.wheelbase_m
    uses_reports: bool = True
    """False: the wheels move by the model alone, also where the vehicle has reported them."""
    unreported_s: float = 0.02
    """The end of the total delay for which no report can exist: the control's latency and the age of the state."""
    delay_error_s: float = 0.0
    """By how much the assumed total delay is too long."""
    constant_delay_s: float | None = None
    """The total delay that is assumed whatever the true one is; None: the true one plus `delay_error_s`."""
    lane_error_s: float = 0.0
    """By how much the assumed age of the averaged lane is too large."""

    def assumed_s(self, total_delay_s: float) -> float:
        """Return the total delay that is assumed."""
        return (total_delay_s if self.constant_delay_s is None else self.constant_delay_s) + self.delay_error_s


@dataclass(frozen=True, slots=True)
class OpenedLoop:
    """The loop, opened at the car's input: the sampled car, and the controller's output as a row over the signals.

    The signals are the car's five states, the `past` last commands that the car got, the `past` last ones that the
    controller remembers, and the averages of lateral error and heading error at the last frame.
    """

    sampled: SampledPlant
    smoothing: float
    command: FloatArray
    past: int

    def closed(self) -> FloatArray:
        """Return the state transition matrix of the closed loop, in which both kinds of commands are the same."""
        past, sampled = self.past, self.sampled
        size = _CAR + past + 2
        command = np.concatenate([self.command[: _CAR + past], self.command[-2:]])
        command[_CAR:-2] += self.command[_CAR + past : -2]
        step = np.zeros((size, size))
        step[:_CAR, :_CAR] = sampled.transition
        step[:_CAR, _CAR + sampled.delay_frames] += sampled.previous_input
        if sampled.delay_frames == 0:
            step[:_CAR] += np.outer(sampled.new_input, command)
        else:
            step[:_CAR, _CAR + sampled.delay_frames - 1] += sampled.new_input
        step[_CAR] = command
        step[_CAR + 1 : -2, _CAR:-3] = np.eye(past - 1)
        step[-2:] = (1 - self.smoothing) * np.eye(size)[-2:] + self.smoothing * np.eye(size)[2:4]
        return step

    def response(self, frequencies_radps: FloatArray, frame_rate_hz: float) -> ComplexArray:
        """Return the response from the car's input to minus the controller's output, at each frequency."""
        sampled, past = self.sampled, self.past
        z = np.exp(1j * frequencies_radps / frame_rate_hz)[:, np.newaxis]
        delayed = sampled.new_input * z**-sampled.delay_frames + sampled.previous_input * z ** -(
            sampled.delay_frames + 1
        )
        resolvents = z[..., np.newaxis] * np.eye(_CAR) - sampled.transition
        car = np.linalg.solve(resolvents, delayed[..., np.newaxis])[..., 0]
        commands = z ** -np.arange(1, past + 1)
        averages = self.smoothing * car[:, 2:4] / (z - (1 - self.smoothing))
        of_car, of_received, of_memory, of_average = np.split(self.command, [_CAR, _CAR + past, _CAR + 2 * past])
        output = car @ of_car + commands @ of_received + averages @ of_average
        return np.asarray(-output / (1 - commands @ of_memory), dtype=np.complex128)


def opened_loop(loop: LateralLoop, predictor: Predictor, total_delay_s: float) -> OpenedLoop:
    """Return the loop with this controller, opened at the car's input."""
    lane_age_s = (1 / loop.smoothing - 1) / loop.frame_rate_hz + predictor.lane_error_s
    assumed_s = predictor.assumed_s(total_delay_s) + predictor.steering_dead_time_s
    true_s, period_s = total_delay_s + loop.car.steering_dead_time_s, 1 / loop.frame_rate_hz
    memory_s = lane_age_s + max(assumed_s, true_s) + (0.0 if predictor.uses_reports else MODEL_MEMORY_S)
    past = math.ceil(memory_s / period_s) + 2
    signals = np.eye(_CAR + 2 * past + 2)
    average = loop.smoothing * signals[2:4] + (1 - loop.smoothing) * signals[-2:]
    received = _Commands(signals[_CAR : _CAR + past], true_s, period_s)
    remembered = _Commands(signals[_CAR + past : -2], assumed_s, period_s)
    rows = np.vstack([average, signals[4]])
    predicted = _predict((loop, predictor), rows, received, remembered, -lane_age_s)
    return OpenedLoop(sampled_plant(loop, total_delay_s), loop.smoothing, loop.gain @ predicted, past)


@dataclass(frozen=True, slots=True)
class _Commands:
    """Rows of commands, the newest first; each takes effect `effect_s` after its frame."""

    rows: FloatArray
    effect_s: float
    period_s: float

    def at(self, at_s: float) -> int:
        """Return the index of the command that is in effect just after `at_s`."""
        return max(math.ceil((self.effect_s - at_s) / self.period_s - 1e-9), 1) - 1

    def during(self, begin_s: float, end_s: float) -> Iterator[tuple[float, FloatArray]]:
        """Yield the duration of each command's effect, and its row."""
        while begin_s < end_s - 1e-9:
            index = self.at(begin_s)
            until_s = end_s if index == 0 else min(end_s, self.effect_s - index * self.period_s)
            yield until_s - begin_s, self.rows[index]
            begin_s = until_s


def _predict(
    known: tuple[LateralLoop, Predictor],
    rows: FloatArray,
    received: _Commands,
    remembered: _Commands,
    since_s: float,
) -> FloatArray:
    """Return the rows of the predicted lateral error and heading error.

    `rows` are the averaged errors, of the time `since_s`, and the wheel angle of time 0.
    """
    (loop, predictor), rows = known, rows.copy()
    assumed_lag_s = max(predictor.steering_lag_s, _SHORTEST_LAG_S)
    reported_mps = loop.speed_mps * loop.speed_report_factor
    end_s = remembered.effect_s
    if predictor.uses_reports:
        lag_s = max(loop.car.steering_lag_s, _SHORTEST_LAG_S)
        for duration_s, command in reversed(list(received.during(since_s, 0.0))):  # back from time 0
            rows[2] = command + (rows[2] - command) * math.exp(duration_s / lag_s)
        reported_s = min(received.effect_s - loop.car.steering_dead_time_s - predictor.unreported_s, end_s)
        for duration_s, command in received.during(since_s, reported_s):
            rows = _move(rows, command, duration_s, reported_mps, predictor.wheelbase_m, lag_s)
        since_s = max(since_s, reported_s)
    else:
        begin_s = since_s - MODEL_MEMORY_S
        rows[2] = remembered.rows[remembered.at(begin_s)]
        for duration_s, command in remembered.during(begin_s, since_s):
            rows[2] = command + (rows[2] - command) * math.exp(-duration_s / assumed_lag_s)
    for duration_s, command in remembered.during(since_s, end_s):
        rows = _move(rows, command, duration_s, reported_mps, predictor.wheelbase_m, assumed_lag_s)
    return rows[:2]


def _move(rows: FloatArray, command: FloatArray, duration_s: float, *car: float) -> FloatArray:
    """Return the rows of lateral error, heading error and wheel angle after a time with a constant command."""
    moved: FloatArray = _kinematic(round(duration_s, 9), *car) @ np.vstack([rows, command])
    return moved[:3]


@lru_cache(maxsize=4096)
def _kinematic(duration_s: float, speed_mps: float, wheelbase_m: float, lag_s: float) -> FloatArray:
    """Return the transition of lateral error, heading error, wheel angle and constant command (4 x 4)."""
    rates = np.zeros((4, 4))
    rates[0, 1], rates[1, 2] = speed_mps, speed_mps / wheelbase_m
    rates[2, 2:] = -1 / lag_s, 1 / lag_s
    return np.asarray(expm(rates * duration_s), dtype=np.float64)


def compensated_spectral_radius(loop: LateralLoop, predictor: Predictor, total_delay_s: float) -> float:
    """Return the factor by which the least damped mode grows per frame; the loop is stable if this is less than 1."""
    closed = opened_loop(loop, predictor, total_delay_s).closed()
    return float(np.max(np.abs(np.linalg.eigvals(closed))))


def compensated_phase_margin_rad(loop: LateralLoop, predictor: Predictor, total_delay_s: float) -> float:
    """Return the smallest phase margin over all frequencies where the gain is 1; negative if the loop is unstable."""
    opened = opened_loop(loop, predictor, total_delay_s)
    frequencies = np.geomspace(0.05, math.pi * loop.frame_rate_hz * 0.999, 1500)
    response = opened.response(frequencies, loop.frame_rate_hz)
    larger = np.abs(response) > 1
    changes = np.flatnonzero(larger[:-1] != larger[1:])
    if len(changes) == 0:
        return math.inf
    at_one = []
    for index in changes:
        low, high = np.log(np.abs(response[index : index + 2]))
        share = low / (low - high)
        at_one.append(response[index] + share * (response[index + 1] - response[index]))
    margin = float(np.min(np.abs(np.angle(-np.array(at_one)))))
    return margin if compensated_spectral_radius(loop, predictor, total_delay_s) < 1 else -margin


def configured_variant(config: RunConfig) -> tuple[Variant, LateralLoop, Predictor] | None:
    """Return the loop of a run with a controller that knows the delay; None if it has another controller or car.

    The part of the total delay without reports is the control's delay and `Predictor.unreported_s`. Raises `UserError`
    for a preset, car or condition that does not exist.
    """
    controller = config.controller
    variant = VARIANTS.get(controller.kind)
    if variant is None or config.vehicle.kind != "simulator":
        return None
    loop = run_loop(config, controller.lookahead_s or variant.lookahead_s)
    known = config.controller.compensation
    assumed, right = known.settings_at(config.camera.rate_hz), CompensationConfig().settings_at(config.camera.rate_hz)
    camera_error_s = assumed.camera_delay_s - right.camera_delay_s - config.camera.sensor_delay_ms / 1000
    predictor = Predictor(
        steering_lag_s=known.steering_lag_s,
        steering_dead_time_s=known.steering_dead_time_s,
        wheelbase_m=controller.wheelbase_m,
        uses_reports=variant.uses_reports,
        unreported_s=Predictor().unreported_s
        + config.network.requested(conditions()[config.network.condition]).control_ms / 1000,
        # A measured delay ends at a time that was measured; an assumed one begins at the assumed exposure.
        delay_error_s=known.delay_error_s if variant.measures_delay else -camera_error_s,
        constant_delay_s=None if variant.measures_delay else known.constant_delay_s,
        lane_error_s=camera_error_s + assumed.average_lag_s - right.average_lag_s,
    )
    return variant, loop, predictor


def configured_margin_s(config: RunConfig) -> float | None:
    """Return the smallest total delay at which a run's loop is unstable, or None; see `configured_variant`."""
    configured = configured_variant(config)
    return None if configured is None else variant_critical_delay_s(*configured)


@lru_cache(maxsize=64)
def variant_critical_delay_s(variant: Variant, loop: LateralLoop, predictor: Predictor) -> float:
    """Return the smallest total delay in seconds at which the loop is unstable; over 3 s, infinity."""
    return smallest_unstable_s(lambda delay_s: variant_radius(variant, loop, predictor, delay_s))


def variant_radius(variant: Variant, loop: LateralLoop, predictor: Predictor, total_delay_s: float) -> float:
    """Return the spectral radius of a loop with a controller of `lavt.control.compensation`."""
    if variant.predicts:
        return compensated_spectral_radius(loop, predictor, total_delay_s)
    return spectral_radius(scheduled_loop(variant, loop, total_delay_s + predictor.delay_error_s), total_delay_s)


def scheduled_loop(variant: Variant, loop: LateralLoop, total_delay_s: float) -> LateralLoop:
    """Return the loop with the lookahead and the speed that a variant chooses for a total delay."""
    nearest_m, farthest_m = LOOKAHEAD_RANGE_M
    distance_m, speed_mps = loop.lookahead_s * loop.speed_mps, loop.speed_mps
    if variant.lookaheads_s:
        distance_m = interpolate(variant.lookaheads_s, total_delay_s) * speed_mps * loop.speed_report_factor
    if variant.speeds_mps:
        speed_mps = min(speed_mps, interpolate(variant.speeds_mps, total_delay_s) / loop.speed_report_factor)
    return replace(loop, lookahead_s=min(max(distance_m, nearest_m), farthest_m) / speed_mps, speed_mps=speed_mps)
