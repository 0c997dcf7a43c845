"""LAVT measures what network delay does to driving by video."""

__version__ = "0.1.0"
