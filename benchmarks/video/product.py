"""Our two sides as `lavt server` and `lavt client` build them, less what has nothing to do with the video."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any, Protocol

from benchmarks.video.pictures import picture_of, planes_loop
from benchmarks.video.run import GOP_FRAMES, RATE_HZ, VBV_MS, Run

from lavt.assembly.entropy import MachineEntropy
from lavt.assembly.fidelity import VIDEO
from lavt.assembly.nodes import build_client, build_server
from lavt.assembly.vehicles import VehicleSetup, build_geometry_setup
from lavt.clock import MachineClock
from lavt.config import ClientConfig, ServerConfig
from lavt.domain import CameraModel, Now, Pose
from lavt.node import Hop, Message, Node, Send
from lavt.nodes.picture_reader import PictureReader
from lavt.nodes.watcher import WatcherNode
from lavt.runtime.realtime import RealRuntime
from lavt.transport.udp_link import UdpLink
from lavt.transport.video.frame_codec import PictureReceiver
from lavt.vehicle.camera import CapturedFrame

LOOPBACK = "127.0.0.1"


class LoopCamera:
    """A camera that plays the loop into a buffer of its own, in I420, as the other side does."""

    rate_hz = float(RATE_HZ)
    phase_ns = 0

    def __init__(self, run: Run) -> None:
        self.model = CameraModel(run.width_px, run.height_px)
        self._loop = planes_loop(run.loop)
        self._planes = self._loop[0].copy()

    def capture(self, number: int, at_ns: int, pose: Pose | None) -> CapturedFrame:  # noqa: ARG002 (nothing moves)
        """Give a frame of the loop."""
        self._planes[:] = picture_of(self._loop, number)
        return CapturedFrame(number, at_ns, self._planes)


class Deaf:
    """Stands for a node that only listens: takes the messages of some channels and forgets them."""

    counts: Mapping[str, int] = {}

    def __init__(self, name: str, *channels: str) -> None:
        self.name = name
        self.chains: Mapping[str, Sequence[Hop]] = dict.fromkeys(channels, (("forget", _forget),))

    def next_wake_ns(self) -> None:
        """It sleeps."""


def _forget(_message: Message, _now: Now) -> None: ...


class Nowhere:
    """A link that leads nowhere."""

    def send(self, *sends: Send) -> None:
        """Forget messages."""


class Note(Protocol):
    """What is done with the messages that a run's record would hold."""

    def write(self, topic: str, payload: Any, now: Now) -> None:
        """Take one."""
        ...


class Ends:
    """A side at work: its nodes, its video socket and its runtime."""

    def __init__(self, channel: str, note: Note, *, remote: tuple[str, int] | None = None) -> None:
        self.clock = MachineClock()
        self.runtime: RealRuntime | None = None
        self._note = note
        self._link = UdpLink(self.clock, channel, self._deliver, bind=(LOOPBACK, 0), remote=remote)

    @property
    def port(self) -> int:
        """The video's port."""
        return self._link.port

    def start(self, nodes: Sequence[Node]) -> RealRuntime:
        """Start the nodes, then let messages in."""
        self.runtime = RealRuntime(self.clock, nodes, self._note, lambda: None)
        self.runtime.start({"video": self._link, "zenoh": Nowhere()})
        self._link.start()
        return self.runtime

    def close(self) -> None:
        """Stop everything; raises what ended a node before its time."""
        if self.runtime is not None:
            self.runtime.stop()
        self._link.close()
        if self.runtime is not None and self.runtime.failed is not None:
            raise self.runtime.failed

    def _deliver(self, channel: str, payload: Any, arrived: Now, peer: Any) -> None:
        if self.runtime is not None and not self.runtime.stopped.is_set():
            self.runtime.deliver(channel, payload, arrived, peer)


def sender_nodes(run: Run, clock: MachineClock, port: int) -> Sequence[Node]:
    """Build the server's camera node for a loop of pictures."""
    config = ServerConfig.model_validate(
        {
            "camera": {"width_px": run.width_px, "height_px": run.height_px, "rate_hz": RATE_HZ},
            "video": {"bit_rate_bps": run.bit_rate_bps, "gop_frames": GOP_FRAMES, "buffer_ms": VBV_MS},
        }
    )

    def vehicle_setup(config: ServerConfig) -> VehicleSetup:
        return replace(build_geometry_setup(config), camera=LoopCamera(run))

    fidelity = replace(VIDEO, vehicle_setup=vehicle_setup)
    nodes = build_server(config, clock.now, MachineEntropy(), host="", video_port=port, fidelity=fidelity)
    return [nodes.camera, Deaf("actuator", "frame")]


class WatchedPictures:
    """The client's decoder, with its last picture at hand."""

    def __init__(self, pictures: PictureReceiver) -> None:
        self.last: Any = None
        self.decode = pictures.decode
        self._read_stamp = pictures.read_stamp

    def read_stamp(self, received: Any) -> int:
        """Read the stamp, and keep what it was read from."""
        self.last = received
        return self._read_stamp(received)


def receiver_nodes(run: Run, clock: MachineClock) -> tuple[Sequence[Node], WatchedPictures]:
    """Build the client's receiver, and what reads its pictures."""
    size = {"width_px": run.width_px, "height_px": run.height_px}
    config = ClientConfig.model_validate({"camera": {**size, "rate_hz": RATE_HZ}})
    watched = WatchedPictures(VIDEO.receiver(config))
    return [build_client(config, clock.now, MachineEntropy()).receiver, WatcherNode(PictureReader(watched))], watched
