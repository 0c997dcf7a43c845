"""What the predictive display draws, when it draws nothing, and that it changes no command."""

from __future__ import annotations

import json
import math
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from tests.nodes.stand_ins import MONO_NS, WALL_NS, at, payloads
from tests.nodes.test_human_driver import HumanBench

from lavt.control.loop_history import CLOCK_STEP_NS, STATE_AGE_NS
from lavt.control.prediction import MAX_LOOP_NS, CarModel, Prediction, RelativePose
from lavt.domain import NS_PER_MS, NS_PER_S, CameraModel, State
from lavt.node import Send
from lavt.nodes.page_prediction import Outline, PagePredictor, draw
from lavt.nodes.payloads import ReceivedUnit
from lavt.perception.calibration import CalibratedCamera, calibrated_pinhole_camera
from lavt.transport.messages import encode
from lavt.transport.video.stamp import rtp_timestamp

MODEL = CarModel(wheelbase_m=2.8, steering_rate_radps=0.8, steering_lag_s=0.12, stop_deceleration_mps2=4.0)
OUTLINE = Outline(front_m=4.0, rear_m=1.0, width_m=2.0)
CAMERA = calibrated_pinhole_camera(CameraModel(width_px=640, height_px=480))
VIDEO_NS, CONTROL_NS = 200 * NS_PER_MS, 50 * NS_PER_MS
STEP_NS = 20 * NS_PER_MS


def state(mono_ns: int, applied: int, **values: Any) -> State:
    """Return a state that the vehicle has sent at this time since the start; all clocks of the bench agree."""
    defaults = {"speed_mps": 8.0, "steering_rad": 0.0, "gear": "drive", "safety": "driving"}
    fields = {**defaults, **values}
    return State(WALL_NS + mono_ns, MONO_NS + mono_ns, reason="", applied_sequence=applied, rejected="", **fields)


class PredictionBench:
    """A person's driver node that drives, with a vehicle that applies each command after `CONTROL_NS`."""

    def __init__(self, *, is_shown: bool = True) -> None:
        predictor = PagePredictor(MODEL, OUTLINE, CAMERA) if is_shown else None
        self.bench = HumanBench(predictor=predictor).drive()
        self.sent: list[tuple[int, int]] = []
        self.commands: list[bytes] = []

    def step(self, *, steering: float = 0.0, is_applied: bool = True, **values: Any) -> None:
        """Let 20 ms pass, with an input and a state of the vehicle."""
        command = self.bench.input(throttle=0.5, steering=steering)
        assert command is not None
        self.commands.append(encode(command))
        self.sent.append((command.sequence, self.bench.mono_ns))
        applied = max((n for n, at_ns in self.sent if at_ns + CONTROL_NS <= self.bench.mono_ns), default=-1)
        self.bench.deliver("state", encode(state(self.bench.mono_ns, applied if is_applied else -1, **values)))

    def drive(self, steps: int = 30, **values: Any) -> PredictionBench:
        """Drive, with a picture every 40 ms, and return this bench."""
        for index in range(steps):
            if index % 2 == 0:
                self.bench.show()
            self.step(**values)
        return self

    def unit(self) -> list[Send]:
        """Deliver an access unit that is `VIDEO_NS` old."""
        unit = ReceivedUnit(b"", rtp_timestamp(WALL_NS + self.bench.mono_ns - VIDEO_NS), True, True, MONO_NS)
        return self.bench.deliver("access_unit", unit)

    def prediction(self) -> dict[str, Any] | None:
        """Return what the page gets for an access unit; None: nothing."""
        found = [json.loads(text) for text in payloads(self.unit(), "page_status")]
        assert len(found) <= 1
        return found[0] if found else None


def ground_ahead(camera: CalibratedCamera, row: float) -> float:
    """Return the distance from the rear axle at which the ground is in this row of a level camera."""
    return camera.x_m + camera.z_m * camera.focal_px[1] / (row - camera.middle_px[1])


def test_a_prediction_comes_before_its_picture() -> None:
    """Each access unit that a page gets follows its prediction, with its RTP timestamp and its stamp."""
    bench = PredictionBench().drive()
    sends = [send for send in bench.unit() if send.channel.startswith("page_")]
    assert [(send.channel, send.peer) for send in sends] == [("page_status", 1), ("page_unit", 1)]
    prediction = json.loads(sends[0].payload)
    stamp_ns = WALL_NS + bench.bench.mono_ns - VIDEO_NS
    assert prediction["unit"] == rtp_timestamp(stamp_ns)
    assert 0 <= stamp_ns - int(prediction["stamp"]) < 12_000


