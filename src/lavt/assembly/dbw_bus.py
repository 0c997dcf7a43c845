"""The bus that a config or profile names, and the messages that are expected on it, for `lavt can monitor`."""

from __future__ import annotations

from pathlib import Path

from lavt.config.dbw import DbwConfig
from lavt.config_file import parse_config, read_yaml
from lavt.errors import UserError
from lavt.vehicle.dbw.profile import Profile
from lavt.vehicle.dbw.traffic import ExpectedMessages


def find_dbw(target: str) -> DbwConfig:
    """Return the section `vehicle.dbw` of a server's config, or a default section with the named profile.

    Raises `UserError` for a config whose vehicle is not by wire.
    """
    path = Path(target)
    if path.suffix not in {".yaml", ".yml"}:
        return DbwConfig(profile=target)
    data = read_yaml(path)
    if "kit" in data:  # the file is a profile
        return DbwConfig(profile=target)
    vehicle = data.get("vehicle")
    section = vehicle.get("dbw") if isinstance(vehicle, dict) and vehicle.get("kind") == "dbw" else None
    if not isinstance(section, dict):
        raise UserError(f"{path} has no vehicle of kind dbw with a section dbw: name one that has, or a profile")
    return parse_config(DbwConfig, section, f"{path}: vehicle.dbw")


def expected_traffic(profile: Profile) -> ExpectedMessages:
    """Return the messages that a profile expects on its bus.

    Checksums and counters are selected by signal name, and so include those of messages that the profile does not use.
    """
    axes = profile.axes.values()
    checksums = {part.checksum for part in axes} | {part.checksum for part in profile.reports.values()}
    return ExpectedMessages(
        checksums=checksums - {""},
        counters={command.count for command in axes} - {""},
        timeouts_ns={message: report.timeout_ns for message, report in profile.reports.items()},
        short_lengths=frozenset() if profile.clearing_bytes is None else {profile.clearing_bytes},
    )
