from __future__ import annotations

import pytest

from lavt.domain import NS_PER_S
from lavt.errors import UserError

certificates = pytest.importorskip("lavt.transport.security.certificates", exc_type=ImportError)

NOW_NS = 1_800_000_000 * NS_PER_S
"""2027-01-15."""


def test_expired_authority() -> None:
    """An authority signs certificates until the second it expires, and is rejected afterwards."""
    authority = certificates.new_authority(NOW_NS, 10)
    expiry_ns = NOW_NS + 10 * certificates.NS_PER_DAY
    for now_ns in (NOW_NS, expiry_ns - NS_PER_S):
        pair = certificates.new_certificate(
            authority, "one", "operator", server_hosts=None, now_wall_ns=now_ns, days=30
        )
        assert certificates.summarize(pair.public, "") == certificates.CertificateSummary(
            "one", "operator", (), "2027-01-25"
        )
    with pytest.raises(UserError, match="2027-01-25"):
        certificates.new_certificate(authority, "one", "operator", server_hosts=None, now_wall_ns=expiry_ns, days=30)


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("192.0.2.7", True),
        ("2001:db8::7", True),
        ("car", True),
        ("car-1.example.org", True),
        ("", False),
        ("[2001:db8::7]", False),
        ("192.0.2.7:7448", False),
        ("car_1", False),
        ("-car", False),
        ("car..org", False),
        ("car.org\n", False),
        ("a" * 64, False),
        (".".join(["a" * 60] * 5), False),
    ],
)
def test_is_host(text: str, expected: bool) -> None:
    """A host is an IP address or a DNS name, without brackets, port or line break."""
    assert certificates.is_host(text) is expected
