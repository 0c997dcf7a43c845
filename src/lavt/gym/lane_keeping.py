"""The environment `lavt/LaneKeeping-v0`: an agent drives a car over a delayed network. `docs/gym.md` describes it."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Literal

import cv2
import gymnasium
import numpy as np
from gymnasium import spaces
from gymnasium.error import ClosedEnvironmentError, InvalidAction, ResetNeeded
from numpy.typing import ArrayLike, NDArray

from lavt.assembly.cameras import client_camera
from lavt.config import ClientCameraConfig
from lavt.domain import MAX_REPORTED_MPS, MAX_ROAD_WHEEL_RAD, GroundTruth, Lane
from lavt.errors import UserError
from lavt.experiment.runs.virtual_run import free_finished_loops
from lavt.gym.agent_drive import AgentDrive
from lavt.gym.episode_plan import Delay, EpisodePlanner, Names
from lavt.gym.reward import RewardMeter, parse_weights
from lavt.gym.settings import check_count, check_positive, parse_path
from lavt.gym.top_view import draw_top_view
from lavt.recording.output_directory import check_directory

Observation = NDArray[np.float32] | dict[str, NDArray[Any]]

LANE = {"c0_m": 20.0, "c1": 2.0, "c2_per_m": 0.5, "confidence": 1.0}
VEHICLE = {"speed_mps": MAX_REPORTED_MPS, "steering_rad": MAX_ROAD_WHEEL_RAD, "loop_delay_s": 10.0}
"""The names of the numbers in an observation, in order, each with its largest magnitude."""
NEVER_NEGATIVE = ("confidence", "loop_delay_s")
FIDELITY = {"lane": "geometry", "pixels": "video"}
"""The default fidelity by the kind of observation."""
FAILURES = ("lane_left", "collision", "off_road", "safe_stop")
"""The endings that the reward penalizes."""


class LaneKeepingEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """A car on a road with a remote driver, the agent.

    A step lasts from one picture that the client sees to the next one, and virtual time stands still while the agent
    decides. All parameters are described in `docs/gym.md`.

    Raises `UserError` for wrong values; each message is a sentence that says what to do.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 30}  # noqa: RUF012 (as in the base)

    def __init__(
        self,
        *,
        observation: Literal["lane", "pixels"] = "lane",
        config: str | Path | None = None,
        changes: Iterable[str] = (),
        route: Names = None,
        condition: Names = None,
        video_ms: Delay = None,
        control_ms: Delay = None,
        fidelity: str | None = None,
        controls_speed: bool = False,
        steering_scale_rad: float = 0.2,
        action_history: int = 0,
        max_cross_track_m: float = 1.75,
        reward: Mapping[str, float] | None = None,
        records: str | Path | None = None,
        render_mode: str | None = None,
    ) -> None:
        if observation not in FIDELITY:
            raise UserError(f"there is no observation {observation!r}; choose one of {', '.join(FIDELITY)}")
        if observation == "pixels" and fidelity == "geometry":
            raise UserError("fidelity geometry has no pictures: choose video or pixels, or observation lane")
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UserError(f"there is no render mode {render_mode!r}: choose rgb_array or None")
        check_positive("steering_scale_rad", steering_scale_rad)
        check_positive("max_cross_track_m", max_cross_track_m)
        check_count("action_history", action_history, 1000)
        self._weights = parse_weights(reward)
        self._planner = EpisodePlanner(
            config=config,
            changes=changes,
            fidelity=fidelity or FIDELITY[observation],
            route=route,
            condition=condition,
            video_ms=video_ms,
            control_ms=control_ms,
        )
        self._records = parse_path("records", records)
        if self._records is not None:
            check_directory(self._records)
        self.render_mode = render_mode
        self._shows_pixels = observation == "pixels"
        self._steering_scale_rad = float(steering_scale_rad)
        self._max_cross_track_m = max_cross_track_m
        self._speed_mps = self._planner.base.controller.effective_preset().speed_mps
        self._actions: deque[NDArray[np.float32]] = deque(maxlen=int(action_history))
        self._action_shape = (2 if controls_speed else 1,)
        self.action_space = spaces.Box(-1.0, 1.0, self._action_shape, np.float32)
        self._numbers = self._number_space(action_history)
        self.observation_space = self._make_observation_space()
        self._episodes = 0
        self._drive: AgentDrive | None = None
        self._has_ended = True
        self._is_closed = False
        self._truth: GroundTruth | None = None
        cv2.setNumThreads(1)  # more threads would change the order of summation

    def _number_space(self, action_history: int) -> spaces.Box:
        """Return the space of the observation's numbers: lane (unless pixels are shown), vehicle, earlier actions."""
        limits = VEHICLE if self._shows_pixels else LANE | VEHICLE
        actions = np.ones(action_history * self._action_shape[0], np.float32)
        low = np.array([0.0 if name in NEVER_NEGATIVE else -limit for name, limit in limits.items()], np.float32)
        high = np.array(list(limits.values()), np.float32)
        return spaces.Box(np.concatenate([low, -actions]), np.concatenate([high, actions]), dtype=np.float32)

    def _make_observation_space(self) -> spaces.Space[Any]:
        if not self._shows_pixels:
            return self._numbers
        camera = client_camera(ClientCameraConfig(**self._planner.base.camera.model_dump()))
        picture = spaces.Box(0, 255, (camera.height_px, camera.width_px, 3), np.uint8)
        return spaces.Dict({"picture": picture, "vehicle": self._numbers})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Begin the next episode: the car is armed and stationary at the beginning of the route.

        `options` can have the keys of `OPTIONS` (`episode_plan.py`). Raises `UserError` for wrong options, and
        `WorkError` if the car was never armed, for example because every picture is older than the limit of the gate.
        """
        if self._is_closed:
            raise ClosedEnvironmentError("the environment is closed: make a new one")
        super().reset(seed=seed)
        self._end_drive()
        planned = self._planner.plan(
            self.np_random, {} if options is None else options, f"episode-{self._episodes + 1:06d}"
        )
        self._episodes += 1
        self._drive = drive = AgentDrive(planned, None if self._records is None else self._records / planned.name)
        self._has_ended = False
        self._meter = RewardMeter(self._weights, drive.wheelbase_m)
        self._actions.extend([np.zeros(self._action_shape, np.float32)] * (self._actions.maxlen or 0))
        self._truth = _newest(drive)
        return self._observe(drive), self._info(drive, {}, "")

    def step(self, action: ArrayLike) -> tuple[Observation, float, bool, bool, dict[str, Any]]:
        """Command an action from the present picture, and drive until the next picture or the end of the episode.

        Values beyond +-1 are clipped. Raises `InvalidAction` for an action of another shape or that is not finite, and
        `ResetNeeded` before `reset` and after the end of an episode.
        """
        if self._is_closed:
            raise ClosedEnvironmentError("the environment is closed: make a new one")
        drive = self._drive
        if drive is None or self._has_ended:
            raise ResetNeeded("the episode has ended or not begun: call reset()")
        chosen = self._valid_action(action)
        if self._actions.maxlen:
            self._actions.appendleft(chosen)
        speed_share = (float(chosen[1]) + 1) / 2 if len(chosen) == 2 else 1.0
        drive.act(float(chosen[0]) * self._steering_scale_rad, speed_share * self._speed_mps)
        truths = drive.take_truths()
        self._truth = truths[-1] if truths else self._truth
        ending = drive.ending or ""
        if not ending and any(abs(truth.cross_track_m) > self._max_cross_track_m for truth in truths):
            ending = "lane_left"
        terms = self._meter.terms(truths, has_failed=ending in FAILURES)
        self._has_ended = ending != ""
        is_truncated = ending == "timeout"
        info = self._info(drive, terms, ending)
        return self._observe(drive), sum(terms.values()), self._has_ended and not is_truncated, is_truncated, info

    def _valid_action(self, action: ArrayLike) -> NDArray[np.float32]:
        try:
            chosen = np.array(action, np.float32)
        except (OverflowError, TypeError, ValueError) as error:
            raise InvalidAction(f"an action must be an array of numbers: {error}") from error
        if chosen.shape != self._action_shape or not np.isfinite(chosen).all():
            raise InvalidAction(f"an action must be finite and of shape {self._action_shape}, not {action!r}")
        return np.clip(chosen, -1.0, 1.0)

    def _observe(self, drive: AgentDrive) -> Observation:
        view = drive.view
        vehicle = [view.speed_mps, view.steering_rad, view.loop_delay_s or 0.0]
        seen = vehicle if self._shows_pixels else [*view.lane.centre, view.lane.confidence, *vehicle]
        numbers: NDArray[np.float32] = np.concatenate([np.array(seen, np.float32), *self._actions])
        numbers = np.clip(np.nan_to_num(numbers), self._numbers.low, self._numbers.high).astype(np.float32)
        if not self._shows_pixels:
            return numbers
        return {"picture": cv2.cvtColor(view.picture, cv2.COLOR_BGR2RGB), "vehicle": numbers}

    def _info(self, drive: AgentDrive, terms: Mapping[str, float], ending: str) -> dict[str, Any]:
        planned, truth = drive.planned, self._truth
        return {
            "reward_terms": dict(terms),
            "ending": ending,
            "time_s": drive.time_s,
            "cross_track_m": math.nan if truth is None else truth.cross_track_m,
            "heading_error_rad": math.nan if truth is None else truth.heading_error_rad,
            "speed_mps": math.nan if truth is None else truth.speed_mps,
            "progress_m": math.nan if truth is None else truth.progress_m,
            **drive.latencies(),
            **drive.vehicle_status(),
            "route": planned.config.vehicle.route,
            "condition": planned.config.network.condition,
            "injected_video_ms": planned.requested.video_ms,
            "injected_control_ms": planned.requested.control_ms,
        }

    @property
    def seen_lane(self) -> Lane:
        """The lane that the client detected in the present picture, also if the observation does not contain it."""
        if self._drive is None:
            raise ResetNeeded("no picture has been seen: call reset()")
        return self._drive.view.lane

    def render(self) -> NDArray[np.uint8] | None:
        """Return a view from above for `render_mode` rgb_array, (400, 400, 3), or None without a render mode."""
        if self.render_mode is None:
            return None
        lane = self.seen_lane
        return draw_top_view(None if self._drive is None else self._drive.route, self._truth, lane)

    def close(self) -> None:
        """End the episode, and complete its records; further calls have no effect."""
        self._is_closed = self._has_ended = True
        self._end_drive()

    def _end_drive(self) -> None:
        drive, self._drive, self._has_ended = self._drive, None, True
        if drive is None:
            return
        drive.close()
        config = drive.planned.config
        del drive
        free_finished_loops(config)


def _newest(drive: AgentDrive) -> GroundTruth | None:
    truths = drive.take_truths()
    return truths[-1] if truths else None
