"""The first questions to a CARLA server, its version and its episode, without the package `carla`.

The package aborts the process if the answer comes from another program, such as a web server, and it takes a refused
connection for a server that is slow. So LAVT asks once itself: a request of msgpack-rpc with the bytes of the package.
The package reads states with the episode, and a state that it cannot read aborts the process.
"""

from __future__ import annotations

import socket
from typing import Any, Final

import msgspec

MAX_ANSWER_BYTES: Final = 4096
MAX_PARTS: Final = 16
ANSWER: Final = 1
"""The first item of an answer of msgpack-rpc."""


class NoServerError(Exception):
    """No CARLA server answers; the text is the reason."""


def ask_version(host: str, port: int, timeout_s: float) -> str | None:
    """Return the version of the CARLA server at an address; None if it answers in another form.

    Raises `NoServerError` if the host is unknown, if nothing listens there, if no answer comes within `timeout_s`, or
    if another program answers.
    """
    match _ask("version", host, port, timeout_s):
        case [[1, str(version)]]:
            return version
    return None


def ask_episode(host: str, port: int, timeout_s: float) -> int | None:
    """Return the number of the server's episode, which a new world changes; None if it answers in another form.

    Raises `NoServerError` as `ask_version` does.
    """
    match _ask("get_episode_info", host, port, timeout_s):
        case [[1, [int(episode), *_]]]:
            return episode
    return None


def _ask(method: str, host: str, port: int, timeout_s: float) -> Any:
    """Return the result of a method without arguments."""
    request = msgspec.msgpack.encode([0, 1, method, [[False]]])
    try:
        with socket.create_connection((host, port), timeout_s) as connection:
            connection.sendall(request)
            return _read_answer(connection)[3]
    except TimeoutError:
        raise NoServerError(f"no answer came within {timeout_s:g} s") from None
    except ConnectionRefusedError:
        raise NoServerError("no program listens there") from None
    except (socket.gaierror, UnicodeError):  # the latter: a name that is too long, or has an empty part
        raise NoServerError("the host is unknown") from None
    except ConnectionError:
        raise NoServerError("the connection was closed") from None
    except OSError as error:
        raise NoServerError(f"the machine cannot be reached ({error.strerror})") from None


def _read_answer(connection: socket.socket) -> list[Any]:
    """Return the items of the answer, which has four."""
    data = b""
    for _ in range(MAX_PARTS):
        part = connection.recv(MAX_ANSWER_BYTES)
        data += part
        try:
            answer = msgspec.msgpack.decode(data)
        except (msgspec.DecodeError, UnicodeDecodeError, RecursionError):  # incomplete, or no msgpack
            answer = None
        match answer:
            case [int(kind), _, _, _] if kind == ANSWER:
                return list(answer)
        if not part or answer is not None or len(data) > MAX_ANSWER_BYTES or not _may_begin_answer(data):
            break
    raise NoServerError("another program answers")


def _may_begin_answer(data: bytes) -> bool:
    """Return whether data begin as a list of four items."""
    return data[0] == 0x94 or data[0] in {0xDC, 0xDD}
