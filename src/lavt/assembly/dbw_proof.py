"""The proof that a kit's watchdog brakes: made of what `lavt can prove` saw, held against a config before arming."""

from __future__ import annotations

import json
from pathlib import Path

from lavt.assembly.dbw import profile_digest
from lavt.clock import calendar_time
from lavt.config.dbw import DbwConfig, WatchdogProof
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS
from lavt.errors import UserError
from lavt.vehicle.dbw.bus import is_virtual
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.dbw.watchdog_test import BRAKE, BRAKE_WITHIN_NS, WatchdogObservation

AGAIN = "run `lavt can prove`"


def proof_of(seen: WatchdogObservation, gear: str, profile: Profile, config: DbwConfig, wall_ns: int) -> WatchdogProof:
    """Make the proof of what was seen on a config's bus."""
    return WatchdogProof(
        at=calendar_time(wall_ns).isoformat(),
        profile=config.profile,
        commands=profile.commands,
        digest=profile_digest(config.profile, config.dbc),
        interface=config.interface,
        channel=config.channel,
        options=config.options,
        is_virtual=is_virtual(config.interface, config.channel),
        gear=gear,
        brake=BRAKE,
        release_ms=round(seen.released_ns / NS_PER_MS, 1),
        braked_ms=round(seen.braked_ns / NS_PER_MS, 1),
        reports=seen.reports,
        said=seen.kit_messages,
    )


def check_proof(path: str, profile: Profile, config: DbwConfig) -> str:
    """Say why the file at `path` does not prove that this profile's kit brakes on this config's bus; empty: it does."""
    if not path:
        return f"that the kit's watchdog brakes is not proved: {AGAIN}, and name its file in vehicle.dbw.watchdog_proof"
    try:
        proof = parse_config(WatchdogProof, _read(path), path)
    except UserError as error:
        return f"that the kit's watchdog brakes is not proved ({error}): {AGAIN}"
    bus = (config.interface, config.channel, config.options, is_virtual(config.interface, config.channel))
    for what, proved, found in (
        ("profile or DBC", proof.digest, profile_digest(config.profile, config.dbc)),
        ("set of commands", proof.commands, profile.commands),
        ("bus", (proof.interface, proof.channel, proof.options, proof.is_virtual), bus),
    ):
        if proved != found:
            return f"{path} proves the watchdog of another {what}: {AGAIN} again"
    if proof.braked_ms * NS_PER_MS > BRAKE_WITHIN_NS:
        return f"in {path} the kit took {proof.braked_ms:g} ms to brake, which is too long: {AGAIN} again"
    return ""


def _read(path: str) -> dict[str, object]:
    try:
        found = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON") from error
    if not isinstance(found, dict):
        raise UserError(f"{path} is no proof")
    return found
