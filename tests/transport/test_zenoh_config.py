from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import zenoh

from lavt.errors import UserError
from lavt.transport.zenoh_config import check_tls_files, flatten, with_host

ENDPOINTS = {
    "tcp/127.0.0.1:7447": "tcp/HOST:7447",
    "udp/127.0.0.1:7448?rel=1;mixed_rel=1": "udp/HOST:7448?rel=1;mixed_rel=1",
    "quic/[::1]:7448?mixed_rel=1#iface=lo": "quic/HOST:7448?mixed_rel=1#iface=lo",
    "tcp/name:7447#bind=127.0.0.2:1": "tcp/HOST:7447#bind=127.0.0.2:1",
}


@pytest.mark.parametrize("endpoint", ENDPOINTS)
@pytest.mark.parametrize("host", ["192.0.2.7", "vehicle.example", "2001:db8::7"])
def test_the_host_of_an_endpoint_is_replaced(endpoint: str, host: str) -> None:
    """Only the host changes, not the protocol, the port and the parameters; an IPv6 address gets brackets."""
    assert with_host(endpoint, host) == ENDPOINTS[endpoint].replace("HOST", f"[{host}]" if ":" in host else host)


def test_an_endpoint_that_is_a_path_stays() -> None:
    """The endpoint of a Unix socket has no host."""
    assert with_host("unixsock-stream//run/lavt/zenoh.sock", "192.0.2.7") == "unixsock-stream//run/lavt/zenoh.sock"


def test_nested_settings_become_keys_with_slashes() -> None:
    """Nested settings are flattened to Zenoh's keys; lists and empty mappings are values."""
    settings = {"listen": {"endpoints": ["tcp/127.0.0.1:0"]}, "mode": "router", "transport": {"link": {"tx": {}}}}
    assert flatten(settings) == {"listen/endpoints": ["tcp/127.0.0.1:0"], "mode": "router", "transport/link/tx": {}}


def damage(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:150])


DAMAGES: dict[str, tuple[str, Callable[[Path], object]]] = {
    "missing certificate": ("certificate", Path.unlink),
    "missing key": ("private_key", Path.unlink),
    "missing authority": ("root_ca_certificate", Path.unlink),
    "truncated certificate": ("certificate", damage),
    "truncated key": ("private_key", damage),
    "truncated authority": ("root_ca_certificate", damage),
    "empty certificate": ("certificate", lambda file: file.write_bytes(b"")),
    "binary authority": ("root_ca_certificate", lambda file: file.write_bytes(bytes(range(256)))),
    "key of another": ("private_key", lambda file: file.write_bytes((file.parent / "other.key").read_bytes())),
}


@pytest.mark.parametrize("kind", ["listen", "connect"])
@pytest.mark.parametrize("case", [*DAMAGES, ""])
def test_an_unusable_certificate_or_key_is_named(case: str, kind: str, tmp_path: Path) -> None:
    """A file that TLS needs and cannot use is an error that names it, also for a router that only dials."""
    certificates = pytest.importorskip("lavt.transport.security.certificates", exc_type=ImportError)
    authority = certificates.new_authority(1, 40_000)
    pairs = [
        certificates.new_certificate(authority, name, "vehicle", server_hosts=(), now_wall_ns=1, days=40_000)
        for name in ("one", "other")
    ]
    files = {
        "root_ca_certificate": tmp_path / "authority.pem",
        f"{kind}_certificate": tmp_path / "one.pem",
        f"{kind}_private_key": tmp_path / "one.key",
    }
    contents = (authority.public, pairs[0].public, pairs[0].private)
    for file, content in zip([*files.values(), tmp_path / "other.key"], [*contents, pairs[1].private], strict=True):
        file.write_bytes(content)
        file.chmod(0o600)
    config = zenoh.Config()
    config.insert_json5(f"{kind}/endpoints", json.dumps(["quic/127.0.0.1:7448"]))
    for name, file in files.items():
        config.insert_json5(f"transport/link/tls/{name}", json.dumps(str(file)))
    if not case:
        check_tls_files(config)
        return
    name, change = DAMAGES[case]
    damaged = files[name if name in files else f"{kind}_{name}"]
    change(damaged)
    with pytest.raises(UserError, match=str(damaged)):
        check_tls_files(config)
    config.insert_json5(f"{kind}/endpoints", json.dumps(["tcp/127.0.0.1:7447"]))
    check_tls_files(config)
