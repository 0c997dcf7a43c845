"""Make the targets for the console: requests to its site, and messages of a page that drives or only watches."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

import numpy as np
from benchmarks.fuzzing.mutation import Chance, Corpus
from benchmarks.fuzzing.target import START, NodeBench, Target, expect, total

from lavt.control.client_limits import CLIENT_LIMITS
from lavt.control.human_controls import HUMAN_LIMITS, HumanControls
from lavt.domain import NS_PER_MS, NS_PER_US, CameraModel, Command, Lane, SessionReply, SessionRequest, State
from lavt.node import Send
from lavt.nodes.client_session import ClientSession
from lavt.nodes.human_driver import HumanDriverNode
from lavt.nodes.page_watch import PageWatchNode
from lavt.nodes.payloads import DecodedFrame, DelayChoice, LaneSeen, ReceivedUnit, RelayDelay
from lavt.nodes.picture_reader import PictureReader
from lavt.perception.calibration import calibrated_pinhole_camera
from lavt.transport.console.message_limit import MessageLimit
from lavt.transport.console.page_messages import MAX_DELAY_MS, PAGE_VERSION
from lavt.transport.console.site import SOCKET_PATH, ConsoleSite
from lavt.transport.messages import decode, encode
from lavt.transport.video.frame_codec import RenderedPicture, VideoReceiver
from lavt.transport.video.h264 import Decoder
from lavt.transport.video.stamp import rtp_timestamp

STEP_NS = 5 * NS_PER_MS
"""Time between two inputs."""
INPUTS_PER_TRUE_INPUT = 4
INPUTS_PER_FRAME = 7
INPUTS_AFTER_END = 20
"""This number of inputs after an emergency stop or a release, a new client takes the place of the old one."""
OPEN_HAND_INPUTS, HOLDING_INPUTS = 8, 60
"""In turn, the hand of the true inputs is open, and holds, for these numbers of inputs."""
INPUTS_PER_PAUSE = 150
PAUSE_NS = 300 * NS_PER_MS
"""The pages pause this often, for this long."""
FEWEST_INPUTS = 1000
"""After fewer inputs than this, a target need not have driven."""
HEIGHT_PX, WIDTH_PX = 96, 128
PORT, TOKEN = 8123, "0123456789abcdef"
INPUT = {"type": "input", "seen_us": 0, "held": True, "live": True, "steering": 0.5, "throttle": 0.5, "brake": 0.0}
SHOWN_TIMES = ("arrived_us", "decoded_us", "drawn_us", "shown_us")
MESSAGES: tuple[Mapping[str, Any], ...] = (
    INPUT,
    {**INPUT, "held": False},
    {**INPUT, "live": False, "steering": -1.0},
    {"type": "ack", "unit": 7},
    {"type": "shown", "unit": 7, "stamp": "7", **dict.fromkeys(SHOWN_TIMES, 7), "offset_us": -1.5, "bound_us": 60.0},
    {"type": "probe", "sent_us": 7},
    {"type": "lost"},
    {"type": "stop"},
    {"type": "drive"},
    {"type": "release"},
    {"type": "delay", "video_ms": 225.0, "control_ms": 100.0},
)


def page_corpus() -> Corpus:
    """Return the corpus of the messages of a page."""
    return Corpus([json.dumps(message).encode() for message in MESSAGES], is_json=True)


def as_received(data: bytes, chance: Chance) -> str | bytes:
    """Return an input as the socket delivers it: most are texts, if they are valid UTF-8."""
    try:
        return data if chance.below(8) == 0 else data.decode()
    except UnicodeDecodeError:
        return data


def as_object(data: str | bytes) -> Mapping[str, Any]:
    """Return the JSON object of a message, read leniently; empty for anything else."""
    try:
        value = json.loads(data)
    except (ValueError, RecursionError):
        return {}
    return value if isinstance(value, dict) else {}


def new_human_driver() -> HumanDriverNode:
    """Make the driver node of a person."""
    return HumanDriverNode(
        PictureReader(VideoReceiver(Decoder(), (HEIGHT_PX, WIDTH_PX))),
        HumanControls(wheelbase_m=2.8448),
        ClientSession("alice", 7, rearm=True, start_ns=START.mono_ns, clear_stop=True),
        CLIENT_LIMITS,
        DelayChoice((("L0", 0.0, 0.0),), RelayDelay(0.0, 0.0)),
    )


class DrivingPages:
    """A person's driver node with a page that drives and one that watches, and the checks of what the node sends."""

    def __init__(self) -> None:
        self.commands = self.drive_commands = self.inputs = 0
        self.rejected_before_restarts = 0
        self._held_ns = 0
        """When the driving page last sent an input that holds, or a message that could be one; 0: the hand is open."""
        self._is_stopped = False
        """The client has made an emergency stop."""
        self._state_number = 0
        self._bench = NodeBench(new_human_driver(), self._check)
        self._limits: dict[int, MessageLimit] = {}
        self._inputs_since_start = self._inputs_since_end = 0
        self._restart()

    def _restart(self) -> None:
        self.rejected_before_restarts = self.rejected_count()
        self._bench.node = new_human_driver()
        self._is_stopped = False
        self._inputs_since_start = self._inputs_since_end = 0
        self._limits = {1: MessageLimit(), 2: MessageLimit()}
        for page in self._limits:
            self._bench.deliver("page_opened", None, page)
        self._bench.deliver("session_reply", encode(SessionReply(True, "", 5, bytes(16), 5600, "kernel", 0)))

    def rejected_count(self) -> int:
        """Return how many messages were rejected."""
        counts = self._bench.node.counts
        rejected = total(counts, "page_messages_unreadable", "inputs_", "delays_rejected", "page_acks_unknown")
        return self.rejected_before_restarts + rejected

    def feed(self, _channel: str, data: bytes, chance: Chance) -> None:
        """Deliver an input from one of the pages; true messages of the page and the vehicle come in between."""
        self.inputs += 1
        self._inputs_since_start += 1
        if self._inputs_since_end >= INPUTS_AFTER_END:
            self._restart()
        page, message = 1 + chance.below(2), as_received(data, chance)
        self._limits[page].allows(message, self._bench.now.mono_ns)
        if page == 1 and as_object(message).get("held") is True:
            self._held_ns = self._bench.now.mono_ns  # perhaps: a damaged input may be invalid
        self._is_stopped |= as_object(message).get("type") == "stop"
        self._bench.deliver("page_message", message, page)
        node = self._bench.node
        assert isinstance(node, HumanDriverNode)
        expect(self._is_stopped or not node.session.emergency_stop, "a message that is no stop has stopped the vehicle")
        self._is_stopped = bool(node.session.emergency_stop)  # a stop with other fields is no stop
        self._inputs_since_end += self._is_stopped or not node.session.has_control
        self._bench.advance(STEP_NS if self.inputs % INPUTS_PER_PAUSE else PAUSE_NS)
        if self.inputs % INPUTS_PER_TRUE_INPUT == 0:
            self._deliver_true_messages()

    def _deliver_true_messages(self) -> None:
        bench, now = self._bench, self._bench.now
        self._state_number += 1
        state = State(now.wall_ns, self._state_number, 5.0, 0.0, "drive", "driving", "armed", 0, "", "", "alice", 7)
        bench.deliver("state", encode(state))
        is_held = self._inputs_since_start % (OPEN_HAND_INPUTS + HOLDING_INPUTS) > OPEN_HAND_INPUTS
        self._held_ns = now.mono_ns if is_held else 0
        bench.deliver("page_message", json.dumps({**INPUT, "seen_us": now.mono_ns // NS_PER_US, "held": is_held}), 1)
        unit = rtp_timestamp(now.wall_ns)
        if self.inputs % INPUTS_PER_FRAME == 0:
            picture = RenderedPicture(np.zeros((HEIGHT_PX, WIDTH_PX, 3), np.uint8))
            bench.deliver("access_unit", ReceivedUnit(b"unit", unit, True, True, now.mono_ns))
            bench.deliver("view", DecodedFrame(now.wall_ns, now.wall_ns, picture))
            bench.deliver("page_message", json.dumps({"type": "ack", "unit": unit}), 1)

    def _check(self, send: Send) -> None:
        """Check that the vehicle can decode what is sent to it, and that nothing drives without a hand that holds."""
        if send.channel == "control":
            command = decode(Command, send.payload)
            self.commands += 1
            expect(abs(command.steering_rad) <= HUMAN_LIMITS.steering_limit_rad, "a command steers too far")
            expect(command.mode == "stop" or not self._is_stopped, "a stopped client drives")
            if command.mode == "drive":
                self.drive_commands += 1
                age_ns = self._bench.now.mono_ns - self._held_ns
                expect(age_ns < HUMAN_LIMITS.input_timeout_ns, "a command drives, but no hand holds")
        elif send.channel == "session":
            decode(SessionRequest, send.payload)
        elif send.channel == "relay_delay":
            delays = (send.payload.video_ms, send.payload.control_ms)
            expect(all(0 <= delay_ms <= MAX_DELAY_MS for delay_ms in delays), "a delay out of range was chosen")
        elif send.channel == "page_status":
            json.loads(send.payload)

    def finish(self) -> str:
        """Check that the page drove, and return a summary."""
        expect(self.inputs < FEWEST_INPUTS or self.drive_commands > 0, "the page never drove")
        return f"{self.commands} commands, {self.drive_commands} of them in mode drive"


def driving_page(seed: int) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for the messages of two pages, one of which drives.

    Invariants: the vehicle can decode each command and request; no command drives without an input of the driving page
    that holds, at most 200 ms old; only a message of the type stop makes an emergency stop.
    """
    pages = DrivingPages()
    return Target({"page_message": page_corpus()}, pages.feed, pages.rejected_count, pages.finish)


def watching_page(seed: int) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for the messages of a page that watches. Invariant: messages are sent to this page only."""
    camera = calibrated_pinhole_camera(CameraModel(width_px=WIDTH_PX, height_px=HEIGHT_PX))
    node = PageWatchNode("lane_keeper", 8.0, camera, ("alice", 7))
    units = inputs = 0

    def on_send(send: Send) -> None:
        nonlocal units
        expect(send.channel in {"watch_unit", "watch_status"}, f"a watching page has sent on {send.channel}")
        expect(send.peer == 1, "a message to no page")
        units += send.channel == "watch_unit"
        if send.channel == "watch_status":
            json.loads(send.payload)

    bench = NodeBench(node, on_send)
    bench.deliver("watch_opened", None, 1)
    lane = Lane((0.3, 0.01, 0.001), 3.5, 3.6, 20.0, 1.0)

    def feed(channel: str, data: bytes, chance: Chance) -> None:
        nonlocal inputs
        inputs += 1
        bench.deliver(channel, as_received(data, chance), 1)
        bench.advance(STEP_NS)
        if inputs % INPUTS_PER_FRAME == 0:
            now = bench.now
            bench.deliver("access_unit", ReceivedUnit(b"unit", rtp_timestamp(now.wall_ns), True, True, now.mono_ns))
            bench.deliver("lane", LaneSeen(now.wall_ns, lane))
            ack = {"type": "ack", "unit": rtp_timestamp(now.wall_ns)}
            bench.deliver(channel, json.dumps(ack), 1)

    def rejected_count() -> int:
        return total(node.counts, "page_messages_unreadable", "page_commands_dropped", "page_acks_unknown")

    def finish() -> str:
        expect(inputs < FEWEST_INPUTS or units > 0, "the page got no picture")
        return f"{units} access units, {node.counts['page_commands_dropped']} commands dropped"

    return Target({"watch_message": page_corpus()}, feed, rejected_count, finish)


def console_site(seed: int) -> Target:  # noqa: ARG001 (it uses no random numbers)
    """Make a target for requests and hellos. Invariant: the socket needs this site's origin, host and token."""
    site = ConsoleSite(PORT, TOKEN)
    own = f"127.0.0.1:{PORT}"
    requests = [
        f"{method}\n{path}\n{host}\n{origin}".encode()
        for method in ("GET", "POST")
        for path in (SOCKET_PATH, "/", "/main.js?x", "/../secret")
        for host in (own, f"localhost:{PORT}", "attacker.example")
        for origin in (f"http://{own}", "null", "")
    ]
    hello = {"type": "hello", "version": PAGE_VERSION, "token": TOKEN}
    rejections = opened = greeted = 0

    def request(data: bytes) -> None:
        nonlocal rejections, opened
        method, path, host, origin = (data.decode("latin-1").split("\n") + [""] * 4)[:4]
        answer = site.answer(method, path, [host], [origin] if origin else [])
        if answer is None:
            opened += 1
            addresses = {f"{name}:{PORT}" for name in ("127.0.0.1", "[::1]", "localhost")}
            expect(host.lower() in addresses, "the socket was opened for another host")
            expect(origin.removeprefix("http://") in addresses, "the socket was opened for another origin")
        else:
            rejections += answer.status != 200

    def greet(data: str | bytes) -> None:
        nonlocal rejections, greeted
        if site.reject_hello(data) is None:
            greeted += 1
            expect(as_object(data).get("token") == TOKEN, "a page without the token was accepted")
        else:
            rejections += 1

    def feed(channel: str, data: bytes, chance: Chance) -> None:
        if channel == "request":
            request(data)
        else:
            greet(as_received(data, chance))

    corpora = {"request": Corpus(requests), "hello": Corpus([json.dumps(hello).encode()], is_json=True)}
    return Target(corpora, feed, lambda: rejections, lambda: f"{opened} sockets opened, {greeted} pages greeted")
