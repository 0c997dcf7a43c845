"""Runs, sweeps, the analysis of their records, and the report."""
