"""No code uses periodic sending, which would repeat the last command of a frozen program."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

SOURCE = Path(__file__).parent.parent / "src" / "lavt"

PERIODIC = re.compile(
    r"send_periodic|_send_periodic_internal|\w*Cyclic\w*Task\w*|broadcastmanager|modify_data"  # names of python-can
    r"|\w*BCM\w*|\w*bcm\w*|AF_CAN|PF_CAN|CAN_RAW"  # names of the kernel, and of sockets that could use them
)
"""Complete names that belong to periodic sending, also in a string, with which a program could look up the name."""


def periodic_sending(source: str) -> list[str]:
    """Return the names in a program that belong to periodic sending."""
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
def test_no_module_sends_periodically(path: Path) -> None:
    """No module uses periodic sending of python-can or of the kernel, or opens a CAN socket itself."""
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
def test_planted_periodic_sending_is_found(planted: str) -> None:
    """Periodic sending is found, however it is imported or called."""
    assert periodic_sending(planted)


def test_single_sends_are_allowed() -> None:
    """Single sends are allowed, and so are sentences that mention periodic sending."""
    assert not periodic_sending('"""Never send_periodic here."""\nbus.send(message, timeout=0)\nimport can')