def test_the_shapes_are_at_their_distances() -> None:
    """At 8 m/s, the ghost's front is the loop delay's 2 m ahead, and the stopping line 8 m further."""
    prediction = PredictionBench().drive().prediction()
    assert prediction is not None
    loop_m = 8.0 * (VIDEO_NS + CONTROL_NS) / NS_PER_S
    tolerance_m = 8.0 * 0.01 + 0.05  # half of the states' period, and the rounding of rows
    ghost_m = ground_ahead(CAMERA, min(row for _, row in prediction["ghost"]))
    assert ghost_m == pytest.approx(OUTLINE.front_m + loop_m, abs=tolerance_m)
    (left, stop_row), (right, _) = prediction["stop"]
    assert ground_ahead(CAMERA, stop_row) == pytest.approx(OUTLINE.front_m + loop_m + 8.0, abs=2 * tolerance_m)
    assert (left + right) / 2 == pytest.approx(CAMERA.middle_px[0], abs=0.1)
    rows = [row for _, row in prediction["left"]]
    assert rows == sorted(rows, reverse=True)
    assert ground_ahead(CAMERA, rows[0]) == pytest.approx(OUTLINE.front_m, abs=0.05)
    assert ground_ahead(CAMERA, rows[-1]) == pytest.approx(ghost_m, abs=0.05)


def test_commands_on_their_way_count() -> None:
    """Left steering that the vehicle has not applied yet turns the stopping line to the left, and no state does."""
    bench = PredictionBench().drive()
    straight = bench.prediction()
    bench.step(steering=1.0)
    turned = bench.prediction()
    assert straight is not None
    assert turned is not None
    assert turned["stop"][0][0] < straight["stop"][0][0] - 5


def turned_after(acting_ns: int) -> float:
    """Return the heading after a step of 0.05 rad at 8 m/s has acted for this time, with the lag of the wheels."""
    lag_s, acting_s = MODEL.steering_lag_s, acting_ns / NS_PER_S
    return 8.0 / MODEL.wheelbase_m * 0.05 * (acting_s - lag_s * (1 - math.exp(-acting_s / lag_s)))


