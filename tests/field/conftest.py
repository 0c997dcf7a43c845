"""Fixtures of the field tests, which run in network namespaces."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from tests.field.namespaces import kernel_lacks_namespaces, programs_missing
from tests.require import need


@pytest.fixture(scope="session")
def namespaces() -> None:
    """Skip the test unless network namespaces can be made."""
    if kernel_lacks_namespaces():
        need("namespaces", "needs root and a kernel that lets it make network namespaces with NAT")
    if programs_missing():
        need("namespaces", "needs ip and nft: apt-get install iproute2 nftables")


@pytest.fixture(scope="session")
def print_report(request: pytest.FixtureRequest) -> Callable[[str], None]:
    """Return a function that prints a measurement, even if the test fails or its output is captured."""
    plugins = request.config.pluginmanager
    reporter, capture = plugins.getplugin("terminalreporter"), plugins.getplugin("capturemanager")
    assert reporter is not None
    assert capture is not None

    def write_lines(text: str) -> None:
        with capture.global_and_fixture_disabled():
            reporter.write_line(f"\n{text}")

    return write_lines
