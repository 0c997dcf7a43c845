# ruff: noqa: D102 (a test bench with short methods)

from __future__ import annotations

import json
from typing import Any

import numpy as np
import pytest
from tests.nodes.stand_ins import MONO_NS, WALL_NS, at, deliver

from lavt.domain import NS_PER_MS, NS_PER_S, PATH_POINTS, CameraModel, Command, Lane, State
from lavt.node import WAKE, Send
from lavt.nodes.page_watch import MAX_UNACKNOWLEDGED, PageWatchNode, lane_lines
from lavt.nodes.payloads import LaneSeen, PictureRead, ReceivedUnit
from lavt.perception.calibration import calibrated_pinhole_camera
from lavt.transport.messages import encode
from lavt.transport.rtp.reception_stats import ReceptionSample
from lavt.transport.video.stamp import rtp_timestamp

CAMERA = calibrated_pinhole_camera(CameraModel(width_px=640, height_px=480))
LANE = Lane(centre=(0.0, 0.0, 0.0), width_m=3.5, near_m=5.0, far_m=25.0, confidence=0.5)
COMMANDS = (
    {"type": "input", "seen_us": 0, "held": True, "live": True, "steering": 1.0, "throttle": 1.0, "brake": 0.0},
    {"type": "stop"},
    {"type": "drive"},
    {"type": "release"},
    {"type": "delay", "video_ms": 2000.0, "control_ms": 0.0},
)


class WatchBench:
    """The node of the pages that watch, with page 1, and methods that deliver what it observes."""

    def __init__(self) -> None:
        self.node = PageWatchNode("lane_keeper", 8.0, CAMERA, ("alice", 7))
        self.mono_ns = 0
        self.open(1)

    def deliver(self, channel: str, payload: object, *, page: Any = None) -> list[Send]:
        return deliver(self.node, channel, payload, at(self.mono_ns), page)

    def open(self, page: int) -> list[Send]:
        return self.deliver("watch_opened", None, page=page)

    def page(self, page: int = 1, **message: Any) -> list[Send]:
        return self.deliver("watch_message", json.dumps(message), page=page)

    def unit(self, number: int, *, is_keyframe: bool = False) -> list[Send]:
        return self.deliver("access_unit", ReceivedUnit(b"data", number, True, is_keyframe, MONO_NS))

    def status(self, page: int = 1) -> dict[str, Any]:
        """Return the next status of a page."""
        self.mono_ns += 50 * NS_PER_MS
        (text,) = [send.payload for send in self.deliver(WAKE, None) if send.peer == page]
        status: dict[str, Any] = json.loads(text)
        return status

    def state(self, *, applied: int, operator: str = "alice") -> None:
        state = State(1, 1, 5.0, 0.1, "drive", "driving", "why", applied, "", "", operator, 7)
        self.deliver("state", encode(state))


def test_pages_get_access_units_from_a_keyframe_on() -> None:
    """A page gets the undecoded access units from the next keyframe on, while it acknowledges them."""
    bench = WatchBench()
    assert bench.unit(1) == []
    (first,) = bench.unit(2, is_keyframe=True)
    assert (first.channel, first.peer) == ("watch_unit", 1)
    assert first.payload.endswith(b"data")
    for number in range(3, 2 + MAX_UNACKNOWLEDGED):
        assert len(bench.unit(number)) == 1
    assert bench.unit(90) == []
    bench.page(type="ack", unit=1 + MAX_UNACKNOWLEDGED)
    assert bench.unit(91) == []
    assert len(bench.unit(92, is_keyframe=True)) == 1
    assert bench.node.counts["page_units_skipped"] == 3


def test_the_lane_goes_with_the_stamp_of_its_picture() -> None:
    """Each page gets the lines of the lane in pixels, with the picture's stamp and RTP timestamp."""
    bench = WatchBench()
    bench.open(2)
    sends = bench.deliver("lane", LaneSeen(WALL_NS, LANE))
    assert [(send.channel, send.peer) for send in sends] == [("watch_status", 1), ("watch_status", 2)]
    lane = json.loads(sends[0].payload)
    assert (lane["type"], lane["unit"], lane["stamp"]) == ("lane", rtp_timestamp(WALL_NS), str(WALL_NS))
    assert lane["confidence"] == 0.5
    left, right = np.array(lane["left"]), np.array(lane["right"])
    assert left.shape == right.shape == (12, 2)
    assert (np.diff(left[:, 1]) < 0).all()  # a farther point is higher in the picture
    np.testing.assert_allclose(left + right, [[639, row * 2] for row in left[:, 1]], atol=0.2)  # symmetric
    # 5 m ahead of the camera's foot, half of a lane's width is at column 319.5 - f 1.75 / depth.
    assert left[0, 0] == pytest.approx(319.5 - 320 * 1.75 / depth_m(5.0), abs=0.2)


def depth_m(ahead_m: float) -> float:
    """Return the depth, along the camera's axis, of a point on the ground."""
    model = CameraModel(width_px=640, height_px=480)
    return float((ahead_m - model.x_m) * np.cos(model.pitch_rad) + model.z_m * np.sin(model.pitch_rad))