@pytest.mark.parametrize("acting_ns", [0, 40 * NS_PER_MS, 100 * NS_PER_MS, 200 * NS_PER_MS])
def test_a_command_turns_the_ghost_as_long_as_it_acts(acting_ns: int) -> None:
    """A command that is sent now does not turn the ghost; later, it has acted since then, to half a states' period."""
    predictor, control_ns, now_ns = PagePredictor(MODEL, OUTLINE, CAMERA), 250 * NS_PER_MS, 100 * STEP_NS
    sent = [(number, number * STEP_NS) for number in range(101)]
    for number, at_ns in sent:
        predictor.history.note_command(number, 0.05 if at_ns >= now_ns - acting_ns else 0.0, at_ns)
        applied = max((n for n, t in sent[: number + 1] if t + control_ns <= at_ns), default=-1)
        predictor.history.note_state(state(at_ns, applied), at_ns)
    prediction = predictor.predict_since(WALL_NS + now_ns - VIDEO_NS, now_ns)
    assert prediction is not None
    least, most = (turned_after(max(0, acting_ns + error_ns)) for error_ns in (-STEP_NS // 2, STEP_NS // 2))
    assert 0.99 * least <= prediction.ghost.heading_rad <= 1.01 * most


def ghosts_after_setting_the_clock(step_ns: int, steps: int) -> list[float | None]:
    """Return how far ahead of each picture the ghost is, one for each 20 ms since the vehicle's clock was set.

    The car drives at 8 m/s, each command takes effect after `CONTROL_NS`, and each picture is `VIDEO_NS` old.
    """
    predictor, set_ns = PagePredictor(MODEL, OUTLINE, CAMERA), 50 * STEP_NS
    ghosts: list[float | None] = []
    for number in range(50 + steps):
        now_ns = number * STEP_NS
        predictor.history.note_command(number, 0.0, now_ns)
        newest = state(now_ns, number - -(-CONTROL_NS // STEP_NS))
        clock_ns = step_ns if now_ns >= set_ns else 0
        predictor.history.note_state(replace(newest, sent_wall_ns=newest.sent_wall_ns + clock_ns), now_ns)
        captured_ns = now_ns - VIDEO_NS
        picture_ns = WALL_NS + captured_ns + (step_ns if captured_ns >= set_ns else 0)
        prediction = predictor.predict_since(picture_ns, now_ns)
        if now_ns >= set_ns:
            ghosts.append(None if prediction is None else prediction.ghost.x_m)
    return ghosts


LOOP_M = 8.0 * (VIDEO_NS + CONTROL_NS) / NS_PER_S
LOOP_TOLERANCE_M = 8.0 * 0.01 + 0.05


@pytest.mark.parametrize("step_ms", [-10_000, -1_000, -200, -40, 40, 200, 1_000, 10_000])
def test_a_clock_that_is_set_hides_the_prediction(step_ms: int) -> None:
    """When the vehicle's clock is set, nothing is drawn at once, until the new clock has stamped picture and states."""
    ghosts_m = ghosts_after_setting_the_clock(step_ms * NS_PER_MS, 300)
    hidden_ns = STEP_NS * next(index for index, ghost_m in enumerate(ghosts_m) if ghost_m is not None)
    # A clock that was set back must have passed the time that it had shown.
    expected_ns = min(VIDEO_NS + max(0, -step_ms * NS_PER_MS), MAX_LOOP_NS)
    assert expected_ns <= hidden_ns <= expected_ns + 2 * STEP_NS
    for ghost_m in ghosts_m[hidden_ns // STEP_NS :]:
        assert ghost_m == pytest.approx(LOOP_M, abs=LOOP_TOLERANCE_M)


@pytest.mark.parametrize("step_ns", [-CLOCK_STEP_NS, CLOCK_STEP_NS])
def test_a_step_of_the_clock_that_is_not_noticed_moves_the_ghost_little(step_ns: int) -> None:
    """A smaller step of the clock moves the ghost by no more than the car drives in this time."""
    ghosts_m = [ghost_m for ghost_m in ghosts_after_setting_the_clock(step_ns, 100) if ghost_m is not None]
    assert len(ghosts_m) >= 99  # the delay is unknown until the next state if the clock goes back
    for ghost_m in ghosts_m:
        assert ghost_m == pytest.approx(LOOP_M, abs=8.0 * CLOCK_STEP_NS / NS_PER_S + LOOP_TOLERANCE_M)


@pytest.mark.parametrize(
    "values",
    [
        {"safety": "safe_stop"},
        {"safety": "degraded"},
        {"speed_mps": math.nan},
        {"speed_mps": -1.0},
        {"steering_rad": math.nan},
    ],
    ids=str,
)
def test_a_vehicle_that_does_not_drive_has_no_prediction(values: dict[str, Any]) -> None:
    """When the vehicle stops by itself, or reports what cannot be, nothing is drawn."""
    bench = PredictionBench().drive()
    assert bench.prediction() is not None
    bench.bench.mono_ns += STEP_NS
    bench.bench.deliver("state", encode(state(bench.bench.mono_ns, bench.sent[-4][0], **values)))
    assert bench.prediction() is None


def test_without_states_nothing_is_drawn() -> None:
    """Just before the newest state is 300 ms old there is a prediction; then there is none."""
    bench = PredictionBench().drive()
    bench.bench.mono_ns += STATE_AGE_NS - 1
    assert bench.prediction() is not None
    bench.bench.mono_ns += 1
    assert bench.prediction() is None


def test_an_unknown_loop_delay_draws_nothing() -> None:
    """Unless the vehicle reports newly applied commands, it is not known when a command takes effect."""
    assert PredictionBench().drive(is_applied=False).prediction() is None


def test_without_a_picture_nothing_is_drawn() -> None:
    """Before this client has decoded a picture, no stamp is known."""
    predictor = PagePredictor(MODEL, OUTLINE, CAMERA)
    assert predictor.message(1, at(0)) is None


def test_without_control_nothing_is_drawn() -> None:
    """After a release, the vehicle's state tells nothing of the effect of this client's commands."""
    bench = PredictionBench().drive()
    bench.bench.deliver("operator", "release")
    bench.bench.mono_ns += STEP_NS
    bench.bench.deliver("state", encode(state(bench.bench.mono_ns, bench.sent[-3][0])))
    assert not bench.bench.session.has_control
    assert bench.prediction() is None


@settings(max_examples=15)
@given(st.lists(st.floats(-1.0, 1.0), min_size=1, max_size=8))
def test_the_display_changes_no_command(steering: list[float]) -> None:
    """With and without the display, the same inputs make the same commands."""
    shown, hidden = PredictionBench(), PredictionBench(is_shown=False)
    for bench in (shown, hidden):
        for angle in steering:
            bench.drive(4, steering=angle)
            bench.unit()
    assert shown.commands == hidden.commands
    assert hidden.prediction() is None


def test_an_outline_that_is_not_in_view_is_left_out() -> None:
    """The camera sees no point of a car that stands beneath it; no point is far outside the picture."""
    here = (RelativePose(0.0, 0.0, 0.0),)
    turned = (RelativePose(0.0, 0.0, math.pi),)
    drawn = draw(CAMERA, OUTLINE, Prediction(here, turned), 1, 2)
    assert drawn.stop == ()
    points = [*drawn.left, *drawn.right, *drawn.ghost]
    assert all(abs(column - 320) < 1280 and abs(row - 240) < 960 for column, row in points)
