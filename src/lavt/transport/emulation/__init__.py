"""Emulated links: delay, jitter and loss in process, recorded traces and the relay."""
