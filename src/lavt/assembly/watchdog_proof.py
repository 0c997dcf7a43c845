"""The proof of a passed watchdog test: `lavt can test-watchdog` writes it, and arming requires it."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Final

from lavt.assembly.dbw import profile_digest
from lavt.clock import calendar_time, wall_time_ns
from lavt.config.dbw import DbwConfig, WatchdogProof
from lavt.config_file import parse_config
from lavt.domain import NS_PER_MS, NS_PER_S
from lavt.errors import UserError
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.dbw.virtual_bus import is_virtual
from lavt.vehicle.dbw.watchdog_test import BRAKE, BRAKE_WITHIN_NS, LEAST_REPORTS, WatchdogObservation

NS_PER_DAY: Final = 86_400 * NS_PER_S
CLOCK_TOLERANCE_DAYS: Final = 1
"""A proof with a date in the future is accepted up to this difference: the clocks of two machines can differ."""
RUN_TEST = "run `lavt can test-watchdog`"


def new_proof(
    observation: WatchdogObservation, gear: str, profile: Profile, config: DbwConfig, wall_ns: int
) -> WatchdogProof:
    """Return the proof of a watchdog test that passed on the config's bus."""
    return WatchdogProof(
        car=config.car,
        at=calendar_time(wall_ns).isoformat(),
        profile=config.profile,
        commands=profile.commands,
        digest=profile_digest(config.profile, config.dbc),
        interface=config.interface,
        channel=config.channel,
        options=config.options,
        is_virtual=is_virtual(config.interface, config.channel, config.options),
        gear=gear,
        brake=BRAKE,
        release_ms=round(observation.released_ns / NS_PER_MS, 1),
        braked_ms=round(observation.braked_ns / NS_PER_MS, 1),
        reports=observation.reports,
        said=observation.kit_messages,
    )


def proof_rejection(path: str, profile: Profile, config: DbwConfig, wall_ns: int) -> str:
    """Return why the proof at `path` is not valid at `wall_ns` for this profile and for the config's car and bus.

    The result is empty if the proof is valid.
    """
    if not path:
        return f"the kit's watchdog has not been tested: {RUN_TEST} and name its proof in vehicle.dbw.watchdog_proof"
    try:
        proof = parse_config(WatchdogProof, _read_json_object(path), path)
    except UserError as error:
        return f"the kit's watchdog has no valid test ({error}): {RUN_TEST}"
    bus = (
        config.interface,
        config.channel,
        config.options,
        is_virtual(config.interface, config.channel, config.options),
    )
    for subject, tested, configured in (
        ("profile or DBC", proof.digest, profile_digest(config.profile, config.dbc)),
        ("set of commands", proof.commands, profile.commands),
        ("car", proof.car, config.car),
        ("bus", (proof.interface, proof.channel, proof.options, proof.is_virtual), bus),
    ):
        if tested != configured:
            return f"{path} is the watchdog test of another {subject}: {RUN_TEST} again"
    if (age := _age_rejection(proof.at, config.watchdog_proof_days, wall_ns)) != "":
        return f"{path} {age}: {RUN_TEST} again"
    if proof.reports < LEAST_REPORTS:
        return f"{path} is based on {proof.reports} reports of the brake, fewer than {LEAST_REPORTS}: {RUN_TEST} again"
    if proof.braked_ms * NS_PER_MS > BRAKE_WITHIN_NS:
        return f"in {path} the kit took {proof.braked_ms:g} ms to brake, which is too long: {RUN_TEST} again"
    return ""


def _age_rejection(at: str, days: int, wall_ns: int) -> str:
    """Return why a proof with the date `at` is not accepted at `wall_ns`; empty: it is accepted."""
    try:
        age_days = (wall_ns - wall_time_ns(at)) / NS_PER_DAY
    except (ValueError, OverflowError):
        return f"has no date ({at[:40]!r})"
    if age_days > days:
        return f"is {age_days:.0f} days old, more than {days} (vehicle.dbw.watchdog_proof_days)"
    return "is from the future, by this machine's clock" if age_days < -CLOCK_TOLERANCE_DAYS else ""


def _read_json_object(path: str) -> dict[str, object]:
    try:
        data = json.loads(Path(path).read_bytes())
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(f"{path} is not a watchdog proof: it is not JSON") from error
    if not isinstance(data, dict):
        raise UserError(f"{path} is not a watchdog proof: it contains no JSON object")
    return data
