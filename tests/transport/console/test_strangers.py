from __future__ import annotations

from collections import Counter

from lavt.transport.console.strangers import MAX_STRANGER_BYTES, MAX_STRANGERS, Strangers


class FakeConnection:
    """A connection that notes its end."""

    is_aborted = False

    def abort(self) -> None:
        """Note the end."""
        self.is_aborted = True


def test_the_oldest_stranger_makes_room() -> None:
    """A connection too many closes the oldest stranger, not itself, and not one that has shown the token."""
    counts: Counter[str] = Counter()
    strangers, connections = Strangers(counts), [FakeConnection() for _ in range(MAX_STRANGERS + 2)]
    for connection in connections[:-1]:
        strangers.add(connection, connection.abort)
        if connection is connections[0]:
            strangers.remove(connection)
    assert not any(connection.is_aborted for connection in connections)
    strangers.add(connections[-1], connections[-1].abort)
    assert [connection for connection in connections if connection.is_aborted] == [connections[1]]
    assert counts == {"connections_too_many": 1}


def test_a_stranger_is_read_up_to_a_limit() -> None:
    """A connection that has sent too much is closed unread; after the token there is no limit."""
    strangers, stranger, page = Strangers(Counter()), FakeConnection(), FakeConnection()
    for connection in (stranger, page):
        strangers.add(connection, connection.abort)
        assert strangers.may_read(connection, MAX_STRANGER_BYTES)
    strangers.remove(page)
    assert strangers.may_read(page, 1)
    assert not strangers.may_read(stranger, 1)
    assert (stranger.is_aborted, page.is_aborted) == (True, False)
