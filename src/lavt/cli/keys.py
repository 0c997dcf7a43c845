"""`lavt keys`: create certificates and signing keys with a test certificate authority, and list the files."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Final

import typer

from lavt.cli import console
from lavt.clock import MachineClock, calendar_time
from lavt.errors import UserError
from lavt.transport.messages import NAME
from lavt.transport.security.keys import key_expiry_ns

if TYPE_CHECKING:
    from lavt.transport.security.certificates import CertificateSummary, KeyPair

AUTHORITY: Final = "authority"
DEFAULT_DAYS: Final = 365
MAX_DAYS: Final = 3650
LISTENING_ROLES: Final = ("vehicle", "cloud")
"""Roles whose routers accept connections: their certificates contain their addresses."""
PINNED_ROLES: Final[Mapping[str, tuple[str, ...]]] = {
    "vehicle": ("operator",),
    "operator": ("vehicle",),
    "monitor": ("vehicle",),
    "cloud": (),
}
"""For each role, the roles whose public keys it needs to verify their signatures. A cloud router neither verifies nor
signs."""

Names = list[str] | None


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("keys")(keys)


def keys(
    directory: Annotated[Path, typer.Argument(help="The authority's directory; created if it does not exist.")],
    vehicle: Annotated[Names, typer.Option(help="A vehicle's name, as in its config; repeatable.")] = None,
    operator: Annotated[Names, typer.Option(help="The name of an operator, who may drive; repeatable.")] = None,
    monitor: Annotated[
        Names, typer.Option(help="The name of a monitor, which may only read the state; repeatable.")
    ] = None,
    cloud: Annotated[Names, typer.Option(help="The name of a router in the cloud; repeatable.")] = None,
    host: Annotated[
        Names,
        typer.Option(help="An address or host name of these vehicles and cloud routers; repeatable."),
    ] = None,
    days: Annotated[int, typer.Option(help="Validity of the certificates and signing keys in days.")] = DEFAULT_DAYS,
) -> None:
    """Create certificates and signing keys with a test certificate authority.

    Run the command again to add names. The authority is for tests only: its private key has no password. The command
    overwrites nothing.

    Example: lavt keys ./keys --vehicle vehicle-1 --operator operator-1 --host 192.0.2.7
    """
    certificates = _certificates()
    roles = {"vehicle": vehicle or [], "operator": operator or [], "monitor": monitor or [], "cloud": cloud or []}
    hosts = tuple(host or ())
    _check_arguments(certificates, roles, hosts, days)
    _check_directory(directory, [name for names in roles.values() for name in names])
    now_wall_ns = MachineClock().now().wall_ns
    authority = _open_authority(certificates, directory, now_wall_ns, days)
    for role, names in roles.items():
        for name in names:
            server_hosts = hosts if role in LISTENING_ROLES else None
            pair = certificates.new_certificate(
                authority, name, role, server_hosts=server_hosts, now_wall_ns=now_wall_ns, days=days
            )
            _write_pair(directory, name, (".key", ".pem"), pair)
            _write_pair(directory, name, (".sign.key", ".sign.pub"), certificates.new_signing_pair(now_wall_ns, days))
    summary = certificates.summarize(authority.public, AUTHORITY)
    console.print_result("\n".join(_instructions(directory, summary, _list_certificates(certificates, directory))))


def _certificates() -> ModuleType:
    """Import the certificates module; raise `UserError` if its dependency is not installed."""
    try:
        from lavt.transport.security import certificates  # noqa: PLC0415 (an optional dependency)
    except ImportError as error:
        raise UserError(f"lavt keys needs cryptography ({error}): pip install -e '.[secure]' in the clone") from error
    return certificates


def _check_arguments(certificates: ModuleType, roles: Mapping[str, list[str]], hosts: Iterable[str], days: int) -> None:
    """Raise `UserError` for missing, invalid or repeated names, invalid hosts, and an invalid number of days."""
    names = [name for role_names in roles.values() for name in role_names]
    if not names:
        raise UserError("no names: give at least one, such as --vehicle vehicle-1")
    for name in names:
        if not NAME.match(name) or name == AUTHORITY:
            raise UserError(
                f"{name!r} is not a valid name: use 1 to 32 letters, digits, _ or -, begin with a letter or digit, "
                f"and do not use {AUTHORITY!r}"
            )
    repeated = [name for name, count in Counter(names).items() if count > 1]
    if repeated:
        raise UserError(f"{repeated[0]!r} is named twice: access rights belong to a name, so names must be unique")
    for host in hosts:
        if not certificates.is_host(host):
            raise UserError(f"--host {host!r} is neither an address nor a host name: leave out port and protocol")
    if hosts and not any(roles[role] for role in LISTENING_ROLES):
        raise UserError("--host is the address of a vehicle or a cloud router: name one with --vehicle or --cloud")
    if not 1 <= days <= MAX_DAYS:
        raise UserError(f"--days {days}: choose 1 to {MAX_DAYS}")


def _check_directory(directory: Path, names: Iterable[str]) -> None:
    """Raise `UserError` for names whose files exist, an incomplete authority, or a directory that others can read."""
    if not directory.exists():
        return
    if not directory.is_dir():
        raise UserError(f"{directory} is a file: name a directory")
    if directory.stat().st_mode & 0o077:
        raise UserError(f"other users can read {directory}, which is for private keys: chmod 700 {directory}")
    files = [directory / f"{AUTHORITY}{suffix}" for suffix in (".key", ".pem")]
    missing = [file for file in files if not file.exists()]
    if len(missing) == 1:
        raise UserError(f"{missing[0]} is missing: restore it, or create a new authority in another directory")
    for name in names:
        for suffix in (".key", ".pem", ".sign.key", ".sign.pub"):
            if (directory / (name + suffix)).exists():
                raise UserError(
                    f"{directory / (name + suffix)} already exists: choose another name, or move the file away"
                )


def _open_authority(certificates: ModuleType, directory: Path, now_wall_ns: int, days: int) -> KeyPair:
    """Read the authority of the directory, or create one."""
    key, certificate = (directory / f"{AUTHORITY}{suffix}" for suffix in (".key", ".pem"))
    if key.exists():
        pair: KeyPair = certificates.KeyPair(key.read_bytes(), certificate.read_bytes())
        return pair
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    pair = certificates.new_authority(now_wall_ns, days)
    _write_pair(directory, AUTHORITY, (".key", ".pem"), pair)
    return pair


def _write_pair(directory: Path, name: str, suffixes: tuple[str, str], pair: KeyPair) -> None:
    """Write a private file, readable by its owner only, and its public file."""
    for suffix, content, mode in zip(suffixes, (pair.private, pair.public), (0o600, 0o644), strict=True):
        descriptor = os.open(directory / (name + suffix), os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(descriptor, "wb") as file:
            file.write(content)


def _list_certificates(certificates: ModuleType, directory: Path) -> list[CertificateSummary]:
    """Return the summaries of all certificates in the directory, sorted by role and name."""
    summaries = [
        certificates.summarize(path.read_bytes(), str(path))
        for path in directory.glob("*.pem")
        if path.name != f"{AUTHORITY}.pem"
    ]
    order = list(PINNED_ROLES)
    known = [summary for summary in summaries if summary.role in order]
    return sorted(known, key=lambda summary: (order.index(summary.role), summary.name))


def _instructions(directory: Path, authority: CertificateSummary, summaries: list[CertificateSummary]) -> list[str]:
    """Return the lines that list which files to copy to which machine."""
    lines = [f"{directory} is a test authority, valid until {authority.expires}; keep {AUTHORITY}.key on this machine."]
    for summary in summaries:
        own = f"{AUTHORITY}.pem {summary.name}.pem {summary.name}.key"
        signing = f" {summary.name}.sign.key" if PINNED_ROLES[summary.role] else ""
        public = directory / f"{summary.name}.sign.pub"
        expires_ns = key_expiry_ns(public.read_bytes(), public) if signing and public.exists() else None
        expires = "" if expires_ns is None else f", signing key until {calendar_time(expires_ns):%Y-%m-%d}"
        pinned = "".join(f" {other.name}.sign.pub" for other in summaries if other.role in PINNED_ROLES[summary.role])
        hosts = f", reachable at {', '.join(summary.hosts)}" if summary.hosts else ""
        lines.append(f"{summary.role} {summary.name}, valid until {summary.expires}{expires}{hosts}")
        lines.append(f"  copy to its machine: {own}{signing}{pinned}")
    lines.append("Copy each .key to that one machine only, and make it readable by LAVT's user only (mode 0600).")
    return lines
