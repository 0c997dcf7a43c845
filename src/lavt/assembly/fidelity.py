"""The fidelities of a run's frames: coded video, rendered pixels, or only the geometry of the lane."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

from lavt.assembly.cameras import client_camera
from lavt.assembly.detection.detectors import build_detector
from lavt.assembly.vehicles import VehicleSetup, build_geometry_setup, build_vehicle_setup
from lavt.config import ClientConfig, ServerConfig
from lavt.nodes.driver import LaneDetection
from lavt.perception.detection import TRACK_CONFIDENCE, DetectorSettings, PictureDetector
from lavt.perception.lane_detector import GroundTruthLaneDetector
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
    """The functions that build the vehicle, and both ends of the video, for one fidelity."""

    vehicle_setup: Callable[[ServerConfig], VehicleSetup]
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


def _track_confidence(config: ClientConfig) -> float:
    """Return the lowest confidence of a tracked lane: a lane that may be followed is tracked."""
    return min(TRACK_CONFIDENCE, config.controller.effective_preset().lane_confidence)


def _lane_detector(config: ClientConfig) -> PictureDetector:
    return _build_lane_detector(config, None)


def _timed_lane_detector(config: ClientConfig) -> PictureDetector:
    return _build_lane_detector(config, config.camera.rate_hz)


def _build_lane_detector(config: ClientConfig, rate_hz: float | None) -> PictureDetector:
    settings = DetectorSettings(track_confidence=_track_confidence(config), file=config.perception.file)
    return build_detector(config.perception.detector, client_camera(config.camera), settings, rate_hz=rate_hz)


def _ground_truth_detector(config: ClientConfig) -> GroundTruthLaneDetector:
    return GroundTruthLaneDetector(_track_confidence(config))


VIDEO = FidelityModel(build_vehicle_setup, _video_sender, _video_receiver, _timed_lane_detector)
"""Coded video in real time: a detector that cannot keep the rate of the pictures is rejected."""


def _pixels() -> FidelityModel:
    codec = InMemoryFrameCodec()
    return FidelityModel(build_vehicle_setup, lambda _: codec, lambda _: codec, _lane_detector)


def _geometry() -> FidelityModel:
    return FidelityModel(build_geometry_setup, lambda _: LaneSender(), lambda _: LaneReceiver(), _ground_truth_detector)


FIDELITIES: dict[str, Callable[[], FidelityModel]] = {
    "video": lambda: replace(VIDEO, detector=_lane_detector),
    "pixels": _pixels,
    "geometry": _geometry,
}
"""The models by the config's `fidelity`. Each run gets a new model, because with `pixels` its two sides share a
codec. They are for virtual time, in which a result never depends on the speed of the machine."""
