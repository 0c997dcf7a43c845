"""The software car: an emulator of a by-wire kit whose wheels are the built-in simulator's.

It shares no code with the adapter that drives it. Its frames are packed independently, from the published sources
(docs/can.md) alone, so that a misreading in either of the two shows.
"""
