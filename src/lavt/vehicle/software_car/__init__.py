"""The software car: an emulator of a by-wire kit whose wheels are the built-in simulator's.

It shares no code with the adapter that drives it: frames are packed here independently, from the facts alone, so that a
misreading on either side shows.
"""
