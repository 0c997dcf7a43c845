"""The configs of the two sides, from the config of a run on one machine."""

from __future__ import annotations

from collections.abc import Sequence

from lavt.assembly.cameras import CARLA, SIMULATED
from lavt.config import (
    ClientCameraConfig,
    ClientClockConfig,
    ClientConfig,
    ClientVideoConfig,
    ClockConfig,
    ConsoleConfig,
    RunConfig,
    ServerCameraConfig,
    ServerConfig,
    ServerVideoConfig,
    ZenohConfig,
)
from lavt.transport.clock_sync import probe

CAMERA_SOURCES = {"carla": CARLA}
"""The source of the pictures of a run by the kind of its vehicle, if it is not the simulator's camera."""

LOCAL_TCP = "tcp/127.0.0.1:0"
SERVER_LISTENS = (LOCAL_TCP, "udp/127.0.0.1:0?rel=1;mixed_rel=1")


def embedded_router(*, listen: Sequence[str] = (), dialled: Sequence[str] = ()) -> ZenohConfig:
    """Return the config of an embedded router with these endpoints."""
    settings = {key: {"endpoints": list(endpoints)} for key, endpoints in (("listen", listen), ("connect", dialled))}
    return ZenohConfig(router_settings=settings)


def server_config(run: RunConfig, seed: int, *, zenoh: ZenohConfig | None = None) -> ServerConfig:
    """Return the server's config of a run; its ports are free ports on the loopback interface.

    Without `zenoh`, the server has an embedded router.
    """
    return ServerConfig(
        vehicle=run.vehicle,
        camera=ServerCameraConfig(source=CAMERA_SOURCES.get(run.vehicle.kind, SIMULATED), **run.camera.model_dump()),
        video=ServerVideoConfig(bind="127.0.0.1", port=0, **run.video.model_dump()),
        zenoh=zenoh or embedded_router(listen=SERVER_LISTENS),
        clock=ClockConfig(probe_port=0),
        safety=run.safety,
        record=run.record,
        seed=seed,
    )


def client_config(
    run: RunConfig,
    seed: int,
    *,
    zenoh: ZenohConfig | None = None,
    video_port: int = 0,
    probe_port: int = probe.DEFAULT_PORT,
) -> ClientConfig:
    """Return the client's config of a run; without `zenoh`, the default router.

    In a study, the page of a person shows no latencies, because the participant must not know the condition.
    """
    return ClientConfig(
        controller=run.controller,
        perception=run.perception,
        console=ConsoleConfig(shows_latency=run.study.participant is None),
        camera=ClientCameraConfig(**run.camera.model_dump()),
        video=ClientVideoConfig(port=video_port, reorder_hold_ms=run.video.reorder_hold_ms),
        zenoh=zenoh or ZenohConfig(),
        clock=ClientClockConfig(probe_port=probe_port),
        record=run.record,
        seed=seed,
    )
