"""Former names of what `tests/support` has, for tests that still use them."""

from tests.support import inconclusive, stalls

HeldUp = stalls.HostStalled
again_where_held_up = inconclusive.AGAIN
