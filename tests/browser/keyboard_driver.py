"""A driver who looks at the page and presses its keys, in any browser.

It takes the picture from the page's canvas and the speed from the page's status, detects the lane, and steers to its
centre by pressing and releasing the arrow keys, as a person does.
"""

from __future__ import annotations

import base64
import math
from collections.abc import Sequence
from typing import Any, Final

import cv2
import numpy as np
from tests.browser.chromium import ProtocolError
from tests.browser.conftest import AnyTab

from lavt.assembly.cameras import camera_model
from lavt.clock import MachineClock
from lavt.control.human_controls import HumanLimits
from lavt.control.lane_watch import LANE_CONFIDENCE
from lavt.control.pure_pursuit import lookahead_m, pursuit_curvature_per_m, steering_rad
from lavt.domain import NS_PER_S
from lavt.experiment.runs.human_drive import drive_config
from lavt.perception.calibration import calibrated_pinhole_camera
from lavt.perception.lane_detector import LaneDetector
from lavt.safety.state_machine import TRIGGER_MESSAGES

LOOK: Final = """(() => {
  const {status, keyboard} = globalThis.lavtConsole;
  const picture = document.querySelector("#picture").toDataURL("image/jpeg", 0.9).split(",")[1];
  return {status, steering: keyboard.steering, picture};
})()"""
SPEED_MPS: Final = 7.0
LOOKAHEAD_S: Final = 1.2
KEYS: Final = {1: "ArrowLeft", -1: "ArrowRight"}
"""The key of each direction, left positive."""
RATES_PER_S: Final = {"press": 1.6, "release": 3.0}
"""How fast the page turns towards full deflection, and back (hand.js)."""
FRESH_KEY_NS: Final = NS_PER_S // 2
"""The page expects an event of a key at least every 1.5 s."""
TAPPED: Final = "ArrowUp"
"""The key that is tapped then: it changes the speed a little."""


class KeyboardDriver:
    """Drives the car of a `lavt drive` with these settings from a page to the end of its route."""

    def __init__(self, tab: AnyTab, settings: Sequence[str]) -> None:
        config = drive_config(list(settings))
        self.stops = 0
        """How often the page has lost the hand."""
        self._tab = tab
        self._detector = LaneDetector(calibrated_pinhole_camera(camera_model(config.camera)))
        self._wheelbase_m = config.controller.wheelbase_m
        self._limits = HumanLimits()
        self._clock = MachineClock()
        self._held: set[str] = set()
        self._pressed_ns = 0
        self._deflection = 0.0

    def drive(self, limit_s: float) -> None:
        """Arm, and drive until the vehicle says that the drive is over; fail after `limit_s`.

        If the vehicle stops before, as on a busy machine, whose browser pauses, it is armed again.
        """
        limit_ns = self._clock.now().mono_ns + round(limit_s * NS_PER_S)
        before_ns = self._clock.now().mono_ns
        while True:
            now_ns, seen = self._clock.now().mono_ns, self._seen()
            assert now_ns < limit_ns, f"the route was not driven within {limit_s:g} s, with {self.stops} stops"
            if seen is None:
                continue
            status = seen["status"]
            if status["reason"] == TRIGGER_MESSAGES["drive over"]:
                break
            if status["hand"] == "held" and status["safety"] in ("driving", "degraded"):
                self._steer(seen, (now_ns - before_ns) / NS_PER_S)
            elif status["hand"] == "open" and status["phase"] == "arming":
                self._hold({"Space"})
            elif status["hand"] != "held" and self._held:
                self.stops += 1
                self._hold(set())
                self._detector.forget()
            before_ns = now_ns
        self._hold(set())

    def _seen(self) -> dict[str, Any] | None:
        """Return what the page shows; None if it is not connected."""
        try:
            seen: dict[str, Any] = self._tab.evaluate(LOOK)
        except ProtocolError:
            return None
        return seen if seen["status"] is not None else None

    def _steer(self, seen: dict[str, Any], step_s: float) -> None:
        """Press the keys that bring the wheels nearest to where they should be when the next picture is seen."""
        encoded = np.frombuffer(base64.b64decode(seen["picture"]), np.uint8)
        picture: Any = cv2.imdecode(encoded, cv2.IMREAD_COLOR)
        lane = self._detector.detect(picture)
        speed_mps = seen["status"]["speed_mps"]
        if lane.confidence >= LANE_CONFIDENCE:
            curvature_per_m = pursuit_curvature_per_m(lane, lookahead_m(LOOKAHEAD_S, speed_mps))
            lateral_rad = math.atan(self._wheelbase_m * self._limits.lateral_limit_mps2 / max(speed_mps, 1.0) ** 2)
            full_rad = min(lateral_rad, self._limits.steering_limit_rad)
            self._deflection = max(-1.0, min(1.0, steering_rad(curvature_per_m, self._wheelbase_m) / full_rad))
        turn = min((0, 1, -1), key=lambda turn: abs(turned(seen["steering"], turn, step_s) - self._deflection))
        keys = {KEYS[turn]} if turn else set()
        self._hold({"Space", *keys, *(["ArrowUp"] if speed_mps < SPEED_MPS else [])})

    def _hold(self, keys: set[str]) -> None:
        """Press and release keys until these are held; if none was pressed lately, tap one."""
        now_ns = self._clock.now().mono_ns
        downs = {code: code in keys for code in keys ^ self._held}
        if any(downs.values()):
            self._pressed_ns = now_ns
        elif keys and now_ns - self._pressed_ns > FRESH_KEY_NS:
            self._pressed_ns = now_ns
            downs[TAPPED] = TAPPED not in keys
            keys = keys ^ {TAPPED}
        if downs:
            self._tab.keys(downs)
        self._held = keys


def turned(deflection: float, turn: int, step_s: float) -> float:
    """Return the page's deflection after `step_s` with the key of a direction, or without a key (0)."""
    if turn == 0:
        return math.copysign(max(abs(deflection) - RATES_PER_S["release"] * step_s, 0.0), deflection)
    rate = RATES_PER_S["release" if turn * deflection < 0 else "press"]
    return max(-1.0, min(1.0, deflection + turn * rate * step_s))
