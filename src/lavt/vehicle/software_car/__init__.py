"""The software car: an emulated by-wire kit that moves the car of the built-in simulator.

It shares no code with the by-wire adapter, which drives it. Both were written from the published sources (docs/can.md)
alone, so that a misreading in one of them becomes visible.
"""
