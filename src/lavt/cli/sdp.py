"""`lavt sdp`: print the session description (SDP) that a player needs to show the video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer

from lavt.assembly.addresses import resolved_address
from lavt.assembly.fidelity import VIDEO
from lavt.cli import console
from lavt.config import ServerConfig
from lavt.config_file import load_config
from lavt.errors import UserError
from lavt.transport.rtp.sdp import profile_level_id, session_description


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("sdp")(sdp)


def sdp(
    config: Annotated[Path, typer.Argument(help="A server config in YAML, such as configs/server.yaml.")],
    receiver: Annotated[
        str, typer.Option(help="The receiver in video.send_to, as host:port; required if there are several.")
    ] = "",
    changes: console.SetOption = None,
) -> None:
    """Print the SDP file for watching the video in a player.

    The file is for a receiver in video.send_to, which is empty in the shipped configs. Pass the same --set options as
    to the server. Play it on the receiver's machine: ffplay -protocol_whitelist file,udp,rtp -fflags nobuffer -flags
    low_delay lavt.sdp (docs/watching.md has more players).

    Example: lavt sdp configs/server.yaml --set 'video.send_to=["127.0.0.1:5004"]' > lavt.sdp
    """
    settings = load_config(ServerConfig, config, changes or [])
    address = _choose_receiver(settings.video.send_to, receiver)
    description = session_description(
        address, rate_hz=settings.camera.rate_hz, profile_level_id=_profile_level_id(settings)
    )
    console.print_result(description.removesuffix("\n"))


def _choose_receiver(send_to: tuple[str, ...], receiver: str) -> tuple[str, int]:
    """Return the address of `receiver` or, if it is empty, of the only receiver."""
    if not send_to:
        raise UserError(
            "video.send_to is empty: name a receiver as for the server, such as --set "
            """'video.send_to=["127.0.0.1:5004"]'"""
        )
    addresses = [resolved_address("video.send_to", text) for text in send_to]
    if not receiver:
        if len(addresses) > 1:
            raise UserError(f"the video is sent to {', '.join(send_to)}: choose one of them with --receiver")
        return addresses[0]
    requested = resolved_address("--receiver", receiver)
    if requested not in addresses:
        raise UserError(f"{receiver} is not in video.send_to: add it, or choose {', '.join(send_to)}")
    return requested


def _profile_level_id(settings: ServerConfig) -> str:
    """Encode a picture, and return its profile and level; the level depends on picture size, rates and buffer."""
    picture = np.zeros((settings.camera.height_px, settings.camera.width_px, 3), np.uint8)
    sender = VIDEO.sender(settings)
    planes, _ = sender.prepare(picture)
    return profile_level_id(sender.encode(planes, keyframe=True))
