"""The proof of a passed watchdog test: `lavt can test-watchdog` writes it, and arming requires it."""

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

RUN_TEST = "run `lavt can test-watchdog`"


def new_proof(
    observation: WatchdogObservation, gear: str, profile: Profile, config: DbwConfig, wall_ns: int
) -> WatchdogProof:
    """Return the proof of a watchdog test that passed on the config's bus."""
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
        release_ms=round(observation.released_ns / NS_PER_MS, 1),
        braked_ms=round(observation.braked_ns / NS_PER_MS, 1),
        reports=observation.reports,
        said=observation.kit_messages,
    )


def proof_rejection(path: str, profile: Profile, config: DbwConfig) -> str:
    """Return why the proof at `path` does not apply to this profile and the config's bus; empty if it applies."""
    if not path:
        return f"the kit's watchdog has not been tested: {RUN_TEST} and name its file in vehicle.dbw.watchdog_proof"
    try:
        proof = parse_config(WatchdogProof, _read(path), path)
    except UserError as error:
        return f"the kit's watchdog has no valid test ({error}): {RUN_TEST}"
    bus = (config.interface, config.channel, config.options, is_virtual(config.interface, config.channel))
    for subject, tested, configured in (
        ("profile or DBC", proof.digest, profile_digest(config.profile, config.dbc)),
        ("set of commands", proof.commands, profile.commands),
        ("bus", (proof.interface, proof.channel, proof.options, proof.is_virtual), bus),
    ):
        if tested != configured:
            return f"{path} is the watchdog test of another {subject}: {RUN_TEST} again"
    if proof.braked_ms * NS_PER_MS > BRAKE_WITHIN_NS:
        return f"in {path} the kit took {proof.braked_ms:g} ms to brake, which is too long: {RUN_TEST} again"
    return ""


def _read(path: str) -> dict[str, object]:
    try:
        data = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not JSON") from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is not a watchdog proof: it contains no JSON object")
    return data
