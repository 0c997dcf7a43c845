"""Summaries of runs: means with confidence intervals, contrasts between conditions, survival."""
