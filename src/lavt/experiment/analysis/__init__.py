"""The analysis of one run's records: clock offset, latencies, lane keeping, validity and `result.json`."""
