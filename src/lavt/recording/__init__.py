"""Records of runs (MCAP), their tables and provenance, and the live status of a side."""
