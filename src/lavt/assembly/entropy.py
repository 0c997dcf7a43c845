"""Where epochs, tokens, stream identifiers and the seeds of runs come from."""

from __future__ import annotations

import secrets
from typing import Protocol

from lavt.streams import stream, stream_key


class Entropy(Protocol):
    """Where epochs, tokens and stream identifiers come from."""

    def number(self, bits: int) -> int:
        """Give a number of so many random bits."""
        ...

    def token(self, length: int) -> bytes:
        """Give so many random bytes."""
        ...


class MachineEntropy:
    """The operating system's randomness."""

    def number(self, bits: int) -> int:
        """Give a number of so many random bits."""
        return secrets.randbits(bits)

    def token(self, length: int) -> bytes:
        """Give so many random bytes."""
        return secrets.token_bytes(length)


class SeededEntropy:
    """Numbers that repeat with the seed: for virtual time, where nobody is kept out."""

    def __init__(self, seed: int, name: str) -> None:
        self._generator = stream(seed, f"{name} entropy")

    def number(self, bits: int) -> int:
        """Give a number of so many random bits."""
        return int.from_bytes(self.token(bits // 8), "little")

    def token(self, length: int) -> bytes:
        """Give so many random bytes."""
        return self._generator.bytes(length)


def run_seed(seed: int, route: str, repetition: int) -> int:
    """Seed of one repetition on a route: the same under every condition, so that conditions are paired.

    53 bits, because that is as far as JSON's readers agree on numbers.
    """
    return stream_key(seed, f"run {route} {repetition}") & (2**53 - 1)
