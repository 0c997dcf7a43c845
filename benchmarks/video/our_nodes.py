"""LAVT's half of the benchmark: video nodes and their runtime, as `lavt server` and `lavt client` build them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from benchmarks.video.pictures import memory_map_pictures, picture_of
from benchmarks.video.run import GOP_FRAMES, RATE_HZ, VBV_MS, Run

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.fidelity import VIDEO
from lavt.assembly.nodes import build_client, build_server
from lavt.assembly.vehicles import VehicleSetup, build_geometry_setup
from lavt.clock import MachineClock
from lavt.config import ClientConfig, ServerConfig
from lavt.domain import CameraModel, Now, Pose
from lavt.node import Message, Node, Send, Stage
from lavt.nodes.picture_reader import PictureReader
from lavt.nodes.watcher import WatcherNode
from lavt.runtime.realtime import RealRuntime
from lavt.transport.udp_link import UdpLink
from lavt.transport.video.frame_codec import PictureReceiver
from lavt.vehicle.camera import CapturedFrame

LOOPBACK = "127.0.0.1"


class RepeatingCamera:
    """A camera that repeats the run's pictures. It copies each, in I420, into a buffer, as GStreamer's sender does."""

    rate_hz = float(RATE_HZ)
    phase_ns = 0

    def __init__(self, run: Run) -> None:
        self.model = CameraModel(run.width_px, run.height_px)
        self._pictures = memory_map_pictures(run.pictures_stem)
        self._planes = self._pictures[0].copy()

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame:  # noqa: ARG002 (nothing moves)
        """Return frame `number`."""
        self._planes[:] = picture_of(self._pictures, number)
        return CapturedFrame(number, at_ns, self._planes)


class DiscardingNode:
    """A node that discards all messages on the given channels."""

    counts: Mapping[str, int] = {}

    def __init__(self, name: str, *, channels: Sequence[str]) -> None:
        self.name = name
        self.pipelines: Mapping[str, Sequence[Stage]] = dict.fromkeys(channels, (("discard", _discard),))

    def next_wake_ns(self) -> None:
        """Return None: the node is never woken."""


def _discard(_message: Message, _now: Now) -> None: ...


class NullLink:
    """A link that discards messages."""

    def send(self, *sends: Send) -> None:
        """Discard messages."""


class MessageRecorder(Protocol):
    """A recorder, which gets every message that a run's record would contain."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Record a message."""
        ...


class ProcessRuntime:
    """LAVT's part of a sending or receiving process: nodes, video socket and runtime."""

    def __init__(self, channel: str, recorder: MessageRecorder, *, remote: tuple[str, int] | None = None) -> None:
        self.clock = MachineClock()
        self.runtime: RealRuntime | None = None
        self._recorder = recorder
        self._link = UdpLink(self.clock, channel, bind=(LOOPBACK, 0), remote=remote)

    @property
    def port(self) -> int:
        """The port of the video socket."""
        return self._link.port

    def start(self, nodes: Sequence[Node]) -> RealRuntime:
        """Start the nodes, then receive messages."""
        self.runtime = RealRuntime(self.clock, nodes, self._recorder, lambda: None)
        self.runtime.start({"video": self._link, "zenoh": NullLink()})
        self._link.start(self._deliver)
        return self.runtime

    def close(self) -> None:
        """Stop the runtime and close the socket; raise the error that stopped a node, if there is one."""
        if self.runtime is not None:
            self.runtime.stop()
        self._link.close()
        if self.runtime is not None and self.runtime.failed is not None:
            raise self.runtime.failed

    def _deliver(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        if self.runtime is not None and not self.runtime.stopped.is_set():
            self.runtime.deliver(channel, payload, arrived, peer)


def build_sender_nodes(run: Run, clock: MachineClock, port: int) -> Sequence[Node]:
    """Build the server's camera node with a `RepeatingCamera`, and a node that discards messages to the actuator."""
    config = ServerConfig.model_validate(
        {
            "camera": {"width_px": run.width_px, "height_px": run.height_px, "rate_hz": RATE_HZ},
            "video": {"bit_rate_bps": run.bit_rate_bps, "gop_frames": GOP_FRAMES, "buffer_ms": VBV_MS},
        }
    )

    def vehicle_setup(config: ServerConfig) -> VehicleSetup:
        return replace(build_geometry_setup(config), camera=RepeatingCamera(run))

    fidelity = replace(VIDEO, vehicle_setup=vehicle_setup)
    nodes = build_server(config, clock.now, MachineEntropy(), host="", video_port=port, fidelity=fidelity)
    return [nodes.camera, DiscardingNode(name="actuator", channels=("frame",))]


class LastPictureDecoder:
    """A `PictureReceiver`, the client's decoder, which keeps the picture whose stamp was read last."""

    def __init__(self, decoder: PictureReceiver) -> None:
        self.last: Any = None
        self.decode = decoder.decode
        self._read_stamp = decoder.read_stamp

    def read_stamp(self, received: Any) -> int:
        """Read the stamp and keep the picture."""
        self.last = received
        return self._read_stamp(received)


def build_receiver_nodes(run: Run, clock: MachineClock) -> tuple[Sequence[Node], LastPictureDecoder]:
    """Build the client's receiver node and a watcher node; return both nodes, and the watcher's decoder."""
    size = {"width_px": run.width_px, "height_px": run.height_px}
    config = ClientConfig.model_validate({"camera": {**size, "rate_hz": RATE_HZ}})
    decoder = LastPictureDecoder(VIDEO.receiver(config))
    receiver_node = build_client(config, clock.now, MachineEntropy()).receiver
    return [receiver_node, WatcherNode(PictureReader(decoder))], decoder
