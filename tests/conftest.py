"""What all tests share: what becomes of those that the host stalled."""

pytest_plugins = ["tests.support.inconclusive"]
