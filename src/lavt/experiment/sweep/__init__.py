"""Sweeps: many runs on one machine or on a cluster, with summary and report."""
