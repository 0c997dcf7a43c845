"""`lavt relay`: delay without netem and without root."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.addresses import resolved_address
from lavt.assembly.links import injected
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import DelayConfig, ImpairmentConfig, LinkConfig, RelayConfig
from lavt.config_file import load_config
from lavt.errors import UserError
from lavt.runtime import process_priority
from lavt.transport.emulation.delay_line import DelayModel, Lognormal
from lavt.transport.emulation.impairment import Impairment
from lavt.transport.emulation.link import LinkInjection
from lavt.transport.emulation.relay import NONE, Relay, RelayedFlow, is_delayed_video, video_index


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("relay")(relay)


def relay(
    config: Annotated[Path, typer.Argument(help="A relay config in YAML.")],
    changes: console.Set = None,
    as_json: console.Json = False,
) -> None:
    """Carry video and control between two sides and hold back what the config says, until Ctrl-C.

    Example: lavt relay configs/relay.yaml --set video.constant_ms=75
    """
    process_priority.take()
    settings = load_config(RelayConfig, config, changes or [])
    opened = Relay(MachineClock(), flows(settings))
    with console.until_told() as told:
        ports = opened.ports()
        if as_json:
            console.show_json({"ports": ports})
        else:
            console.show(
                f"relaying video at port {ports['video']} and control at port {ports['control']}; Ctrl-C ends it"
            )
        while not told.is_set():
            opened.step()
    if as_json:
        console.show_json({"held_ms": opened.held_ms(), "late_ms": opened.late_ms(), "counts": opened.counts()})
    opened.close()


def flows(config: RelayConfig) -> list[RelayedFlow]:
    """Give the two flows that are relayed; raises `UserError` for addresses, links and traces that cannot be used."""
    seed = config.seed
    return [
        RelayedFlow(
            "video", _resolved("video_listen", config.video_listen), _resolved("video_server", config.video_server),
            upstream=NONE, downstream=_law(config.video, seed, "video inherent"),
            delays_downstream=is_delayed_video, index_downstream=video_index,
            downstream_injected=_link("video", config.video, seed),
        ),
        RelayedFlow(
            "control", _resolved("control_listen", config.control_listen),
            _resolved("control_server", config.control_server),
            upstream=_law(config.control, seed, "control inherent"),
            downstream=_law(config.state, seed, "state inherent"),
            upstream_injected=_link("control", config.control, seed),
            downstream_injected=_link("state", config.state, seed),
        ),
    ]  # fmt: skip


def _law(config: DelayConfig, seed: int, name: str) -> DelayModel:
    jitter = Lognormal(config.jitter_median_ms, config.jitter_sigma) if config.jitter_median_ms > 0 else None
    return DelayModel(config.constant_ms, jitter, seed, name)


def _link(name: str, config: DelayConfig, seed: int) -> LinkInjection | None:
    """Give what `link` asks for, if it asks for anything."""
    if config.link == LinkConfig():
        return None
    impairment = ImpairmentConfig(**config.link.model_dump(exclude={"delay_ms"}))
    return injected(name, config.link.delay_ms, impairment, seed) or LinkInjection(
        Impairment(delay_ms=config.link.delay_ms), seed, name
    )


def _resolved(key: str, text: str) -> tuple[str, int]:
    """Read an address of a UDP flow and look its host up."""
    if text.startswith(("tcp/", "tls/", "quic/")):
        raise UserError(
            f"{key}: the relay carries UDP only, not {text!r}: let the routers talk by udp/...?rel=1;mixed_rel=1"
        )
    return resolved_address(key, text)
