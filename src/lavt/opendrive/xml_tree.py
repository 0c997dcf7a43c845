"""Read XML files of strangers: no document type (so no entities), and limits on size, depth and number of elements."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import NoReturn
from xml.etree.ElementTree import Element, TreeBuilder
from xml.parsers import expat

from lavt.errors import UserError

MAX_BYTES = 64 * 1024 * 1024
MAX_DEPTH = 32
MAX_ELEMENTS = 2_000_000
MAX_ID_CHARACTERS = 64
INTEGER = re.compile(r"[+-]?[0-9]{1,9}")
MAX_NUMBER = 1e9
"""The largest magnitude of a number. Computations with larger ones could overflow."""


def read_file(path: str) -> bytes:
    """Return the content of a map file; raise UserError if it cannot be read or is too large."""
    try:
        if Path(path).is_fifo():
            raise UserError(f"the map {path} is a pipe: name a file")
        with Path(path).open("rb") as file:
            content = file.read(MAX_BYTES + 1)
    except OSError as error:
        raise UserError(f"the map {path} cannot be read ({error.strerror}): name an existing file") from error
    except ValueError as error:  # a path with a null character
        raise UserError(f"the map {path!r} cannot be read ({error}): name an existing file") from error
    if len(content) > MAX_BYTES:
        raise UserError(f"the map {path} is larger than {MAX_BYTES // 1024 // 1024} MiB: cut out the roads you need")
    return content


def parse_xml(content: bytes, source: str) -> Element:
    """Return the root element of an XML document; raise UserError if it is not one, or exceeds a limit."""
    builder = TreeBuilder()
    depth = elements = 0

    def start(tag: str, attributes: dict[str, str]) -> None:
        nonlocal depth, elements
        depth += 1
        elements += 1
        if depth > MAX_DEPTH:
            raise UserError(f"{source}: elements are nested deeper than {MAX_DEPTH}: this is not an OpenDRIVE map")
        if elements > MAX_ELEMENTS:
            raise UserError(f"{source}: there are more than {MAX_ELEMENTS} elements: cut out the roads you need")
        builder.start(tag, attributes)

    def end(tag: str) -> None:
        nonlocal depth
        depth -= 1
        builder.end(tag)

    def refuse_document_type(*_: object) -> NoReturn:
        raise UserError(f"{source}: the file declares a document type: remove the line <!DOCTYPE ...>")

    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.StartDoctypeDeclHandler = refuse_document_type
    try:
        parser.Parse(content, True)
    except expat.ExpatError as error:
        raise UserError(f"{source} is not well-formed XML ({error}): name an OpenDRIVE file (.xodr)") from error
    except (LookupError, ValueError) as error:  # an encoding that Python does not know, or cannot use here
        raise UserError(f"{source} has an unknown encoding ({str(error)[:80]}): save it as UTF-8") from error
    return builder.close()


def read_id(element: Element, key: str, where: str) -> str:
    """Return an id, which must exist and be fit for messages: printable and not too long."""
    value = read_text(element, key, where)
    if len(value) > MAX_ID_CHARACTERS or not value.isprintable():
        shown = ascii(value[:20])
        raise UserError(
            f"{where}: <{element.tag}> has {key}={shown}...: use at most {MAX_ID_CHARACTERS} printable characters"
        )
    return value


def read_text(element: Element, key: str, where: str) -> str:
    """Return an attribute that must exist."""
    value = element.get(key)
    if value is None:
        raise UserError(f"{where}: <{element.tag}> has no attribute {key}: add it")
    return value


def read_number(element: Element, key: str, where: str, default: float | None = None) -> float:
    """Return an attribute as a finite number; without a default it must exist."""
    text = element.get(key)
    if text is None and default is not None:
        return default
    text = read_text(element, key, where)
    try:
        number = math.nan if "_" in text else float(text)  # Python reads 1_0 as 10, XML does not
    except ValueError:
        number = math.nan
    if not abs(number) <= MAX_NUMBER:
        raise UserError(
            f"{where}: <{element.tag}> has {key}={text[:40]!a}: write a finite number, at most {MAX_NUMBER:.0e}"
        )
    return number


def read_integer(element: Element, key: str, where: str) -> int:
    """Return an attribute that must be a whole number of at most nine digits."""
    text = read_text(element, key, where).strip()
    if not INTEGER.fullmatch(text):
        raise UserError(f"{where}: <{element.tag}> has {key}={text[:40]!a}: write a whole number")
    return int(text)
