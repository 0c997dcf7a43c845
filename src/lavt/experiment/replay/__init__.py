"""Replays of finished runs: videos made from their records."""
