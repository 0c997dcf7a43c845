"""The node of a client's pages that watch a controller drive (docs/drive.md).

It observes what the client's nodes send and receive, and sends messages to the pages only: so no page can command the
vehicle, request a keyframe, or change the video that the controller gets. Its thread is not that of the driver node.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from lavt.domain import NS_PER_MS, NS_PER_US, Command, FloatArray, Lane, Now, State
from lavt.errors import BadMessage
from lavt.node import WAKE, Message, Peer, Send, Stage
from lavt.nodes.page_figures import BitRate, RoundTrip, vehicle_figures
from lavt.nodes.page_video import PageVideo
from lavt.nodes.payloads import LaneSeen, PictureRead, ReceivedUnit
from lavt.perception.calibration import CalibratedCamera, picture_points
from lavt.transport.console.page_messages import (
    PageAck,
    PageLane,
    PageLost,
    PageProbe,
    PageShown,
    PageStatus,
    ProbeAnswer,
    pack_text,
    pack_unit,
    parse_page_message,
)
from lavt.transport.messages import decode
from lavt.transport.rtp.reception_stats import ReceptionSample
from lavt.transport.video.stamp import rtp_timestamp

STATUS_PERIOD_NS: Final = 50 * NS_PER_MS
MAX_UNACKNOWLEDGED: Final = 8
"""A page that watches acknowledges later than one that drives, because each picture waits for its lane, and no keyframe
is requested for it. So it may be further behind: by a quarter of a second at 30 Hz."""
LANE_POINTS: Final = 12
"""Points of each line of a lane. On a curve of 10 m radius, 12 points over 20 m are a fifth of a metre from it at
most."""


class PageWatchNode:
    """The node that shows pages how `controller` drives, with a target speed of `target_mps`.

    It sends each access unit undecoded, and for each picture the lane that the controller detected in it. The pages may
    only acknowledge pictures and probe the clock; everything else that they send is counted and dropped.
    `client` is the name and the instance of this client, which the vehicle reports while the client has control.
    """

    name = "page_watch"

    def __init__(self, controller: str, target_mps: float, camera: CalibratedCamera, client: tuple[str, int]) -> None:
        self._counts: Counter[str] = Counter()
        """Counts of the node and of closed pages."""
        self._controller = controller
        self._target_mps = target_mps
        self._camera = camera
        self._client = client
        self._pages: dict[Peer, PageVideo] = {}
        self._status_ns = 0
        self._bit_rate, self._round_trip = BitRate(), RoundTrip()
        self._reception: ReceptionSample | None = None
        self._video_ms: float | None = None
        self._command: Command | None = None
        self._state: State | None = None
        self._state_ns = 0
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            "access_unit": (("forward", self._forward),),
            "picture": (("note", self._note_picture),),
            "lane": (("forward", self._forward_lane),),
            "control": (("note", self._note_command),),
            "state": (("note", self._note_state),),
            "reception": (("note", self._note_reception),),
            "watch_opened": (("note", self._open_page),),
            "watch_closed": (("note", self._close_page),),
            "watch_message": (("handle", self._handle_message),),
            WAKE: (("send", self._send_statuses),),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the counts of the node and of the pages."""
        return sum((page.counts for page in self._pages.values()), self._counts)

    def next_wake_ns(self) -> int | None:
        """Return when the next status is due; None without pages."""
        return self._status_ns if self._pages else None

    # What the client's nodes send and receive.

    def _forward(self, message: Message, now: Now) -> list[Send]:
        unit: ReceivedUnit = message.payload
        self._bit_rate.note(len(unit.data), now.mono_ns)
        pages = [page for page, video in self._pages.items() if video.offer(unit)]
        if not pages:
            return []
        sent_us = now.mono_ns // NS_PER_US
        packed = pack_unit(unit.data, unit.rtp_timestamp, is_keyframe=unit.keyframe, sent_us=sent_us)
        return [Send("watch_unit", packed, page) for page in pages]

    def _note_picture(self, message: Message, _now: Now) -> None:
        picture: PictureRead = message.payload
        if picture.stamp_ns is not None:
            self._video_ms = (picture.read_wall_ns - picture.stamp_ns) / NS_PER_MS

    def _forward_lane(self, message: Message, _now: Now) -> list[Send]:
        """Send the lane of a picture, also if none was detected: a page waits for it before it draws the picture."""
        if not self._pages:
            return []
        seen: LaneSeen = message.payload
        left, right = lane_lines(self._camera, seen.lane)
        lane = pack_text(
            PageLane(
                unit=rtp_timestamp(seen.stamp_ns),
                stamp=str(seen.stamp_ns),
                confidence=seen.lane.confidence,
                left=left,
                right=right,
            )
        )
        return [Send("watch_status", lane, page) for page in self._pages]

    def _note_command(self, message: Message, now: Now) -> None:
        try:
            self._command = decode(Command, message.payload)
        except BadMessage:  # the vehicle cannot decode it, either
            self._counts["commands_unreadable"] += 1
            return
        self._round_trip.note_command(self._command.sequence, now.mono_ns)

    def _note_state(self, message: Message, now: Now) -> None:
        try:
            state = decode(State, message.payload)
        except BadMessage:
            self._counts["states_unreadable"] += 1
            return
        self._state, self._state_ns = state, now.mono_ns
        if self._has_control:
            self._round_trip.note_applied(state.applied_sequence, now.mono_ns)

    def _note_reception(self, message: Message, _now: Now) -> None:
        self._reception = message.payload

    # Pages.

    def _open_page(self, message: Message, now: Now) -> None:
        self._pages[message.peer] = PageVideo(MAX_UNACKNOWLEDGED)
        self._status_ns = now.mono_ns
        self._counts["pages_opened"] += 1

    def _close_page(self, message: Message, _now: Now) -> None:
        video = self._pages.pop(message.peer, None)
        if video is not None:
            self._counts += video.counts

    def _handle_message(self, message: Message, now: Now) -> list[Send]:
        video = self._pages.get(message.peer)
        if video is None:  # it was closed in the meantime
            return []
        try:
            parsed = parse_page_message(message.payload)
        except BadMessage:
            self._counts["page_messages_unreadable"] += 1
            return []
        if isinstance(parsed, PageProbe):
            arrived_us, now_us = message.arrived.wall_ns // NS_PER_US, now.wall_ns // NS_PER_US
            return [Send("watch_status", pack_text(ProbeAnswer(parsed.sent_us, arrived_us, now_us)), message.peer)]
        if isinstance(parsed, PageAck):
            video.acknowledge(parsed.unit)
        elif isinstance(parsed, PageLost):
            video.lose()
        elif not isinstance(parsed, PageShown):
            self._counts["page_commands_dropped"] += 1
        return []

    # Status.

    @property
    def _has_control(self) -> bool:
        state = self._state
        return state is not None and (state.active_operator, state.active_operator_instance) == self._client

    def _send_statuses(self, _message: Message, now: Now) -> list[Send]:
        if not self._pages or now.mono_ns < self._status_ns:
            return []
        self._status_ns = now.mono_ns + STATUS_PERIOD_NS
        status = pack_text(self._status(now))
        return [Send("watch_status", status, page) for page in self._pages]

    def _status(self, now: Now) -> PageStatus:
        state, command, round_trip_ns = self._state, self._command, self._round_trip.newest_ns
        return PageStatus(
            sent_us=now.mono_ns // NS_PER_US,
            role="watches",
            can_drive=False,
            hand="no_page",
            phase="",
            session_reason="",
            has_control=self._has_control,
            speed_mps=None if state is None else state.speed_mps,
            target_mps=self._target_mps,
            steering_rad=None if state is None else state.steering_rad,
            state_age_ms=None if state is None else (now.mono_ns - self._state_ns) / NS_PER_MS,
            emergency_stop="none",
            command=None if command is None else (command.steering_rad, command.throttle, command.brake),
            video_ms=self._video_ms,
            round_trip_ms=None if round_trip_ns is None else round_trip_ns / NS_PER_MS,
            bit_rate_bps=self._bit_rate.at_bps(now.mono_ns),
            lost_share=None if self._reception is None else self._reception.lost_share,
            delay=None,
            controller=self._controller,
            **vehicle_figures(state, shows_latency=True),
        )


Line = tuple[tuple[float, float], ...]


def lane_lines(camera: CalibratedCamera, lane: Lane) -> tuple[Line, Line]:
    """Return the left and the right line of a lane as points (column, row) in the picture, the nearest first.

    Points that the camera does not see are left out. Without confidence, both lines are empty.
    """
    if lane.confidence <= 0:
        return (), ()
    x_m = np.linspace(lane.near_m, lane.far_m, LANE_POINTS)
    c0, c1, c2 = lane.centre
    slope = c1 + 2 * c2 * x_m
    length = np.sqrt(1 + slope**2)
    centre_m = np.column_stack([x_m, c0 + c1 * x_m + c2 * x_m**2])
    to_left_m = np.column_stack([-slope / length, 1 / length]) * lane.width_m / 2
    return _in_picture(camera, centre_m + to_left_m), _in_picture(camera, centre_m - to_left_m)


def _in_picture(camera: CalibratedCamera, ground_m: FloatArray) -> Line:
    points = picture_points(camera, ground_m)
    seen = points[np.isfinite(points).all(axis=1)].round(1)
    return tuple((float(column), float(row)) for column, row in seen)
