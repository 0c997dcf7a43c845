"""Runs, sweeps, what is computed from their records, and the report."""
