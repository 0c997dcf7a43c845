"""What stands for pictures in a run: video, pixels, or the geometry of the lane alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from lavt.assembly.cameras import client_camera
from lavt.assembly.vehicles import VehicleSetup, build_plant, build_unpictured
from lavt.config import ClientConfig, ServerConfig
from lavt.nodes.driver import LaneDetection
from lavt.perception.lane_detector import LaneDetector
from lavt.perception.lane_given import GivenLane
from lavt.transport.video.frame_codec import (
    InMemoryFrameCodec,
    LaneReceiver,
    LaneSender,
    PictureReceiver,
    PictureSender,
    VideoReceiver,
    VideoSender,
)
from lavt.transport.video.h264 import Decoder, Encoder


@dataclass(frozen=True, slots=True)
class FidelityModel:
    """How the pictures of a run come about and cross the network: what is made for it on both sides."""

    plant: Callable[[ServerConfig], VehicleSetup]
    sender: Callable[[ServerConfig], PictureSender]
    receiver: Callable[[ClientConfig], PictureReceiver]
    detector: Callable[[ClientConfig], LaneDetection]


def _video_sender(config: ServerConfig) -> VideoSender:
    video, camera = config.video, config.camera
    return VideoSender(
        Encoder(
            width_px=camera.width_px,
            height_px=camera.height_px,
            rate_hz=camera.rate_hz,
            bit_rate_bps=video.bit_rate_bps,
            gop_frames=video.gop_frames,
            preset=video.preset,
            threads=video.encoder_threads,
            buffer_s=video.buffer_ms / 1000,
        )
    )


def _video_receiver(config: ClientConfig) -> VideoReceiver:
    camera = client_camera(config.camera)
    return VideoReceiver(Decoder(), (camera.height_px, camera.width_px))


def _lane_detector(config: ClientConfig) -> LaneDetector:
    return LaneDetector(client_camera(config.camera))


VIDEO = FidelityModel(build_plant, _video_sender, _video_receiver, _lane_detector)


def _pixels() -> FidelityModel:
    between = InMemoryFrameCodec()
    return FidelityModel(build_plant, lambda _: between, lambda _: between, _lane_detector)


def _geometry() -> FidelityModel:
    return FidelityModel(build_unpictured, lambda _: LaneSender(), lambda _: LaneReceiver(), lambda _: GivenLane())


FIDELITIES: dict[str, Callable[[], FidelityModel]] = {
    "video": lambda: VIDEO,
    "pixels": _pixels,
    "geometry": _geometry,
}
"""By the config's `fidelity`: what to make for one run, whose two sides may share something."""
