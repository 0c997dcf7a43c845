"""The sources of random epochs, tokens and stream identifiers, and the seeds of runs."""

from __future__ import annotations

import secrets
from typing import Protocol

from lavt.streams import stream, stream_key


class Entropy(Protocol):
    """A source of random epochs, tokens and stream identifiers."""

    def number(self, bits: int) -> int:
        """Return a random number of `bits` bits."""
        ...

    def token(self, length: int) -> bytes:
        """Return `length` random bytes."""
        ...


class MachineEntropy:
    """The operating system's source of randomness."""

    def number(self, bits: int) -> int:
        """Return a random number of `bits` bits."""
        return secrets.randbits(bits)

    def token(self, length: int) -> bytes:
        """Return `length` random bytes."""
        return secrets.token_bytes(length)


class SeededEntropy:
    """A reproducible source for virtual time, where no attacker could exploit predictable numbers."""

    def __init__(self, seed: int, name: str) -> None:
        self._generator = stream(seed, f"{name} entropy")

    def number(self, bits: int) -> int:
        """Return a random number of `bits` bits."""
        return int.from_bytes(self.token(bits // 8), "little")

    def token(self, length: int) -> bytes:
        """Return `length` random bytes."""
        return self._generator.bytes(length)


def participant_seed(seed: int, participant: int) -> int:
    """Return the seed of all runs of one participant of a study; it has 53 bits, as `run_seed` has."""
    return stream_key(seed, f"participant {participant}") & (2**53 - 1)


def run_seed(seed: int, route: str, repetition: int) -> int:
    """Return the seed of one repetition on a route.

    The seed does not depend on the condition, so that runs under different conditions can be compared in pairs. It has
    53 bits, the largest integer size that all JSON readers support.
    """
    return stream_key(seed, f"run {route} {repetition}") & (2**53 - 1)
