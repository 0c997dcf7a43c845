"""The configs of the two sides, from the config of a run on one machine."""

from __future__ import annotations

from lavt.config import (
    ClientCameraConfig,
    ClientClockConfig,
    ClientConfig,
    ClientVideoConfig,
    ClockConfig,
    RunConfig,
    ServerCameraConfig,
    ServerConfig,
    ServerVideoConfig,
    ZenohConfig,
)
from lavt.transport.clock_sync import probe


def server_config(run: RunConfig, seed: int, *, router: str = "") -> ServerConfig:
    """Return the server's config of a run; its ports are free ports on the loopback interface."""
    return ServerConfig(
        vehicle=run.vehicle,
        camera=ServerCameraConfig(**run.camera.model_dump()),
        video=ServerVideoConfig(bind="127.0.0.1", port=0, **run.video.model_dump()),
        zenoh=ZenohConfig(router=router),
        clock=ClockConfig(probe_port=0),
        safety=run.safety,
        record=run.record,
        seed=seed,
    )


def client_config(
    run: RunConfig, *, router: str = "", video_port: int = 0, probe_port: int = probe.DEFAULT_PORT
) -> ClientConfig:
    """Return the client's config of a run."""
    return ClientConfig(
        controller=run.controller,
        camera=ClientCameraConfig(**run.camera.model_dump()),
        video=ClientVideoConfig(port=video_port, reorder_hold_ms=run.video.reorder_hold_ms),
        zenoh=ZenohConfig(router=router),
        clock=ClientClockConfig(probe_port=probe_port),
        record=run.record,
    )
