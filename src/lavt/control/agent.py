"""The controller in an agent's place, which turns the steering and the speed that the agent wants into decisions."""

from __future__ import annotations

from lavt.control.loop_history import LoopHistory
from lavt.control.preset import Preset
from lavt.control.pure_pursuit import RememberedLane, clamp, curvature_per_m, lookahead_m, pursuit_path_per_m
from lavt.control.speed_control import SpeedKeeper
from lavt.domain import NS_PER_S, Decision, Lane


class AgentController:
    """A controller that steers as an agent wants, and keeps the speed that the agent wants by PI control.

    The steering is clamped to the preset's steering limit, the speed to the preset's speed. As for every controller,
    the speed is lower while the lane is badly visible, and no pedal is used without a lane. The planned path leads onto
    the centre of the seen lane and along it; the vehicle follows it only if commands are missing. `history` gets the
    vehicle's states and the commands sent.
    """

    def __init__(self, preset: Preset, *, wheelbase_m: float) -> None:
        self.history = LoopHistory()
        self.wanted_steering_rad = 0.0
        """The wanted angle of the road wheels, left positive."""
        self.wanted_speed_mps = preset.speed_mps
        self._preset = preset
        self._wheelbase_m = wheelbase_m
        self._speed_keeper = SpeedKeeper(preset.speed_mps, preset.lane_confidence)
        self._remembered = RememberedLane(preset.lane_confidence)
        self._steering_rad = 0.0
        self._decided_ns: int | None = None

    def decide(self, lane: Lane, speed_mps: float, now_ns: int) -> Decision:
        """Return the wanted steering, the pedals that keep the wanted speed, and the path along the lane."""
        preset = self._preset
        step_s = 0.0 if self._decided_ns is None else (now_ns - self._decided_ns) / NS_PER_S
        self._decided_ns = now_ns
        self._remembered.update(lane, speed_mps * step_s, curvature_per_m(self._steering_rad, self._wheelbase_m))
        self._steering_rad = clamp(self.wanted_steering_rad, preset.steering_limit_rad)
        self._speed_keeper.full_speed_mps = min(max(self.wanted_speed_mps, 0.0), preset.speed_mps)
        throttle, brake = self._speed_keeper.pedals(lane.confidence, speed_mps, step_s)
        return Decision(
            steering_rad=self._steering_rad,
            throttle=throttle,
            brake=brake,
            path_curvature_per_m=pursuit_path_per_m(
                self._remembered.lane,
                lookahead_m(preset.lookahead_s, speed_mps),
                preset.curvature_limit_per_m(speed_mps, self._wheelbase_m),
                self._remembered.pose,
            ),
        )