def test_the_lines_of_a_curved_lane_are_half_a_width_from_its_middle() -> None:
    """Projected back to the ground, both lines are at half of the lane's width from the centre line."""
    lane = Lane(centre=(0.3, 0.05, 0.01), width_m=3.0, near_m=6.0, far_m=20.0, confidence=1.0)
    model = CameraModel(width_px=640, height_px=480)
    centre = np.array([(x, 0.3 + 0.05 * x + 0.01 * x**2) for x in np.linspace(0, 30, 3001)])
    for line in lane_lines(CAMERA, lane):
        for column, row in line:
            side, down = (column - 319.5) / 320, (row - 239.5) / 320
            ahead = (np.cos(model.pitch_rad) - down * np.sin(model.pitch_rad)) / (
                np.sin(model.pitch_rad) + down * np.cos(model.pitch_rad)
            )
            x = model.x_m + ahead * model.z_m
            depth = (x - model.x_m) * np.cos(model.pitch_rad) + model.z_m * np.sin(model.pitch_rad)
            distance_m = np.hypot(*(centre - (x, -side * depth)).T).min()
            assert distance_m == pytest.approx(1.5, abs=0.1)


def test_no_lane_is_sent_as_such() -> None:
    """A lane without confidence has no lines, and is sent, so that the page draws the picture at once."""
    bench = WatchBench()
    (send,) = bench.deliver("lane", LaneSeen(WALL_NS, Lane((0.0, 0.0, 0.0), 3.5, 5.0, 25.0, 0.0)))
    lane = json.loads(send.payload)
    assert (lane["left"], lane["right"]) == ([], [])


def test_points_behind_the_camera_are_left_out() -> None:
    """Points of a lane that begins behind the camera are left out."""
    left, right = lane_lines(CAMERA, Lane((0.0, 0.0, 0.0), 3.5, -20.0, 20.0, 1.0))
    assert 0 < len(left) == len(right) < 12


def test_a_page_commands_nothing() -> None:
    """Whatever a page sends, the node answers probes only, and sends nothing to another receiver than the page."""
    bench = WatchBench()
    bench.unit(1, is_keyframe=True)
    for message in COMMANDS:
        assert bench.page(**message) == []
    assert bench.node.counts["page_commands_dropped"] == len(COMMANDS)
    assert bench.page(type="lost") == []  # no keyframe is requested
    assert bench.deliver("watch_message", b"\xff", page=1) == []
    assert bench.node.counts["page_messages_unreadable"] == 1
    (answer,) = bench.page(type="probe", sent_us=5)
    assert (answer.channel, answer.peer) == ("watch_status", 1)
    assert json.loads(answer.payload)["sent_us"] == 5


def test_the_status_tells_what_the_vehicle_does() -> None:
    """A page's status has the vehicle's state, the controller and its last command, and the latencies."""
    bench = WatchBench()
    status = bench.status()
    assert (status["controller"], status["role"], status["safety"]) == ("lane_keeper", "watches", "")
    assert status["can_drive"] is False
    bench.deliver("picture", PictureRead(WALL_NS, True, "", False, True, 1, 1, 1, 1, WALL_NS + 30 * NS_PER_MS))
    bench.deliver("picture", PictureRead(None, False, "no picture", True, False, 1, 1, 1, 1, WALL_NS))
    bench.deliver("control", encode(Command(1, 5, 1, 1, 1, 0.2, 0.3, 0.0, (0.0,) * PATH_POINTS, "drive", 0)))
    bench.deliver("reception", ReceptionSample(NS_PER_S, 9, 1, 0, 1, 0, 0, 0, 0, None))
    bench.mono_ns += 20 * NS_PER_MS
    bench.state(applied=5)
    status = bench.status()
    assert (status["safety"], status["speed_mps"], status["target_mps"]) == ("driving", 5.0, 8.0)
    assert status["command"] == [0.2, 0.3, 0.0]
    assert (status["video_ms"], status["round_trip_ms"], status["lost_share"]) == (30.0, 20.0, 0.1)
    assert status["has_control"] is True
    assert status["state_age_ms"] == 50.0


def test_the_status_has_the_speed_limit_of_a_governed_vehicle() -> None:
    """The speed limit with its reason is shown; it is null if the vehicle reports none."""
    bench = WatchBench()
    bench.state(applied=5)
    assert (bench.status()["speed_limit_mps"], bench.status()["speed_limit_reason"]) == (None, "")
    state = State(1, 1, 5.0, 0.1, "drive", "driving", "why", 5, "", speed_limit_mps=4.5, speed_limit_reason="latency")
    bench.deliver("state", encode(state))
    assert (bench.status()["speed_limit_mps"], bench.status()["speed_limit_reason"]) == (4.5, "latency")


def test_a_command_of_another_client_is_not_timed() -> None:
    """While another client has control, the sequence numbers that the vehicle applies are not this client's."""
    bench = WatchBench()
    bench.deliver("control", encode(Command(1, 5, 1, 1, 1, 0.2, 0.3, 0.0, (0.0,) * PATH_POINTS, "drive", 0)))
    bench.state(applied=5, operator="bob")
    status = bench.status()
    assert (status["has_control"], status["round_trip_ms"], status["active_operator"]) == (False, None, "bob")


def test_unreadable_messages_are_counted() -> None:
    """A state or command that cannot be decoded is counted and dropped."""
    bench = WatchBench()
    bench.deliver("state", b"\xc1")
    bench.deliver("control", b"\xc1")
    assert bench.node.counts["states_unreadable"] == bench.node.counts["commands_unreadable"] == 1


def test_without_pages_nothing_is_sent() -> None:
    """After its last page was closed, the node does not wake and sends nothing."""
    bench = WatchBench()
    bench.unit(1, is_keyframe=True)
    bench.page(type="ack", unit=9)
    bench.deliver("watch_closed", None, page=1)
    assert bench.node.next_wake_ns() is None
    assert bench.unit(2, is_keyframe=True) == []
    assert bench.deliver("lane", LaneSeen(WALL_NS, LANE)) == []
    assert bench.page(type="stop") == []
    assert bench.node.counts["page_acks_unknown"] == 1
