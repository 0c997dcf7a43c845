"""`lavt keys`: a test authority with certificates and keys, and which file goes to which machine."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Annotated, Final

import typer

from lavt.cli import console
from lavt.clock import MachineClock
from lavt.errors import UserError
from lavt.transport.messages import NAME

if TYPE_CHECKING:
    from lavt.transport.security.certificates import CertificateSummary, KeyPair

AUTHORITY: Final = "authority"
DEFAULT_DAYS: Final = 365
LONGEST_DAYS: Final = 3650
DIALLED: Final = ("vehicle", "cloud")
"""Whose routers others dial: their certificates name the addresses."""
PINNED: Final[Mapping[str, tuple[str, ...]]] = {
    "vehicle": ("operator",),
    "operator": ("vehicle",),
    "monitor": ("vehicle",),
    "cloud": (),
}
"""Whose signatures each role checks: it needs their public keys."""

Names = list[str] | None


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command("keys")(keys)


def keys(
    directory: Annotated[Path, typer.Argument(help="Where the authority is, or will be made.")],
    vehicle: Annotated[Names, typer.Option(help="A vehicle's name, as in its config; as often as needed.")] = None,
    operator: Annotated[Names, typer.Option(help="An operator: may drive; as often as needed.")] = None,
    monitor: Annotated[Names, typer.Option(help="Someone who may only watch the state; as often as needed.")] = None,
    cloud: Annotated[Names, typer.Option(help="A router between the others; as often as needed.")] = None,
    host: Annotated[
        Names,
        typer.Option(help="Address or host name at which these vehicles and clouds are dialled; as often as needed."),
    ] = None,
    days: Annotated[int, typer.Option(help="For how many days the certificates hold.")] = DEFAULT_DAYS,
) -> None:
    """Make a test authority, and certificates and signing keys for names; run again to add names.

    It is an authority for tests: its key lies in a file without a password. Nothing that exists is overwritten.

    Example: lavt keys keys --vehicle vehicle-1 --operator operator-1 --host 192.0.2.7
    """
    certificates = _certificates()
    roles = {"vehicle": vehicle or [], "operator": operator or [], "monitor": monitor or [], "cloud": cloud or []}
    hosts = tuple(host or ())
    _check(certificates, roles, hosts, days)
    _check_directory(directory, [name for names in roles.values() for name in names])
    now_wall_ns = MachineClock().now().wall_ns
    authority = _authority(certificates, directory, now_wall_ns, days)
    for role, names in roles.items():
        for name in names:
            server_hosts = hosts if role in DIALLED else None
            pair = certificates.new_certificate(
                authority, name, role, server_hosts=server_hosts, now_wall_ns=now_wall_ns, days=days
            )
            _write_pair(directory, name, (".key", ".pem"), pair)
            _write_pair(directory, name, (".sign.key", ".sign.pub"), certificates.new_signing_pair())
    console.show(
        "\n".join(
            _told(directory, certificates.summarize(authority.public, AUTHORITY), _everybody(certificates, directory))
        )
    )


def _certificates() -> ModuleType:
    try:
        from lavt.transport.security import certificates  # noqa: PLC0415 (an extra)
    except ImportError as error:
        raise UserError(f"lavt keys needs cryptography ({error}): pip install 'lavt[secure]'") from error
    return certificates


def _check(certificates: ModuleType, roles: Mapping[str, list[str]], hosts: Iterable[str], days: int) -> None:
    """Raise `UserError` for what nothing can be made of."""
    names = [name for each in roles.values() for name in each]
    if not names:
        raise UserError("keys for nobody: give names, such as --vehicle vehicle-1 --operator operator-1")
    for name in names:
        if not NAME.match(name) or name == AUTHORITY:
            raise UserError(
                f"nobody can be called {name!r}: use 1 to 32 letters, digits, _ or -, not _ or - first, and not "
                f"{AUTHORITY!r}"
            )
    twice = [name for name, times in Counter(names).items() if times > 1]
    if twice:
        raise UserError(f"{twice[0]!r} is there twice: access is by name, so each needs one of its own")
    for host in hosts:
        if not certificates.is_host(host):
            raise UserError(f"--host {host!r} is neither an address nor a host name: leave out port and protocol")
    if hosts and not any(roles[role] for role in DIALLED):
        raise UserError("--host is where a vehicle or a cloud is dialled: name one with --vehicle or --cloud")
    if not 1 <= days <= LONGEST_DAYS:
        raise UserError(f"--days {days}: choose 1 to {LONGEST_DAYS}")


def _check_directory(directory: Path, names: Iterable[str]) -> None:
    """Raise `UserError` where something would be overwritten, half of an authority is missing, or others may look."""
    if not directory.exists():
        return
    if not directory.is_dir():
        raise UserError(f"{directory} is a file: name a directory")
    if directory.stat().st_mode & 0o077:
        raise UserError(f"others may look into {directory}, where private keys shall be: chmod 700 {directory}")
    halves = [directory / f"{AUTHORITY}{ending}" for ending in (".key", ".pem")]
    missing = [half for half in halves if not half.exists()]
    if len(missing) == 1:
        raise UserError(f"{missing[0]} is missing: copy it back, or make a new authority in another directory")
    for name in names:
        for ending in (".key", ".pem", ".sign.key", ".sign.pub"):
            if (directory / (name + ending)).exists():
                raise UserError(
                    f"{directory / (name + ending)} exists and is not overwritten: choose another name, or move it away"
                )


def _authority(certificates: ModuleType, directory: Path, now_wall_ns: int, days: int) -> KeyPair:
    """Read the authority of the directory, or make one."""
    key, shown = (directory / f"{AUTHORITY}{ending}" for ending in (".key", ".pem"))
    if key.exists():
        pair: KeyPair = certificates.KeyPair(key.read_bytes(), shown.read_bytes())
        return pair
    directory.mkdir(mode=0o700, parents=True, exist_ok=True)
    pair = certificates.new_authority(now_wall_ns, days)
    _write_pair(directory, AUTHORITY, (".key", ".pem"), pair)
    return pair


def _write_pair(directory: Path, name: str, endings: tuple[str, str], pair: KeyPair) -> None:
    """Write a private file, which only its owner may read, and the one that may be shown."""
    for ending, content, mode in zip(endings, (pair.private, pair.public), (0o600, 0o644), strict=True):
        created = os.open(directory / (name + ending), os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(created, "wb") as file:
            file.write(content)


def _everybody(certificates: ModuleType, directory: Path) -> list[CertificateSummary]:
    """Give all whose certificates are in the directory, by role and name."""
    found = [
        certificates.summarize(path.read_bytes(), str(path))
        for path in directory.glob("*.pem")
        if path.name != f"{AUTHORITY}.pem"
    ]
    order = list(PINNED)
    return sorted((each for each in found if each.role in order), key=lambda each: (order.index(each.role), each.name))


def _told(directory: Path, authority: CertificateSummary, everybody: list[CertificateSummary]) -> list[str]:
    lines = [f"{directory} is a test authority until {authority.expires}; {AUTHORITY}.key never leaves this machine."]
    for one in everybody:
        own = f"{AUTHORITY}.pem {one.name}.pem {one.name}.key"
        signing = f" {one.name}.sign.key" if PINNED[one.role] else ""
        pinned = "".join(f" {other.name}.sign.pub" for other in everybody if other.role in PINNED[one.role])
        at = f", dialled at {', '.join(one.hosts)}" if one.hosts else ""
        lines.append(f"{one.role} {one.name}, until {one.expires}{at}")
        lines.append(f"  copy to its machine: {own}{signing}{pinned}")
    lines.append("Each .key goes to that one machine only, readable by LAVT's user only (mode 0600).")
    return lines
