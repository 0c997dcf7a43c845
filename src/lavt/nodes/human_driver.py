"""The driver node of a person, who sees the video and drives in a web page (docs/drive.md).

Access units go to the page undecoded. The client decodes them, too, for their stamps: a command has the stamp of the
newest picture that the page has shown. So if the page stops, the vehicle gets no command from a newer picture.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import ClassVar, Final

from lavt.control.client_limits import ClientLimits
from lavt.control.human_controls import LOST, HumanControls, HumanInput
from lavt.domain import NS_PER_MS, NS_PER_S, NS_PER_US, Decision, Mode, Now
from lavt.errors import BadMessage
from lavt.node import WAKE, Message, Peer, Send, Stage
from lavt.nodes.client_session import ClientSession
from lavt.nodes.commander import Commander, stopping
from lavt.nodes.page_figures import BitRate, RoundTrip, vehicle_figures
from lavt.nodes.page_prediction import PagePredictor
from lavt.nodes.page_video import PageVideo
from lavt.nodes.payloads import (
    DecodedFrame,
    DelayChoice,
    FrameStamp,
    HumanSample,
    ReceivedUnit,
    RelayDelay,
)
from lavt.nodes.picture_reader import PictureReader
from lavt.nodes.shown_frames import ShownFrames
from lavt.transport.console.page_messages import (
    PageAck,
    PageDelay,
    PageDrive,
    PageInput,
    PageLost,
    PageProbe,
    PageRelease,
    PageShown,
    PageStatus,
    PageStop,
    ProbeAnswer,
    pack_text,
    pack_unit,
    parse_page_message,
)
from lavt.transport.rtp.reception_stats import ReceptionSample

STATUS_PERIOD_NS: Final = 50 * NS_PER_MS
STATE_AGE_NS: Final = 300 * NS_PER_MS
"""An older state does not tell what the vehicle does now."""
SEAT_NS: Final = 5 * NS_PER_S
"""After this long without an input from the driving page, another page can drive."""
COMMAND_GAP_NS: Final = 5 * NS_PER_MS
"""Between commands that inputs cause; a page sends an input every 20 ms, but can send bursts."""
IDLE_COMMAND_NS: Final = 100 * NS_PER_MS
"""A command that is older is no longer shown as the last one."""


class HumanDriverNode(Commander):
    """The node that drives by the inputs of a person, from one page at a time; other pages watch.

    `delays` are those that the person can choose; None: this client cannot change the delays. Without `shows_latency`,
    the pages show no latencies and no lost packets. With a `predictor`, they show its predictions.
    """

    def __init__(
        self,
        reader: PictureReader,
        controls: HumanControls,
        session: ClientSession,
        limits: ClientLimits,
        delays: DelayChoice | None = None,
        *,
        shows_latency: bool = True,
        predictor: PagePredictor | None = None,
    ) -> None:
        super().__init__(session, limits)
        self._reader = reader
        self._controls = controls
        self._shows_latency, self._predictor = shows_latency, predictor
        self._conditions = () if delays is None else delays.conditions
        self._delay = None if delays is None else delays.initial
        self._pages: dict[Peer, PageVideo] = {}
        self._page_counts: Counter[str] = Counter()
        """Counts of closed pages."""
        self._driving_page: Peer = None
        self._was_driving = False
        """The session was driving when it was last examined."""
        self._status_ns = 0
        self._hand: str = "no_page"
        """The state of the hand in the last record entry."""
        self._shown = ShownFrames()
        self._bit_rate, self._round_trip = BitRate(), RoundTrip()
        self._reception: ReceptionSample | None = None
        self._last: tuple[int, Decision] | None = None
        """Time and content of the last command."""
        self.pipelines: Mapping[str, Sequence[Stage]] = {
            **self._session_pipelines,
            "access_unit": (("forward", self._forward),),
            "unit_to_decode": reader.stages,
            "video_reception": (("note", self._note_reception),),
            "view": (("note", self._note_view),),
            "page_opened": (("note", self._open_page),),
            "page_closed": (("note", self._close_page),),
            "page_message": (("handle", self._handle_page_message),),
            WAKE: (("wake", self._wake_all),),
        }

    @property
    def counts(self) -> Mapping[str, int]:
        """Return the counts of the node, its picture reader, the controls and the pages."""
        pages = sum((page.counts for page in self._pages.values()), self._page_counts)
        return {**self._reader.counts, **self._controls.counts, **pages, **self._shown.counts, **self._counts}

    def next_wake_ns(self) -> int | None:
        """Return when a command, a session request or a status is due."""
        wake_ns = super().next_wake_ns()
        if not self._pages:
            return wake_ns
        return self._status_ns if wake_ns is None else min(wake_ns, self._status_ns)

    def _wake_all(self, message: Message, now: Now) -> list[Send]:
        sends = self._wake(message, now)
        if self._pages and now.mono_ns >= self._status_ns:
            self._status_ns = now.mono_ns + STATUS_PERIOD_NS
            sends += [*self._record_hand(now), *self._statuses(now)]
        return sends

    # Video.

    def _forward(self, message: Message, now: Now) -> list[Send]:
        """Send an access unit to the pages, and then decode it."""
        unit: ReceivedUnit = message.payload
        self._bit_rate.note(len(unit.data), now.mono_ns)
        pages = [peer for peer, video in self._pages.items() if video.offer(unit)]
        sends = []
        if pages:
            sent_us = now.mono_ns // NS_PER_US
            packed = pack_unit(unit.data, unit.rtp_timestamp, is_keyframe=unit.keyframe, sent_us=sent_us)
            sends = [*self._predict(unit, pages, now), *(Send("page_unit", packed, peer) for peer in pages)]
        return [*sends, Send("unit_to_decode", unit)]

    def _predict(self, unit: ReceivedUnit, pages: Sequence[Peer], now: Now) -> list[Send]:
        """Return what is predicted for the picture of a unit; the page has it before the picture."""
        prediction = None if self._predictor is None else self._predictor.message(unit.rtp_timestamp, now)
        return [] if prediction is None else [Send("page_status", pack_text(prediction), peer) for peer in pages]

    def _note_view(self, message: Message, now: Now) -> None:
        frame: DecodedFrame = message.payload
        if self._predictor is not None:
            self._predictor.note_picture(frame.stamp_ns)
        self._decide_from(self._shown.note_decoded(frame), now)

    def _note_reception(self, message: Message, _now: Now) -> None:
        self._reception = message.payload

    def _acknowledge(self, page: Peer, ack: PageAck, now: Now) -> list[Send]:
        is_known = self._pages[page].acknowledge(ack.unit)
        if is_known and page == self._driving_page:
            self._decide_from(self._shown.show(ack.unit), now)
        return self._request_keyframe(page)

    def _decide_from(self, frame: FrameStamp | None, now: Now) -> None:
        """Decide from a frame that the page has shown, and that this client has decoded, too; None: there is none."""
        if frame is not None:
            self._view, self._view_ns = frame, now.mono_ns

    def _record_shown(self, page: Peer, shown: PageShown, _now: Now) -> list[Send]:
        """Record when the driving page had a picture, unless the page has read another stamp than this client."""
        picture = self._shown.times(shown) if page == self._driving_page else None
        return [] if picture is None else [Send("page_picture", picture)]

    def _lose_video(self, page: Peer, _lost: PageLost, _now: Now) -> list[Send]:
        self._pages[page].lose()
        return self._request_keyframe(page)

    def _request_keyframe(self, page: Peer) -> list[Send]:
        """Return a request for a keyframe if the driving page waits for one; a page that watches gets the next one."""
        is_needed = page == self._driving_page and self._pages[page].needs_keyframe
        return [Send("picture_lost", None)] if is_needed else []

    # Pages.

    def _open_page(self, message: Message, now: Now) -> list[Send]:
        self._pages[message.peer] = PageVideo()
        self._status_ns = now.mono_ns
        self._counts["pages_opened"] += 1
        return self._drive_from(message.peer, None, now)

    def _close_page(self, message: Message, now: Now) -> list[Send]:
        video = self._pages.pop(message.peer, None)
        if video is not None:
            self._page_counts += video.counts
        if message.peer == self._driving_page:
            self._driving_page = None
            self._forget_view()
            self._controls.detach()
        return self._record_hand(now)

    def _is_seat_free(self, now: Now) -> bool:
        """Return whether no page drives: none has begun to, or the one that has is silent, as if frozen."""
        return self._driving_page is None or self._controls.silent_ns(now.mono_ns) >= SEAT_NS

    def _drive_from(self, page: Peer, _request: PageDrive | None, now: Now) -> list[Send]:
        """Let a page drive if no other page does."""
        if not self._is_seat_free(now) or page == self._driving_page:
            return []
        self._driving_page = page
        self._forget_view()
        self._controls.attach(now.mono_ns)
        return [*self._record_hand(now), *self._request_keyframe(page)]

    def _forget_view(self) -> None:
        """Make no command from a picture of another page; after an emergency stop, commands still carry it."""
        self._shown.forget_awaited()
        if not self.session.emergency_stop:
            self._view = None

    def _handle_page_message(self, message: Message, now: Now) -> list[Send]:
        if message.peer not in self._pages:  # it was closed in the meantime
            return []
        try:
            parsed = parse_page_message(message.payload)
        except BadMessage:
            self._counts["page_messages_unreadable"] += 1
            return []
        if isinstance(parsed, PageProbe):
            arrived_us, now_us = message.arrived.wall_ns // NS_PER_US, now.wall_ns // NS_PER_US
            return [Send("page_status", pack_text(ProbeAnswer(parsed.sent_us, arrived_us, now_us)), message.peer)]
        return self._PAGE_MESSAGES[type(parsed)](self, message.peer, parsed, now)

    def _handle_input(self, page: Peer, new: PageInput, now: Now) -> list[Send]:
        if page != self._driving_page:
            self._counts["inputs_without_control"] += 1
            return []
        self._lock_after_drive()
        self._controls.handle(
            HumanInput(new.seen_us * NS_PER_US, new.held, new.live, new.steering, new.throttle, new.brake), now.mono_ns
        )
        self._hand = self._controls.hand(now.mono_ns)
        sample = HumanSample(now.mono_ns, self._hand, new.steering, new.throttle, new.brake)
        return [*self._command_after_input(now), Send("human_input", sample)]

    def _command_after_input(self, now: Now) -> list[Send]:
        """Return a command at once, or let it be due later if the last one has just been sent."""
        due_ns = 0 if self._last is None else self._last[0] + COMMAND_GAP_NS
        if now.mono_ns >= due_ns:
            return self._command(now)
        self._command_ns = due_ns
        return []

    def _stop(self, _page: Peer, _stop: PageStop, now: Now) -> list[Send]:
        """Make an emergency stop, also for a page that watches.

        A repeated request is the same stop, unless this client does not know whether the vehicle is still stopped.
        """
        session, state = self.session, self._newest_state
        is_known = now.mono_ns - self._state_ns < STATE_AGE_NS
        is_stopped = state is not None and state.safety == "emergency_stop" and is_known
        if session.emergency_stop and (is_stopped or not session.is_stop_confirmed):
            return []
        return self._raise_emergency_stop(now)

    def _release_from(self, page: Peer, _request: PageRelease, now: Now) -> list[Send]:
        """Release control, for the driving page only; the vehicle stops."""
        return self._release(now) if page == self._driving_page else []

    def _change_delay(self, page: Peer, delay: PageDelay, _now: Now) -> list[Send]:
        if self._delay is None or page != self._driving_page:
            self._counts["delays_rejected"] += 1
            return []
        self._delay = RelayDelay(delay.video_ms, delay.control_ms)
        return [Send("relay_delay", self._delay)]

    _PAGE_MESSAGES: ClassVar[dict[type, Callable[..., list[Send]]]] = {
        PageInput: _handle_input,
        PageAck: _acknowledge,
        PageShown: _record_shown,
        PageLost: _lose_video,
        PageStop: _stop,
        PageDrive: _drive_from,
        PageRelease: _release_from,
        PageDelay: _change_delay,
    }

    def _record_hand(self, now: Now) -> list[Send]:
        """Return a record entry if the state of the hand has changed without an input."""
        hand = self._controls.hand(now.mono_ns)
        if hand == self._hand:
            return []
        self._hand = hand
        return [Send("human_input", HumanSample(now.mono_ns, hand, 0.0, 0.0, 0.0))]

    # Commands.

    def _choose(self, now_ns: int) -> tuple[Mode, Decision] | None:
        """Return what the person commands; None if the page or the hand is lost: the vehicle then stops by itself."""
        hand = self._controls.hand(now_ns)
        decision = self._controls.decide(self._speed_mps)
        if self.session.emergency_stop:
            return "stop", stopping(decision)
        if hand in LOST:
            return None
        if self.session.phase != "driving":
            is_ready = hand == "held" and self._controls.is_neutral
            return ("arm", Decision(0.0, 0.0, 1.0, decision.path_curvature_per_m)) if is_ready else None
        if hand != "held":
            return "stop", stopping(decision)
        return self._limited_by_age(decision, now_ns)

    def _note_command(self, decision: Decision, now: Now) -> None:
        self._round_trip.note_command(self._sequence, now.mono_ns)
        self._last = now.mono_ns, decision
        if self._predictor is not None:
            self._predictor.history.note_command(self._sequence, decision.steering_rad, now.mono_ns)

    def _note_state(self, message: Message, now: Now) -> None:
        super()._note_state(message, now)
        self._lock_after_drive()

    def _lock_after_drive(self) -> None:
        """Lock the latch when a drive has ended, for whatever reason, so that only a fresh press arms again."""
        is_driving = self.session.phase == "driving"
        if self._was_driving and not is_driving:
            self._controls.lock()
        self._was_driving = is_driving

    def _handle_newer_state(self, now: Now) -> None:
        state = self._newest_state
        if state is not None and self.session.has_control:
            self._round_trip.note_applied(state.applied_sequence, now.mono_ns)
            if self._predictor is not None:
                self._predictor.history.note_state(state, now.mono_ns)
        elif self._predictor is not None:
            self._predictor.history.forget()

    # Status.

    def _statuses(self, now: Now) -> list[Send]:
        return [Send("page_status", pack_text(self._status(page, now)), page) for page in self._pages]

    def _status(self, page: Peer, now: Now) -> PageStatus:
        state, session, view = self._newest_state, self.session, self._view
        last, shows, round_trip_ns = self._last, self._shows_latency, self._round_trip.newest_ns
        is_current = last is not None and now.mono_ns - last[0] < IDLE_COMMAND_NS
        stop = "none" if not session.emergency_stop else "confirmed" if session.is_stop_confirmed else "sent"
        return PageStatus(
            sent_us=now.mono_ns // NS_PER_US,
            role="drives" if page == self._driving_page else "watches",
            can_drive=self._is_seat_free(now),
            hand=self._hand,
            phase=session.phase,
            session_reason=session.reason,
            has_control=session.has_control,
            speed_mps=None if state is None else state.speed_mps,
            target_mps=self._controls.speed_mps,
            steering_rad=None if state is None else state.steering_rad,
            state_age_ms=None if state is None else (now.mono_ns - self._state_ns) / NS_PER_MS,
            emergency_stop=stop,  # type: ignore[arg-type]
            command=(last[1].steering_rad, last[1].throttle, last[1].brake) if last and is_current else None,
            shows_latency=shows,
            video_ms=None if view is None or not shows else (view.read_wall_ns - view.stamp_ns) / NS_PER_MS,
            round_trip_ms=None if round_trip_ns is None or not shows else round_trip_ns / NS_PER_MS,
            bit_rate_bps=self._bit_rate.at_bps(now.mono_ns),
            lost_share=None if self._reception is None or not shows else self._reception.lost_share,
            delay=None if self._delay is None else (self._delay.video_ms, self._delay.control_ms),
            conditions=self._conditions,
            **vehicle_figures(state, shows_latency=shows),
        )
