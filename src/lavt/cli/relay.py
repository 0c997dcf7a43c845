"""`lavt relay`: inject network latency without netem and without root."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from lavt.assembly.addresses import resolved_address
from lavt.assembly.links import link_injection
from lavt.cli import console
from lavt.clock import MachineClock
from lavt.config import DelayConfig, ImpairmentConfig, LinkConfig, RelayConfig
from lavt.config_file import load_config
from lavt.errors import UserError
from lavt.runtime import process_priority
from lavt.transport.emulation.delay_line import DelayModel, Lognormal
from lavt.transport.emulation.impairment import Impairment
from lavt.transport.emulation.link import LinkInjection
from lavt.transport.emulation.relay import NO_DELAY, Relay, RelayedFlow, must_delay_video_datagram, video_delay_index


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("relay")(relay)


def relay(
    config: Annotated[Path, typer.Argument(help="A relay config in YAML.")],
    changes: console.SetOption = None,
    as_json: console.JsonOption = False,
) -> None:
    """Forward video and control with injected latency.

    The relay runs between the two sides until Ctrl-C and delays packets as its config says.

    Example: lavt relay configs/relay.yaml --set video.constant_ms=75
    """
    process_priority.raise_priority()
    settings = load_config(RelayConfig, config, changes or [])
    forwarder = Relay(MachineClock(), flows(settings))
    with console.stop_on_signals() as stop:
        ports = forwarder.ports()
        if as_json:
            console.print_json({"ports": ports})
        else:
            console.print_result(
                f"relaying video at port {ports['video']} and control at port {ports['control']}; Ctrl-C ends it"
            )
        while not stop.is_set():
            forwarder.step()
    if as_json:
        console.print_json(
            {
                "held_ms": forwarder.median_delays_ms(),
                "late_ms": forwarder.median_lateness_ms(),
                "counts": forwarder.counts(),
            }
        )
    forwarder.close()


def flows(config: RelayConfig) -> list[RelayedFlow]:
    """Return the two flows to relay (video, control); raise `UserError` for invalid addresses, links and traces."""
    seed = config.seed
    video = RelayedFlow(
        "video",
        _resolve("video_listen", config.video_listen),
        _resolve("video_server", config.video_server),
        upstream=NO_DELAY,
        downstream=_delay_model(config.video, seed, stream_name="video inherent"),
        downstream_delay_filter=must_delay_video_datagram,
        downstream_delay_index_function=video_delay_index,
        downstream_injected=_link_injection("video", config.video, seed),
    )
    control = RelayedFlow(
        "control",
        _resolve("control_listen", config.control_listen),
        _resolve("control_server", config.control_server),
        upstream=_delay_model(config.control, seed, stream_name="control inherent"),
        downstream=_delay_model(config.state, seed, stream_name="state inherent"),
        upstream_injected=_link_injection("control", config.control, seed),
        downstream_injected=_link_injection("state", config.state, seed),
    )
    return [video, control]


def _delay_model(config: DelayConfig, seed: int, *, stream_name: str) -> DelayModel:
    """Return the config's constant delay plus jitter.

    The jitter is drawn from the random-number stream `stream_name` of `seed`. The streams are named "inherent", because
    only the inherent latency has this jitter; the constant delay can be inherent, injected or both.
    """
    jitter = Lognormal(config.jitter_median_ms, config.jitter_sigma) if config.jitter_median_ms > 0 else None
    return DelayModel(config.constant_ms, jitter, seed, stream_name)


def _link_injection(name: str, config: DelayConfig, seed: int) -> LinkInjection | None:
    """Return the injection that the config's `link` describes; None if all its values are defaults."""
    if config.link == LinkConfig():
        return None
    impairment = ImpairmentConfig(**config.link.model_dump(exclude={"delay_ms"}))
    if impairment == ImpairmentConfig():  # the link only delays
        return LinkInjection(Impairment(delay_ms=config.link.delay_ms), seed, name)
    return link_injection(name, config.link.delay_ms, impairment, seed)


def _resolve(key: str, text: str) -> tuple[str, int]:
    """Parse the address of a UDP flow and resolve its host."""
    if text.startswith(("tcp/", "tls/", "quic/")):
        raise UserError(
            f"{key}: the relay forwards UDP only, not {text!r}: connect the routers by udp/...?rel=1;mixed_rel=1"
        )
    return resolved_address(key, text)
