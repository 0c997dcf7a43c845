from __future__ import annotations

import pytest

from lavt.transport.zenoh_config import flatten, with_host

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
