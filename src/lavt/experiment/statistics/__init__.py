"""Statistics over runs: means with confidence intervals, contrasts between conditions, survival."""
