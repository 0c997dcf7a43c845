"""The kernel's CAN gateway rules (`cangw -L`), which forward frames between interfaces, read through netlink.

Layout: linux/can/gw.h and linux/netlink.h. A kernel without the gateway sends only rules of other families, or none.
"""

from __future__ import annotations

import errno
import os
import socket
import struct
import sys
from collections.abc import Iterator
from typing import Final

RTM_NEWROUTE, RTM_GETROUTE = 24, 26
NLMSG_ERROR, NLMSG_DONE = 2, 3
DUMP_REQUEST: Final = 0x301
"""NLM_F_REQUEST and NLM_F_DUMP."""
CAN_FAMILY, GATEWAY_CAN_TO_CAN = 29, 1
"""PF_CAN and CGW_TYPE_CAN_CAN, the family and the type of the rules."""
SOURCE, DESTINATION = 9, 10
"""CGW_SRC_IF and CGW_DST_IF."""
HEADER, RULE, ATTRIBUTE = struct.Struct("=IHHII"), struct.Struct("=BBH"), struct.Struct("=HH")
TIMEOUT_S = 2.0
MAX_BYTES = 1 << 20


def gateway_interfaces() -> frozenset[int]:
    """Return the indices of the interfaces that are the source or destination of a rule.

    Raises `OSError` if the rules cannot be read.
    """
    found: set[int] = set()
    with socket.socket(socket.AF_NETLINK, socket.SOCK_RAW, socket.NETLINK_ROUTE) as link:
        link.settimeout(TIMEOUT_S)
        link.bind((0, 0))
        request = RULE.pack(CAN_FAMILY, GATEWAY_CAN_TO_CAN, 0)
        link.sendto(HEADER.pack(HEADER.size + len(request), RTM_GETROUTE, DUMP_REQUEST, 1, 0) + request, (0, 0))
        while True:
            data = link.recv(MAX_BYTES)
            if not data:
                raise OSError(errno.EIO, os.strerror(errno.EIO))
            interfaces, is_last = parse_rules(data)
            found |= interfaces
            if is_last:
                return frozenset(found)


def parse_rules(data: bytes) -> tuple[set[int], bool]:
    """Return the indices of the interfaces in a datagram of rules, and whether it is the last datagram.

    Raises `OSError` if the datagram reports an error.
    """
    found: set[int] = set()
    for kind, body in _pieces(data, HEADER):
        if kind == NLMSG_DONE:
            return found, True
        if kind == NLMSG_ERROR:
            (number,) = struct.unpack_from("=i", body)
            raise OSError(-number, os.strerror(-number))
        if kind == RTM_NEWROUTE and body[:1] == bytes([CAN_FAMILY]):
            attributes = dict(_pieces(body[RULE.size :], ATTRIBUTE))
            found |= {
                int.from_bytes(attributes[attribute][:4], sys.byteorder)
                for attribute in (SOURCE, DESTINATION)
                if attribute in attributes
            }
    return found, False


def _pieces(data: bytes, header: struct.Struct) -> Iterator[tuple[int, bytes]]:
    """Yield type and body of netlink messages or attributes. Each begins at a multiple of 4, with length and type."""
    while len(data) >= header.size:
        length, kind = header.unpack_from(data)[:2]
        if not header.size <= length <= len(data):
            raise OSError(errno.EBADMSG, os.strerror(errno.EBADMSG))
        yield kind, data[header.size : length]
        data = data[(length + 3) & ~3 :]
