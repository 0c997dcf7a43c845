"""Nothing sends by itself: the last command of a program that froze must not stand."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "lavt"

PERIODIC = re.compile(
    r"send_periodic|_send_periodic_internal|\w*Cyclic\w*Task\w*|broadcastmanager|modify_data"  # python-can's
    r"|\w*BCM\w*|\w*bcm\w*|AF_CAN|PF_CAN|CAN_RAW"  # the kernel's, and sockets that could be its
)
"""Whole names; a text that is one counts as well, as it may be looked up by it."""


def periodic_sending(source: str) -> list[str]:
    """Which names in a program belong to sending that goes on by itself."""
    return [name for node in ast.walk(ast.parse(source)) for name in _names(node) if PERIODIC.fullmatch(name)]


def _names(node: ast.AST) -> Iterator[str]:
    match node:
        case ast.Name(id=name) | ast.Attribute(attr=name) | ast.FunctionDef(name=name) | ast.ClassDef(name=name):
            yield name
        case ast.Constant(value=str(text)):
            yield from re.split(r"[.:]", text)
        case ast.alias(name=name):
            yield from name.split(".")
        case ast.ImportFrom(module=str(module)):
            yield from module.split(".")


@pytest.mark.parametrize("path", sorted(SOURCE.rglob("*.py")), ids=lambda path: str(path.relative_to(SOURCE)))
def test_none(path: Path) -> None:
    """No module has python-can or the kernel send frames by itself, or opens a CAN socket past the port."""
    assert periodic_sending(path.read_text("utf-8")) == []


PLANTED = [
    "task = bus.send_periodic(message, 0.02)",
    "getattr(bus, 'send_periodic')(message, 0.02)",
    "from can import ThreadBasedCyclicSendTask",
    "from can.interfaces.socketcan import CyclicSendTask as Task",
    "import can.broadcastmanager",
    "import_module('can.broadcastmanager')",
    "s = socket.socket(socket.PF_CAN, socket.SOCK_DGRAM, 2)",
    "s = socket.socket(29, socket.SOCK_DGRAM, socket.CAN_BCM)",
    "class Mine(can.LimitedDurationCyclicSendTaskABC): ...",
]


@pytest.mark.parametrize("planted", PLANTED)
def test_found(planted: str) -> None:
    """A planted use is found, however it is named."""
    assert periodic_sending(planted)


def test_others() -> None:
    """What sends once, or is only spoken of, is let be."""
    assert not periodic_sending('"""Never send_periodic here."""\nbus.send(message, timeout=0)\nimport can')
