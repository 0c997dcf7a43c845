"""The checks of keys and certificates, of `lavt doctor`."""

from __future__ import annotations

from pathlib import Path
from typing import Final

from lavt.doctor.checks import Check

RENEWAL_DAYS: Final = 14.0
"""The remaining validity below which a certificate or a key should be renewed."""


def check_keys_configured(is_secured: bool) -> Check:
    """Check that messages are signed and the video is encrypted."""
    if is_secured:
        return Check("security", "ok", "messages are signed, and the video is encrypted")
    do = "on two machines: create keys with `lavt keys` and use the secure configs (docs/deployment.md)"
    found = "no keys: anyone who can reach the vehicle's router can drive; use this in a lab or a VPN only"
    return Check("security", "warning", found, do)


def check_key_file(key: str, path: Path, *, rejection: str, mode: int, is_private: bool) -> Check:
    """Check that a key file is readable and, if it is private, that only its owner can read it."""
    if rejection:
        return Check(key, "problem", f"{path} cannot be read: {rejection}", "copy it here, or fix the config")
    if is_private and mode & 0o077:
        found = f"{path} is a private key that other users can read (mode {mode & 0o777:o})"
        return Check(key, "problem", found, f"chmod 600 {path}; create new keys if others had access")
    return Check(key, "ok", f"{path} is readable")


def check_signing_key(path: Path, days_left: float | None) -> Check:
    """Check that a signing key remains valid for at least `RENEWAL_DAYS`; None: it has no expiry."""
    if days_left is None:
        return Check(path.name, "warning", f"the key {path} never expires", "create a new one with `lavt keys`")
    return check_certificate(path, days_left, kind="key")


def check_certificate(path: Path, days_left: float, *, kind: str = "certificate") -> Check:
    """Check that a certificate, or a key, remains valid for at least `RENEWAL_DAYS`."""
    name, measured = path.name, {"days_left": round(days_left, 2)}
    do = "create new certificates and keys with `lavt keys`, and copy them to all machines"
    if days_left < 0:
        return Check(name, "problem", f"the {kind} {path} expired {-days_left:.0f} days ago", do, measured)
    found = f"the {kind} {path} is valid for {days_left:.0f} days"
    if days_left < RENEWAL_DAYS:
        return Check(name, "warning", found, do, measured)
    return Check(name, "ok", found, measured=measured)
