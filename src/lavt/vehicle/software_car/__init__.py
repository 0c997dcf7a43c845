"""The software car: an emulator of a by-wire kit whose wheels are the built-in simulator's.

It shares nothing with the adapter that drives it: its bits are packed here once more, from the facts alone, so that a
misreading on either side shows.
"""
